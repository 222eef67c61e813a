"""Observations from images and joint states that arrive one by one, for a policy and for the import of bags. No ROS.

All times are seconds on one clock. Shapes: J joints, P state components.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np

from vla.io.errors import UserError
from vla.robots.controllers import UNITS
from vla.spec import Array, Spec

EARLY_SHARE = 0.25  # share of a control period by which an image may precede the next planned observation
HISTORY = 1.0  # duration of the history of joint states [s]
MAX_CLOCK_ERROR = 0.1  # by which a time stamp may be in the future, because clocks differ [s]
MAX_STAMP_AGE = 10.0  # age above which a time stamp is taken for that of another clock [s]
MAX_SKEW = 0.05  # largest difference between the time stamps of one set of images [s]


class JointMeasurement(NamedTuple):
    """A joint state."""

    stamp: float
    joints: Array  # (J,) [rad]
    velocities: Array  # (J,) [rad/s]
    opening: float  # of the gripper [m]


class Observer:
    """The newest images of all cameras, with the joint state nearest to them in time.

    Images within `MAX_SKEW` of each other form a matching set.
    """

    def __init__(self, spec: Spec) -> None:
        """Args: the spec of the policy.

        Raises:
            UserError: the spec has no robot, or its state has more than joint states contain.
        """
        self._spec, self._model = spec, spec.require_robot("deployment")
        if extra_names := [name for name in spec.state if name not in self._model.components]:
            raise UserError(f"the policy's state has {', '.join(extra_names)}, which joint states do not contain")
        self._factors = np.array([UNITS.get(unit.removesuffix("/s"), 1.0) for unit in spec.state_units])
        self.fresh_sets = 0  # matching sets since the last reset to 0, each with a newer image of every camera
        self._newest: dict[str, tuple[float, Array]] = {}  # camera → time stamp and image
        self._counted_stamps: dict[str, float] = {}  # camera → time stamp of its image in the last counted set
        self._matched_at = -np.inf  # newest time stamp in the last matching set
        self._joint_states: deque[JointMeasurement] = deque()

    def add_image(self, camera: str, image: Array, stamp: float) -> None:
        """Add an image (H, W, 3) uint8 that was taken at `stamp`."""
        self._newest[camera] = (stamp, image)
        if self.image_time is None:
            return
        times = {name: self._newest[name][0] for name in self._spec.cameras}
        self._matched_at = max(times.values())
        if all(time > self._counted_stamps.get(name, -np.inf) for name, time in times.items()):
            self.fresh_sets, self._counted_stamps = self.fresh_sets + 1, times

    def add_joint_state(self, measured: JointMeasurement) -> None:
        """Add a joint state."""
        self._joint_states.append(measured)
        while self._joint_states[0].stamp < measured.stamp - HISTORY:
            self._joint_states.popleft()

    @property
    def newest_joint_state(self) -> JointMeasurement | None:
        """The newest joint state."""
        return self._joint_states[-1] if self._joint_states else None

    @property
    def image_time(self) -> float | None:
        """Oldest time stamp of the newest images; None if these do not form a matching set."""
        if any(camera not in self._newest for camera in self._spec.cameras):
            return None
        times = [self._newest[camera][0] for camera in self._spec.cameras]
        return min(times) if max(times) - min(times) <= MAX_SKEW else None

    @property
    def images(self) -> dict[str, Array]:
        """Camera → its newest image."""
        return {camera: self._newest[camera][1] for camera in self._spec.cameras}

    def image_problem(self, now: float, max_age: float) -> str:
        """Describe an image that is missing or older than `max_age` [s], or images unmatched for so long; else ""."""
        for camera in self._spec.cameras:
            if camera not in self._newest:
                return f"no image of the camera {camera} yet"
            if now - self._newest[camera][0] > max_age:
                return f"the newest image of the camera {camera} is older than {max_age} s"
        if now - self._matched_at > max_age:
            return f"the images of {', '.join(self._spec.cameras)} are more than {MAX_SKEW} s apart"
        return ""

    @property
    def duration(self) -> float:
        """Time from the oldest joint state in the history to the newest [s]."""
        return self._joint_states[-1].stamp - self._joint_states[0].stamp if self._joint_states else 0.0

    def displacement(self, seconds: float) -> float:
        """Return how far a joint has moved within the last `seconds` of the history [rad]."""
        positions = [state.joints for state in self._recent(seconds)]
        return float(np.ptp(positions, axis=0).max()) if positions else 0.0

    def jump(self, seconds: float, speed: Array) -> float:
        """Return how much farther a joint has moved between two joint states of the last `seconds` than `speed` (J,)
        allows [rad]."""
        states = self._recent(seconds)
        times, joints = np.array([state.stamp for state in states]), np.array([state.joints for state in states])
        allowed = np.abs(np.diff(times))[:, None] * speed
        return float((np.abs(np.diff(joints, axis=0)) - allowed).max(initial=0.0))

    def _recent(self, seconds: float) -> list[JointMeasurement]:
        return [state for state in self._joint_states if state.stamp >= self._joint_states[-1].stamp - seconds]

    def new_image_time(self, previous: float, earliest: float) -> float | None:
        """Return when the newest images were taken; None unless they match, after `previous`, from about `earliest`."""
        time, slack = self.image_time, EARLY_SHARE / self._spec.control_hz
        return None if time is None or time <= previous or time < earliest - slack else time

    def joint_state_at(self, stamp: float) -> JointMeasurement:
        """Return the joint state nearest to `stamp` in the history."""
        return min(self._joint_states, key=lambda state: abs(state.stamp - stamp))

    def state(self, measured: JointMeasurement) -> Array:
        """Return the robot state (P,) float32 in the order and units of the spec."""
        values = dict(zip(self._model.joints, measured.joints, strict=True))
        values |= dict(zip(self._model.velocities, measured.velocities, strict=False))
        return np.array([values.get(name, measured.opening) for name in self._spec.state] / self._factors, np.float32)
