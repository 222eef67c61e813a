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
from vla.deploy.bag import DESCRIPTION, bag_errors, messages_of, opened
from vla.deploy.control_loop import REPEATED
from vla.deploy.joint_limiter import JointLimits
from vla.deploy.observer import HISTORY, OLDEST, Measured, Observer
from vla.deploy.safety import State
from vla.deploy.settings import Topics
from vla.io.errors import UserError
from vla.io.images import resize
from vla.robots.controllers import gripper_index, recorded_controller
from vla.spec import LONGEST_INSTRUCTION, Array, Episode, Spec

STATUS = "/vla_agent/status"  # end of the name of the topic that tells who moves the arm
GAP = 0.3  # longest time between two commands of one motion [s]
MEASURED_WITHIN = 0.2  # largest time between an observation and its joint state [s]
STILL, STILL_OPENING = 0.01, 0.002  # an arm that has moved less [rad], and its gripper [m], is at rest
LEAD = 0.1  # time that is kept before a person's motion begins and after it ends [s]
LATE = 1.5  # longest time between two steps without a warning [control periods]
SHORTEST = 0.5  # shorter segments are left out [s]
MOSTLY = 0.5  # largest share of a component's actions beyond its bounds; a larger one means other units

log = logging.getLogger(__name__)

Track = list[tuple[float, Array]]  # positions over time
WHEN = itemgetter(0)


class _Picture(NamedTuple):
    """An image; its pixels are read again when they are needed."""

    camera: str
    taken: float


class _Followed(NamedTuple):
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
        """Format the time and the instruction."""
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
        self.inputs: list[tuple[float, _Picture | Measured]] = []  # when they arrived
        self.measured: Track = []  # joints (J,) [rad] and opening [m], together (J + 1,)
        self.commands: Track = []  # (J,) [rad]
        self.openings: Track = []  # commanded, 0 … 1
        self._followed: list[_Followed | None] = []  # at every joint state
        self._instruction, self._said_at, self._number = "", -np.inf, 0
        self._used, self._dropped = set[str](), dict[str, str]()  # topics; topic → why its first message is unusable
        with opened(folder) as reader:
            self.kinds = {connection.topic: connection.msgtype for connection in reader.connections}
            status = next((topic for topic in self.kinds if topic.endswith(STATUS)), None)
            self._has_status = status is not None
            self._person = None if status else True  # whether a person moves the arm, or the policy; None: neither
            handlers: dict[str | None, Callable[[float, Any], None]] = {
                **{topics.joint_states: self._measure, topics.finger_states: self._measure},
                **{topics.instruction: self._instruct, topics.commands: self._command},
                **{topics.gripper: self._command_fingers, status: self._hand_over},
                **{topic: partial(self._see, camera) for camera, topic in topics.images.items()},
            }
            self._start = reader.start_time * 1e-9
            read, expected = 0, sum(each.msgcount for each in reader.connections if each.topic in handlers)
            for topic, stamp, message in messages_of(reader, handlers, folder):
                read += 1
                try:
                    handlers[topic]((stamp - reader.start_time) * 1e-9, message)
                    self._used.add(topic)
                except UserError as error:
                    self._dropped.setdefault(topic, str(error))
                except (AttributeError, TypeError, ValueError):
                    self._dropped.setdefault(topic, f"they are of type {messages.shorten(self.kinds[topic])}")
        if read < expected:
            raise UserError(f"{folder} is incomplete: {read} of {expected} messages are there, was its end cut off?")
        self.require(topics.joint_states, topics.instruction)

    def require(self, *topics: str) -> None:
        """Raise a UserError unless there are usable messages on topics."""
        for topic in topics:
            if topic not in self.kinds:
                known = messages.shorten(", ".join(sorted(self.kinds)) or "nothing", 500)
                raise UserError(f"{self.folder} has no topic {topic}, it has {known}: choose others with expert.topics")
            if topic not in self._used:
                why = self._dropped.get(topic, "there are no messages")
                raise UserError(f"{self.folder}: no message on {topic} can be used: {why}")

    def segments(self) -> Iterator[_Segment]:
        """Yield the periods in which an instruction was followed, by a person only while the arm moves."""
        for followed, group in groupby(zip(self._followed, self.measured, strict=True), key=itemgetter(0)):
            if followed is None:
                continue
            times, positions = zip(*(measured for _, measured in group), strict=True)
            start, end = times[0], times[-1]
            if followed.person:
                scaled = np.array(positions) / [*[STILL] * len(self._limits.joints), STILL_OPENING]
                left, on_way = (np.flatnonzero(np.abs(scaled - rest).max(1) > 1) for rest in (scaled[0], scaled[-1]))
                start = max(times[left[0]] - LEAD, start) if len(left) else end
                end = min(times[on_way[-1]] + LEAD, end) if len(on_way) else start
            if end - start >= SHORTEST:
                yield _Segment(followed.instruction, followed.person, start, end)

    def sees(self, camera: str, segment: _Segment) -> bool:
        """Return whether there are images of a camera in a segment."""
        first = bisect_left(self.inputs, segment.start, key=WHEN)
        stop = bisect_right(self.inputs, segment.end, key=WHEN)
        pictures = (each for _, each in self.inputs[first:stop] if isinstance(each, _Picture))
        return any(each.camera == camera and each.taken >= segment.start for each in pictures)

    def _see(self, camera: str, at: float, message: Any) -> None:
        if not hasattr(message, "format"):
            messages.image_from(message)  # compressed ones are decoded when they are needed
        self.inputs.append((at, _Picture(camera, self._taken(at, message))))

    def _taken(self, at: float, message: Any) -> float:
        """Return when a message's content was captured: its time stamp if plausible, else `at`, when it came."""
        taken = message.header.stamp.sec + message.header.stamp.nanosec * 1e-9
        age = self._start + at - taken
        return at - age if taken and 0 <= age < OLDEST else at

    def _measure(self, at: float, message: Any) -> None:
        taken = self._taken(at, message)
        if (measured := self._joint_states.read(message, taken)) is None:
            raise UserError("they hold the fingers alone")
        taken = max(taken, self.measured[-1][0]) if self.measured else taken
        self.inputs.append((at, Measured(taken, *measured)))
        self.measured.append((taken, np.append(measured[0], measured[2])))
        followed = _Followed(self._number, self._instruction, bool(self._person))
        self._followed.append(followed if self._instruction and self._person is not None else None)

    def _instruct(self, at: float, message: Any) -> None:
        said = message.data.strip()
        if len(message.data) > LONGEST_INSTRUCTION:  # which the node drops
            raise UserError(f"an instruction of {len(message.data)} characters, the limit is {LONGEST_INSTRUCTION}")
        if not said and self._has_status:  # which stops the node, and its status tells until when
            return
        self._number += said != self._instruction or at - self._said_at > REPEATED
        self._instruction, self._said_at = said, at

    def _hand_over(self, at: float, message: Any) -> None:
        values = {pair.key: pair.value for pair in message.values}
        running = False if values.get("state") == State.RUNNING else None
        self._person = True if values.get(messages.HANDED_OVER) == "yes" else running

    def _command(self, at: float, message: Any) -> None:
        """Add a command; one without joint positions is dropped: actions follow the measured motion."""
        if hasattr(message, "points"):  # the node replaces all points after the first by its next trajectory
            names, positions = message.joint_names, message.points[0].positions if message.points else ()
        elif hasattr(message, "data"):
            names, positions = self._limits.joints, message.data
        else:
            names, positions = message.name, message.position
        joints, opening = messages.command_from(names, positions, self._limits)
        self.commands.append((at, joints))
        if opening is not None:
            self.openings.append((at, np.array(opening)))

    def _command_fingers(self, at: float, message: Any) -> None:
        if not len(message.data) or not np.isfinite(message.data).all():
            raise UserError("finger positions are missing or not finite")
        self.openings.append((at, np.mean(message.data) / self._limits.finger_travel))


class BagDemonstrations(imported.ImportedDemonstrations):
    """Episodes of bags, at the control rate of the task, with the observations that the policy node makes of them.
    Raises a UserError if a bag is missing, damaged or incomplete, lacks topics, or is of another robot.

    An episode is a period in which one instruction was followed, by the policy, or, from motion to rest, by a person to
    whom the arm was handed over; `recorded.person` in its draws tells which. Without the topic of the node's status a
    person always moves the arm. The action of a step is the motion that was commanded for one control period; where
    none was, as when an arm is guided by hand, the measured one. Actions beyond the bounds of the task are clipped,
    depth is 0. Whether an episode succeeded is not known: its outcome is "unverified".

    Args:
        folder: of a bag, or of a folder of bags.
        topics: in the bags.
        robot: names of the joints, and travel of the fingers.
        spec: of the task.
    """

    def __init__(self, folder: Path | str | None, topics: Topics, robot: JointLimits, *, spec: Spec) -> None:
        self.spec, self._limits = spec.without_truth, robot
        model = spec.require_robot("expert=bag")
        if len(robot.joints) != len(model.joints):
            counts = f"the task's robot has {len(model.joints)} joints, expert.robot has {len(robot.joints)}"
            raise UserError(f"{counts}: choose another one with deploy/robot@expert.robot=OPTION")
        if missing := [camera for camera in spec.cameras if camera not in topics.images]:
            raise UserError(f"no topic for cameras {', '.join(missing)}: add +expert.topics.images.{missing[0]}=TOPIC")
        self._controller, self._gripper = recorded_controller(spec), gripper_index(spec)
        self._cameras = {topics.images[camera]: camera for camera in spec.cameras}  # topic → camera
        bags = _read_bags(folder, topics, robot)
        for bag in bags:
            bag.require(*self._cameras)
        found = _segments(bags, spec.cameras)
        self._episodes = [(bag, segment, self._steps(bag, segment)) for bag, segment in found]
        self._actions = [
            np.array([self._action(bag, segment, step.taken) for step in steps])
            for bag, segment, steps in self._episodes
        ]
        actions = np.concatenate(self._actions)
        if wrong := imported.out_of_bounds(actions, spec, MOSTLY):
            raise UserError(f"{folder} does not match the task: {'; '.join(wrong)}")
        imported.log_clipped(actions, spec)

    @classmethod
    def recording(
        cls, folder: Path | str | None, topics: Mapping[str, Any], robot: Mapping[str, Any]
    ) -> imported.Recording:
        """Describe bags: their state and action are the joints, see `ImportedDemonstrations.recording`."""
        named = Topics(**{name: value for name, value in topics.items() if name != "_target_"})
        limits = JointLimits(**{name: value for name, value in robot.items() if name != "_target_"})
        bags, joints = _read_bags(folder, named, limits), tuple(limits.joints)
        cameras = tuple(camera for camera, topic in named.images.items() if topic in bags[0].kinds)
        bags[0].require(named.images[cameras[0]] if cameras else next(iter(named.images.values())))
        values = np.array([value[: len(joints)] for bag in bags for _, value in bag.commands or bag.measured]).T
        bounds = {name: imported.action_bounds(each) for name, each in zip(joints, values, strict=True)}
        pictures = (each for _, each in bags[0].inputs if isinstance(each, _Picture))
        taken = [each.taken for each in pictures if each.camera == cameras[0]]
        period = float(np.median(np.diff(taken))) if len(taken) > 1 else 0.0
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
        recorded = {"episode": number, "person": segment.person, "lacks": ["depth"] if self.spec.depth else []}
        return self.recorded_episode(number, words, "unverified", recorded, rows, actions)

    def numbers(self, number: int) -> tuple[str, Array, Array]:
        """Return what is known of an episode without its images: instruction, state (N, P) and actions (N, D)."""
        _, segment, steps = self._episodes[number]
        return segment.instruction, np.array([step.state for step in steps]), self._actions[number]

    def _steps(self, bag: _Bag, segment: _Segment) -> list[_Step]:
        """Return the steps of a segment, made as the policy node makes observations; raise a UserError without any."""
        observer, steps, period = Observer(self.spec), list[_Step](), 1 / self.spec.control_hz
        first = bisect_left(bag.inputs, segment.start - HISTORY, key=WHEN)
        stop = bisect_right(bag.inputs, segment.end, key=WHEN)
        last, nominal, longest = -np.inf, -np.inf, 0.0  # time of the last step, due time of the next, longest gap [s]
        for now, each in bag.inputs[first:stop]:
            if isinstance(each, Measured):
                observer.add_joint_state(each)
                continue
            observer.add_image(each.camera, np.array(now), each.taken)
            at = observer.due(last, nominal)
            if at is None or observer.newest is None or not segment.start <= at <= segment.end - period:
                continue
            measured = observer.measured_at(at)
            if abs(measured.at - at) <= MEASURED_WITHIN:
                longest = max(longest, at - last if steps else 0.0)
                # Early images must not make all later steps early, too.
                last, nominal = at, (at if at - nominal > period / 2 else nominal) + period
                arrivals = {camera: float(image) for camera, image in observer.images.items()}
                steps.append(_Step(at, arrivals, observer.state(measured)))
        if not steps:
            raise UserError(f"{bag.folder} has no matching images of {', '.join(self.spec.cameras)} in {segment}")
        if longest > LATE * period:
            why = "images or joint states are missing, or do not match"
            log.warning("%s: no step for up to %.2f s in %s: %s", bag.folder, longest, segment, why)
        return steps

    def _images(self, bag: _Bag, steps: Sequence[_Step]) -> dict[tuple[str, float], Array]:
        """Return camera and arrival [s] → image (H, W, 3)."""
        wanted = {place for step in steps for place in step.arrivals.items()}
        first, last = (choose(at for _, at in wanted) for choose in (min, max))
        images = dict[tuple[str, float], Array]()
        with opened(bag.folder) as reader:
            start = reader.start_time
            span = start + round(first * 1e9), start + round(last * 1e9) + 1
            for topic, stamp, message in messages_of(reader, self._cameras, bag.folder, *span):
                if (place := (self._cameras[topic], (stamp - start) * 1e-9)) in wanted:
                    with bag_errors(bag.folder):
                        images[place] = resize(messages.image_from(message), self.spec.image_size)
        return images

    def _action(self, bag: _Bag, segment: _Segment, at: float) -> Array:
        """Return the (D,) motion from `at` over one control period."""
        end, joints = at + 1 / self.spec.control_hz, len(self._limits.joints)
        track = bag.commands if _covers(bag.commands, at) and _covers(bag.commands, end) else bag.measured
        motion = self._controller.motion_between(*(_between(track, when)[:joints] for when in (at, end)))
        if self._gripper is None:
            return motion
        told = bag.openings[: bisect_right(bag.openings, end, key=WHEN)][-1:]
        if told and told[0][0] >= segment.start:  # an earlier command was the policy's, not the person's
            return np.insert(motion, self._gripper, told[0][1])
        return np.insert(motion, self._gripper, _between(bag.measured, end)[joints] / self._limits.stroke)


def _covers(track: Track, at: float) -> bool:
    """Return whether there are positions shortly before and shortly after `at`."""
    place = bisect_right(track, at, key=WHEN)
    return 0 < place < len(track) and track[place][0] - track[place - 1][0] <= GAP


def _between(track: Track, at: float) -> Array:
    """Interpolate linearly."""
    after = min(bisect_left(track, at, key=WHEN), len(track) - 1)
    (begin, start), (end, stop) = track[max(after - 1, 0)], track[after]
    return start + min(max((at - begin) / max(end - begin, 1e-9), 0.0), 1.0) * (stop - start)


def _read_bags(folder: Path | str | None, topics: Topics, limits: JointLimits) -> list[_Bag]:
    if folder is None:
        raise UserError("expert=bag needs a bag: name its folder with expert=bag expert.folder=DIR")
    inside = sorted(path.parent for path in Path(folder).glob(f"*/{DESCRIPTION}"))
    return [_Bag(each, topics, limits) for each in inside or [Path(folder)]]


def _segments(bags: Sequence[_Bag], cameras: Sequence[str]) -> list[tuple[_Bag, _Segment]]:
    """Return the segments that are episodes: those with images of all cameras; raise a UserError if there are none."""
    found = []
    for bag, segment in ((each, segment) for each in bags for segment in each.segments()):
        if blind := [camera for camera in cameras if not bag.sees(camera, segment)]:
            log.warning("%s: no image of %s in %s, which is left out", bag.folder, ", ".join(blind), segment)
        else:
            found.append((bag, segment))
    if found:
        return found
    raise UserError(f"{bags[0].folder} has no instruction that was followed with images of {', '.join(cameras)}")
