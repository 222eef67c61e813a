"""One task of Meta-World: its simulator, and its pictures."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import mujoco
import numpy as np

from vla.io.errors import UserError
from vla.io.parts import FULL_WINDOW, Part, cut
from vla.spec import Array, Spec
from vla.tasks.metaworld.package import simulator, stop_sliding
from vla.tasks.rendering.renderer import LazyRenderer, RendererFactory, Views

HALF_TURN = np.array([0.0, 0.0, 0.0, 1.0])  # about the optical axis, quaternion wxyz
# LeRobot (src/lerobot/envs/metaworld.py) moves this camera, which hangs upside down, and turns its pictures.
CAMERA, CAMERA_PLACE = "corner2", (0.75, 0.075, 0.7)  # [m]
LEROBOT = 480  # height and width of its pictures [px]
HAND = "hand"  # the part of CAMERA's picture around a point below the hand, in place of a camera
MIDDLE = (0.0, 0.0, -0.075)  # of that part, 3 cm below the fingertips, from the position of the hand [m]
PLACE = ("hand_x", "hand_y", "hand_z")  # of the hand, in the state
FOVY = 60.0  # of CAMERA [degrees], and its orientation in every task before the turn, wxyz
ORIENTATION = (-0.39503823089303436, 0.26266733956017996, -0.4349370357280407, 0.7653629464596412)
CURRENT, BEFORE = slice(18), slice(18, 36)  # of an observation (39,): hand, gripper, objects now and one step before


class TaskScene:
    """Simulator of a task with LeRobot's camera poses; its renderer is made with the first picture."""

    def __init__(self, task: str, spec: Spec, renderer: RendererFactory, drawn: int | None, shadows: int) -> None:
        """Compile a task; a UserError if it lacks a camera. For `drawn` and `shadows` see `MetaWorld`."""
        self.simulator, self._size, self._drawn_size = simulator(task), spec.image_size, drawn
        self.model = model = self.simulator.model
        cameras = spec.cameras
        names = [model.camera(number).name for number in range(model.ncam)]
        if unknown := [name for name in cameras if name not in (*names, HAND)]:
            raise UserError(
                f"task.cameras names {', '.join(unknown)}; Meta-World has {', '.join(names)}, and {HAND}, which is "
                f"the part of {CAMERA} around the hand"
            )
        camera = names.index(CAMERA)
        model.cam_pos[camera] = CAMERA_PLACE
        model.cam_quat[camera] = _orientation()
        model.vis.quality.shadowsize = shadows
        model.mat_reflectance[:] = 0  # no renderer draws reflections, and none is visible from corner2
        parts = {part.camera: part for part in spec.parts}
        self._parts = [parts.get(name, Part(name)) for name in cameras]
        self._places = [names.index(CAMERA if name == HAND else name) for name in cameras]
        # A full picture is drawn once per camera, even if several windows are cut from it.
        camera_ids = self._places if drawn is None else sorted(set(self._places))
        height, width = self._size if drawn is None else (drawn, drawn)
        self._views = Views(camera_ids, height, width, site_groups=(0, 1, 2), aspect=1.0)
        self._renderer = LazyRenderer(renderer, self.model, self._views)

    def reset(self, seed: int) -> Array:
        """Draw object and goal; return the observation (39,): hand, gripper, objects, these one step before, goal."""
        self.simulator.seed(seed)
        observation, _ = self.simulator.reset()
        stop_sliding(self.simulator)
        # Some tasks move bodies after the last step of physics: without this, the first observation and picture would
        # still show objects and goals where they were in the previous episode, or are in the model's file.
        mujoco.mj_kinematics(self.model, self.simulator.data)
        current = self.simulator._get_curr_obs_combined_no_goal()
        observation[CURRENT] = observation[BEFORE] = self.simulator._prev_obs = current
        self._renderer.changed = True
        return observation

    def step(self, command: Array) -> tuple[Array, bool]:
        """Apply a command (4,) of -1…1, displacement [cm] and effort that closes the gripper, for one control period.

        Returns the observation (39,), and whether the task is solved.
        """
        observation, _, _, _, info = self.simulator.step(command)
        return observation, bool(info["success"])

    def pictures(self) -> Array:
        """Draw every camera's picture (cameras, H, W, 3) uint8."""
        hand = self.simulator.get_endeff_pos()
        windows = np.array([part.window_at(hand) for part in self._parts])
        if self._drawn_size is None:
            return self._renderer.render(self.simulator.data, windows)[0]
        pictures = dict(zip(self._views.cameras, self._renderer.render(self.simulator.data)[0], strict=True))
        crops = zip(self._places, windows, strict=True)
        return np.stack([cut(pictures[camera], window, self._size) for camera, window in crops])

    def close(self) -> None:
        """Free physics and GL."""
        self._renderer.close()
        self.simulator.close()


def parts_of(cameras: Sequence[str], window: Sequence[float] | None, hand_size: float) -> Iterator[Part]:
    """Yield what cameras show of LeRobot's picture: CAMERA a window or all of it, HAND the part around the hand.

    If only CAMERA shows it, and all of it, there are no parts.
    """
    if CAMERA in cameras and (window is not None or HAND in cameras):
        yield Part(CAMERA, tuple(window or FULL_WINDOW))
    if HAND in cameras:
        half = hand_size / 2
        yield Part(HAND, (-half, -half, half, half), PLACE, MIDDLE, _projection(), LEROBOT)


def _orientation() -> Array:
    """Return the orientation (4,) of CAMERA with LeRobot's half turn of its pictures, wxyz."""
    quaternion = np.empty(4)
    mujoco.mju_mulQuat(quaternion, np.array(ORIENTATION), HALF_TURN)
    return quaternion


def _projection() -> tuple[float, ...]:
    """Return the (3, 4) matrix of `Part.projection` for LeRobot's picture, row by row."""
    axes = np.empty(9)
    mujoco.mju_quat2Mat(axes, _orientation())
    x_axis, y_axis, z_axis = axes.reshape(3, 3).T
    scale = 2 * np.tan(np.radians(FOVY / 2))  # height of the picture at a depth of 1
    rows = np.stack([-z_axis * scale / 2 - y_axis, -z_axis * scale / 2 + x_axis, -z_axis * scale])
    matrix = np.column_stack([rows, -rows @ np.array(CAMERA_PLACE)])
    return tuple(matrix.ravel().tolist())
