"""Time-outs and limits that hold or stop an arm, and the states of its control. No ROS.

All times are seconds on one monotonic clock.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from vla.deploy.motion import Motion
from vla.deploy.observer import JointMeasurement
from vla.io.types import Count, Point, Positive


def clock() -> float:
    """Return the time [s] on a clock that is never set, and goes on while the computer sleeps, where there is one."""
    return time.clock_gettime(getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC))


class State(StrEnum):
    """States of a control loop."""

    WAITING = "waiting"  # for a joint state, an image or an instruction; holds the measured pose
    RUNNING = "running"
    HOLDING = "holding"  # an input is late or invalid; runs again after fresh images
    STOPPED = "stopped"  # by request, until resumed; or by time-out, until the next instruction
    HANDED_OVER = "handed over"  # a person moves the arm, until it is handed back; commands nothing
    FAULT = "fault"  # needs inspection; until deactivated


@dataclass(frozen=True)
class Safety:
    """Time-outs and limits that hold or stop the arm."""

    image_age: Positive  # oldest image to act on [s]
    joints_age: Positive  # oldest joint state to act on [s]
    inference: Positive  # longest duration of an inference [s]
    instruction: Positive | None  # longest time to execute one instruction [s]; None: unlimited
    tracking: Positive  # largest tracking error of a joint of the arm [rad] …
    tracking_for: Positive  # … for so long [s]
    fresh_frames: Count  # consecutive matching sets of images after which a held arm moves again
    rejected: Count  # consecutive rejected plans that cause a fault
    # opposite corners of the box for the tool point, in the frame of Cartesian actions [m]; None for joint positions
    workspace: tuple[Point, Point] | None


class Tracking:
    """Compares an arm with its commands."""

    def __init__(self, safety: Safety, follows_positions: bool) -> None:
        """Args: limits of the error; whether the arm follows the commands, else errors are ignored."""
        self._safety, self._follows_positions = safety, follows_positions
        self._away_since: float | None = None
        self._lost = False  # True if the newest joint state was too old at the last check

    def check(self, motion: Motion, joint_state: JointMeasurement, now: float) -> tuple[bool, bool]:
        """Return whether the arm is off its commands for too long, and whether it moved while no joint state came."""
        errors = np.abs(motion.limiter.position - joint_state.joints)
        error = float(errors.max(where=motion.limiter.limits.is_arm, initial=0.0))
        deviates = motion.started and self._follows_positions and error > self._safety.tracking
        was_lost, self._lost = self._lost, now - joint_state.stamp > self._safety.joints_age
        if self._lost or not deviates:
            self._away_since = None
        elif self._away_since is None:
            self._away_since = now
        off_track = self._away_since is not None and now - self._away_since > self._safety.tracking_for
        return off_track, deviates and was_lost and not self._lost
