"""Axes about what is seen around the blocks: light, cameras, table, background."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import numpy as np
from annotated_types import Ge, Le

from vla.spec import Array
from vla.tasks.bound import BoundScene
from vla.tasks.randomize.axis import Angle, Length, Shares, rounded
from vla.tasks.scene import LAMP_DISTANCE, SHADOWED, TEXTURE
from vla.types import NonNegativeRange, Share

PATTERNS = ("checks", "stripes", "patches")


class Light:
    """Brightness, colour, direction and place of the lamp."""

    def __init__(self, brightness: NonNegativeRange, tint: Share = 0.0, tilt: Angle = 0.0) -> None:
        """Args: range of brightness 0…1; largest change of each channel; largest change of the direction [rad]."""
        self.brightness, self.tint, self.tilt = brightness, tint, tilt

    def __call__(self, scene: BoundScene, random_state: np.random.RandomState) -> dict[str, Any]:
        """Draw a lamp, far enough away that all of its rays are parallel."""
        diffuse = random_state.uniform(*self.brightness) + random_state.uniform(-self.tint, self.tint, 3)
        direction = scene.model.light_dir[0] + np.append(np.tan(random_state.uniform(-self.tilt, self.tilt, 2)), 0.0)
        scene.model.light_diffuse[0] = diffuse
        scene.model.light_dir[0] = direction / np.linalg.norm(direction)
        scene.model.light_pos[0] = np.array(SHADOWED) - LAMP_DISTANCE * scene.model.light_dir[0]
        return {"diffuse": rounded(diffuse), "direction": rounded(scene.model.light_dir[0])}


class Cameras:
    """Where each camera is, where it looks, and how wide."""

    def __init__(
        self,
        position: Length = 0.0,
        rotation: Angle = 0.0,
        fovy: Annotated[float, Ge(0), Le(30)] = 0.0,
        wrist: Share = 0.25,
    ) -> None:
        """Args: largest change along each axis [m], about each axis [rad], of the field of view [degrees]; the
        share of all three that the wrist camera, which is screwed on, gets."""
        self.position, self.rotation, self.fovy, self.wrist = position, rotation, fovy, wrist

    def __call__(self, scene: BoundScene, random_state: np.random.RandomState) -> dict[str, Any]:
        """Draw a mounting error for each camera."""
        draws = {}
        for name, camera in scene.cameras.items():
            share = self.wrist if name == "wrist" else 1.0
            shift, turn = random_state.uniform(-share, share, 3), random_state.uniform(-share, share, 3)
            zoom = random_state.uniform(-share, share)
            scene.model.cam_pos[camera] += self.position * shift
            scene.model.cam_fovy[camera] += self.fovy * zoom
            scene.turn_camera(camera, self.rotation * turn)
            draws[name] = {
                "position": rounded(self.position * shift),
                "rotation": rounded(self.rotation * turn),
                "fovy": round(self.fovy * zoom, 3),
            }
        return draws


class Table:
    """Colour of the table."""

    def __init__(self, brightness: Shares, tint: Share = 0.0) -> None:
        """Args: range of brightness, 0…1; largest change of each channel."""
        self.brightness, self.tint = brightness, tint

    def __call__(self, scene: BoundScene, random_state: np.random.RandomState) -> dict[str, Any]:
        """Draw a colour."""
        rgb = random_state.uniform(*self.brightness) + random_state.uniform(-self.tint, self.tint, 3)
        scene.model.geom_rgba[scene.model.geom("table").id, :3] = rgb
        return {"rgb": rounded(rgb)}


class Texture:
    """A picture on table or floor, made by chance: checks, stripes or patches in two shades."""

    def __init__(self, surface: Literal["table", "floor"], contrast: Shares) -> None:
        """Args: what it lies on; range of how much darker and differently coloured its second shade is, 0…1."""
        self.surface, self.contrast = surface, contrast

    def __call__(self, scene: BoundScene, random_state: np.random.RandomState) -> dict[str, Any]:
        """Draw a pattern."""
        kind = PATTERNS[random_state.randint(len(PATTERNS))]
        shade = 1 - random_state.uniform(*self.contrast) * random_state.uniform(0, 1, 3)
        where = _pattern(kind, random_state)[:, :, None]  # (H, W, 1) 0…1
        picture = 255 * (1 - where + where * shade)
        scene.paint_texture(self.surface, picture.astype(np.uint8))
        return {"kind": kind, "shade": rounded(shade)}


def _pattern(kind: str, random_state: np.random.RandomState) -> Array:
    """(TEXTURE, TEXTURE) 0…1: where the second shade is."""
    across, along = np.meshgrid(np.arange(TEXTURE), np.arange(TEXTURE))
    if kind == "patches":
        coarse = random_state.uniform(0, 1, (8, 8))
        return np.kron(coarse, np.ones((TEXTURE // 8, TEXTURE // 8)))
    width = int(random_state.choice([4, 8, 16]))
    if kind == "stripes":
        return ((across // width) % 2).astype(float)
    return ((across // width + along // width) % 2).astype(float)


class Background:
    """Colour of everything that is not on the table."""

    def __init__(self, brightness: Shares, tint: Share = 0.0) -> None:
        """Args: range of brightness, 0…1; largest change of each channel."""
        self.brightness, self.tint = brightness, tint

    def __call__(self, scene: BoundScene, random_state: np.random.RandomState) -> dict[str, Any]:
        """Draw a colour of the floor."""
        rgb = random_state.uniform(*self.brightness) + random_state.uniform(-self.tint, self.tint, 3)
        scene.model.geom_rgba[scene.model.geom("floor").id, :3] = np.clip(rgb, 0, 1)
        return {"rgb": rounded(rgb)}
