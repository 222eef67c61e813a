"""Perturbation of experts, so that demonstrations cover the states that a learner will drift into."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from annotated_types import Ge, Le, MinLen

from vla.io.errors import UserError
from vla.io.types import CountRange, Names, PositiveRange, Share, Text
from vla.spec import Agent, Array, Observation, Spec

Corner = Annotated[tuple[float, ...], MinLen(2)]  # x, y and, in most worlds, z [m]

MISS, MISS_STEPS = 0.03, 3  # offset [m] and duration [steps] of a missed grasp
MAX_TURN = 0.2  # of the gripper per step of an excursion [rad]


@dataclass
class Perturbation:
    """Excursions, missed grasps and action noise.

    An excursion moves the tool at full speed towards a random point for a few steps, with the gripper, if there is one,
    open or closed at random. Only a gripper misses grasps. Raises a UserError if `low`, `high` and `move` differ in
    length, or `low` exceeds `high`.
    """

    low: Corner  # lower corner of the box of excursion targets, in the frame of the actions [m]
    high: Corner  # upper corner [m]
    tool: Text  # key, in the simulator's truth, of the last commanded tool position [m]
    move: Names  # action components that translate the tool along x, y and z [m], as many as the corners have
    turn: Text | None  # action component that turns the gripper [rad]
    gripper: Text | None  # action component that closes the gripper at its lower bound and opens it at its upper one
    start: Share  # probability that an episode begins with an excursion
    start_steps: CountRange  # length of the first excursion [steps]
    rate: Share  # probability per step of a further excursion
    steps: CountRange  # length of a further excursion [steps]
    noise: Annotated[float, Ge(0), Le(2)]  # standard deviation of the noise on every motion, relative to the motion
    closed: Share  # probability that an excursion closes the gripper
    unturned: Share  # probability that an episode executes no turns, so that objects are also grasped by their edges
    missed: Share  # probability of a missed grasp: the gripper closes a few centimetres beside the object
    # Range of the speed of an episode, relative to the expert's. Slow episodes contain more states of the last
    # centimetres, where imprecise policies stall.
    pace: PositiveRange

    def __post_init__(self) -> None:
        low, high, move = len(self.low), len(self.high), len(self.move)
        if not low == high == move:
            raise UserError(f"expert.perturb.low, high and move must be equally long, not {low}, {high} and {move}")
        if (np.array(self.low) > self.high).any():
            raise UserError(f"expert.perturb.low must not exceed high, got {[*self.low]} and {[*self.high]}")

    def reset(self, spec: Spec, seed: int) -> None:
        """Draw the pace of an episode and its first excursion (UserError: the actions lack a named component)."""
        groups = self.move, (self.turn,) if self.turn else (), (self.gripper,) if self.gripper else ()
        if misfits := [name for group in groups for name in group if name not in spec.action]:
            raise UserError(f"expert.perturb names {', '.join(misfits)}, but an action has {', '.join(spec.action)}")
        self._move, self._turn, self._grip = ([spec.action.index(name) for name in group] for group in groups)
        self._motions = [index for index in range(len(spec.action)) if index not in self._grip]
        self._shut, self._wide = (np.array(bounds)[self._grip] for bounds in (spec.low, spec.high))
        self._random = np.random.default_rng([seed, 0x5EED])
        self._pace = np.random.default_rng([seed, 0xACE]).uniform(*self.pace)
        self._steps_left, self._open = 0, True
        self._turns = self._random.uniform() >= self.unturned
        if self._random.uniform() < self.start:
            self._begin(self.start_steps)

    def _begin(self, steps: Sequence[int]) -> None:
        self._steps_left = int(self._random.integers(steps[0], steps[1] + 1))
        self._point = self._random.uniform(self.low, self.high)
        self._angle = self._random.uniform(-MAX_TURN, MAX_TURN)
        self._gripper = self._wide if self._random.uniform() >= self.closed else self._shut

    def __call__(self, clean: Array, truth: dict[str, Array], must_turn: bool = False, steady: bool = False) -> Array:
        """Return the (D,) action to execute instead of `clean`, not yet clipped to the bounds of the spec.

        With `must_turn` the gripper also turns in episodes without turns; with `steady` no excursion begins. Raises a
        UserError if the truth has no such tool.
        """
        tool, coordinates = truth.get(self.tool), len(self.low)
        if tool is None or tool.shape != (coordinates,):
            raise UserError(
                f"expert.perturb.tool={self.tool} is no point of {coordinates} coordinates in the truth, which has "
                f"{', '.join(truth) or 'nothing'}"
            )
        opens = bool((clean[self._grip] >= (self._shut + self._wide) / 2).all())
        grasps, self._open = self._open and not opens, opens
        if self._steps_left == 0 and self._random.uniform() < self.rate and not steady:
            self._begin(self.steps)
        elif self._steps_left == 0 and grasps and self._random.uniform() < self.missed:
            angle = self._random.uniform(-np.pi, np.pi)
            self._steps_left, self._angle, self._gripper = MISS_STEPS, 0.0, self._shut
            self._point = tool + MISS * np.array([np.cos(angle), np.sin(angle), 0.0])[: len(tool)]
        action = clean.astype(float)
        if self._steps_left > 0:
            self._steps_left -= 1
            action[self._move] = self._point - tool
            action[self._turn], action[self._grip] = self._angle, self._gripper
            return action
        action[self._motions] *= self._pace * (1 + self.noise * self._random.standard_normal(len(self._motions)))
        action[self._turn] *= self._turns or must_turn
        return action


class Perturbed:
    """An expert with perturbed actions; `info["clean"]` is the expert's own action, the label to imitate."""

    def __init__(self, spec: Spec, expert: Callable[..., Agent], perturb: Perturbation) -> None:
        """Perturb the expert that `expert` makes for `spec`, the spec of the environment."""
        self._spec, self._expert, self._perturb = spec, expert(spec=spec), perturb
        self.memoryless = bool(getattr(self._expert, "memoryless", False))  # true of the label
        self.looks = bool(getattr(self._expert, "looks", True))
        self.info: dict[str, Any] = {}

    def reset(self, instruction: str, seed: int) -> None:
        """Start an episode; `seed` seeds the expert and the perturbation."""
        self.info = {}
        self._expert.reset(instruction, seed)
        self._perturb.reset(self._spec, seed)

    def act(self, observation: Observation) -> Array:
        """Return the (D,) float32 action to execute (UserError: the observation lacks the simulator's truth)."""
        clean = self._expert.act(observation)
        self.info = {**self._expert.info, "clean": clean}
        options = {name: self._expert.info[name] for name in ("must_turn", "steady") if name in self._expert.info}
        action = self._perturb(clean, observation.require_truth("expert.perturb"), **options)
        return np.clip(action, self._spec.low, self._spec.high).astype(np.float32)
