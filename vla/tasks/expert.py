"""The scripted expert: a closed loop on the simulator's truth that remembers nothing.

What it does depends only on the state it sees, so every action it gives is the right label for that state, however the
state came about, and a policy can learn to recover from anything the expert was pushed into.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any

import numpy as np
from annotated_types import Ge, Le

from vla.spec import Array, Observation, Spec
from vla.tasks.control import DOWN, MAX_OPENING, rotation_z, vector_from_rotation
from vla.tasks.goals.goal import MANNERS, Manner
from vla.types import CountRange, Point, PositiveRange, Share

HOVER = 0.08  # height above the block from which it is approached [m]
CARRY = 0.07  # height above the table at which it is carried [m]
FUNNEL = 2.5  # height gained per metre of horizontal distance, so that approaches come from above
# As loose as still works: a learner that is a centimetre off must not wait for ever to be exact.
GRASP_XY, GRASP_Z = 0.012, 0.012  # tolerances at which the gripper closes, turned as it is [m]
PLACE_Z = 0.012  # tolerance of the height at which it opens [m]
FINGERTIP = 0.012  # half the width of the closed fingertips [m]
LOW = 0.012  # lowest tool point at which a fingertip clears the table [m]
LANE = 0.010  # how far beside the line of a push the fingertips may be [m]
PUSH_AT = 1.1  # where a block is pushed, as a share of half its height: it tips neither way
PUSH = 0.015  # furthest that a block is pushed in one step [m]
MAX_YAW = 0.9  # furthest turn from neutral from which the nearest faces are taken [rad]
MISS, MISS_STEPS = 0.03, 3  # how far beside the block a grasp is made to miss [m], and for how long [steps]
CLEARANCE = 0.012  # between open fingers and a block on both sides together [m]


class Waypoint:
    """Reaches, grasps, carries and releases, with recovery after a missed grasp, a drop or a push."""

    def __init__(self, spec: Spec, perturb: Perturbation | None = None) -> None:
        """Args: what an action looks like; how to disturb what is executed, while the clean action is recorded."""
        self._low, self._high = np.array(spec.low), np.array(spec.high)
        self._perturb = perturb
        self.info: dict[str, Any] = {}

    def reset(self, instruction: str, seed: int) -> None:
        """Start over; `seed` feeds the perturbation."""
        self.info = {}
        if self._perturb is not None:
            self._perturb.reset(seed)

    def act(self, observation: Observation) -> Array:
        """The action to execute; `info["clean"]` is the one to imitate.

        Raises:
            ValueError: the observation carries no simulator truth.
        """
        if observation.truth is None:
            raise ValueError("the scripted expert needs the simulator's truth, which this observation does not carry")
        clean = np.clip(self._decide(observation.truth, observation.gripper), self._low, self._high).astype(np.float32)
        self.info = {"clean": clean}
        if self._perturb is None:
            return clean
        executed = self._perturb(clean, observation.truth["commanded"])
        return np.clip(executed, self._low, self._high).astype(np.float32)

    def _decide(self, truth: dict[str, Array], opening: float) -> Array:
        """(7,) unclipped action for this state."""
        manner = MANNERS[int(truth["manner"][0])]
        if manner == "stay":
            return self._action(truth, np.zeros(3), 0.0, 1.0)
        if manner == "push":
            return self._push(truth)
        if truth["grasped"][0]:
            return self._carry(truth, manner)
        if manner == "place" and _placed(truth):
            free = opening > 2 * truth["half_size"][0] + CLEARANCE / 2
            return self._action(truth, np.array([0.0, 0.0, HOVER if free else 0.0]), 0.0, 1.0)
        return self._reach(truth, opening)

    def _reach(self, truth: dict[str, Array], opening: float) -> Array:
        tool, block, width = truth["commanded"][:3, 3], truth["block"], 2 * truth["half_size"][0]
        offset = block - tool
        yaw = _yaw_to_faces(truth)
        away = float(np.hypot(offset[0], offset[1]))
        between = away < GRASP_XY + 0.004 and abs(offset[2]) < GRASP_Z + 0.004
        closing = between and width - 0.006 < opening < MAX_OPENING - 0.004
        aligned = away < GRASP_XY and abs(offset[2]) < GRASP_Z
        if closing or (aligned and opening > width - 0.006):
            return self._action(truth, offset, yaw, 0.0)
        # Down only where it is straight below; further away, or with the fingers too close, stay above it.
        height = min(FUNNEL * max(away - GRASP_XY / 2, 0.0), HOVER)
        if opening < width + CLEARANCE:
            height = max(height, 0.045) if not between else HOVER
        offset[2] += height
        return self._action(truth, _rising_first(offset), yaw, 1.0)

    def _carry(self, truth: dict[str, Array], manner: Manner) -> Array:
        offset, tolerance = truth["destination"] - truth["block"], truth["tolerance"][0]
        away = float(np.hypot(offset[0], offset[1]))
        if manner == "hold":
            return self._action(truth, offset, 0.0, 0.0)
        height = min(FUNNEL * max(away - tolerance / 2, 0.0), CARRY)
        opens = away < tolerance and abs(offset[2]) < PLACE_Z
        offset[2] += height
        return self._action(truth, _rising_first(offset), 0.0, 1.0 if opens else 0.0)

    def _push(self, truth: dict[str, Array]) -> Array:
        """Go behind the block, as seen from its destination, and drive through it with closed fingers."""
        tool, block, (half, _, half_height) = truth["commanded"][:3, 3], truth["block"], truth["half_size"]
        way = (truth["destination"] - block)[:2]
        distance = float(np.hypot(*way))
        ahead = way / max(distance, 1e-6)
        aside = np.array([-ahead[1], ahead[0]])
        along, across = (tool - block)[:2] @ ahead, (tool - block)[:2] @ aside
        near = np.hypot(along, across) < half + FINGERTIP
        if near and tool[2] < block[2] + half_height + FINGERTIP and tool[2] > LOW + half_height:
            return self._action(truth, np.array([0.0, 0.0, HOVER]), 0.0, 1.0)  # around it: let go, and up
        height = max(LOW, min(PUSH_AT * half, 0.9 * half_height))
        behind = np.sqrt(2) * half + FINGERTIP + 0.006  # whatever the block's turn
        if tool[2] < height + 0.012 and -behind - 0.03 < along < -half and abs(across) < LANE:
            offset = np.append(min(distance, PUSH) * ahead - across * aside, height - tool[2])
            return self._action(truth, offset, 0.0, 0.0)
        offset = np.append(block[:2] - (behind + 0.004) * ahead, height) - tool
        away = float(np.hypot(offset[0], offset[1]))
        offset[2] += min(FUNNEL * max(away - LANE / 2, 0.0), HOVER)
        return self._action(truth, _rising_first(offset), 0.0, 0.0)

    def _action(self, truth: dict[str, Array], offset: Array, yaw: float, gripper: float) -> Array:
        """Move by `offset`, scaled to what one step allows without bending the path, upright and turned by `yaw`."""
        rotation = truth["commanded"][:3, :3]
        upright = rotation_z(np.arctan2(rotation[1, 0], rotation[0, 0]) + yaw) @ DOWN
        scale = max(1.0, float(np.max(np.abs(offset) / self._high[:3])))
        return np.concatenate([offset / scale, vector_from_rotation(upright @ rotation.T), [gripper]])


def _rising_first(offset: Array) -> Array:
    """The same way, but up before sideways where the tool is too low, so that nothing is pushed over."""
    if offset[2] > 0.01:
        offset[:2] *= 0.02 / (0.02 + offset[2])
    return offset


def _placed(truth: dict[str, Array]) -> bool:
    """The block rests close enough to its destination."""
    offset = truth["destination"] - truth["block"]
    return bool(np.hypot(offset[0], offset[1]) < 1.5 * truth["tolerance"][0] and abs(offset[2]) < PLACE_Z)


def _yaw_to_faces(truth: dict[str, Array]) -> float:
    """Turn [rad] that brings the fingers onto the nearest two faces of the block, not far from the arm's neutral yaw.

    Nearest, because a cube looks the same after a quarter turn: a learner could not tell which one is meant.
    """
    rotation, (cosine, sine) = truth["commanded"][:3, :3], truth["faces"]
    yaw = np.arctan2(rotation[1, 0], rotation[0, 0])
    back = np.clip(yaw, -MAX_YAW, MAX_YAW) - yaw  # to where the nearest faces are taken from
    quarter = np.pi / 2
    return float(back + (np.arctan2(sine, cosine) / 4 - back + quarter / 2) % quarter - quarter / 2)


class Perturbation:
    """Pushes the robot off the expert's path, so that demonstrations cover the states a learner will drift into.

    An excursion drives towards a random point at full speed for a few steps, with the gripper open or closed at random.
    """

    def __init__(
        self,
        start: Share = 0.7,
        start_steps: CountRange = (2, 9),
        rate: Share = 0.06,
        steps: CountRange = (2, 5),
        noise: Annotated[float, Ge(0), Le(2)] = 0.2,
        closed: Share = 0.3,
        unturned: Share = 0.3,
        missed: Share = 0.1,
        pace: PositiveRange = (1.0, 1.0),
        low: Point = (0.34, -0.26, 0.015),
        high: Point = (0.66, 0.26, 0.34),
    ) -> None:
        """Args:
        start: probability that an episode begins with an excursion.
        start_steps: shortest and longest first excursion [steps].
        rate: probability per step of another one.
        steps: shortest and longest later excursion [steps].
        noise: standard deviation of the noise on every executed motion, as a share of it.
        closed: probability that an excursion commands a closed gripper.
        unturned: probability that an episode carries no turn out, so that blocks are also held by their edges.
        missed: probability that a grasp is made to miss: the gripper closes a few centimetres beside the block.
        pace: least and largest share of its motions that an episode executes: a slow one shows more of the last
            centimetres, where a learner that is not quite there comes to rest.
        low: lower corner of the box of points to go to, in the base frame [m].
        high: upper corner.
        """
        self._start, self._start_steps, self._rate, self._steps = start, tuple(start_steps), rate, tuple(steps)
        self._noise, self._closed, self._unturned, self._missed = noise, closed, unturned, missed
        (self._slowest, self._fastest), self._low, self._high = pace, np.array(low), np.array(high)

    def reset(self, seed: int) -> None:
        """Draw how fast, whether and where this episode starts off."""
        self._random = np.random.default_rng([seed, 0x5EED])
        self._pace = np.random.default_rng([seed, 0xACE]).uniform(self._slowest, self._fastest)
        self._left, self._open = 0, True
        self._turns = self._random.uniform() >= self._unturned
        if self._random.uniform() < self._start:
            self._begin(self._start_steps)

    def _begin(self, steps: Sequence[int]) -> None:
        self._left = int(self._random.integers(steps[0], steps[1] + 1))
        self._point = self._random.uniform(self._low, self._high)
        self._turn = self._random.uniform(-0.2, 0.2)
        self._gripper = float(self._random.uniform() >= self._closed)

    def __call__(self, clean: Array, commanded: Array) -> Array:
        """The (7,) action to execute instead of `clean`, given the commanded (4, 4) pose."""
        grasps, self._open = self._open and clean[6] < 0.5, bool(clean[6] >= 0.5)
        if self._left == 0 and self._random.uniform() < self._rate:
            self._begin(self._steps)
        elif self._left == 0 and grasps and self._random.uniform() < self._missed:
            angle = self._random.uniform(-np.pi, np.pi)
            self._left, self._turn, self._gripper = MISS_STEPS, 0.0, 0.0
            self._point = commanded[:3, 3] + MISS * np.array([np.cos(angle), np.sin(angle), 0.0])
        action = clean.astype(float)
        if self._left > 0:
            self._left -= 1
            action[:3] = self._point - commanded[:3, 3]
            action[5], action[6] = self._turn, self._gripper
            return action
        action[:6] *= self._pace * (1 + self._noise * self._random.standard_normal(6))
        action[5] *= self._turns
        return action
