"""Checked conversion between ROS messages and arrays: the middleware also delivers NaN and wrong lengths and sizes.

The functions read and fill message objects; nothing here imports ROS.

Shapes: H by W pixels, J joints.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from annotated_types import MaxLen

from vla.deploy.joint_limiter import JointLimits
from vla.deploy.observer import JointMeasurement
from vla.io.documents import STRICT
from vla.io.errors import UserError
from vla.io.images import decode_image
from vla.io.printable import escape
from vla.io.types import Natural, NonNegative, Seed
from vla.spec import LONGEST_INSTRUCTION, Array, Name

# Encoding → bytes per pixel, and the places of red, green and blue among them.
ENCODINGS = {
    "rgb8": (3, slice(0, 3)),
    "bgr8": (3, slice(2, None, -1)),
    "rgba8": (4, slice(0, 3)),
    "bgra8": (4, slice(2, None, -1)),
}

HANDED_OVER = "handed over"  # in the agent's status: yes if a person moves the arm, and in a dry run; else no
FINGERS_AGE = 0.5  # oldest state of fingers that come in messages of their own [s]
LIMIT_TOLERANCE = 0.5  # distance outside its limits at which an arm moved by a person may still be [rad]


@dataclass(frozen=True)
class SimulatedEpisode:
    """Message of the simulator about its episode; the JSON text of `/vla_simulator/episode`."""

    __pydantic_config__ = STRICT

    seed: Seed
    instruction: Annotated[str, MaxLen(LONGEST_INSTRUCTION)]
    done: bool
    steps: Natural  # control steps since the instruction; below, their simulated time
    seconds: NonNegative
    outcome: Name
    task: Annotated[str, MaxLen(100)]
    milestones: Annotated[tuple[Name, ...], MaxLen(100)]


def shorten(text: str, max_length: int = 80) -> str:
    """Truncate text to at most `max_length` characters, printable for logs."""
    text = escape(text)
    return text if len(text) <= max_length else f"{text[: max_length - 1]}…"


def image_from(message: Any) -> Array:
    """Read the (H, W, 3) uint8 RGB image of a sensor_msgs/Image or CompressedImage; raise a UserError if it is none."""
    if hasattr(message, "format"):  # whatever it says
        return decode_image(bytes(message.data))
    if message.encoding not in ENCODINGS:
        raise UserError(f"image encoding is {shorten(message.encoding)!r}, expected one of {', '.join(ENCODINGS)}")
    depth, order = ENCODINGS[message.encoding]
    height, width, step = message.height, message.width, message.step
    if not height or not width or step < width * depth or len(message.data) != step * height:
        raise UserError(
            f"{len(message.data)} bytes in rows of {step} are no {width} by {height} pixels of {message.encoding}"
        )
    rows = np.frombuffer(message.data, np.uint8).reshape(height, step)[:, : width * depth]
    return np.ascontiguousarray(rows.reshape(height, width, depth)[..., order])


def fill_image(message: Any, image: Array, frame: str) -> Any:
    """Fill a sensor_msgs/Image with an (H, W, 3) uint8 RGB image; returns the message."""
    message.height, message.width = image.shape[:2]
    message.encoding, message.step, message.header.frame_id = "rgb8", 3 * image.shape[1], frame
    message.data = image.tobytes()  # a numpy array would be checked item by item
    return message


class JointStates:
    """Joint states of an arm, whose fingers come in the same messages or in others."""

    def __init__(self, limits: JointLimits) -> None:
        """Args: the limits, of which names and positions are used."""
        self._limits, self._fingers = limits, (-np.inf, 0.0)  # when they came, opening

    def read(self, message: Any, stamp: float) -> JointMeasurement | None:
        """Return the joint state in a sensor_msgs/JointState.

        Joints are found by name. Missing velocities, also NaN, become zero. A message with only the fingers returns
        None, and provides the opening for later ones during `FINGERS_AGE`. Raises a UserError if a joint is missing,
        named twice or far beyond its limits, the lengths differ, or a number is not finite.

        Args:
            message: the message.
            stamp: when it was captured [s].
        """
        arm, fingers, names = self._limits.joints, self._limits.fingers, {*message.name}
        fingers_only = names >= {*fingers} and names.isdisjoint(arm)  # which may have further joints
        if fingers and fingers_only and len(names) < len(fingers) + len(arm):
            self._fingers = (stamp, self._opening(_positions(message, fingers)[0]))
            return None
        if stamp - self._fingers[0] <= FINGERS_AGE and names.isdisjoint(fingers):
            position, velocity = _positions(message, arm)
            opening = self._fingers[1]
        else:
            position, velocity = _positions(message, [*arm, *fingers])
            opening = self._opening(position[len(arm) :])
        place, low, high = position[: len(arm)], np.array(self._limits.low), np.array(self._limits.high)
        if (violations := (place < low - LIMIT_TOLERANCE) | (place > high + LIMIT_TOLERANCE)).any():
            joint = int(np.argmax(violations))
            raise UserError(f"joint state has {arm[joint]} at {place[joint]:g} rad, where this arm cannot be")
        return JointMeasurement(stamp, place, velocity[: len(arm)], opening)

    def _opening(self, fingers: Array) -> float:
        """Return the opening [m] at positions of all fingers; 0 without any."""
        limits = self._limits
        if not limits.fingers or limits.widest is None:
            return 0.0
        return limits.widest * limits.opening(dict(zip(limits.fingers, fingers, strict=True)))


def _positions(message: Any, joints: Sequence[str]) -> tuple[Array, Array]:
    """Read positions and velocities of some joints, by name."""
    names = list(message.name)
    if missing_joints := [name for name in joints if names.count(name) != 1]:
        raise UserError(
            f"joint state lacks {', '.join(missing_joints)}, or has it twice; it has {', '.join(names) or 'nothing'}"
        )
    if len(message.position) != len(names) or len(message.velocity) not in (0, len(names)):
        raise UserError(
            f"joint state has {len(names)} names, {len(message.position)} positions, {len(message.velocity)} velocities"
        )
    places = [names.index(name) for name in joints]
    position = np.array(message.position, dtype=float)[places]
    velocity = np.array(message.velocity, dtype=float)[places] if len(message.velocity) else np.zeros(len(places))
    velocity = np.where(np.isnan(velocity), 0.0, velocity)  # ros2_control's mark of a joint without one
    if not (np.isfinite(position).all() and np.isfinite(velocity).all()):
        raise UserError("joint state has a number that is not finite")
    return position, velocity


def command_from(names: Sequence[str], positions: Any, limits: JointLimits) -> tuple[Array, float | None]:
    """Return target positions (J,) [rad] and opening 0 … 1, or None without fingers, of a command, by name. Raises a
    UserError if a joint is missing, the lengths differ, or a number is not finite."""
    names, positions = list(names), np.array(positions, dtype=float)
    missing_joints = [name for name in limits.joints if name not in names]
    if missing_joints or len(names) != len(positions) or not np.isfinite(positions).all():
        problem = f"lacks {', '.join(missing_joints)}" if missing_joints else "needs one finite position per name"
        raise UserError(f"joint command {problem}")
    fingers = {name: positions[names.index(name)] for name in limits.fingers if name in names}
    return positions[[names.index(name) for name in limits.joints]], limits.opening(fingers) if fingers else None
