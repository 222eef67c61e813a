"""Events of a bag: joint states, commands, instructions, and who moved the arm when.

All times are seconds since the first message. Shapes: J joints, N samples.
"""

from __future__ import annotations

import logging
from bisect import bisect_right
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from vla.deploy import messages
from vla.deploy.bag import messages_of, opened
from vla.deploy.control_loop import REPEATED
from vla.deploy.joint_limiter import JointLimits
from vla.deploy.observer import Measured, age_of
from vla.deploy.safety import State
from vla.deploy.settings import Topics
from vla.io.errors import UserError
from vla.spec import LONGEST_INSTRUCTION, Array

log = logging.getLogger(__name__)

Handler = Callable[[int, float, Any], None]  # of a message: when it was recorded [ns] and [s], itself

GAP = 0.3  # longest time between two commands of one motion [s]
STILL, STILL_OPENING = 0.01, 0.002  # an arm that has moved less [rad], and its gripper [m], has not begun to move
LEAD = 0.1  # of a motion that are kept before it begins and after it ends [s]
SHORTEST = 0.5  # shorter stretches are left out [s]


class Picture(NamedTuple):
    """An image, which is read again when it is needed."""

    camera: str
    at: float  # when it was taken
    stamp: int  # when it was recorded [ns]


@dataclass(frozen=True)
class Stretch:
    """A time in which one instruction was followed."""

    instruction: str
    start: float
    end: float
    person: tuple[tuple[float, float], ...]  # when a person moved the arm, from … to


@dataclass
class _Track:
    """Positions over time."""

    times: list[float] = field(default_factory=list)
    values: list[Any] = field(default_factory=list)  # (J,) or a number each

    def add(self, at: float, value: Any) -> None:
        """Add a value, which replaces all values at later times."""
        while self.times and self.times[-1] >= at:
            self.times.pop(), self.values.pop()
        self.times.append(at)
        self.values.append(value)

    def covers(self, at: float) -> bool:
        """Return whether there are values shortly before and shortly after `at`."""
        place = bisect_right(self.times, at)
        return 0 < place < len(self.times) and self.times[place] - self.times[place - 1] <= GAP

    def between(self, at: float) -> Array:
        """Interpolate linearly."""
        place = min(max(bisect_right(self.times, at), 1), len(self.times) - 1)
        (before, after), (start, end) = self.times[place - 1 : place + 1], self.values[place - 1 : place + 1]
        share = min(max((at - before) / (after - before), 0.0), 1.0)
        return np.asarray(start + share * (end - start))

    def last(self, at: float) -> Any:
        """Return the newest value at `at`; None before the first one."""
        place = bisect_right(self.times, at)
        return self.values[place - 1] if place else None


class BagIndex:
    """A bag without its pixels, read once.

    Messages that the policy node would drop are left out, and so are cameras without a topic in the bag.
    """

    def __init__(self, folder: Path, topics: Topics, limits: JointLimits, status: str) -> None:
        """Args: folder of the bag; topics, joints of the arm, and topic of the policy node's status.

        Raises:
            UserError: it is no bag, damaged or incomplete, or lacks the topic of joint states or instructions.
        """
        self.folder, self._limits, self._joint_states = folder, limits, messages.JointStates(limits)
        self.inputs: list[tuple[float, Picture | Measured]] = []  # when they arrived
        self.measured, self.openings = _Track(), _Track()  # joints (J,) [rad], opening of the gripper [m]
        # Joints (J,) [rad], openings 0 … 1; None from a hand-over until the person's first command.
        self.commands, self.gripper_commands = _Track(), _Track()
        self._usable = Counter[str]()  # topic → number of messages that say something
        self._dropped: dict[str, str] = {}  # topic → why its first unusable message is that
        self._instruction, self._said_at = "", -np.inf
        self._seen = set[str]()  # cameras of usable images
        self._taken: dict[str, tuple[int, int]] = {}  # camera → time stamp of its last image
        self._number = 0  # of the try: the next one begins with an instruction, or when the agent runs again
        self._moments: list[tuple[float, int, bool | None, str]] = []  # of joint states: try, who moves the arm, words
        with opened(folder) as reader:
            self.kinds = {connection.topic: connection.msgtype for connection in reader.connections}
            self._has_status = status in self.kinds
            self._person: bool | None = None if self._has_status else True  # who moves the arm; None: nobody
            self._tell_missing(topics, status)
            self._read(reader, self._handlers(topics, status))
        for topic in (topics.joint_states, topics.instruction):
            self.require(topic)
        self.inputs.sort(key=lambda each: each[0])
        self.stretches = [*self._stretches()]

    def require(self, topic: str) -> None:
        """Raise a UserError unless there are usable messages on a topic."""
        if topic not in self.kinds:
            known = messages.shorten(", ".join(sorted(self.kinds)) or "nothing", 500)
            raise UserError(f"{self.folder} has no topic {topic}, it has {known}: choose others with expert.topics")
        if not self._usable[topic]:
            why = self._dropped.get(topic, "there are no messages")
            raise UserError(f"{self.folder}: no message on {topic} can be used: {why}")

    def corrections(self) -> list[Stretch]:
        """Return the times in which a person moved the arm, from the beginning of the motion to its end."""
        found = []
        for stretch in self.stretches:
            for start, end in stretch.person:
                trimmed = self._moving(start, end)
                if trimmed is not None and trimmed[1] - trimmed[0] >= SHORTEST:
                    found.append(replace(stretch, start=trimmed[0], end=trimmed[1], person=(trimmed,)))
        return found

    def _moving(self, start: float, end: float) -> tuple[float, float] | None:
        """Return when the arm began and ceased to move between two times; None if it did not."""
        first, last = bisect_right(self.measured.times, start), bisect_right(self.measured.times, end)
        if last - first < 2:
            return None
        joints, openings = np.array(self.measured.values[first:last]), np.array(self.openings.values[first:last])

        def away(place: int) -> Array:
            moved = np.abs(joints - joints[place]).max(1) > STILL
            return np.flatnonzero(moved | (np.abs(openings - openings[place]) > STILL_OPENING))

        began, ceased = away(0), away(-1)
        if not len(began):
            return None
        times = self.measured.times[first:last]
        return max(times[began[0]] - LEAD, start), min(times[ceased[-1]] + LEAD, end)

    def _tell_missing(self, topics: Topics, status: str) -> None:
        """Log what replaces missing topics; raise a UserError if the status has another name, as in a namespace."""
        folder, there = self.folder, self.kinds
        if others := [topic for topic in there if topic.endswith(status) and not self._has_status]:
            raise UserError(
                f"{folder} has no topic {status}, which tells who moves the arm, but {others[0]}: choose it with "
                f"expert.status={others[0]}"
            )
        if not self._has_status:
            log.info("%s has no topic %s: all motion counts as a person's", folder, status)
        if topics.commands not in there:
            log.info("%s has no topic %s: actions follow the measured motion", folder, topics.commands)

    def _handlers(self, topics: Topics, status: str) -> dict[str, Handler]:
        """Return topic → handler of its messages; a UserError if one is of another type."""
        joint_state, numbers = "sensor_msgs/msg/JointState", "std_msgs/msg/Float64MultiArray"
        kinds: dict[str | None, dict[str, Handler]] = {}
        for camera, topic in topics.images.items():
            image: Handler = lambda stamp, at, message, camera=camera: self._image(camera, stamp, at, message)  # noqa: E731
            kinds[topic] = {"sensor_msgs/msg/Image": image, "sensor_msgs/msg/CompressedImage": image}
        kinds |= {
            topics.joint_states: {joint_state: self._joints},
            topics.finger_states: {joint_state: self._joints},
            topics.instruction: {"std_msgs/msg/String": self._words},
            topics.gripper: {numbers: self._fingers},
            status: {"diagnostic_msgs/msg/DiagnosticStatus": self._status},
            topics.commands: {
                joint_state: self._command,
                "trajectory_msgs/msg/JointTrajectory": self._trajectory,
                numbers: self._numbers,
                # Twists contain no joint positions: actions then follow the measured motion.
                "geometry_msgs/msg/TwistStamped": lambda *_: None,
            },
        }
        found = {topic: (kind, kinds[topic]) for topic, kind in self.kinds.items() if topic in kinds}
        for topic, (kind, handlers) in found.items():
            if kind not in handlers:
                raise UserError(
                    f"{self.folder}: {topic} is of type {messages.shorten(kind)}, expected {' or '.join(handlers)}"
                )
        return {topic: handlers[kind] for topic, (kind, handlers) in found.items()}

    def _read(self, reader: Any, handlers: dict[str, Handler]) -> None:
        connections = [connection for connection in reader.connections if connection.topic in handlers]
        folder, start, read = self.folder, reader.start_time, 0
        for topic, stamp, message in messages_of(reader, connections, folder):
            read += 1
            try:
                handlers[topic](stamp, (stamp - start) * 1e-9, message)
                self._usable[topic] += 1
            except UserError as error:
                self._dropped.setdefault(topic, str(error))
        expected = sum(connection.msgcount for connection in connections)
        if read < expected:
            raise UserError(f"{folder} is incomplete: {read} of {expected} messages are there, was its end cut off?")

    def _image(self, camera: str, stamp: int, at: float, message: Any) -> None:
        taken = message.header.stamp.sec, message.header.stamp.nanosec
        if taken != (0, 0) and taken == self._taken.get(camera):
            raise UserError(f"two images of the camera {camera} have the same time stamp")
        self._taken[camera] = taken
        if camera not in self._seen or not hasattr(message, "format"):
            messages.image_from(message)  # other compressed ones are decoded when they are needed
            self._seen.add(camera)
        self.inputs.append((at, Picture(camera, at - age_of(taken, stamp * 1e-9), stamp)))

    def _joints(self, stamp: int, at: float, message: Any) -> None:
        if (measured := self._joint_states.read(message, at)) is None:
            return
        self.inputs.append((at, Measured(at, *measured)))
        self.measured.add(at, measured[0])
        self.openings.add(at, measured[2])
        self._moments.append((at, self._number, self._person if self._instruction else None, self._instruction))

    def _words(self, stamp: int, at: float, message: Any) -> None:
        said = message.data.strip()
        if len(said) > LONGEST_INSTRUCTION:
            raise UserError(f"an instruction of {len(said)} characters")
        if not said and self._has_status:
            return  # the agent says that it stops
        if said != self._instruction or at - self._said_at > REPEATED:
            self._number += 1
        self._instruction, self._said_at = said, at

    def _status(self, stamp: int, at: float, message: Any) -> None:
        values = {pair.key: pair.value for pair in message.values}
        before = self._person
        self._person = True if values.get(messages.HANDED_OVER) == "yes" else None
        if self._person and not before:
            self.gripper_commands.add(at, None)  # the policy's last command is not the person's
        if self._person is None and values.get("state") == State.RUNNING:
            self._person = False
        self._number += before is not None and self._person is None

    def _command(self, stamp: int, at: float, message: Any) -> None:
        joints, opening = messages.command_from(message.name, message.position, self._limits)
        self.commands.add(at, joints)
        if opening is not None:
            self.gripper_commands.add(at, opening)

    def _trajectory(self, stamp: int, at: float, message: Any) -> None:
        for point in message.points:
            due = at + point.time_from_start.sec + point.time_from_start.nanosec * 1e-9
            self.commands.add(due, messages.command_from(message.joint_names, point.positions, self._limits)[0])

    def _numbers(self, stamp: int, at: float, message: Any) -> None:
        self.commands.add(at, messages.command_from(self._limits.joints, message.data, self._limits)[0])

    def _fingers(self, stamp: int, at: float, message: Any) -> None:
        opening = float(np.mean(message.data)) / self._limits.finger_travel if len(message.data) else np.nan
        if not np.isfinite(opening):
            raise UserError("finger positions that are not finite")
        self.gripper_commands.add(at, opening)

    def _stretches(self) -> Iterator[Stretch]:
        """Yield every try, with the times in which a person moved the arm."""
        moved = (moment for moment in self._moments if moment[2] is not None)
        for (_, words), of_try in groupby(moved, key=lambda moment: (moment[1], moment[3])):
            moments = [*of_try]
            start, end = moments[0][0], moments[-1][0]
            runs = [(person, [*run]) for person, run in groupby(moments, key=lambda moment: moment[2])]
            if end - start >= SHORTEST:
                yield Stretch(words, start, end, tuple((run[0][0], run[-1][0]) for who, run in runs if who))


_newest: dict[str, BagIndex] = {}  # arguments, with the state of the files → the last index


def read_index(folder: Path, topics: Topics, limits: JointLimits, status: str) -> BagIndex:
    """Return the index of a bag, which is kept for the next call: composition and import both need it."""
    files = sorted(folder.iterdir()) if folder.is_dir() else []
    state = [(file.name, file.stat().st_size, file.stat().st_mtime_ns) for file in files]
    key = repr((folder, topics, limits, status, state))
    if key not in _newest:
        index = BagIndex(folder, topics, limits, status)
        _newest.clear()
        _newest[key] = index
    return _newest[key]
