"""Resets of a world: a contact sheet of their first observations, and a table of what was drawn."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib import colormaps
from PIL import Image, ImageDraw
from rich.markup import escape
from rich.table import Table

from vla.data.episode_filter import flat, leaves
from vla.reports.fonts import image_fonts
from vla.spec import Array, Observation

TILE = 144  # minimum height of an image on a contact sheet [px]
CAPTION = 18  # height of a text line on a contact sheet [px]
LETTERS = 13  # size of its font [px]
WIDEST = 420  # most of a caption beyond its images [px]


def contact_sheet(seeds: Sequence[int], observations: Sequence[Observation], columns: int = 2) -> Image.Image:
    """Draw the first observations of several episodes on one image.

    Each block has a caption with seed and instruction, the colour image of every camera, and its depth image, from near
    (blue) to far (red) in one range for all blocks. Images are enlarged without interpolation.
    """
    turbo = colormaps["turbo"]
    ranges = {name: _depth_range([each.depth[name] for each in observations]) for name in observations[0].depth}
    blocks = []
    for each in observations:
        depth = [turbo(np.clip((each.depth[name] - low) / (high - low), 0, 1)) for name, (low, high) in ranges.items()]
        tiles = [*each.rgb.values(), *((255 * shades[..., :3]).astype(np.uint8) for shades in depth)]
        factor = max(1, -(-TILE // len(tiles[0])))
        enlarged = [tile.repeat(factor, 0).repeat(factor, 1) for tile in tiles]
        framed = [np.pad(tile, ((0, 4), (0, 4), (0, 0)), constant_values=255) for tile in enlarged]
        blocks.append(np.concatenate(framed, axis=1))
    captions = [f"seed {seed}: {each.instruction}" for seed, each in zip(seeds, observations, strict=True)]
    fonts = image_fonts(captions, LETTERS)
    lengths = [font.getlength(caption) for font, caption in zip(fonts, captions, strict=True)]
    room = max(blocks[0].shape[1], min(WIDEST, int(max(lengths)) + 1))
    height, width = blocks[0].shape[0] + CAPTION, room + CAPTION
    columns = min(columns, len(blocks))
    rows = -(-len(blocks) // columns)
    sheet = Image.new("RGB", (columns * width + CAPTION, rows * (height + CAPTION // 2) + 2 * CAPTION), "white")
    draw = ImageDraw.Draw(sheet)
    for index, (caption, font, block) in enumerate(zip(captions, fonts, blocks, strict=True)):
        left, top = CAPTION + index % columns * width, CAPTION // 2 + index // columns * (height + CAPTION // 2)
        strip = Image.new("RGB", (room, CAPTION), "white")  # cuts off what is longer
        ImageDraw.Draw(strip).text((0, 0), caption, fill="black", font=font)
        sheet.paste(strip, (left, top))
        sheet.paste(Image.fromarray(block), (left, top + CAPTION))
    legend = [f"{name} depth {low / 1000:.2f}-{high / 1000:.2f} m" for name, (low, high) in ranges.items()]
    names = "from left to right: " + ", ".join([f"{name} colour" for name in observations[0].rgb] + legend)
    (font,) = image_fonts([names], LETTERS)
    draw.text((CAPTION, sheet.height - CAPTION - 4), names, fill="black", font=font)
    return sheet


def _depth_range(images: Sequence[Array]) -> tuple[float, float]:
    """Return a near and a far percentile [mm] of the pixels with a return."""
    depth = np.stack(images)
    low, high = np.percentile(depth[depth > 0], (1, 90)) if depth.any() else (0.0, 1.0)
    return float(low), float(max(high, low + 1.0))


def draws_table(seeds: Sequence[int], draws: Sequence[Mapping[str, Any]]) -> Table:
    """Tabulate the draws of several resets: range of numbers or set of words, and the values of the first reset."""
    table = Table("draw", "range", f"seed {seeds[0]}", title=f"{len(draws)} resets")
    first = flat(draws[0])
    for name, span in spans(draws).items():
        values = [f"{leaf:.3g}" if isinstance(leaf, float) else str(leaf) for leaf in leaves(first.get(name))]
        table.add_row(*map(escape, (name, span, " ".join(values))))
    return table


def spans(draws: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    """Return dotted name → range of the numbers, or set of the words, drawn under that name."""
    drawn: dict[str, list[Any]] = {}
    for draw in draws:
        for name, value in flat(draw).items():
            drawn.setdefault(name, []).extend(leaves(value))
    return {
        name: f"{min(values):.4g} … {max(values):.4g}"
        if values and all(isinstance(value, (int, float)) for value in values)
        else ", ".join(sorted({str(value) for value in values}))
        for name, values in drawn.items()
    }
