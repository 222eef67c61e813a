"""Checked conversion between ROS messages and arrays: the middleware also delivers NaN and wrong lengths and sizes.

The functions read and fill message objects; nothing here imports ROS.

Shapes: H by W pixels, J joints.
"""

from __future__ import annotations

import io
import json
import struct
import zlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Annotated, Any

import numpy as np
from annotated_types import MaxLen
from PIL import Image

from vla.deploy.control_loop import Command
from vla.deploy.joint_limiter import Robot
from vla.io.documents import STRICT, parse_json
from vla.io.errors import UserError
from vla.io.printable import printable
from vla.io.types import Natural, NonNegative, Seed
from vla.spec import LONGEST_INSTRUCTION, Array, Name, Names, Numbers, RobotModel

# Encoding → bytes per pixel, and the places of red, green and blue among them.
ENCODINGS = {
    "rgb8": (3, slice(0, 3)),
    "bgr8": (3, slice(2, None, -1)),
    "rgba8": (4, slice(0, 3)),
    "bgra8": (4, slice(2, None, -1)),
}

HANDED_OVER = "handed over"  # in the agent's status: yes if a person moves the arm, always in a dry run; no
MOST_PIXELS = 4096 * 4096  # of a compressed image, whose header may promise any number
LONGEST = 100_000  # characters of a message about an episode
FINGERS_AGE = 0.5  # oldest state of fingers that come in messages of their own [s]


@dataclass(frozen=True)
class ArmDescription:
    """Facts of an arm that a view needs; the JSON text of `/vla_agent/arm`."""

    __pydantic_config__ = STRICT

    joints: Names  # in joint states and commands, base to tip
    fingers: Annotated[tuple[Name, ...], MaxLen(100)]
    chain: Annotated[tuple[Numbers, ...], MaxLen(101)]  # as in `RobotModel`, empty if unknown


@dataclass(frozen=True)
class SimulatedEpisode:
    """Message of the simulator about its episode; the JSON text of `/vla_simulator/episode`."""

    __pydantic_config__ = STRICT

    seed: Seed
    instruction: Annotated[str, MaxLen(LONGEST_INSTRUCTION)]
    done: bool
    steps: Natural  # of control since the instruction, and simulated time
    seconds: NonNegative
    outcome: Name
    task: Annotated[str, MaxLen(100)]
    milestones: Annotated[tuple[Name, ...], MaxLen(100)]


def shorten(text: str, longest: int = 80) -> str:
    """Truncate text to at most `longest` characters, printable for logs."""
    text = printable(text)
    return text if len(text) <= longest else f"{text[: longest - 1]}…"


def image_from(message: Any) -> Array:
    """Read the (H, W, 3) uint8 RGB image of a sensor_msgs/Image or CompressedImage.

    Raises:
        UserError: the encoding is not supported, or the size is zero or does not match the data.
    """
    if hasattr(message, "format"):
        return _decompressed(message)
    if message.encoding not in ENCODINGS:
        raise UserError(f"image encoding is {shorten(message.encoding)!r}, expected one of {', '.join(ENCODINGS)}")
    depth, order = ENCODINGS[message.encoding]
    height, width, step = message.height, message.width, message.step
    if not height or not width:
        raise UserError(f"image is {width} by {height} pixels")
    if step < width * depth:
        raise UserError(f"image step is {step} bytes, {width} pixels of {message.encoding} need {width * depth}")
    if len(message.data) != step * height:
        raise UserError(f"image has {len(message.data)} bytes, {height} rows of {step} are {step * height}")
    rows = np.frombuffer(message.data, np.uint8).reshape(height, step)[:, : width * depth]
    return np.ascontiguousarray(rows.reshape(height, width, depth)[..., order])


def _decompressed(message: Any) -> Array:
    """Decode a sensor_msgs/CompressedImage of colours, JPEG or PNG, whatever its format field says."""
    quoted = repr(shorten(message.format))
    try:
        with Image.open(io.BytesIO(message.data), formats=["JPEG", "PNG"]) as image:
            if image.mode not in ("RGB", "RGBA") or image.width * image.height > MOST_PIXELS:
                raise UserError(f"image of format {quoted} has {image.width} by {image.height} pixels of {image.mode}")
            return np.array(image.convert("RGB"))
    except (OSError, SyntaxError, EOFError, struct.error, zlib.error, Image.DecompressionBombError) as error:
        raise UserError(f"image of format {quoted} is not a JPEG or PNG, or is damaged") from error


def fill_image(message: Any, image: Array, frame: str) -> Any:
    """Fill a sensor_msgs/Image with an (H, W, 3) uint8 RGB image; returns the message."""
    message.height, message.width = image.shape[:2]
    message.encoding, message.step = "rgb8", 3 * image.shape[1]
    message.header.frame_id = frame
    message.data = image.tobytes()  # a numpy array would be checked item by item
    return message


def fill_arm(message: Any, robot: Robot, model: RobotModel) -> Any:
    """Fill a std_msgs/String with the description of the arm; returns the message."""
    description = ArmDescription(tuple(robot.joints), tuple(robot.fingers), model.chain)
    message.data = json.dumps(asdict(description))
    return message


def arm_from(message: Any) -> ArmDescription:
    """Read the description of an arm from a std_msgs/String.

    Raises:
        UserError: it is no such description, or its chain does not fit its joints.
    """
    arm = parse_json(message.data, ArmDescription, "the description of the arm")
    fits = [len(frame) for frame in arm.chain] == [7] * (len(arm.joints) + 1) and all(any(f[3:]) for f in arm.chain)
    if arm.chain and not fits:
        raise UserError(f"the arm's chain is not 7 numbers for each of {len(arm.joints)} joints and the tool")
    return arm


def episode_from(message: Any) -> SimulatedEpisode:
    """Read a simulator's episode from a std_msgs/String; raise a UserError if it is none."""
    return parse_json(message.data[:LONGEST], SimulatedEpisode, "/vla_simulator/episode")


class JointStates:
    """Joint states of an arm, whose fingers come in the same messages or in others."""

    def __init__(self, robot: Robot) -> None:
        """Args: the names of the joints."""
        self._robot, self._fingers = robot, (-np.inf, 0.0)  # when they came, opening

    def read(self, message: Any, at: float) -> tuple[Array, Array, float] | None:
        """Read a sensor_msgs/JointState that came at `at` [s], as `joints_from` does; None if it has the fingers only.

        Raises:
            UserError: as `joints_from`; fingers are missing if none came within the last `FINGERS_AGE`.
        """
        fingers, names = self._robot.fingers, {*message.name}
        of_gripper = names >= {*fingers} and names.isdisjoint(self._robot.joints)  # which may have further joints
        if fingers and of_gripper and len(names) < len(fingers) + len(self._robot.joints):
            self._fingers = (at, float(_positions(message, fingers)[0].sum()))
            return None
        recent = at - self._fingers[0] <= FINGERS_AGE and names.isdisjoint(fingers)
        return joints_from(message, self._robot, self._fingers[1] if recent else None)


def joints_from(message: Any, robot: Robot, opening: float | None = None) -> tuple[Array, Array, float]:
    """Read positions (J,) [rad], velocities (J,) [rad/s] and gripper opening [m] of a sensor_msgs/JointState, by name.

    Missing velocities, also NaN, become zero. With an `opening` from elsewhere the fingers need not be there.

    Raises:
        UserError: a joint is missing or named twice, the lengths differ, or a number is not finite.
    """
    fingers = robot.fingers if opening is None else []
    position, velocity = _positions(message, [*robot.joints, *fingers])
    arm = len(robot.joints)
    return position[:arm], velocity[:arm], float(position[arm:].sum()) if opening is None else opening


def _positions(message: Any, joints: Sequence[str]) -> tuple[Array, Array]:
    """Read positions and velocities of some joints, by name."""
    names = list(message.name)
    if len(set(names)) != len(names):
        raise UserError("joint state names a joint twice")
    missing = [name for name in joints if name not in names]
    if missing:
        raise UserError(f"joint state lacks {', '.join(missing)}; it has {', '.join(names) or 'no names'}")
    if len(message.position) != len(names) or len(message.velocity) not in (0, len(names)):
        raise UserError(
            f"joint state has {len(names)} names, {len(message.position)} positions, {len(message.velocity)} velocities"
        )
    position = np.array(message.position, dtype=float)
    velocity = np.array(message.velocity, dtype=float) if len(message.velocity) else np.zeros(len(names))
    places = [names.index(name) for name in joints]
    position, velocity = position[places], velocity[places]
    velocity = np.where(np.isnan(velocity), 0.0, velocity)  # ros2_control's mark of a joint without one
    if not (np.isfinite(position).all() and np.isfinite(velocity).all()):
        raise UserError("joint state has a number that is not finite")
    return position, velocity


def fill_joint_state(message: Any, robot: Robot, command: Command) -> Any:
    """Fill a sensor_msgs/JointState with target positions of arm and fingers only, as Isaac Sim expects.

    Without an opening in the command, it is of the arm alone.
    """
    fingers = finger_positions(robot, command)
    message.name = [*robot.joints, *robot.fingers[: len(fingers)]]
    message.position = [*command.position.tolist(), *fingers]
    return message


def fill_trajectory(
    message: Any, point: type, duration: type, robot: Robot, commands: Sequence[Command], tick: float
) -> Any:
    """Fill a trajectory_msgs/JointTrajectory that starts now, with one point per tick and the last one at rest.

    The arm therefore stops if no other trajectory follows. `point` and `duration` are the message classes of the parts.
    """
    message.joint_names = list(robot.joints)
    for number, command in enumerate(commands, 1):
        seconds, rest = divmod(number * tick, 1.0)
        time_from_start = duration(sec=int(seconds), nanosec=int(rest * 1e9))
        positions, velocities = command.position.tolist(), command.velocity.tolist()
        if number == len(commands):
            velocities = [0.0] * len(velocities)
        message.points.append(point(positions=positions, velocities=velocities, time_from_start=time_from_start))
    return message


def fill_twist(message: Any, frame: str, velocity: Array) -> Any:
    """Fill a geometry_msgs/TwistStamped with the (6,) velocity of the tool [m/s], [rad/s] in a frame."""
    message.header.frame_id = frame
    parts = (message.twist.linear, message.twist.angular)
    for part, values in zip(parts, velocity.reshape(2, 3).tolist(), strict=True):
        part.x, part.y, part.z = values
    return message


def finger_positions(robot: Robot, command: Command) -> list[float]:
    """Return the target position of every finger joint [m]; none if the command leaves the gripper as it is."""
    return [] if command.opening is None else [command.opening * robot.finger_travel] * len(robot.fingers)


def command_from(names: Sequence[str], positions: Any, robot: Robot) -> tuple[Array, float | None]:
    """Read target positions (J,) [rad] and opening 0 … 1, or None without fingers, of a command, by name.

    Raises:
        UserError: a joint is missing, the lengths differ, or a number is not finite.
    """
    names, positions = list(names), np.array(positions, dtype=float)
    missing = [name for name in robot.joints if name not in names]
    if missing or len(names) != len(positions) or not np.isfinite(positions).all():
        problem = f"lacks {', '.join(missing)}" if missing else "needs one finite position per name"
        raise UserError(f"joint command {problem}")
    fingers = [positions[names.index(name)] for name in robot.fingers if name in names]
    opening = float(np.mean(fingers)) / robot.finger_travel if fingers else None
    return positions[[names.index(name) for name in robot.joints]], opening
