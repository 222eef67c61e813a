"""Import of ROS 2 bags of a deployed policy, or of a person who moves the robot, as demonstrations.

Shapes: N steps, P state components, D action components.
"""

from __future__ import annotations

import logging
from bisect import bisect_left
from collections.abc import Mapping, Sequence
from itertools import islice
from operator import itemgetter
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from vla.data.formats.imported_demonstrations import ImportedDemonstrations, Recording, action_bounds
from vla.deploy import messages
from vla.deploy.bag import bag_errors, messages_of, opened
from vla.deploy.bag_index import BagIndex, Picture, Stretch, read_index
from vla.deploy.joint_limiter import JointLimits
from vla.deploy.observer import HISTORY, Observer
from vla.deploy.settings import Topics
from vla.io.errors import UserError
from vla.io.images import Crop, resize
from vla.io.types import Text
from vla.robots.controllers import gripper_index, recorded_controller
from vla.spec import Array, Episode, Observation, Spec

MEASURED_WITHIN = 0.2  # largest time between an observation and its joint state [s]
ROUNDING = 1e-6  # tolerance of the action bounds
MOSTLY = 0.5  # largest share of a component's actions beyond its bounds; a larger one means other units

log = logging.getLogger(__name__)


class _Step(NamedTuple):
    """One step of an episode, without its images."""

    at: float  # when its images were taken [s]
    pictures: dict[str, int]  # camera → when its image was recorded [ns]
    state: Array  # (P,) float32


class BagDemonstrations(ImportedDemonstrations):
    """Episodes of a bag, at the control rate of the task, with the observations that the policy node makes of it.

    The action of a step is the motion that was commanded for one control period, whoever commanded it; where nobody
    did, as when an arm is guided by hand, the measured one. The gripper's is its last command, or its measured opening
    if there is none in the bag. Actions beyond the bounds of the task are clipped, depth is 0 (no return). Whether an
    episode succeeded is not known: its outcome is "unverified". Its draws list the steps in which a person acted,
    `expert_acts`, and their share, `recorded.corrected`.

    Args:
        folder: of the bag.
        steps: "corrected": every motion of a person is an episode; "all": every try of an instruction is, with what
            the policy did.
        topics: in the bag.
        status: topic of the policy node's status, which tells who moves the arm; without it, a person always does.
        robot: names of the joints, and travel of the fingers.
        image_crop: of images with another aspect ratio than the task's, crop the centre or distort the whole.
        spec: of the task.

    Raises:
        UserError: the bag is missing, damaged or incomplete, lacks topics, or is of another robot.
    """

    def __init__(
        self,
        folder: Path | str | None,
        steps: Literal["corrected", "all"],
        topics: Topics,
        status: Text,
        robot: JointLimits,
        image_crop: Crop,
        *,
        spec: Spec,
    ) -> None:
        self.spec, self._limits, self._crop = spec.without_truth, robot, image_crop
        model = spec.require_robot("expert=bag")
        if len(robot.joints) != len(model.joints):
            raise UserError(f"the task's robot has {len(model.joints)} joints, expert.robot has {len(robot.joints)}")
        if missing := [camera for camera in spec.cameras if camera not in topics.images]:
            raise UserError(f"no topic for the cameras {', '.join(missing)}: add +expert.topics.images.{missing[0]}")
        self._controller, self._gripper = recorded_controller(spec), gripper_index(spec)
        self._cameras = {topics.images[camera]: camera for camera in spec.cameras}  # topic → camera
        self._index = read_index(_folder_of(folder), topics, robot, status)
        for topic in self._cameras:
            self._index.require(topic)
        self._stretches = _chosen(self._index, steps)
        self._steps = [self._steps_in(stretch) for stretch in self._stretches]
        self._actions = [np.array([self._action(step.at) for step in taken]) for taken in self._steps]
        self._require_bounds(np.concatenate(self._actions))

    @classmethod
    def recording(
        cls,
        folder: Path | str | None,
        steps: str,
        topics: Mapping[str, Any],
        status: str,
        robot: Mapping[str, Any],
        image_crop: str,
    ) -> Recording:
        """Describe a bag: its state and action are the joints, see `ImportedDemonstrations.recording`."""
        limits = JointLimits(**{name: value for name, value in robot.items() if name != "_target_"})
        named = Topics(**{name: value for name, value in topics.items() if name != "_target_"})
        index = read_index(_folder_of(folder), named, limits, status)
        cameras = tuple(camera for camera, topic in named.images.items() if topic in index.kinds)
        index.require(named.images[cameras[0]] if cameras else next(iter(named.images.values())))
        track = index.commands if index.commands.times else index.measured
        values = np.transpose(track.values)
        bounds = {name: action_bounds(each) for name, each in zip(limits.joints, values, strict=True)}
        taken = [each.at for _, each in index.inputs if isinstance(each, Picture) and each.camera == cameras[0]]
        period = float(np.median(np.diff(taken))) if len(taken) > 1 else 0.0
        rate = round(1 / period, 1) if period > 0 else 1.0
        joints = tuple(limits.joints)
        return Recording(cameras, rate, joints, joints, bounds, len(_chosen(index, steps)))

    def __len__(self) -> int:
        """Return the number of episodes."""
        return len(self._stretches)

    def episode(self, number: int) -> Episode:
        """Return one episode, with its images; raise a UserError if they are damaged."""
        spec, stretch, steps = self.spec, self._stretches[number], self._steps[number]
        images = self._images(steps)
        depth = {camera: np.zeros(spec.image_size, np.uint16) for camera in spec.depth}
        observations = [
            Observation(
                {camera: images[camera, stamp] for camera, stamp in step.pictures.items()},
                step.state,
                stretch.instruction,
                depth,
            )
            for step in steps
        ]
        clipped = np.clip(self._actions[number], spec.low, spec.high).astype(np.float32)
        acts = _runs([any(start <= step.at <= end for start, end in stretch.person) for step in steps])
        share = sum(last - first + 1 for first, last in acts) / len(steps)
        recorded = {"episode": number, "corrected": round(share, 3), "lacks": ["depth"] if spec.depth else []}
        draws = {"recorded": recorded, "expert_acts": acts}
        what = (number, "recorded", stretch.instruction, "unverified", frozenset[str](), draws)
        return Episode(*what, observations, clipped, clipped)

    def _require_bounds(self, actions: Array) -> None:
        """Log how many actions (N, D) are to be clipped; raise a UserError if they are in other units."""
        beyond = (actions < np.array(self.spec.low) - ROUNDING) | (actions > np.array(self.spec.high) + ROUNDING)
        if far := [name for name, share in zip(self.spec.action, beyond.mean(0), strict=True) if share > MOSTLY]:
            raise UserError(
                f"{self._index.folder}: most actions exceed the bounds of {', '.join(far)}: set task.low and task.high "
                "in the units of task.units"
            )
        if beyond.any():
            log.info("%.2g %% of the actions are clipped to the bounds of the task", 100 * beyond.any(1).mean())

    def _steps_in(self, stretch: Stretch) -> list[_Step]:
        """Return the steps of a stretch, made as the policy node makes its observations; a UserError without any."""
        observer, steps, period = Observer(self.spec), list[_Step](), 1 / self.spec.control_hz
        last = earliest = -np.inf
        first = bisect_left(self._index.inputs, stretch.start - HISTORY, key=itemgetter(0))
        for now, each in islice(self._index.inputs, first, None):
            if now > stretch.end:
                break
            if not isinstance(each, Picture):
                observer.add_joint_state(each)
                continue
            observer.add_image(each.camera, np.array(each.stamp), each.at)
            taken = observer.due(last, earliest)
            if taken is None or observer.newest is None or not stretch.start <= taken <= stretch.end - period:
                continue
            measured = observer.measured_at(taken)
            if abs(measured.at - taken) <= MEASURED_WITHIN:
                pictures = {camera: int(stamp) for camera, stamp in observer.images.items()}
                steps.append(_Step(taken, pictures, observer.state(measured)))
                last, earliest = taken, taken + period
        if not steps:
            raise UserError(
                f"{self._index.folder} has no matching images of {', '.join(self.spec.cameras)} from "
                f"{stretch.start:.1f} to {stretch.end:.1f} s, in '{messages.shorten(stretch.instruction)}'"
            )
        return steps

    def _images(self, steps: Sequence[_Step]) -> dict[tuple[str, int], Array]:
        """Return camera and time of recording [ns] → image (H, W, 3)."""
        wanted = {picture for step in steps for picture in step.pictures.items()}
        span = min(stamp for _, stamp in wanted), max(stamp for _, stamp in wanted) + 1
        images, folder = dict[tuple[str, int], Array](), self._index.folder
        with opened(folder) as reader:
            connections = [connection for connection in reader.connections if connection.topic in self._cameras]
            for topic, stamp, message in messages_of(reader, connections, folder, *span):
                if (key := (self._cameras[topic], stamp)) in wanted:
                    with bag_errors(folder):
                        images[key] = resize(messages.image_from(message), self.spec.image_size, self._crop)
        return images

    def _action(self, at: float) -> Array:
        """Return the (D,) motion from `at` over one control period."""
        index, end = self._index, at + 1 / self.spec.control_hz
        track = index.commands if index.commands.covers(at) and index.commands.covers(end) else index.measured
        motion = self._controller.motion_between(track.between(at), track.between(end))
        if self._gripper is None:
            return motion
        opening = index.gripper_commands.last(end)
        if opening is None:
            opening = float(index.openings.between(end)) / self._limits.stroke
        return np.insert(motion, self._gripper, opening)


def _folder_of(folder: Path | str | None) -> Path:
    if folder is None:
        raise UserError("expert=bag needs a bag: name its folder with expert=bag expert.folder=DIR")
    return Path(folder)


def _chosen(index: BagIndex, steps: str) -> list[Stretch]:
    """Return the stretches that are episodes; a UserError if there are none."""
    found = index.corrections() if steps == "corrected" else index.stretches
    if not found and index.stretches:
        raise UserError(
            f"{index.folder} has no corrections: nobody moved the arm after ~/hand_over. expert.steps=all also takes "
            "what the policy did"
        )
    if not found:
        raise UserError(f"{index.folder} has no instruction that an arm followed")
    return found


def _runs(flags: Sequence[bool]) -> list[tuple[int, int]]:
    """Return the first and the last step of every run of true ones."""
    edges = np.flatnonzero(np.diff([False, *flags, False])).reshape(-1, 2)
    return [(int(first), int(last) - 1) for first, last in edges]
