"""Axes about blocks and pads: how many, which colour, size, shape, mass and friction, and where they lie."""

from __future__ import annotations

from collections.abc import Sequence
from math import dist
from typing import Annotated, Any

import numpy as np
from annotated_types import Ge, Le, MinLen, Predicate

from vla.tasks.bound import BoundScene
from vla.tasks.randomize.axis import Angles, Places, rounded
from vla.tasks.scene import COLOURS, PAD_RADIUS, PADS
from vla.types import CountRange, NonNegative, PositiveRange, Share, ascending, unique

SHAPES = {"cube": 1.0, "cylinder": 1.0, "tall": 1.25, "flat": 0.75}  # name → height over width
HalfSize = Annotated[float, Ge(0.005), Le(0.04)]  # [m], what the gripper can hold
HalfSizes = Annotated[tuple[HalfSize, HalfSize], Predicate(ascending)]
ColourNames = Annotated[Sequence[str], MinLen(1), Predicate(unique)]
ROOM = 0.034  # of a block on the table: half the diagonal of the largest one that there usually is [m]


class Distractors:
    """How many other blocks lie beside the first one that is named."""

    def __init__(self, count: CountRange) -> None:
        """Args: fewest and most; at least one, or the block would need no name."""
        self.count = count

    def __call__(self, scene: BoundScene, random_state: np.random.RandomState) -> dict[str, Any]:
        """Draw how many; all other axes draw for every block, so that this one changes none of theirs."""
        low, high = self.count
        if high >= len(scene.block_geoms):
            raise ValueError(f"{high} distractors need task.blocks={high + 1}, it is {len(scene.block_geoms)}")
        count = int(random_state.randint(low, high + 1))
        scene.present = count + 1
        return {"count": count}


class Colours:
    """Which colour each block has: different names from a list, and a tint of each."""

    def __init__(self, names: ColourNames, jitter: Share = 0.0) -> None:
        """Args: names to draw from without repetition; largest change of each channel, 0…1.

        Raises:
            ValueError: an unknown colour.
        """
        unknown = sorted(set(names) - set(COLOURS))
        if unknown:
            raise ValueError(f"unknown colours {unknown}; there are {sorted(COLOURS)}")
        self.names, self.jitter = tuple(names), jitter

    def __call__(self, scene: BoundScene, random_state: np.random.RandomState) -> dict[str, Any]:
        """Draw names and tints."""
        count = len(scene.block_geoms)
        if count > len(self.names):
            raise ValueError(f"{count} blocks need as many colours, but the colour axis lists {list(self.names)}")
        names = [self.names[index] for index in random_state.permutation(len(self.names))[:count]]
        tint = random_state.uniform(-self.jitter, self.jitter, (count, 3))
        rgb = np.clip([COLOURS[name] for name in names] + tint, 0, 1)
        scene.paint_blocks(names, rgb)
        return {"names": names, "rgb": rounded(rgb)}


class Sizes:
    """Size of each block."""

    def __init__(self, half_size: HalfSizes) -> None:
        """Args: range of half the edge [m]."""
        self.half_size = half_size

    def __call__(self, scene: BoundScene, random_state: np.random.RandomState) -> dict[str, Any]:
        """Draw each block's size; its mass follows, as for the same wood."""
        sizes = random_state.uniform(*self.half_size, len(scene.block_geoms))
        for index, half_size in enumerate(sizes):
            scene.set_block(index, np.full(3, half_size))
        return {"half_size": rounded(sizes)}


class Shapes:
    """Shape of each block; it applies after the size."""

    def __init__(self, names: Annotated[Sequence[str], MinLen(1)]) -> None:
        """Args: names to draw from, evenly.

        Raises:
            ValueError: an unknown shape.
        """
        unknown = sorted(set(names) - set(SHAPES))
        if unknown:
            raise ValueError(f"unknown shapes {unknown}; there are {sorted(SHAPES)}")
        self.names = tuple(names)

    def __call__(self, scene: BoundScene, random_state: np.random.RandomState) -> dict[str, Any]:
        """Draw a shape for each."""
        names = [str(name) for name in random_state.choice(self.names, len(scene.block_geoms))]
        for index, name in enumerate(names):
            scene.set_block(index, scene.extents[index] * (1, 1, SHAPES[name]), round=name == "cylinder")
        return {"names": names}


class Masses:
    """Mass of each block, apart from its size."""

    def __init__(self, factor: PositiveRange) -> None:
        """Args: range of the factor on the mass that follows from size and density."""
        self.factor = factor

    def __call__(self, scene: BoundScene, random_state: np.random.RandomState) -> dict[str, Any]:
        """Draw a factor per block."""
        factors = random_state.uniform(*self.factor, len(scene.block_geoms))
        scene.scale_density(factors)
        return {"factor": rounded(factors)}


class Friction:
    """Sliding friction of blocks and table."""

    def __init__(self, sliding: PositiveRange) -> None:
        """Args: range of the sliding coefficient."""
        self.sliding = sliding

    def __call__(self, scene: BoundScene, random_state: np.random.RandomState) -> dict[str, Any]:
        """Draw one coefficient per block; MuJoCo takes the larger of two surfaces', so the table gets the least."""
        sliding = random_state.uniform(*self.sliding, len(scene.block_geoms))
        scene.model.geom_friction[scene.block_geoms, 0] = sliding
        scene.model.geom_friction[scene.model.geom("table").id, 0] = sliding.min()
        return {"sliding": rounded(sliding)}


class Placement:
    """Where pads and blocks lie: evenly in a rectangle, apart from each other."""

    def __init__(self, x: Places, y: Places, yaw: Angles = (0.0, 0.0), clearance: NonNegative = 0.03) -> None:
        """Args: ranges of centres [m] and block yaw [rad]; least gap between outlines [m]."""
        self.x, self.y, self.yaw, self.clearance = x, y, yaw, clearance

    def __call__(self, scene: BoundScene, random_state: np.random.RandomState) -> dict[str, Any]:
        """Draw a place for everything, whether it will be there or not, one after the other.

        Raises:
            ValueError: the rectangle is too small for this many things.
        """
        count = len(scene.block_geoms)
        # The same room for every block, so that this draw does not depend on those of sizes, shapes and distractors.
        radii = [PAD_RADIUS, *[ROOM] * count, *[PAD_RADIUS] * (len(PADS) - 1)]
        for _ in range(200):
            centres = self._scattered(radii, random_state)
            if len(centres) == len(radii):
                break
        else:
            raise ValueError(
                f"no room for {len(PADS)} pads and {count} blocks {self.clearance} m apart in x {self.x}, y {self.y}; "
                "widen task.randomize.placement or lower its clearance"
            )
        yaws = random_state.uniform(*self.yaw, count)
        pads, blocks = [centres[0], *centres[count + 1 :]], centres[1 : count + 1]
        for pad, (x, y) in enumerate(pads):
            scene.place_pad(pad, x, y)
        for index, (x, y) in enumerate(blocks):
            scene.place_block(index, x, y, yaws[index])
        return {
            "pad": rounded(np.array(pads[0])),
            "pads": rounded(np.array(pads)),
            "blocks": rounded(np.array(blocks)),
            "yaw": rounded(yaws),
        }

    def _scattered(self, radii: Sequence[float], random_state: np.random.RandomState) -> list[tuple[float, float]]:
        """Centres x, y of discs that lie apart; fewer where the next one found no room."""
        centres: list[tuple[float, float]] = []
        for radius in radii:
            for _ in range(100):
                centre = random_state.uniform(*self.x), random_state.uniform(*self.y)
                apart = (dist(centre, other) - near for other, near in zip(centres, radii, strict=False))
                if all(gap > radius + self.clearance for gap in apart):
                    centres.append(centre)
                    break
            else:
                return centres
        return centres
