"""LIBERO's test of success, from a state of MuJoCo alone."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np

from vla.spec import Array

# Prefix of a fixture's name → its joint is open below the first number and closed above the second [m, rad]
# (libero/envs/objects/articulated_objects.py).
CABINET = (-0.14, 0.0)
DOORS = {
    **{f"{colour}_cabinet": CABINET for colour in ("wooden", "white", "yellow")},
    "microwave": (-1.3, -0.005),
}
STOVE_ON, STOVE_OFF = 0.5, 0.0  # turn of the knob at which it is on, and below which it is off: not yet at 0 [rad]
NEAR = 0.03  # largest horizontal distance between a thing and the one that it lies on [m]
OVER = (-0.005, 0.10)  # height above the upper side of a region at which a thing is on it [m]
SLACK = 0.01  # depth below the box of a region at which a thing is still in it [m]
ORDER = ("open", "turnon", "on", "in", "close", "turnoff")  # in which parts of a goal can be done


class Predicate(NamedTuple):
    """One part of a goal."""

    name: str  # one of `ORDER`
    thing: str
    place: str = ""  # thing or region, for "on" and "in"


class Goal:
    """A conjunction of predicates on things: bodies named `THING_main`, or sites, the regions."""

    def __init__(self, model: mujoco.MjModel, goal: Sequence[Sequence[str]]) -> None:
        """Take the model of a scene, and predicates with their arguments, as in `Task.goal`."""
        self._model = model
        self.parts = sorted((Predicate(*part) for part in goal), key=lambda part: ORDER.index(part.name))
        names = [model.body(number).name for number in range(model.nbody)]
        self.bodies = {name.removesuffix("_main"): n for n, name in enumerate(names) if name.endswith("_main")}
        self.sites = {model.site(number).name: number for number in range(model.nsite)}
        self.owner = np.zeros(model.nbody, int)  # body → body of the thing that it is part of, 0: of none
        for number in range(1, model.nbody):
            is_main = names[number].endswith("_main")
            self.owner[number] = number if is_main else self.owner[model.body_parentid[number]]

    def is_reached(self, data: mujoco.MjData) -> bool:
        """Return whether all predicates hold."""
        return all(self.holds(data, *part) for part in self.parts)

    def unmet_predicates(self, data: mujoco.MjData) -> list[Predicate]:
        """Return the predicates that do not hold, in an order in which they can be fulfilled."""
        return [part for part in self.parts if not self.holds(data, *part)]

    def holds(self, data: mujoco.MjData, predicate: str, thing: str, place: str = "") -> bool:
        """Return whether one predicate holds."""
        if predicate == "on":
            return self._is_on(data, self.bodies[thing], place)
        if predicate == "in":
            return self._is_in(data, self.bodies[thing], place)
        turns = data.qpos[self._model.jnt_qposadr[self.joints(thing)]]
        if predicate == "turnon":
            return bool((turns >= STOVE_ON).any())
        if predicate == "turnoff":
            return bool((turns < STOVE_OFF).all())
        open_limit, closed_limit = next(limits for name, limits in DOORS.items() if thing.startswith(name))
        return bool((turns < open_limit).any() if predicate == "open" else (turns > closed_limit).all())

    def joints(self, thing: str) -> Array:
        """Return the joints of a fixture, or of the one body, such as a drawer, that a region belongs to."""
        bodies = self._model.jnt_bodyid
        if thing in self.bodies:
            return np.flatnonzero(self.owner[bodies] == self.bodies[thing])
        return np.flatnonzero(bodies == self._model.site_bodyid[self.sites[thing]])

    def _is_on(self, data: mujoco.MjData, body: int, place: str) -> bool:
        if place in self.bodies:
            support = self.bodies[place]
            gap = data.xpos[body] - data.xpos[support]
            return bool(gap[2] >= 0 and np.hypot(*gap[:2]) < NEAR) and self.are_touching(data, body, support)
        site = self.sites[place]
        size = self._model.site_size[site]
        # Like LIBERO, which multiplies by the site's matrix where its transpose was meant.
        gap = data.site_xmat[site].reshape(3, 3) @ (data.xpos[body] - data.site_xpos[site])
        is_over = size[2] + OVER[0] < gap[2] < size[2] + OVER[1] and bool((np.abs(gap[:2]) < size[:2]).all())
        owner = self.owner[self._model.site_bodyid[site]]  # 0: a part of the table, which needs no touch
        return is_over and (owner == 0 or self.are_touching(data, body, owner))

    def _is_in(self, data: mujoco.MjData, body: int, place: str) -> bool:
        """Return whether the body's origin is in the region, even if the gripper holds it."""
        site = self.sites[place]
        size = np.abs(data.site_xmat[site].reshape(3, 3) @ self._model.site_size[site])
        gap = data.xpos[body] - data.site_xpos[site]
        return bool((gap < size).all() and (gap > -size - np.array([0, 0, SLACK])).all())

    def are_touching(self, data: mujoco.MjData, first: int, second: int) -> bool:
        """Return whether two things, by their bodies, are in contact."""
        pairs = self.owner[self._model.geom_bodyid[data.contact.geom[: data.ncon]]]
        return bool((np.sort(pairs, axis=1) == sorted((first, second))).all(axis=1).any())
