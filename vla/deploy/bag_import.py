"""Import of ROS 2 bags as demonstrations: of a deployed policy, or of a person who moves the robot.

Times are seconds since the first message of a bag. Shapes: N steps, J joints, P state and D action components.
"""

from __future__ import annotations

import logging
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from vla.data.formats import imported_demonstrations as imported
from vla.deploy import messages
from vla.deploy.bag import DESCRIPTION, bag_errors, messages_of, open_bag
from vla.deploy.control_loop import REPETITION_TIME
from vla.deploy.joint_limiter import JointLimits
from vla.deploy.observer import HISTORY, MAX_STAMP_AGE, JointMeasurement, Observer
from vla.deploy.safety import State
from vla.deploy.settings import Topics
from vla.io.errors import UserError
from vla.io.images import resize
from vla.robots.controllers import gripper_index, recorded_controller
from vla.spec import LONGEST_INSTRUCTION, Array, Episode, Spec

STATUS = "/vla_agent/status"  # end of the name of the topic that tells who moves the arm
GAP = 0.3  # longest time between two commands of one motion [s]
MAX_JOINT_STATE_GAP = 0.2  # largest time between an observation and its joint state [s]
REST_MOTION, REST_OPENING = 0.01, 0.002  # an arm that has moved less [rad], and its gripper [m], is at rest
LEAD = 0.1  # time that is kept before a person's motion begins and after it ends [s]
MAX_STEP_GAP = 1.5  # longest time between two steps without a warning [control periods]
MIN_SEGMENT = 0.5  # shorter segments are left out [s]
MAX_OUTSIDE_SHARE = 0.5  # largest share of a component's actions beyond its bounds; a larger one means other units

log = logging.getLogger(__name__)

Track = list[tuple[float, Array]]  # positions over time
ARRIVAL = itemgetter(0)


class _Picture(NamedTuple):
    """An image; its pixels are read again when they are needed."""

    camera: str
    taken: float


class _Assignment(NamedTuple):
    """The instruction that an arm follows at a time, and who moves it."""

    number: int  # of the instruction: the same one may be given again
    instruction: str
    person: bool  # whether a person moves the arm to follow it, or the policy


class _Segment(NamedTuple):
    """A period in which one instruction was followed, by the policy or a person."""

    instruction: str
    person: bool
    start: float
    end: float

    def __str__(self) -> str:
        return f"{self.start:.1f} to {self.end:.1f} s, '{messages.shorten(self.instruction)}'"


class _Step(NamedTuple):
    """One step of an episode, without its images."""

    taken: float
    arrivals: dict[str, float]  # of its images
    state: Array  # (P,) float32


class _Bag:
    """A bag without its pixels, read once: what a policy node would have heard, and what was commanded."""

    def __init__(self, folder: Path, topics: Topics, limits: JointLimits) -> None:
        self.folder, self._limits, self._joint_states = folder, limits, messages.JointStates(limits)
        self.inputs: list[tuple[float, _Picture | JointMeasurement]] = []  # when they arrived
        self.measured: Track = []  # joints (J,) [rad] and opening [m], together (J + 1,)
        self.commands: Track = []  # (J,) [rad]
        self.openings: Track = []  # commanded, 0 … 1
        self._closing: list[bool] = []  # at every joint state, whether the fingers last closed, not opened
        self._extreme = 0.0  # opening [m], the smallest since they last closed or the largest since they last opened
        self._assignments: list[_Assignment | None] = []  # at every joint state
        self._instruction, self._said_at, self._number = "", -np.inf, 0
        self._used, self._problems = set[str](), dict[str, str]()  # topics; topic → why its first message is unusable
        with open_bag(folder) as reader:
            self.kinds = {connection.topic: connection.msgtype for connection in reader.connections}
            statuses = [topic for topic in self.kinds if topic.endswith(STATUS)]
            if len(statuses) > 1:
                raise UserError(f"{folder} has several agents, {', '.join(statuses)}: record each in a bag of its own")
            status = statuses[0] if statuses else None
            self._has_status = status is not None
            self._person = None if status else True  # whether a person moves the arm, or the policy; None: neither
            handlers: dict[str | None, Callable[[float, Any], None]] = {
                **{topics.joint_states: self._measure, topics.finger_states: self._measure},
                **{topics.instruction: self._instruct, topics.commands: self._command},
                **{topics.gripper: self._command_fingers, status: self._hand_over},
                **{topic: partial(self._see, camera) for camera, topic in topics.images.items()},
            }
            self._start = reader.start_time * 1e-9
            count, total = 0, sum(source.msgcount for source in reader.connections if source.topic in handlers)
            for topic, stamp, message in messages_of(reader, handlers, folder):
                count += 1
                try:
                    handlers[topic]((stamp - reader.start_time) * 1e-9, message)
                    self._used.add(topic)
                except UserError as error:
                    self._problems.setdefault(topic, str(error))
                except (AttributeError, TypeError, ValueError):
                    self._problems.setdefault(topic, f"they are of type {messages.shorten(self.kinds[topic])}")
        if count < total:
            raise UserError(f"{folder} is incomplete: {count} of {total} messages are there, was its end cut off?")
        self.require(topics.joint_states, topics.instruction)

    def require(self, *topics: str) -> None:
        """Raise a UserError unless there are usable messages on topics."""
        for topic in topics:
            if topic not in self.kinds:
                names = messages.shorten(", ".join(sorted(self.kinds)) or "nothing", 500)
                raise UserError(f"{self.folder} has no topic {topic}, it has {names}: choose others with expert.topics")
            if topic not in self._used:
                reason = self._problems.get(topic, "there are no messages")
                raise UserError(f"{self.folder}: no message on {topic} can be used: {reason}")

    def segments(self) -> Iterator[_Segment]:
        """Yield the periods in which an instruction was followed, by a person only while the arm moves."""
        for assignment, group in groupby(zip(self._assignments, self.measured, strict=True), key=itemgetter(0)):
            if assignment is None:
                continue
            times, positions = zip(*(sample for _, sample in group), strict=True)
            start, end = times[0], times[-1]
            if assignment.person:
                points = np.array(positions) / [*[REST_MOTION] * len(self._limits.joints), REST_OPENING]
                left, on_way = (np.flatnonzero(np.abs(points - pose).max(1) > 1) for pose in (points[0], points[-1]))
                start = max(times[left[0]] - LEAD, start) if len(left) else end
                end = min(times[on_way[-1]] + LEAD, end) if len(on_way) else start
            if end - start >= MIN_SEGMENT:
                yield _Segment(assignment.instruction, assignment.person, start, end)

    def sees(self, camera: str, segment: _Segment) -> bool:
        """Return whether there are images of a camera in a segment."""
        start = bisect_left(self.inputs, segment.start, key=ARRIVAL)
        stop = bisect_right(self.inputs, segment.end, key=ARRIVAL)
        pictures = (picture for _, picture in self.inputs[start:stop] if isinstance(picture, _Picture))
        return any(picture.camera == camera and picture.taken >= segment.start for picture in pictures)

    def _see(self, camera: str, arrival: float, message: Any) -> None:
        if not hasattr(message, "format"):
            messages.image_from(message)  # compressed ones are decoded when they are needed
        self.inputs.append((arrival, _Picture(camera, self._capture_time(arrival, message))))

    def _capture_time(self, arrival: float, message: Any) -> float:
        """Return when a message's content was captured: its time stamp if plausible, else that of its `arrival`."""
        stamp = message.header.stamp.sec + message.header.stamp.nanosec * 1e-9
        age = self._start + arrival - stamp
        return arrival - age if stamp and 0 <= age < MAX_STAMP_AGE else arrival

    def _measure(self, arrival: float, message: Any) -> None:
        stamp = self._capture_time(arrival, message)
        if (joint_state := self._joint_states.read(message, stamp)) is None:
            raise UserError("they hold the fingers alone")
        stamp = max(stamp, self.measured[-1][0]) if self.measured else stamp
        self.inputs.append((arrival, joint_state._replace(stamp=stamp)))
        self.measured.append((stamp, np.append(joint_state.joints, joint_state.opening)))
        self._follow_fingers(joint_state.opening)
        assignment = _Assignment(self._number, self._instruction, bool(self._person))
        self._assignments.append(assignment if self._instruction and self._person is not None else None)

    def _follow_fingers(self, opening: float) -> None:
        closing = bool(self._closing and self._closing[-1])
        self._extreme = (min if closing else max)(self._extreme, opening)
        if abs(opening - self._extreme) > REST_OPENING:
            closing, self._extreme = not closing, opening
        self._closing.append(closing)

    def closing(self, time: float) -> bool:
        """Return whether the fingers last closed, not opened, until `time`; then they may hold something."""
        return self._closing[max(bisect_right(self.measured, time, key=ARRIVAL) - 1, 0)]

    def _instruct(self, arrival: float, message: Any) -> None:
        instruction = message.data.strip()
        if len(message.data) > LONGEST_INSTRUCTION:  # which the node drops
            raise UserError(f"an instruction of {len(message.data)} characters, the limit is {LONGEST_INSTRUCTION}")
        if not instruction and self._has_status:  # which stops the node, and its status tells until when
            return
        self._number += instruction != self._instruction or arrival - self._said_at > REPETITION_TIME
        self._instruction, self._said_at = instruction, arrival

    def _hand_over(self, arrival: float, message: Any) -> None:
        values = {pair.key: pair.value for pair in message.values}
        running = False if values.get("state") == State.RUNNING else None
        self._person = True if values.get(messages.HANDED_OVER) == "yes" else running

    def _command(self, arrival: float, message: Any) -> None:
        """Add a command; one without joint positions is dropped: actions follow the measured motion."""
        if hasattr(message, "points"):  # the node replaces all points after the first by its next trajectory
            names, positions = message.joint_names, message.points[0].positions if message.points else ()
        elif hasattr(message, "data"):
            names, positions = self._limits.joints, message.data
        else:
            names, positions = message.name, message.position
        joints, opening = messages.command_from(names, positions, self._limits)
        self.commands.append((arrival, joints))
        if opening is not None:
            self.openings.append((arrival, np.array(opening)))

    def _command_fingers(self, arrival: float, message: Any) -> None:
        fingers = dict(zip(self._limits.fingers, message.data, strict=False))
        if not len(message.data) or not np.isfinite(message.data).all():
            raise UserError("finger positions are missing or not finite")
        if fingers:
            self.openings.append((arrival, np.array(self._limits.opening(fingers))))


class BagDemonstrations(imported.ImportedDemonstrations):
    """Episodes of bags, at the control rate of the task, with the observations that the policy node makes of them.
    Raises a UserError if a bag is missing, damaged or incomplete, lacks topics, or is of another robot.

    An episode is a period in which one instruction was followed, by the policy, or, from motion to rest, by a person to
    whom the arm was handed over; `recorded.person` in its draws tells which. Without the topic of the node's status a
    person always moves the arm. The action of a step is the motion that was commanded for one control period; where
    none was, as when an arm is guided by hand, the measured one, but with closed fingers if these last closed: they may
    hold something. Actions beyond the bounds of the task are clipped, depth is 0. Whether an episode succeeded is not
    known: its outcome is "unverified".

    Args:
        folder: of a bag, or of a folder of bags.
        topics: in the bags.
        robot: names of the joints, and travel of the fingers.
        spec: of the task.
    """

    def __init__(self, folder: Path | str | None, topics: Topics, robot: JointLimits, *, spec: Spec) -> None:
        self.spec, self._limits = spec.without_truth, robot
        model = spec.require_robot("expert=bag")
        robot.require(model, "the task", "expert.robot")
        if missing := [camera for camera in spec.cameras if camera not in topics.images]:
            raise UserError(f"no topic for cameras {', '.join(missing)}: add +expert.topics.images.{missing[0]}=TOPIC")
        self._controller, self._gripper = recorded_controller(spec), gripper_index(spec)
        if self._gripper is not None and not robot.fingers:
            raise UserError("the task moves a gripper: name its joints in expert.robot.fingers")
        self._cameras = {topics.images[camera]: camera for camera in spec.cameras}  # topic → camera
        bags = _read_bags(folder, topics, robot)
        for bag in bags:
            bag.require(*self._cameras)
        segments = _segments(bags, spec.cameras)
        self._episodes = [(bag, segment, self._steps(bag, segment)) for bag, segment in segments]
        self._actions = [
            np.array([self._action(bag, segment, step.taken) for step in steps])
            for bag, segment, steps in self._episodes
        ]
        actions = np.concatenate(self._actions)
        if problems := imported.out_of_bounds(actions, spec, MAX_OUTSIDE_SHARE):
            raise UserError(f"{folder} does not match the task: {'; '.join(problems)}")
        imported.log_clipped(actions, spec)

    @classmethod
    def recording(
        cls, folder: Path | str | None, topics: Mapping[str, Any], robot: Mapping[str, Any]
    ) -> imported.Recording:
        """Describe bags: their state and action are the joints, see `ImportedDemonstrations.recording`."""
        bag_topics = Topics(**{name: value for name, value in topics.items() if name != "_target_"})
        limits = JointLimits(**{name: value for name, value in robot.items() if name != "_target_"})
        bags, joints = _read_bags(folder, bag_topics, limits), tuple(limits.joints)
        cameras = tuple(camera for camera, topic in bag_topics.images.items() if topic in bags[0].kinds)
        bags[0].require(bag_topics.images[cameras[0]] if cameras else next(iter(bag_topics.images.values())))
        values = np.array([value[: len(joints)] for bag in bags for _, value in bag.commands or bag.measured]).T
        bounds = {name: imported.action_bounds(series) for name, series in zip(joints, values, strict=True)}
        pictures = (picture for _, picture in bags[0].inputs if isinstance(picture, _Picture))
        times = [picture.taken for picture in pictures if picture.camera == cameras[0]]
        period = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
        rate = round(1 / period, 1) if period > 0 else 1.0
        return imported.Recording(cameras, rate, joints, joints, bounds, len(_segments(bags, cameras)))

    def __len__(self) -> int:
        """Return the number of episodes."""
        return len(self._episodes)

    def episode(self, number: int) -> Episode:
        """Return one episode, with its images; raise a UserError if they are damaged."""
        bag, segment, steps = self._episodes[number]
        words, state, actions = self.numbers(number)
        images, rows = self._images(bag, steps), {"state": state}
        for camera in self.spec.cameras:
            rows[f"rgb_{camera}"] = np.array([images[camera, step.arrivals[camera]] for step in steps])
        details = {"episode": number, "person": segment.person, "lacks": ["depth"] if self.spec.depth else []}
        return self.recorded_episode(number, words, "unverified", details, rows, actions)

    def numbers(self, number: int) -> tuple[str, Array, Array]:
        """Return what is known of an episode without its images: instruction, state (N, P) and actions (N, D)."""
        _, segment, steps = self._episodes[number]
        return segment.instruction, np.array([step.state for step in steps]), self._actions[number]

    def _steps(self, bag: _Bag, segment: _Segment) -> list[_Step]:
        """Return the steps of a segment, made as the policy node makes observations; raise a UserError without any."""
        observer, steps, period = Observer(self.spec), list[_Step](), 1 / self.spec.control_hz
        start = bisect_left(bag.inputs, segment.start - HISTORY, key=ARRIVAL)
        stop = bisect_right(bag.inputs, segment.end, key=ARRIVAL)
        last, nominal, longest = -np.inf, -np.inf, 0.0  # time of the last step, due time of the next, longest gap [s]
        for arrival, item in bag.inputs[start:stop]:
            if isinstance(item, JointMeasurement):
                observer.add_joint_state(item)
                continue
            observer.add_image(item.camera, np.array(arrival), item.taken)
            time = observer.new_image_time(last, nominal)
            if time is None or observer.newest_joint_state is None or not segment.start <= time <= segment.end - period:
                continue
            joint_state = observer.joint_state_at(time)
            if abs(joint_state.stamp - time) <= MAX_JOINT_STATE_GAP:
                longest = max(longest, time - last if steps else 0.0)
                # Early images must not make all later steps early, too.
                last, nominal = time, (time if time - nominal > period / 2 else nominal) + period
                arrivals = {camera: float(image) for camera, image in observer.images.items()}
                steps.append(_Step(time, arrivals, observer.state(joint_state)))
        if not steps:
            raise UserError(f"{bag.folder} has no matching images of {', '.join(self.spec.cameras)} in {segment}")
        if longest > MAX_STEP_GAP * period:
            reason = "images or joint states are missing, or do not match"
            log.warning("%s: no step for up to %.2f s in %s: %s", bag.folder, longest, segment, reason)
        return steps

    def _images(self, bag: _Bag, steps: Sequence[_Step]) -> dict[tuple[str, float], Array]:
        """Return camera and arrival [s] → image (H, W, 3)."""
        keys = {key for step in steps for key in step.arrivals.items()}
        first, last = (choose(arrival for _, arrival in keys) for choose in (min, max))
        images = dict[tuple[str, float], Array]()
        with open_bag(bag.folder) as reader:
            start = reader.start_time
            span = start + round(first * 1e9), start + round(last * 1e9) + 1
            for topic, stamp, message in messages_of(reader, self._cameras, bag.folder, *span):
                if (key := (self._cameras[topic], (stamp - start) * 1e-9)) in keys:
                    with bag_errors(bag.folder):
                        images[key] = resize(messages.image_from(message), self.spec.image_size)
        return images

    def _action(self, bag: _Bag, segment: _Segment, start: float) -> Array:
        """Return the (D,) motion from `start` over one control period."""
        end, joints = start + 1 / self.spec.control_hz, len(self._limits.joints)
        track = bag.commands if _covers(bag.commands, start) and _covers(bag.commands, end) else bag.measured
        motion = self._controller.motion_between(*(_interpolate(track, time)[:joints] for time in (start, end)))
        if self._gripper is None:
            return motion
        openings = bag.openings[: bisect_right(bag.openings, end, key=ARRIVAL)][-1:]
        if openings and openings[0][0] >= segment.start:  # an earlier command was the policy's, not the person's
            return np.insert(motion, self._gripper, openings[0][1])
        opening = self._limits.share(_interpolate(bag.measured, end)[joints])
        # What is held keeps fingers apart, and at that opening a policy would not grip.
        return np.insert(motion, self._gripper, 0.0 if bag.closing(end) else opening)


def _covers(track: Track, time: float) -> bool:
    """Return whether there are positions shortly before and shortly after `time`."""
    place = bisect_right(track, time, key=ARRIVAL)
    return 0 < place < len(track) and track[place][0] - track[place - 1][0] <= GAP


def _interpolate(track: Track, time: float) -> Array:
    index = min(bisect_left(track, time, key=ARRIVAL), len(track) - 1)
    (begin, start), (end, stop) = track[max(index - 1, 0)], track[index]
    return start + min(max((time - begin) / max(end - begin, 1e-9), 0.0), 1.0) * (stop - start)


def _read_bags(folder: Path | str | None, topics: Topics, limits: JointLimits) -> list[_Bag]:
    if folder is None:
        raise UserError("expert=bag needs a bag: name its folder with expert=bag expert.folder=DIR")
    folders = sorted(path.parent for path in Path(folder).glob(f"*/{DESCRIPTION}"))
    return [_Bag(path, topics, limits) for path in folders or [Path(folder)]]


def _segments(bags: Sequence[_Bag], cameras: Sequence[str]) -> list[tuple[_Bag, _Segment]]:
    """Return the segments that are episodes: those with images of all cameras; raise a UserError if there are none."""
    segments = []
    for bag, segment in ((source, segment) for source in bags for segment in source.segments()):
        if unseen_cameras := [camera for camera in cameras if not bag.sees(camera, segment)]:
            log.warning("%s: no image of %s in %s, which is left out", bag.folder, ", ".join(unseen_cameras), segment)
        else:
            segments.append((bag, segment))
    if segments:
        return segments
    raise UserError(f"{bags[0].folder} has no instruction that was followed with images of {', '.join(cameras)}")
