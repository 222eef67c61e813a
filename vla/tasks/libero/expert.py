"""A planner for LIBERO that knows the truth: a memoryless closed-loop controller of a few skills.

Its action depends on the present state alone, so every action is a valid label for its state. What must be done next is
read from the goal's predicates; where to grasp is computed from collision geometry, not from a table of things.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from vla.io.errors import UserError
from vla.spec import Array, Observation, Spec
from vla.tasks.libero import skills
from vla.tasks.libero.controller import REACH
from vla.tasks.libero.environment import STATE
from vla.tasks.libero.goal import CABINET, Predicate
from vla.tasks.libero.grasps import choose_grasp, room_of
from vla.tasks.libero.package import ALL, tasks_of
from vla.tasks.libero.places import place_of, way_off_drawer_path
from vla.tasks.libero.situation import HELD, THIN, Situation
from vla.tasks.world import action_of

DRAWERS = ("wooden_cabinet", "white_cabinet", "yellow_cabinet")  # what must be open for something to be put in
HOLLOWS = (*DRAWERS, "microwave")  # into which things are brought all the way
SLIPPED = 0.03  # by how much a drawer may close while a thing is brought into it, before the thing is let go [m]
ARRIVED = 0.008  # distance from its place at which a thing is all the way in [m]
LOOSENED = 0.5  # commanded opening at which fingers no longer drag along what they let go
NARROW = 0.006  # free room around the hand below which a thing under another one is first dragged out [m]


class Planner:
    """Expert of all tasks of LIBERO."""

    looks = False
    memoryless = True

    def __init__(self, *, spec: Spec) -> None:
        """Act in an environment of this spec; a UserError if it is not that of LIBERO."""
        if spec.state != STATE:
            raise UserError("expert=libero acts in task=libero only: choose the expert of this task")
        self.info: dict[str, Any] = {}
        self._known: dict[tuple[int, ...], Situation] = {}

    def reset(self, instruction: str, seed: int) -> None:
        """Do nothing: the planner has no state."""

    def act(self, observation: Observation) -> Array:
        """Return the (7,) float32 action (UserError: the observation lacks the simulator's truth)."""
        truth = observation.require_truth("expert=libero")
        key = tuple(int(number) for number in truth["task"])
        if key not in self._known:
            self._known[key] = Situation(tasks_of(ALL[key[0]])[key[1]])
        situation = self._known[key]
        situation.take(truth)
        return action_of(decide(situation), REACH)


def decide(situation: Situation) -> Array:
    """Return the command (7,) for a state."""
    todo, touched_thing = situation.goal.unmet_predicates(situation.data), situation.grasped_thing()
    held_thing = touched_thing if situation.opening < HELD and situation.gap > THIN else None
    if not todo:
        return _open_fingers(situation)
    if touched_thing is not None and all(situation.subject(part.thing) != touched_thing for part in todo):
        return _release(situation, held_thing)
    if held_thing is None and _is_put_down(situation, todo):
        return _open_fingers(situation) if situation.opening < LOOSENED else skills.back_off(situation)
    name, thing, place = next((part for part in todo if part.thing == held_thing), todo[0])
    if name in ("on", "in") and _is_shut(situation, place, SLIPPED if thing == held_thing else 0.0):
        if thing == held_thing:  # the hand is needed to open the drawer
            return _open_fingers(situation)
        displacement = way_off_drawer_path(situation, thing, int(situation.goal.joints(place)[0]))
        if displacement is None or not situation.upright:
            return skills.pull(situation, place)
        return skills.drag(situation, thing, displacement)
    if name == "open":
        return skills.pull(situation, thing)
    if not situation.upright:
        return skills.withdraw(situation)
    if name in ("turnon", "turnoff"):
        return skills.twist(situation, thing, skills.TWIST if name == "turnon" else -skills.TWIST)
    if name == "close":
        return skills.push(situation, thing)
    return _deliver(situation, thing, place, thing == held_thing)


def _open_fingers(situation: Situation) -> Array:
    return skills.command(situation, situation.hand, situation.yaw, -1.0, situation.lean)


def _is_put_down(situation: Situation, todo: Sequence[Predicate]) -> bool:
    """Return whether what is between the fingers needs nothing more, or is falling to its place."""
    thing = situation.enclosed_thing()
    part = next((part for part in todo if situation.subject(part.thing) == thing), None)
    if thing is None or part is None:
        return thing is not None
    return part.name in ("on", "in") and skills.is_over(situation, thing, place_of(situation, thing, part.place, True))


def _release(situation: Situation, thing: str | None) -> Array:
    """Let go of a thing that needs nothing more, once it lies where the goal requires it."""
    predicate = next((part for part in situation.goal.parts if part.thing == thing), None)
    if predicate is not None and predicate.name == "in" and situation.subject(predicate.place).startswith(HOLLOWS):
        place = place_of(situation, predicate.thing, predicate.place, True)
        if np.linalg.norm(place.spot - situation.origin(predicate.thing)) > ARRIVED:
            # It counts as there, but it is not down or not far enough in yet.
            return skills.carry(situation, predicate.thing, place)
    if predicate is not None and predicate.name == "on":
        return skills.let_go(situation, predicate.thing)
    return _open_fingers(situation)


def _deliver(situation: Situation, thing: str, destination: str, held: bool) -> Array:
    """Bring a thing to where it is to be."""
    place = place_of(situation, thing, destination, held)
    if held:
        return skills.carry(situation, thing, place)
    grasp = choose_grasp(situation, thing, place)
    if place.current_exit is not None and (grasp is None or room_of(situation, thing, grasp) < NARROW):
        return skills.drag(situation, thing, place.current_exit)
    if grasp is None:
        return skills.drag(situation, thing, (place.spot - situation.origin(thing)) * (1, 1, 0))
    return skills.approach(situation, grasp, situation.points(thing), thing)


def _is_shut(situation: Situation, place: str, slack: float) -> bool:
    """Return whether a place is in a drawer that must be opened first; it may lack `slack` [m] of being open."""
    if place in situation.goal.bodies or not situation.subject(place).startswith(DRAWERS):
        return False
    turns = situation.data.qpos[situation.model.jnt_qposadr[situation.goal.joints(place)]]
    return bool(len(turns)) and not (turns < CABINET[0] + slack).any()
