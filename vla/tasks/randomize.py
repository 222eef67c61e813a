"""Domain randomisation: one class per axis, each with its own switch and its own random stream.

An axis is called once per reset with the bound scene and a stream that depends on the episode's seed and the axis'
name alone, so switching one axis off or changing it leaves what all others draw untouched. It writes into the compiled
model, which was put back to its nominal state, and returns what it drew. Ranges are [low, high], drawn evenly. Axes
are called in the order of the configuration; `null` in place of an axis switches it off.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol
from zlib import crc32

import numpy as np

from vla.spec import Array
from vla.tasks.bound import BoundScene
from vla.tasks.control import DOWN, HOME, MAX_OPENING, rotation_z, solve
from vla.tasks.scene import COLOURS, PAD_RADIUS

Range = tuple[float, float]  # low, high


class Axis(Protocol):
    """One thing that differs between episodes."""

    def __call__(self, scene: BoundScene, random_state: np.random.RandomState) -> dict[str, Any]:
        """Write a draw into the compiled model or the state; returns it as plain numbers, lists and strings."""
        ...


def stream(seed: int, axis: str) -> np.random.RandomState:
    """The random stream of one axis in one episode."""
    return np.random.RandomState(np.random.SeedSequence([seed, crc32(axis.encode())]).generate_state(8))


def _rounded(values: Array) -> list[Any]:
    return np.round(values, 5).tolist()


class Colours:
    """Which colour each block has: different names from a list, and a tint of each."""

    def __init__(self, names: Sequence[str], jitter: float = 0.0) -> None:
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
        return {"names": names, "rgb": _rounded(rgb)}


class Sizes:
    """Size of each block."""

    def __init__(self, half_size: Range) -> None:
        """Args: range of half the edge [m]."""
        self.half_size = half_size

    def __call__(self, scene: BoundScene, random_state: np.random.RandomState) -> dict[str, Any]:
        """Draw each block's size; its mass follows, as for the same wood."""
        sizes = random_state.uniform(*self.half_size, len(scene.block_geoms))
        for index, half_size in enumerate(sizes):
            scene.set_block(index, half_size)
        return {"half_size": _rounded(sizes)}


class Masses:
    """Mass of each block, apart from its size."""

    def __init__(self, factor: Range) -> None:
        """Args: range of the factor on the mass that follows from size and density."""
        self.factor = factor

    def __call__(self, scene: BoundScene, random_state: np.random.RandomState) -> dict[str, Any]:
        """Draw a factor per block."""
        factors = random_state.uniform(*self.factor, len(scene.block_geoms))
        scene.model.body_mass[scene.block_bodies] *= factors
        scene.model.body_inertia[scene.block_bodies] *= factors[:, None]
        return {"factor": _rounded(factors)}


class Friction:
    """Sliding friction of blocks and table."""

    def __init__(self, sliding: Range) -> None:
        """Args: range of the sliding coefficient."""
        self.sliding = sliding

    def __call__(self, scene: BoundScene, random_state: np.random.RandomState) -> dict[str, Any]:
        """Draw one coefficient per block; MuJoCo takes the larger of two surfaces', so the table gets the least."""
        sliding = random_state.uniform(*self.sliding, len(scene.block_geoms))
        scene.model.geom_friction[scene.block_geoms, 0] = sliding
        scene.model.geom_friction[scene.model.geom("table").id, 0] = sliding.min()
        return {"sliding": _rounded(sliding)}


class Placement:
    """Where pad and blocks lie: evenly in a rectangle, apart from each other."""

    def __init__(self, x: Range, y: Range, yaw: Range = (0.0, 0.0), clearance: float = 0.03) -> None:
        """Args: ranges of centres [m] and block yaw [rad]; least gap between outlines [m]."""
        self.x, self.y, self.yaw, self.clearance = x, y, yaw, clearance

    def __call__(self, scene: BoundScene, random_state: np.random.RandomState) -> dict[str, Any]:
        """Draw until nothing is too close.

        Raises:
            ValueError: the rectangle is too small for this many things.
        """
        count = len(scene.block_geoms)
        # A gripper needs room around a block whatever its yaw, hence the circle around its outline.
        radii = [PAD_RADIUS, *(np.sqrt(2) * scene.model.geom_size[scene.block_geoms, 0])]
        for _ in range(2000):
            centres = np.stack(
                [random_state.uniform(*self.x, count + 1), random_state.uniform(*self.y, count + 1)], axis=1
            )
            gaps = [
                np.linalg.norm(centres[a] - centres[b]) - radii[a] - radii[b]
                for a in range(count + 1)
                for b in range(a)
            ]
            if min(gaps) > self.clearance:
                break
        else:
            raise ValueError(
                f"no room for a pad and {count} blocks {self.clearance} m apart in x {self.x}, y {self.y}; "
                "widen task.randomize.placement or lower its clearance"
            )
        yaws = random_state.uniform(*self.yaw, count)
        scene.place_pad(*centres[0])
        for index in range(count):
            x, y = centres[index + 1]
            scene.place_block(index, x, y, yaws[index])
        return {"pad": _rounded(centres[0]), "blocks": _rounded(centres[1:]), "yaw": _rounded(yaws)}


class Arm:
    """Where the gripper starts, how far it is turned, and how far open it is."""

    def __init__(
        self,
        x: Range,
        y: Range,
        z: Range,
        yaw: Range = (0.0, 0.0),
        opening: Range = (MAX_OPENING, MAX_OPENING),
    ) -> None:
        """Args: ranges of the tool point in the base frame [m], its yaw [rad] and the gripper's opening [m]."""
        self.x, self.y, self.z, self.yaw, self.opening = x, y, z, yaw, opening

    def __call__(self, scene: BoundScene, random_state: np.random.RandomState) -> dict[str, Any]:
        """Draw a pose and put the joints there."""
        position = np.array([random_state.uniform(*bounds) for bounds in (self.x, self.y, self.z)])
        yaw, opening = random_state.uniform(*self.yaw), random_state.uniform(*self.opening)
        target = np.eye(4)
        target[:3, 3], target[:3, :3] = position, rotation_z(yaw) @ DOWN
        scene.place_arm(solve(target, HOME), opening)
        return {"tcp": _rounded(position), "yaw": round(yaw, 5), "opening": round(opening, 5)}


class Light:
    """Brightness, colour and direction of the lamp."""

    def __init__(self, brightness: Range, tint: float = 0.0, tilt: float = 0.0) -> None:
        """Args: range of brightness 0…1; largest change of each channel; largest change of the direction [rad]."""
        self.brightness, self.tint, self.tilt = brightness, tint, tilt

    def __call__(self, scene: BoundScene, random_state: np.random.RandomState) -> dict[str, Any]:
        """Draw a lamp."""
        diffuse = random_state.uniform(*self.brightness) + random_state.uniform(-self.tint, self.tint, 3)
        direction = scene.model.light_dir[0] + np.append(np.tan(random_state.uniform(-self.tilt, self.tilt, 2)), 0.0)
        scene.model.light_diffuse[0] = diffuse
        scene.model.light_dir[0] = direction / np.linalg.norm(direction)
        return {"diffuse": _rounded(diffuse), "direction": _rounded(scene.model.light_dir[0])}


class Cameras:
    """Where each camera is, where it looks, and how wide."""

    def __init__(self, position: float = 0.0, rotation: float = 0.0, fovy: float = 0.0, wrist: float = 0.25) -> None:
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
                "position": _rounded(self.position * shift),
                "rotation": _rounded(self.rotation * turn),
                "fovy": round(self.fovy * zoom, 3),
            }
        return draws


class Table:
    """Colour of the table."""

    def __init__(self, brightness: Range, tint: float = 0.0) -> None:
        """Args: range of brightness, 0…1; largest change of each channel."""
        self.brightness, self.tint = brightness, tint

    def __call__(self, scene: BoundScene, random_state: np.random.RandomState) -> dict[str, Any]:
        """Draw a colour."""
        rgb = random_state.uniform(*self.brightness) + random_state.uniform(-self.tint, self.tint, 3)
        scene.model.geom_rgba[scene.model.geom("table").id, :3] = rgb
        return {"rgb": _rounded(rgb)}
