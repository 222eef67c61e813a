"""Fonts of the system for characters that matplotlib's own font lacks, as in instructions in Chinese or Japanese."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path

from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties, findfont, findSystemFonts, fontManager
from matplotlib.ft2font import FT2Font
from matplotlib.text import Text
from PIL import ImageFont

log = logging.getLogger(__name__)


def use_fonts(figure: Figure) -> None:
    """Let the texts of a figure fall back on fonts of the system for what their own font lacks.

    If no font has a character, a box is drawn in its place, and one sentence says so.
    """
    lacking = {text: missing for text in figure.findobj(Text) if (missing := _missing(text))}
    families = [_registered(file) for file in fonts_with(frozenset[str]().union(*lacking.values()))]
    for text in lacking:
        text.set_fontfamily([*text.get_fontfamily(), *families])


def image_fonts(texts: Sequence[str], size: int) -> list[ImageFont.ImageFont | ImageFont.FreeTypeFont]:
    """Return a font of Pillow of `size` [px] for each text: its own, or one of the system that has most of the text."""
    files, own = fonts_with(_special("".join(texts))), ImageFont.load_default(size)
    found = list[ImageFont.ImageFont | ImageFont.FreeTypeFont]()
    for characters in map(_special, texts):
        best = max(files, key=lambda file: len(_in_font(file, characters)), default=None)
        found.append(ImageFont.truetype(best, size) if best and characters else own)
    return found


@contextmanager
def without_glyph_warnings() -> Iterator[None]:
    """Silence matplotlib, which warns of every single character that a font lacks."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", r"Glyph \d+ .*missing from")
        yield


@cache
def fonts_with(characters: frozenset[str]) -> list[str]:
    """Return the files of as few fonts as have the characters together, the one with most of them first."""
    chosen, missing = list[str](), set(characters)
    files = {*findSystemFonts(), findfont(FontProperties())} if missing else ()
    fonts = {file: _in_font(file, characters) for file in sorted(files, key=_is_styled)}  # upright ones first
    while missing:
        best = max(fonts, key=lambda file: len(fonts[file] & missing))
        if not fonts[best] & missing:
            _say_missing()
            break
        chosen.append(best)
        missing -= fonts[best]
    return chosen


def _missing(text: Text) -> frozenset[str]:
    """Return the characters of a text that its font lacks."""
    special = _special(text.get_text())
    return special - _in_font(findfont(text.get_fontproperties()), special) if special else special


def _special(text: str) -> frozenset[str]:
    """Return the characters of a text that leave ink and that not every font has."""
    return frozenset(each for each in text if not each.isascii() and each.isprintable() and not each.isspace())


def _in_font(file: str, characters: frozenset[str]) -> frozenset[str]:
    """Return which of the characters a font has; none if it cannot be read or scaled, or has a box for each of them."""
    try:
        font = FT2Font(file)
    except (OSError, RuntimeError):
        return frozenset()
    drawable = font.scalable and "LastResort" not in Path(file).name
    return frozenset(each for each in characters if drawable and font.get_char_index(ord(each)))


def _is_styled(file: str) -> tuple[bool, str]:
    """Return whether the name of a font's file says that it is bold or slanted, and the name."""
    name = Path(file).stem.lower()
    return any(word in name for word in ("bold", "black", "italic", "oblique", "light", "thin")), name


@cache
def _registered(file: str) -> str:
    """Make a font known to matplotlib, whose own list may be older, and return its family."""
    fontManager.addfont(file)
    return FT2Font(file).family_name


@cache  # said once, however many pictures and texts there are
def _say_missing() -> None:
    log.warning(
        "no font of this machine has some of the characters to be drawn, so pictures show boxes in their place: "
        "install one, such as the package fonts-noto-cjk for Chinese, Japanese and Korean"
    )
