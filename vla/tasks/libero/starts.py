"""Starts of LIBERO's episodes: the official states, which are the test, and new ones from the same regions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np

from vla.io.errors import UserError
from vla.io.types import Share
from vla.spec import Array
from vla.tasks.libero.controller import HOME
from vla.tasks.libero.package import Task, initial_states

POSTURE_NOISE = 0.02  # standard deviation of the arm's joints at a start [rad], as robosuite's
MARGIN = 0.005  # by which the official places exceed the ranges of their region [m]
OVERLAP = 0.002  # largest depth of a contact between two things at a start [m]
DRAWS = 200  # most redraws of a start while things overlap

Motion = Callable[[Array], Array]  # of points (2,) of a table [m]


@dataclass(frozen=True)
class Randomize:
    """Variation of drawn starts in addition to the benchmark's regions: the config node `task.randomize`."""

    places: Share  # share of starts in which two pairs of things swap places, or one pair if fewer than four things may
    colours: Share  # share of starts in which about half of the things have another colour


@dataclass(frozen=True)
class Start:
    """State at the start of an episode, before it settles."""

    qpos: Array  # (nq,)
    fixtures: dict[str, tuple[Array, Array]]  # body → position (3,) [m] and quaternion (4,) wxyz


class Starts:
    """Starts of one task."""

    def __init__(self, model: mujoco.MjModel, task: Task) -> None:
        """Take the model of the scene and the task; a UserError if the official states are of another model."""
        states = initial_states(task)
        if states.shape[1] != 1 + model.nq + model.nv:
            raise UserError(
                f"the initial states of {task.name} have {states.shape[1]} numbers, its scene in MuJoCo "
                f"{mujoco.__version__} needs {1 + model.nq + model.nv}: they are of another scene"
            )
        self._model, self._task, self._states = model, task, states[:, 1 : 1 + model.nq]
        self._data = mujoco.MjData(model)
        self._usual = self._overlaps(self.official(0))  # pairs that always overlap, such as a drawer and its cabinet
        self._owners = {part[1]: part[2] for part in task.initial if part[0] in ("on", "in")}
        self._exchangeable = [thing for thing in self._owners if self._may_move(thing)]
        self.can_exchange = len(self._exchangeable) > 1

    def official(self, number: int) -> Start:
        """Return an official start, with the fixtures as in the task, because its state does not contain them."""
        poses = {
            fixture["body"]: (np.array(fixture["position"]), np.array(fixture["quaternion"]))
            for fixture in self._task.fixtures.values()
        }
        return Start(self._states[number].copy(), poses)

    def draw(self, random: np.random.Generator, exchange: bool) -> Start:
        """Draw a start: fixtures, things, openings and the arm's posture, up to `DRAWS` times more if things overlap.

        Things on a table are drawn from the ranges of their regions, other things and openings from the range of the
        official states; heights and tilts are those of the official states, which share them. With `exchange`, two
        pairs of things on tables, or one pair, swap their regions first, where sentence and goal remain true.
        """
        start = self._draw(random, exchange)
        for _ in range(DRAWS):
            if self._overlaps(start) <= self._usual:
                break
            start = self._draw(random, exchange)
        return start

    def _may_move(self, thing: str) -> bool:
        """Return whether a thing stands on a table, and neither its place nor one beside it is part of the task."""
        kind, goal = thing.rpartition("_")[0], set(self._task.goal)
        twins = [name for name in self._owners if name != thing and name.rpartition("_")[0] == kind]
        for twin in twins:  # if their roles differ, the sentence tells them apart by their places
            exchange = {thing: twin, twin: thing}
            if {tuple(exchange.get(name, name) for name in part) for part in goal} != goal:
                return False
        regions = {name for part in goal for name in part if self._on_table(name)}
        words = {word for region in regions for word in region.split("_")}  # such as "plate" of a place beside one
        return self._on_table(self._owners[thing]) and words.isdisjoint(kind.split("_"))

    def _on_table(self, region: str) -> bool:
        return bool(self._task.regions.get(region, {}).get("ranges"))

    def _draw(self, random: np.random.Generator, exchanged: bool) -> Start:
        start, model, owners = self.official(0), self._model, dict(self._owners)
        if exchanged and self.can_exchange:
            order = random.permutation(self._exchangeable).tolist()
            for one, other in zip(order[0:4:2], order[1:4:2], strict=False):
                owners[one], owners[other] = owners[other], owners[one]
        motions = {name: self._move_fixture(name, owners.get(name), start, random) for name in self._task.fixtures}
        start.qpos[:7] = HOME + POSTURE_NOISE * random.standard_normal(7)
        for joint in range(9, model.njnt):
            place = model.jnt_qposadr[joint]
            if model.jnt_type[joint] != mujoco.mjtJoint.mjJNT_FREE:
                span = self._states[:, place]
                start.qpos[place] = random.uniform(span.min(), span.max())
                continue
            name = model.body(model.jnt_bodyid[joint]).name.removesuffix("_main")
            start.qpos[place : place + 2] = self._place(owners.get(name, ""), place, motions, random)
            start.qpos[place + 3 : place + 7] = self._turn(place, random)
        for thing, base in owners.items():  # a thing on another one
            if base in owners and base not in self._task.fixtures:
                rows = [model.jnt_qposadr[model.joint(f"{name}_joint0").id] for name in (thing, base)]
                start.qpos[rows[0] : rows[0] + 2] = start.qpos[rows[1] : rows[1] + 2]
        return start

    def _region(self, name: str, random: np.random.Generator) -> Array | None:
        """Draw a point (2,) in a region of a table, in the world [m]; None if there is no such region."""
        region = self._task.regions.get(name)
        if region is None or not region["ranges"]:
            return None
        low_x, low_y, high_x, high_y = region["ranges"][0]
        middle = np.array([low_x + high_x, low_y + high_y]) / 2
        half = np.array([high_x - low_x, high_y - low_y]) / 2 + MARGIN
        site = self._model.site(name)  # at the middle of the region, wherever the table is
        body = self._model.body(int(site.bodyid[0]))
        return body.pos[:2] + site.pos[:2] + half * random.uniform(-1, 1, len(middle))

    def _move_fixture(self, name: str, region: str | None, start: Start, random: np.random.Generator) -> Motion:
        """Draw a fixture's place and yaw into `start`, and return its motion from the official pose."""
        place = None if region is None else self._region(region, random)
        if place is None:
            return lambda point: point
        body = self._task.fixtures[name]["body"]
        position, quaternion = start.fixtures[body]
        turn = random.uniform(*sorted(np.ravel(self._task.regions[str(region)]["yaw_rotation"])[:2]))
        if turn or region != self._owners[name]:
            quaternion = np.array([np.cos(turn / 2), 0.0, 0.0, np.sin(turn / 2)])
        angle = _yaw(quaternion) - _yaw(start.fixtures[body][1])
        rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        start.fixtures[body] = np.array([*place, position[2]]), quaternion
        return lambda point: place + rotation @ (point - position[:2])

    def _place(self, region: str, row: int, motions: dict[str, Motion], random: np.random.Generator) -> Array:
        """Draw x and y of a thing [m]."""
        place = self._region(region, random)
        if place is not None:
            return place
        span = self._states[:, row : row + 2]
        fixture_motion = next((motion for fixture, motion in motions.items() if region.startswith(fixture)), None)
        place = random.uniform(span.min(axis=0), span.max(axis=0))
        return place if fixture_motion is None else fixture_motion(place)

    def _turn(self, row: int, random: np.random.Generator) -> Array:
        """Draw the quaternion of a thing like the official ones, which differ only in yaw, if at all."""
        quaternions = self._states[:, row + 3 : row + 7]
        reference, relative = quaternions[0], np.empty(4)
        conjugate = reference * np.array([1, -1, -1, -1])
        yaws = []
        for quaternion in quaternions:
            mujoco.mju_mulQuat(relative, quaternion, conjugate)
            yaws.append(2 * np.arctan2(relative[3], relative[0]))
        yaws = np.angle(np.exp(1j * np.array(yaws)))
        yaw, result = random.uniform(yaws.min(), yaws.max()), np.empty(4)
        mujoco.mju_mulQuat(result, np.array([np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)]), reference)
        return result

    def _overlaps(self, start: Start) -> set[tuple[int, int]]:
        """Return the pairs of bodies that penetrate each other by more than `OVERLAP`."""
        set_start(self._model, self._data, start)
        contact = self._data.contact
        geoms = contact.geom[: self._data.ncon][contact.dist[: self._data.ncon] < -OVERLAP]
        return {(int(one), int(other)) for one, other in np.sort(self._model.geom_bodyid[geoms], axis=1)}


def _yaw(quaternion: Array) -> float:
    """Return the angle of a turn about the z axis [rad]."""
    return float(2 * np.arctan2(quaternion[3], quaternion[0]))


def set_start(model: mujoco.MjModel, data: mujoco.MjData, start: Start) -> None:
    """Put a scene into the state of a start, at rest; fixtures are moved in the model."""
    for body, (position, quaternion) in start.fixtures.items():
        model.body(body).pos, model.body(body).quat = position, quaternion
    mujoco.mj_resetData(model, data)
    data.qpos[:] = start.qpos
    mujoco.mj_forward(model, data)
