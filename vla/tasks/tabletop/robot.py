"""Interface of an arm with a gripper for scene and simulation, and constants that all arms share."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np
from dm_control import mjcf
from numpy.typing import ArrayLike

from vla.robots.cartesian import Kinematics
from vla.spec import Array, RobotModel

# Robot geometry collides with the world but not with itself.
ROBOT_CONTACT = {"contype": 2, "conaffinity": 1}
# Fingertips are soft and do not slip.
FINGERTIP_CONTACT = {
    "friction": (2.0, 0.05, 0.0002),
    "condim": 4,
    "priority": 1,
    "solref": (0.01, 1),
    "solimp": (0.95, 0.99, 0.001),
}
# Options of MuJoCo; elliptic cones and `impratio` prevent slip of held blocks.
PHYSICS = {"timestep": 0.004, "integrator": "implicitfast", "cone": "elliptic", "impratio": 10}
VISIBLE, HIDDEN = 2, 3  # groups of geoms: drawn, and for collisions only
CORNERS = 64  # vertices of every "light" mesh


def attributes(**values: ArrayLike) -> str:
    """Format attributes of MJCF: text, booleans, numbers and sequences of numbers, without loss of precision."""
    return " ".join(f'{name}="{_text(value)}"' for name, value in values.items())


def _text(value: ArrayLike) -> str:
    if isinstance(value, str):
        return value
    if isinstance(value, bool):
        return str(value).lower()
    return " ".join(f"{number:.17g}" for number in np.ravel(value).tolist())


def camera(position: Sequence[float], target: Sequence[float], fovy: float, up: Sequence[float]) -> str:
    """Return the MJCF attributes of a camera at `position` that looks at `target` [m], with a vertical field of view
    `fovy` [degrees]; `up` is the direction towards the upper edge of its pictures."""
    return attributes(pos=position, xyaxes=look_at(position, target, up)[:, :2].T, fovy=fovy)


def look_at(position: Sequence[float] | Array, target: Sequence[float] | Array, up: Sequence[float] | Array) -> Array:
    """Return the rotation (3, 3) of a camera at `position` that looks at `target` along its negative z axis, y up."""
    back = np.asarray(position, dtype=float) - np.asarray(target, dtype=float)
    back /= np.linalg.norm(back)
    right = np.cross(up, back)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(back, right), back], axis=1)


def spread(points: Array) -> Array:
    """Select at most `CORNERS` of the (N, 3) points by farthest-point sampling."""
    indices = [int(np.linalg.norm(points - points.mean(0), axis=1).argmax())]
    distances = np.linalg.norm(points - points[indices[0]], axis=1)
    while len(indices) < min(CORNERS, len(points)):
        indices.append(int(distances.argmax()))
        distances = np.minimum(distances, np.linalg.norm(points - points[indices[-1]], axis=1))
    return points[indices]


class TabletopRobot:
    """An arm with position servos and a gripper whose two sides close along the y axis of the tool.

    The z axis of the tool points out of the gripper. A gripper command is 0 when closed and `travel` when open.
    Elements have their names in the compiled scene; a camera `wrist` is among them.
    """

    prefix: str  # of the names of all its elements
    arm: RobotModel  # for the spec
    kinematics: Kinematics
    joints: Sequence[str]  # J hinges, base to tip
    servos: Sequence[str]  # their actuators, which take positions [rad]
    lead: float  # damping over stiffness of the servos [s]
    fingers: Sequence[str]  # joints of the gripper
    grips: Sequence[str]  # G actuators of the gripper
    closed: Array  # (G,) controls of a closed gripper
    opened: Array  # (G,) controls of an open gripper
    travel: float
    finger_speed: float  # largest change of the command per second
    widest: float  # opening of an open gripper [m]
    fingertips: Sequence[Sequence[str]]  # geoms of either side
    # Half extents of the closed fingertips along x and y, how far they reach below the tool, and their middle on y [m].
    tip: Sequence[float]
    tool: str  # site

    def attach(self, scene: mjcf.RootElement) -> None:
        """Attach the robot to a scene, unless `complete` adds it."""

    def complete(self, scene: mujoco.MjSpec) -> None:
        """Add a robot that PyMJCF cannot read to the exported scene."""

    def grip(self, opening: float) -> tuple[Array | float, float]:
        """Return the positions of the finger joints and the gripper command for an opening [m]."""
        raise NotImplementedError

    def opening(self, model: mujoco.MjModel, data: mujoco.MjData) -> float:
        """Measure the opening [m] in a compiled scene."""
        raise NotImplementedError
