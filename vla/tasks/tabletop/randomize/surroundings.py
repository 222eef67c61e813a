"""Randomizers of the surroundings: light, cameras, table and background."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from annotated_types import Ge, Le

from vla.io.types import NonNegativeRange, Share
from vla.spec import Array
from vla.tasks.tabletop.compiled_scene import CompiledScene
from vla.tasks.tabletop.randomize.randomizer import Angle, Length, Shares, round_values
from vla.tasks.tabletop.scene import LAMP_DISTANCE, SHADOWED, TEXTURE

PATTERNS = ("checks", "stripes", "patches")


@dataclass(frozen=True)
class Light:
    """Brightness, colour and direction of the lamp."""

    brightness: NonNegativeRange | None  # range of brightness, 1: white; or None for the nominal one
    tint: Share  # maximum change of each channel
    tilt: Angle  # maximum tilt about both horizontal axes, as for a lamp straight above [rad]

    def __call__(self, scene: CompiledScene, random_state: np.random.RandomState) -> dict[str, Any]:
        """Draw the properties of the directional lamp."""
        nominal = scene.model.light_diffuse[0]
        brightness = nominal if self.brightness is None else random_state.uniform(*self.brightness)
        diffuse = np.maximum(0.0, brightness + random_state.uniform(-self.tint, self.tint, 3))
        direction = scene.model.light_dir[0] + np.append(np.tan(random_state.uniform(-self.tilt, self.tilt, 2)), 0.0)
        scene.model.light_diffuse[0] = diffuse
        scene.model.light_dir[0] = direction / np.linalg.norm(direction)
        scene.model.light_pos[0] = np.array(SHADOWED) - LAMP_DISTANCE * scene.model.light_dir[0]
        return {"diffuse": round_values(diffuse), "direction": round_values(scene.model.light_dir[0])}


@dataclass(frozen=True)
class Cameras:
    """Position, orientation and field of view of each camera."""

    position: Length  # maximum shift along each axis [m]
    rotation: Angle  # maximum rotation about each axis [rad]
    fovy: Annotated[float, Ge(0), Le(30)]  # maximum change of the field of view [degrees]
    wrist: Share  # factor on all three for the wrist camera, which is mounted rigidly

    def __call__(self, scene: CompiledScene, random_state: np.random.RandomState) -> dict[str, Any]:
        """Draw a mounting error per camera."""
        draws = {}
        for name, camera in scene.cameras.items():
            share = self.wrist if name == "wrist" else 1.0
            shift, turn = random_state.uniform(-share, share, 3), random_state.uniform(-share, share, 3)
            zoom = random_state.uniform(-share, share)
            scene.model.cam_pos[camera] += self.position * shift
            scene.model.cam_fovy[camera] += self.fovy * zoom
            scene.turn_camera(camera, self.rotation * turn)
            draws[name] = {
                "position": round_values(self.position * shift),
                "rotation": round_values(self.rotation * turn),
                "fovy": round(self.fovy * zoom, 3),
            }
        return draws


@dataclass(frozen=True)
class Colour:
    """Colour of a surface."""

    surface: ClassVar[str]
    brightness: Shares  # range of brightness, 0…1
    tint: Share  # maximum change of each channel

    def __call__(self, scene: CompiledScene, random_state: np.random.RandomState) -> dict[str, Any]:
        """Draw a colour, which the tint may move beyond 0…1; the surface shows the nearest one within."""
        rgb = random_state.uniform(*self.brightness) + random_state.uniform(-self.tint, self.tint, 3)
        scene.model.geom_rgba[scene.model.geom(self.surface).id, :3] = np.clip(rgb, 0, 1)
        return {"rgb": round_values(rgb)}


class Table(Colour):
    """Colour of the table."""

    surface = "table"


class Background(Colour):
    """Colour of the floor around the table."""

    surface = "floor"


@dataclass(frozen=True)
class Texture:
    """Random texture on table or floor: checks, stripes or patches in two shades."""

    surface: Literal["table", "floor"]
    contrast: Shares  # range of the contrast of the second shade, 0…1

    def __call__(self, scene: CompiledScene, random_state: np.random.RandomState) -> dict[str, Any]:
        """Draw a pattern."""
        kind = PATTERNS[random_state.randint(len(PATTERNS))]
        shade = 1 - random_state.uniform(*self.contrast) * random_state.uniform(0, 1, 3)
        weights = _pattern(kind, random_state)[:, :, None]  # (H, W, 1) 0…1
        picture = 255 * (1 - weights + weights * shade)
        scene.paint_texture(self.surface, picture.astype(np.uint8))
        return {"kind": kind, "shade": round_values(shade)}


def _pattern(kind: str, random_state: np.random.RandomState) -> Array:
    """Draw (TEXTURE, TEXTURE) 0…1, the weight of the second shade."""
    columns, rows = np.meshgrid(np.arange(TEXTURE), np.arange(TEXTURE))
    if kind == "patches":
        cells = random_state.uniform(0, 1, (8, 8))
        return np.kron(cells, np.ones((TEXTURE // 8, TEXTURE // 8)))
    width = int(random_state.choice([4, 8, 16]))
    if kind == "stripes":
        return ((columns // width) % 2).astype(float)
    return ((columns // width + rows // width) % 2).astype(float)
