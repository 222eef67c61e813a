"""Randomizers of blocks and pads: number, colour, size, shape, mass, friction and placement."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import dist
from typing import Annotated, Any, Literal

import numpy as np
from annotated_types import Ge, Le, MinLen, Predicate

from vla.io.errors import UserError
from vla.io.types import CountRange, NonNegative, PositiveRange, Share, ascending, unique
from vla.tasks.tabletop.compiled_scene import CompiledScene
from vla.tasks.tabletop.randomize.randomizer import Angles, Places, round_values
from vla.tasks.tabletop.scene import COLOURS, PAD_RADIUS, PADS, ColourName

ShapeName = Literal["cube", "cylinder", "tall", "flat"]
SHAPES = {"cube": 1.0, "cylinder": 1.0, "tall": 1.25, "flat": 0.75}  # name → height over width
HalfSize = Annotated[float, Ge(0.005), Le(0.034)]  # for the Panda's gripper and the default clearance [m]
HalfSizes = Annotated[tuple[HalfSize, HalfSize], Predicate(ascending)]
ColourNames = Annotated[Sequence[ColourName], MinLen(1), Predicate(unique)]
ROOM = 0.034  # radius reserved for a block: half the diagonal of the largest one of the default sizes [m]


@dataclass(frozen=True)
class Distractors:
    """Number of blocks besides the first named one."""

    count: CountRange  # minimum and maximum number

    def __call__(self, scene: CompiledScene, random_state: np.random.RandomState) -> dict[str, Any]:
        """Draw the number; other axes draw for every block, so their draws do not depend on it."""
        low, high = self.count
        if high >= len(scene.block_geoms):
            raise UserError(f"task.randomize.distractors.count={[low, high]} needs task.blocks={high + 1} or more")
        count = int(random_state.randint(low, high + 1))
        scene.present = count + 1
        return {"count": count}


@dataclass(frozen=True)
class Colours:
    """Colour of each block: distinct names from a list, each with a random tint."""

    names: ColourNames  # to draw from without replacement
    jitter: Share  # maximum change of each channel, 0…1

    def __call__(self, scene: CompiledScene, random_state: np.random.RandomState) -> dict[str, Any]:
        """Draw names and tints."""
        count = len(scene.block_geoms)
        if count > len(self.names):
            raise UserError(f"task.blocks={count} needs as many task.randomize.colour.names, not {len(self.names)}")
        names = [self.names[index] for index in random_state.permutation(len(self.names))[:count]]
        tint = random_state.uniform(-self.jitter, self.jitter, (count, 3))
        rgb = np.clip([COLOURS[name] for name in names] + tint, 0, 1)
        scene.paint_blocks(names, rgb)
        return {"names": names, "rgb": round_values(rgb)}


@dataclass(frozen=True)
class Sizes:
    """Size of each block."""

    half_size: HalfSizes  # range of half the edge length [m]

    def __call__(self, scene: CompiledScene, random_state: np.random.RandomState) -> dict[str, Any]:
        """Draw each block's size; its mass follows from its density."""
        sizes = random_state.uniform(*self.half_size, len(scene.block_geoms))
        for index, half_size in enumerate(sizes):
            scene.set_block(index, np.full(3, half_size))
        return {"half_size": round_values(sizes)}


@dataclass(frozen=True)
class Shapes:
    """Shape of each block, applied after the size."""

    names: Annotated[Sequence[ShapeName], MinLen(1)]  # to draw from

    def __call__(self, scene: CompiledScene, random_state: np.random.RandomState) -> dict[str, Any]:
        """Draw a shape per block."""
        names = [str(name) for name in random_state.choice(self.names, len(scene.block_geoms))]
        for index, name in enumerate(names):
            scene.set_block(index, scene.extents[index] * (1, 1, SHAPES[name]), round=name == "cylinder")
        return {"names": names}


@dataclass(frozen=True)
class Masses:
    """Mass of each block, independent of its size."""

    factor: PositiveRange  # range of the factor on the density

    def __call__(self, scene: CompiledScene, random_state: np.random.RandomState) -> dict[str, Any]:
        """Draw a factor per block."""
        factors = random_state.uniform(*self.factor, len(scene.block_geoms))
        scene.scale_density(factors)
        return {"factor": round_values(factors)}


@dataclass(frozen=True)
class Friction:
    """Sliding friction of blocks and table."""

    sliding: PositiveRange  # range of the sliding coefficient

    def __call__(self, scene: CompiledScene, random_state: np.random.RandomState) -> dict[str, Any]:
        """Draw a coefficient per block; MuJoCo uses the larger one of a contact, so the table gets the minimum."""
        sliding = random_state.uniform(*self.sliding, len(scene.block_geoms))
        scene.model.geom_friction[scene.block_geoms, 0] = sliding
        scene.model.geom_friction[scene.model.geom("table").id, 0] = sliding.min()
        return {"sliding": round_values(sliding)}


@dataclass(frozen=True)
class Placement:
    """Placement of pads and blocks: uniform in a rectangle, without overlap."""

    x: Places  # range of the centres [m]
    y: Places
    yaw: Angles  # range of the blocks' yaw [rad]
    clearance: NonNegative  # minimum gap between outlines [m]

    def __call__(self, scene: CompiledScene, random_state: np.random.RandomState) -> dict[str, Any]:
        """Draw a place for every pad and block in turn, also absent ones (UserError: the rectangle is too small)."""
        count = len(scene.block_geoms)
        # Equal room for every block, so that this draw is independent of sizes, shapes and distractors.
        radii = [PAD_RADIUS, *[ROOM] * count, *[PAD_RADIUS] * (len(PADS) - 1)]
        for _ in range(200):
            centres = self._scatter(radii, random_state)
            if len(centres) == len(radii):
                break
        else:
            raise UserError(
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
            "pad": round_values(np.array(pads[0])),
            "pads": round_values(np.array(pads)),
            "blocks": round_values(np.array(blocks)),
            "yaw": round_values(yaws),
        }

    def _scatter(self, radii: Sequence[float], random_state: np.random.RandomState) -> list[tuple[float, float]]:
        """Sample centres x, y of disjoint discs by rejection; fewer than `radii` if a disc finds no room."""
        centres: list[tuple[float, float]] = []
        for radius in radii:
            for _ in range(100):
                centre = random_state.uniform(*self.x), random_state.uniform(*self.y)
                gaps = (dist(centre, other) - other_radius for other, other_radius in zip(centres, radii, strict=False))
                if all(gap > radius + self.clearance for gap in gaps):
                    centres.append(centre)
                    break
            else:
                return centres
        return centres
