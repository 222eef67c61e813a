"""One task of Meta-World: its simulator, and its pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from PIL import Image

from vla.io.errors import UserError
from vla.spec import Array
from vla.tasks.metaworld.package import simulator, stop_sliding
from vla.tasks.rendering.renderer import WHOLE, Renderer, RendererFactory, Views

HALF_TURN = np.array([0.0, 0.0, 0.0, 1.0])  # about the optical axis, quaternion wxyz
# LeRobot (src/lerobot/envs/metaworld.py) moves this camera, which hangs upside down, and turns its pictures.
CAMERA, CAMERA_PLACE = "corner2", (0.75, 0.075, 0.7)  # [m]
LEROBOT = 480  # height and width of its pictures [px]
HAND = "hand"  # the part of CAMERA's picture around the fingertips, in place of a camera
MIDDLE = (0.0, 0.0, -0.075)  # of that part, 3 cm below the fingertips, from the position of the hand [m]
CURRENT, BEFORE = slice(18), slice(18, 36)  # of an observation (39,): hand, gripper, objects now and one step before


@dataclass(frozen=True)
class PictureSettings:
    """What pictures of all tasks have in common."""

    renderer: RendererFactory
    cameras: tuple[str, ...]  # names in the model, or HAND
    image_size: tuple[int, int]  # height and width of the pictures [px]
    window: Sequence[float] | None  # this and what follows: see `MetaWorld`
    hand_size: float
    drawn: int | None
    shadows: int


class TaskScene:
    """Simulator of a task with the cameras as LeRobot has them; its renderer is made with the first picture."""

    def __init__(self, task: str, settings: PictureSettings) -> None:
        """Compile a task; a UserError if it lacks a camera."""
        self._settings, self.simulator = settings, simulator(task)
        model, cameras, window = self.simulator.model, settings.cameras, settings.window
        self.model = model
        known = [model.camera(number).name for number in range(model.ncam)]
        if unknown := [name for name in cameras if name not in (*known, HAND)]:
            raise UserError(
                f"task.cameras names {', '.join(unknown)}; Meta-World has {', '.join(known)}, and {HAND}, which is "
                f"the part of {CAMERA} around the hand"
            )
        camera = self._camera = known.index(CAMERA)
        model.cam_pos[camera] = CAMERA_PLACE
        turned = np.empty(4)
        mujoco.mju_mulQuat(turned, model.cam_quat[camera].copy(), HALF_TURN)
        model.cam_quat[camera] = turned
        model.vis.quality.shadowsize = settings.shadows
        model.mat_reflectance[:] = 0  # of the renderers none draws it, and in no task does it show from corner2
        self._windows = np.array([window if window and name == CAMERA else WHOLE for name in cameras], float)
        self._hands = [number for number, name in enumerate(cameras) if name == HAND]
        self._places = [known.index(CAMERA if name == HAND else name) for name in cameras]
        # All of a camera's picture is drawn once.
        seen = self._places if settings.drawn is None else sorted(set(self._places))
        height, width = settings.image_size if settings.drawn is None else (settings.drawn, settings.drawn)
        self._views = Views(seen, height, width, site_groups=(0, 1, 2), aspect=1.0)
        self._renderer: Renderer | None = None
        self._changed = True

    def reset(self, seed: int) -> Array:
        """Draw object and goal, and return the observation (39,): hand, gripper, objects, the same one step before,
        goal."""
        self.simulator.seed(seed)
        observation, _ = self.simulator.reset()
        stop_sliding(self.simulator)
        # Some tasks move bodies after the last step of physics: without this the first observation and picture still
        # have objects and goals where the episode before, or the model's file, has them.
        mujoco.mj_kinematics(self.model, self.simulator.data)
        current = self.simulator._get_curr_obs_combined_no_goal()
        observation[CURRENT] = observation[BEFORE] = self.simulator._prev_obs = current
        self._changed = True
        return observation

    def step(self, command: Array) -> tuple[Array, bool]:
        """Apply a command (4,) of -1…1, displacement [cm] and effort that closes the gripper, for one control period.

        Returns the observation (39,), and whether the task is solved.
        """
        observation, _, _, _, info = self.simulator.step(command)
        return observation, bool(info["success"])

    def pictures(self) -> Array:
        """Draw every camera's picture (cameras, H, W, 3) uint8."""
        if self._renderer is None:
            self._renderer = self._settings.renderer.open(self.model, self._views)
        elif self._changed:
            self._renderer.update()
        self._changed = False
        for number in self._hands:
            self._windows[number] = self._around_the_hand()
        if self._settings.drawn is None:
            return self._renderer.render(self.simulator.data, self._windows)[0]
        pictures = dict(zip(self._views.cameras, self._renderer.render(self.simulator.data)[0], strict=True))
        shown = zip(self._places, self._windows, strict=True)
        return np.stack([_cut(pictures[camera], window, self._settings.image_size) for camera, window in shown])

    def _around_the_hand(self) -> Array:
        """Return the window (4,) of CAMERA's picture around the fingertips, of whole pixels of LeRobot's picture."""
        data, fovy = self.simulator.data, self.model.cam_fovy[self._camera]
        there = self.simulator.get_endeff_pos() + MIDDLE - data.cam_xpos[self._camera]
        across, up, behind = data.cam_xmat[self._camera].reshape(3, 3).T @ there
        half = -behind * np.tan(np.radians(fovy / 2))  # of the whole picture, at that distance
        size = self._settings.hand_size
        corner = np.array([(1 - up / half) / 2, (1 + across / half) / 2]) - size / 2
        upper, left = (np.rint(LEROBOT * corner) / LEROBOT).clip(0, 1 - size)
        return np.array([upper, left, upper + size, left + size])

    def close(self) -> None:
        """Free physics and GL."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None
        self.simulator.close()


def _cut(picture: Array, window: Sequence[float], size: tuple[int, int]) -> Array:
    """Return a window of a square picture (drawn, drawn, 3), averaged to a size: height and width [px]."""
    top, left, bottom, right = (len(picture) * share for share in window)
    image = Image.fromarray(picture).resize(size[::-1], Image.Resampling.BOX, (left, top, right, bottom))
    return np.asarray(image)
