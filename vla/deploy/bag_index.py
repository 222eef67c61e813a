"""Events of a bag: joint states, commands, instructions, and who moved the arm when.

All times are seconds since the first message. Shapes: J joints, N samples.
"""

from __future__ import annotations

import json
import logging
from bisect import bisect_right
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from vla.deploy import messages
from vla.deploy.bag import bag_errors, message_types, messages_of, opened
from vla.deploy.control_loop import REPEATED, State
from vla.deploy.joint_limiter import Robot
from vla.deploy.observer import Measured, age_of
from vla.deploy.settings import Topics
from vla.io.errors import UserError
from vla.spec import LONGEST_INSTRUCTION, Array

log = logging.getLogger(__name__)

IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
JOINTS = "sensor_msgs/msg/JointState"
TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"
NUMBERS = "std_msgs/msg/Float64MultiArray"
TWIST = "geometry_msgs/msg/TwistStamped"
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
class Track:
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


@dataclass
class BagIndex:
    """A bag without its pixels."""

    folder: Path
    inputs: list[tuple[float, Picture | Measured]] = field(default_factory=list)  # when they arrived
    measured: Track = field(default_factory=Track)  # joints (J,) [rad]
    openings: Track = field(default_factory=Track)  # measured, of the gripper [m]
    commands: Track = field(default_factory=Track)  # joints (J,) [rad]
    # Commanded openings of the gripper, 0 … 1; None from a hand-over until the person's first command.
    gripper_commands: Track = field(default_factory=Track)
    stretches: list[Stretch] = field(default_factory=list)

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


def read_index(folder: Path, topics: Topics, robot: Robot, status: str) -> BagIndex:
    """Read all of a bag once.

    Messages that the policy node would drop are left out.

    Raises:
        UserError: it is no bag, damaged or incomplete, or lacks a topic, or all messages on one are unusable.
    """
    files = sorted(folder.iterdir()) if folder.is_dir() else []
    state = tuple((file.name, file.stat().st_size, file.stat().st_mtime_ns) for file in files)
    return _read(folder, json.dumps([asdict(topics), asdict(robot)]), status, state)


@lru_cache(maxsize=2)
def _read(folder: Path, settings: str, status: str, state: tuple[Any, ...]) -> BagIndex:
    """Read a bag, cached by the `state` of its files, because composition and import both need it."""
    topics, robot = json.loads(settings)
    return _Reading(folder, Topics(**topics), Robot(**robot), status).index


class _Reading:
    """One pass through a bag."""

    def __init__(self, folder: Path, topics: Topics, robot: Robot, status: str) -> None:
        self.index = BagIndex(folder)
        self._robot, self._joint_states = robot, messages.JointStates(robot)
        self._instruction, self._said_at = "", -np.inf
        self._person: bool | None = None  # whether a person moves the arm, or the policy; None: nobody
        self._has_status, self._seen = False, set[str]()  # cameras of usable images
        self._taken: dict[str, tuple[int, int]] = {}  # camera → time stamp of its last image
        self._number = 0  # of the try: the next one begins with an instruction, or when the agent runs again
        self._moments: list[tuple[float, int, bool | None, str]] = []  # of joint states: try, who moves the arm, words
        self._dropped: dict[str, str] = {}  # topic → why its first unusable message is that
        self._usable: Counter[str] = Counter()  # topic → messages
        with opened(folder) as reader:
            self._handlers = self._handle(topics, status, reader)
            self._read(reader)
        self._require_usable(topics)
        self.index.inputs.sort(key=lambda each: each[0])
        self.index.stretches = [*self._stretches()]

    def _handle(self, topics: Topics, status: str, reader: Any) -> dict[str, Callable[[int, float, Any], None]]:
        """Return topic → message handler; a UserError if a topic is missing or of another type."""
        commands = {JOINTS: self._command, TRAJECTORY: self._trajectory, NUMBERS: self._numbers, TWIST: self._nothing}
        wanted: dict[str, dict[str, Any]] = {}  # topic → type → handler
        for camera, topic in topics.images.items():
            wanted[topic] = dict.fromkeys(IMAGES, lambda ns, at, m, camera=camera: self._image(camera, ns, at, m))
        wanted |= {topics.joint_states: {JOINTS: self._joints}}
        wanted |= {topics.instruction: {"std_msgs/msg/String": self._words}}
        optional = {topics.commands: commands, status: {"diagnostic_msgs/msg/DiagnosticStatus": self._status}}
        optional |= {topics.gripper: {NUMBERS: self._fingers}} if topics.gripper else {}
        optional |= {topics.finger_states: {JOINTS: self._joints}} if topics.finger_states else {}
        there = {connection.topic: connection.msgtype for connection in reader.connections}
        if missing := ", ".join(topic for topic in wanted if topic not in there):
            known = messages.shorten(", ".join(sorted(there)) or "nothing", 500)
            raise UserError(
                f"{self.index.folder} has no topic {missing}, it has {known}: choose others with expert.topics"
            )
        self._tell_missing(topics, status, there)
        wanted |= optional
        for topic, kinds in wanted.items():
            if topic in there and there[topic] not in kinds:
                raise UserError(
                    f"{self.index.folder}: {topic} is of type {messages.shorten(there[topic])}, expected "
                    f"{' or '.join(kinds)}"
                )
        self._has_status = status in there
        self._person = None if self._has_status else True
        return {topic: kinds[there[topic]] for topic, kinds in wanted.items() if topic in there}

    def _tell_missing(self, topics: Topics, status: str, there: Mapping[str, str]) -> None:
        """Log what replaces optional topics that are missing.

        Raises:
            UserError: the topic `status` is missing, but the bag has one of an agent in a namespace.
        """
        missing = {
            topics.commands: "actions follow the measured motion",
            topics.gripper: "actions have the measured opening of the gripper, unless commands contain fingers",
            topics.finger_states: f"fingers are expected on {topics.joint_states}",
            status: "all motion counts as a person's",
        }
        if others := [topic for topic in there if topic.endswith(status) and status not in there]:
            raise UserError(
                f"{self.index.folder} has no topic {status}, which tells who moves the arm, but {others[0]}: choose it "
                f"with expert.status={others[0]}"
            )
        for topic, instead in missing.items():
            if topic and topic not in there:
                log.info("%s has no topic %s: %s", self.index.folder, topic, instead)

    def _read(self, reader: Any) -> None:
        types = message_types()
        connections = [connection for connection in reader.connections if connection.topic in self._handlers]
        kinds = {connection.topic: connection.msgtype for connection in connections}
        folder, start, read = self.index.folder, reader.start_time, 0
        for topic, stamp, raw in messages_of(reader, connections, folder):
            with bag_errors(folder):
                message = types.deserialize_cdr(raw, kinds[topic])
            read += 1
            try:
                self._handlers[topic](stamp, (stamp - start) * 1e-9, message)
                self._usable[topic] += 1
            except ValueError as error:
                self._dropped.setdefault(topic, str(error))
        expected = sum(connection.msgcount for connection in connections)
        if read < expected:
            raise UserError(f"{folder} is incomplete: {read} of {expected} messages are there, was its end cut off?")

    def _require_usable(self, topics: Topics) -> None:
        for topic in (*topics.images.values(), topics.joint_states, topics.instruction):
            if not self._usable[topic]:
                why = self._dropped.get(topic, "there are no messages")
                raise UserError(f"{self.index.folder}: no message on {topic} can be used: {why}")

    # Messages.

    def _image(self, camera: str, stamp: int, at: float, message: Any) -> None:
        taken = message.header.stamp.sec, message.header.stamp.nanosec
        if taken != (0, 0) and taken == self._taken.get(camera):
            raise UserError(f"two images of the camera {camera} have the same time stamp")
        self._taken[camera] = taken
        if camera not in self._seen or not hasattr(message, "format"):
            messages.image_from(message)  # other compressed ones are decoded when they are needed
            self._seen.add(camera)
        age = age_of(taken, stamp * 1e-9)
        self.index.inputs.append((at, Picture(camera, at - age, stamp)))

    def _joints(self, stamp: int, at: float, message: Any) -> None:
        measured = self._joint_states.read(message, at)
        if measured is None:
            return
        joints, velocities, opening = measured
        self.index.inputs.append((at, Measured(at, joints, velocities, opening)))
        self.index.measured.add(at, joints)
        self.index.openings.add(at, opening)
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
            self.index.gripper_commands.add(at, None)  # the policy's last command is not the person's
        if self._person is None and values.get("state") == State.RUNNING:
            self._person = False
        self._number += before is not None and self._person is None

    def _nothing(self, stamp: int, at: float, message: Any) -> None:
        """Ignore twist commands, which contain no joint positions: actions then follow from the measured motion."""

    def _command(self, stamp: int, at: float, message: Any) -> None:
        joints, opening = messages.command_from(message.name, message.position, self._robot)
        self.index.commands.add(at, joints)
        if opening is not None:
            self.index.gripper_commands.add(at, opening)

    def _trajectory(self, stamp: int, at: float, message: Any) -> None:
        for point in message.points:
            due = at + point.time_from_start.sec + point.time_from_start.nanosec * 1e-9
            self.index.commands.add(due, messages.command_from(message.joint_names, point.positions, self._robot)[0])

    def _numbers(self, stamp: int, at: float, message: Any) -> None:
        self.index.commands.add(at, messages.command_from(self._robot.joints, message.data, self._robot)[0])

    def _fingers(self, stamp: int, at: float, message: Any) -> None:
        opening = float(np.mean(message.data)) / self._robot.finger_travel if len(message.data) else np.nan
        if not np.isfinite(opening):
            raise UserError("finger positions that are not finite")
        self.index.gripper_commands.add(at, opening)

    def _stretches(self) -> Iterator[Stretch]:
        """Yield every try, with the times in which a person moved the arm."""
        for (_, words), of_try in groupby(
            (moment for moment in self._moments if moment[2] is not None), key=lambda moment: (moment[1], moment[3])
        ):
            moments = [*of_try]
            start, end = moments[0][0], moments[-1][0]
            runs = [(person, [*run]) for person, run in groupby(moments, key=lambda moment: moment[2])]
            person = tuple((run[0][0], run[-1][0]) for who, run in runs if who)
            if end - start >= SHORTEST:
                yield Stretch(words, start, end, person)
