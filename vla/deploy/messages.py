"""ROS messages as arrays and back, checked: middleware delivers NaN, wrong lengths and wrong sizes without a word.

Functions take message objects and fill them; nothing here imports ROS.

Shapes: H by W pixels, J joints.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from vla.deploy.governor import Robot
from vla.deploy.session import Command
from vla.spec import Array

# Encoding → bytes per pixel, and where in them red, green and blue are.
ENCODINGS = {
    "rgb8": (3, slice(0, 3)),
    "bgr8": (3, slice(2, None, -1)),
    "rgba8": (4, slice(0, 3)),
    "bgra8": (4, slice(2, None, -1)),
}


def cut(text: str, longest: int = 80) -> str:
    """Text of any length as logs show it, with at most `longest` characters."""
    return text if len(text) <= longest else f"{text[: longest - 1]}…"


def image_from(message: Any) -> Array:
    """The (H, W, 3) uint8 RGB image of a sensor_msgs/Image.

    Raises:
        ValueError: an encoding that is no colour image, no pixels, or fewer bytes than it promises.
    """
    if message.encoding not in ENCODINGS:
        raise ValueError(f"image encoding is {cut(message.encoding)!r}, understood are {', '.join(ENCODINGS)}")
    depth, order = ENCODINGS[message.encoding]
    height, width, step = message.height, message.width, message.step
    if not height or not width:
        raise ValueError(f"image is {width} by {height} pixels")
    if step < width * depth:
        raise ValueError(f"image step is {step} bytes, {width} pixels of {message.encoding} need {width * depth}")
    if len(message.data) != step * height:
        raise ValueError(f"image has {len(message.data)} bytes, {height} rows of {step} are {step * height}")
    rows = np.frombuffer(message.data, np.uint8).reshape(height, step)[:, : width * depth]
    return np.ascontiguousarray(rows.reshape(height, width, depth)[..., order])


def fill_image(message: Any, image: Array, frame: str) -> Any:
    """A sensor_msgs/Image that holds the (H, W, 3) uint8 RGB `image`."""
    message.height, message.width = image.shape[:2]
    message.encoding, message.step = "rgb8", 3 * image.shape[1]
    message.header.frame_id = frame
    message.data = image.tobytes()  # a numpy array would be checked item by item
    return message


def joints_from(message: Any, robot: Robot) -> tuple[Array, Array, float]:
    """Positions (J,) [rad], velocities (J,) [rad/s] and gripper opening [m] of a sensor_msgs/JointState, by name.

    Velocities that are not given are zero.

    Raises:
        ValueError: a joint is missing or named twice, lists do not fit together, or a number is not finite.
    """
    names = list(message.name)
    if len(set(names)) != len(names):
        raise ValueError("joint state names a joint twice")
    missing = [name for name in (*robot.joints, *robot.fingers) if name not in names]
    if missing:
        raise ValueError(f"joint state lacks {', '.join(missing)}; it has {', '.join(names) or 'no names'}")
    if len(message.position) != len(names) or len(message.velocity) not in (0, len(names)):
        raise ValueError(
            f"joint state has {len(names)} names, {len(message.position)} positions, {len(message.velocity)} velocities"
        )
    position = np.array(message.position, dtype=float)
    velocity = np.array(message.velocity, dtype=float) if len(message.velocity) else np.zeros(len(names))
    if not (np.isfinite(position).all() and np.isfinite(velocity).all()):
        raise ValueError("joint state has a number that is not finite")
    arm = [names.index(name) for name in robot.joints]
    fingers = [names.index(name) for name in robot.fingers]
    return position[arm], velocity[arm], float(position[fingers].sum())


def fill_joint_state(message: Any, robot: Robot, command: Command) -> Any:
    """A sensor_msgs/JointState with target positions of arm and fingers, and nothing else, as Isaac Sim takes it."""
    message.name = [*robot.joints, *robot.fingers]
    message.position = [*command.position.tolist(), *finger_positions(robot, command)]
    return message


def fill_trajectory(
    message: Any, point: type, duration: type, robot: Robot, commands: Sequence[Command], tick: float
) -> Any:
    """A trajectory_msgs/JointTrajectory that starts now, one point per tick, the last one at rest.

    If no other one follows, the arm stops by itself. `point` and `duration` are the classes of its parts.
    """
    message.joint_names = list(robot.joints)
    for number, command in enumerate(commands, 1):
        seconds, rest = divmod(number * tick, 1.0)
        when = duration(sec=int(seconds), nanosec=int(rest * 1e9))
        positions, velocities = command.position.tolist(), command.velocity.tolist()
        if number == len(commands):
            velocities = [0.0] * len(velocities)
        message.points.append(point(positions=positions, velocities=velocities, time_from_start=when))
    return message


def finger_positions(robot: Robot, command: Command) -> list[float]:
    """Target position of every finger joint [m]."""
    return [command.opening * robot.finger_travel] * len(robot.fingers)


def command_from(message: Any, robot: Robot) -> tuple[Array, float | None]:
    """Target positions (J,) [rad] and opening 0 … 1, or None if not given, of a JointState, by name.

    Raises:
        ValueError: a joint is missing, lists do not fit together, or a number is not finite.
    """
    names, positions = list(message.name), np.array(message.position, dtype=float)
    missing = [name for name in robot.joints if name not in names]
    if missing or len(names) != len(positions) or not np.isfinite(positions).all():
        what = f"lacks {', '.join(missing)}" if missing else "has names and finite positions that do not fit together"
        raise ValueError(f"joint command {what}")
    fingers = [positions[names.index(name)] for name in robot.fingers if name in names]
    opening = float(np.mean(fingers)) / robot.finger_travel if fingers else None
    return positions[[names.index(name) for name in robot.joints]], opening
