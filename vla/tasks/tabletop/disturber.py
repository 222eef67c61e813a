"""Disturbances in the course of an episode: pushes, drops, and moves of objects, which the agent does not cause.

A disturbance is determined by the episode's draws and states, so that a replay of the agent's actions reproduces it.
The agent perceives it only through its observations.

- push: for a few control steps the arm moves sideways instead of as commanded, within its limits.
- drop: the gripper opens while it holds the named block above the table.
- move_block: the named block is moved on the table while the gripper approaches it from above.
- move_target: the pad, or the block to stack on, is moved while the named block is carried or pushed there.

Objects are moved to free places, clear of the gripper.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from vla.spec import Array
from vla.tasks.tabletop.compiled_scene import CompiledScene, Disturbance
from vla.tasks.tabletop.goals.goal import Spot, Subgoal, WorldState
from vla.tasks.tabletop.outcome import CLEAR
from vla.tasks.tabletop.scene import PAD_RADIUS

PUSH_STEP = 0.04  # largest motion of a push per control step [m]
OPEN_STEPS = 3  # control steps for which a drop keeps the gripper open
APPROACH = 0.2  # distance between tool and block below which the block is being approached [m]
ABOVE = 0.02  # height of the gripper above an object at which it can be moved [m]
BESIDE = 0.09  # horizontal distance from the gripper at which the object can be moved, too [m]
GAP = 0.02  # between a moved object and its neighbours [m]
DIRECTIONS = 24  # largest number of directions to try
GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))  # between a direction and the next one to try [rad]


class Disturber:
    """Disturbance of one episode.

    Attributes:
        motion: translation (3,) of the tool in the next control period, in place of the commanded motion, or None [m].
        offset: displacement (3,) of the tool by a push, at the end of that period [m].
        opens: whether the gripper opens in that period, whatever is commanded.
        events: control step and description of everything that has happened.
    """

    def __init__(self, disturbance: Disturbance, scene: CompiledScene) -> None:
        """Take what was drawn for the episode, and the scene."""
        self._disturbance, self._scene = disturbance, scene
        self._steps_left = 0  # of a push or a drop
        self._possible_for = 0  # [steps]
        self.motion: Array | None = None
        self.offset, self.opens = np.zeros(3), False
        self.events: list[tuple[int, str]] = []

    def override(self, action: Array) -> Array:
        """Return the action (7,) to execute in place of `action`."""
        if self.motion is not None:
            action = np.array([*self.motion, 0, 0, 0, action[6]])
        return np.append(action[:6], 1.0) if self.opens else action

    def update(self, step: int, state: WorldState, subgoal: Subgoal) -> bool:
        """Continue a push or a drop, or start a disturbance that is due; return whether an object was moved.

        `step` is the index of the control step that comes next, `state` the one before it.
        """
        self._steps_left = max(0, self._steps_left - 1)
        if self._steps_left:
            self.offset = self.offset if self.motion is None else self.offset + self.motion
            return False
        self.motion, self.offset, self.opens = None, np.zeros(3), False
        if len(self.events) == self._disturbance.times or not self._is_possible(state, subgoal):
            return False
        self._possible_for += 1
        if self._possible_for <= self._disturbance.delay or not (description := self._happen(state, subgoal)):
            return False
        self._possible_for = 0
        self.events.append((step, description))
        return self._disturbance.kind.startswith("move")

    def _is_possible(self, state: WorldState, subgoal: Subgoal) -> bool:
        """Return whether the preconditions of the disturbance hold in this state."""
        kind, block = self._disturbance.kind, subgoal.block
        if kind == "push":
            return True
        if subgoal.done or subgoal.skill == "stay":
            return False
        if kind == "move_block":
            return bool(np.linalg.norm(state.tool - state.positions[block]) < APPROACH) and state.resting(block)
        is_lifted = bool(state.held[block] and state.positions[block, 2] > state.extents[block, 2] + CLEAR)
        return is_lifted or bool(kind == "move_target" and subgoal.skill == "push" and state.touched[block])

    def _happen(self, state: WorldState, subgoal: Subgoal) -> str:
        """Start the disturbance and return its description; an empty string if there is no free place."""
        kind, distance = self._disturbance.kind, f"{100 * self._disturbance.distance:.1f} cm"
        if kind == "drop":
            self.opens, self._steps_left = True, OPEN_STEPS
            return "drop: the gripper opens"
        if kind == "push":
            place = next(self._places_around(state.tool), None)
            if place is None:
                return ""
            self._steps_left = max(1, math.ceil(self._disturbance.distance / PUSH_STEP))
            self.motion = self.offset = np.append(place - state.tool[:2], 0.0) / self._steps_left
            return f"push: the arm is pushed by {distance}"
        target: Spot | None = ("block", subgoal.block) if kind == "move_block" else _target(state, subgoal)
        if target is None or (place := self._free_place(state, target)) is None:
            return ""
        object_kind, index = target
        (self._scene.place_pad if object_kind == "pad" else self._scene.move_block)(index, *place)
        return f"{kind}: the {object_kind} is moved by {distance}"

    def _places_around(self, start: Array) -> Iterator[Array]:
        """Yield the places (2,) at the drawn distance from `start` that are in the area, the drawn direction first."""
        for number in range(DIRECTIONS):
            angle = self._disturbance.angle + number * GOLDEN_ANGLE
            place = start[:2] + self._disturbance.distance * np.array([math.cos(angle), math.sin(angle)])
            if (place >= self._disturbance.low).all() and (place <= self._disturbance.high).all():
                yield place

    def _free_place(self, state: WorldState, target: Spot) -> Array | None:
        """Return the first place (2,) for an object away from its neighbours and the gripper, or None."""
        object_kind, index = target
        radii = np.linalg.norm(state.extents, axis=1)  # of the blocks, whatever face is up
        things: dict[Spot, tuple[Array, float]] = {
            ("pad", pad): (centre, PAD_RADIUS) for pad, centre in enumerate(state.pads)
        }
        things |= {("block", block): (centre, radii[block]) for block, centre in enumerate(state.positions)}
        start, radius = things.pop(target)
        neighbours = [thing for (kind, number), thing in things.items() if kind == "pad" or not state.held[number]]
        if object_kind == "block" and not _clear_of_gripper(state, index, start):
            return None
        for place in self._places_around(start):
            if all(math.dist(place, centre[:2]) > radius + size + GAP for centre, size in neighbours) and (
                object_kind == "pad" or _clear_of_gripper(state, index, place)
            ):
                return place
        return None


def _target(state: WorldState, subgoal: Subgoal) -> Spot | None:
    """Return the pad, else the other block that rests on the table, at the destination of a subgoal."""
    for pad, place in enumerate(state.pads):
        if subgoal.skill != "hold" and np.array_equal(place[:2], subgoal.destination[:2]):
            return "pad", pad
    for block, place in enumerate(state.positions):
        if block != subgoal.block and np.array_equal(place[:2], subgoal.destination[:2]) and state.resting(block):
            return "block", block
    return None


def _clear_of_gripper(state: WorldState, block: int, place: Array) -> bool:
    """Return whether gripper and held blocks are far from, or above, a block that lies at `place`."""
    bottom = min([state.tool[2], *(state.positions[:, 2] - state.extents[:, 2])[state.held]])
    is_above = bottom > state.positions[block, 2] + state.extents[block, 2] + ABOVE
    return bool(is_above or math.dist(state.tool[:2], place[:2]) > BESIDE)
