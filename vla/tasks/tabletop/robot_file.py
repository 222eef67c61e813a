"""A robot arm with a gripper from files in MJCF or URDF, as a configuration describes it."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.util import find_spec
from os.path import normpath
from pathlib import Path
from typing import Annotated

import mujoco
from annotated_types import MinLen

from vla.io.errors import UserError
from vla.io.types import Inherited, Names, Point, Positive, Text
from vla.tasks.tabletop import model_file, robot_spec

Values = Annotated[dict[str, float], MinLen(1)]


@dataclass(frozen=True, kw_only=True)
class RobotFile:
    """An arm in a file, with its hand or with the hand in a file of its own.

    Attributes:
        file: arm, in MJCF or URDF.
        hand: file of its hand, the names in which get `hand_` in front; None: `file` contains the hand.
        mount: site or body of the arm that carries this hand.
        place: position of the base; the table's top is at height 0 [m].
        yaw: of the base [rad].
        joints: J hinges of the arm, base to tip; other joints below the hand are fixed.
        home: (J,) positions in which the gripper points down over the table and closes sideways [rad].
        speed: largest speed of the joints [rad/s].
        tool: site or body of the hand whose axes are the tool's: x is the one that points forward at home, z down.
        offset: of the tool point, between the fingertips, in this frame [m]. It is moved aside to the middle of a block
            between them, which is not that of one jaw that moves, and down if they reach far below it.
        open: actuator or joint of the gripper → its value when open; joints get position servos.
        closed: the same when closed.
        force: largest force of these servos [N], or torque [N m].
        fingertips: names of the geoms, bodies or sites that hold a block: of either side.
        camera: position of the wrist camera in the tool's frame [m].
        target: point that it looks at [m].
    """

    file: Path
    hand: Path | None
    mount: Text | None
    place: Point
    yaw: float
    joints: Names
    home: list[float]
    speed: Positive
    tool: Text
    offset: Point
    open: Values
    closed: Values
    force: Positive
    fingertips: tuple[Names, Names]
    camera: Point
    target: Point

    def read(self) -> mujoco.MjSpec:
        """Read the model of the arm with its hand.

        Raises:
            UserError: a file is missing or does not compile.
        """
        spec = model_file.read("file", self.file)
        if self.hand is not None:
            robot_spec.attach_hand(spec, model_file.read("hand", self.hand), self.mount)
        return spec


class InstalledRobot(RobotFile):
    """An arm whose files are in an installed package, which is not imported."""

    def __init__(self, file: Text, hand: Text | None, **inherited: Inherited) -> None:
        """Args: paths that begin with the name of a package, such as dm_control/third_party/kinova/jaco_arm.xml.

        Raises:
            UserError: no such package, or a path out of it.
        """
        super().__init__(file=_installed(file), hand=_installed(hand) if hand else None, **inherited)


def _installed(path: str) -> Path:
    """Return a file in a package; one in the working folder, which Python also finds, is not installed."""
    package, _, rest = path.partition("/")
    found = find_spec(package) if package.isidentifier() else None
    source = Path(found.origin).absolute() if found and found.origin else Path()
    file = Path(normpath(source.parent / rest))
    if source.name != "__init__.py" or source.parents[1] == Path.cwd() or source.parent not in file.parents:
        raise UserError(f"task.robot: {path} must begin with the name of an installed package and stay within it")
    return file
