"""Starts of LIBERO's episodes: the official states, which are the test, and new ones from the same regions."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from vla.io.errors import UserError
from vla.spec import Array
from vla.tasks.libero.controller import HOME
from vla.tasks.libero.package import Task, initial_states

POSTURE_NOISE = 0.02  # standard deviation of the arm's joints at a start [rad], as robosuite's
MARGIN = 0.005  # by which the official places exceed the ranges of their region [m]
OVERLAP = 0.002  # largest depth of a contact between two things at a start [m]
DRAWS = 200  # of places until no things overlap


@dataclass(frozen=True)
class Start:
    """State at the start of an episode, before it settles."""

    qpos: Array  # (nq,)
    fixtures: dict[str, tuple[Array, Array]]  # body → position (3,) [m] and quaternion (4,) wxyz


class Starts:
    """Starts of one task."""

    def __init__(self, model: mujoco.MjModel, task: Task) -> None:
        """Args: the model of the scene; the task.

        Raises:
            UserError: the official states are of another model.
        """
        states = initial_states(task)
        if states.shape[1] != 1 + model.nq + model.nv:
            raise UserError(
                f"the initial states of {task.name} have {states.shape[1]} numbers, its scene in MuJoCo "
                f"{mujoco.__version__} needs {1 + model.nq + model.nv}: they are of another scene"
            )
        self._model, self._task, self._states = model, task, states[:, 1 : 1 + model.nq]
        self._data = mujoco.MjData(model)
        self._usual = self._overlapping(self.official(0))  # such as drawers in their cabinet
        self._owners = {part[1]: part[2] for part in task.initial if part[0] in ("on", "in")}

    def __len__(self) -> int:
        return len(self._states)

    def official(self, number: int) -> Start:
        """Return an official start, with the fixtures as the scene was made; they are not in its state."""
        poses = {
            one["body"]: (np.array(one["position"]), np.array(one["quaternion"]))
            for one in self._task.fixtures.values()
        }
        return Start(self._states[number].copy(), poses)

    def drawn(self, random: np.random.Generator) -> Start:
        """Draw a start: fixtures, things, openings and the arm's posture, until nothing overlaps.

        Things on a table are drawn in the ranges of their regions, others, and openings, within what the official
        states span; heights and tilts are those of the official states, which are alike in them.
        """
        start = self._draw(random)
        for _ in range(DRAWS):
            if self._overlapping(start) <= self._usual:
                break
            start = self._draw(random)
        return start

    def _draw(self, random: np.random.Generator) -> Start:
        start, model = self.official(0), self._model
        moved = {name: self._move_fixture(name, start, random) for name in self._task.fixtures}
        start.qpos[:7] = HOME + POSTURE_NOISE * random.standard_normal(7)
        for joint in range(9, model.njnt):
            place = model.jnt_qposadr[joint]
            if model.jnt_type[joint] != mujoco.mjtJoint.mjJNT_FREE:
                span = self._states[:, place]
                start.qpos[place] = random.uniform(span.min(), span.max())
                continue
            name = model.body(model.jnt_bodyid[joint]).name.removesuffix("_main")
            start.qpos[place : place + 2] = self._place(name, place, moved, random)
            start.qpos[place + 3 : place + 7] = self._turn(place, random)
        for thing, base in self._owners.items():  # a thing on another one
            if base in self._owners and base not in self._task.fixtures:
                rows = [model.jnt_qposadr[model.joint(f"{name}_joint0").id] for name in (thing, base)]
                start.qpos[rows[0] : rows[0] + 2] = start.qpos[rows[1] : rows[1] + 2]
        return start

    def _region(self, name: str, random: np.random.Generator) -> Array | None:
        """Draw x and y in a region of a table, in the world [m]; None: it is none."""
        region = self._task.regions.get(name)
        if region is None or not region["ranges"]:
            return None
        low_x, low_y, high_x, high_y = region["ranges"][0]
        middle = np.array([low_x + high_x, low_y + high_y]) / 2
        half = np.array([high_x - low_x, high_y - low_y]) / 2 + MARGIN
        site = self._model.site(name)  # at the middle of the region, wherever the table is
        body = self._model.body(int(site.bodyid[0]))
        return body.pos[:2] + site.pos[:2] + half * random.uniform(-1, 1, len(middle))

    def _move_fixture(self, name: str, start: Start, random: np.random.Generator) -> Array:
        """Draw a fixture's place and yaw into `start`, and return its displacement (2,) from the official place."""
        region = self._owners.get(name)
        place = None if region is None else self._region(region, random)
        if place is None:
            return np.zeros(2)
        body = self._task.fixtures[name]["body"]
        position, quaternion = start.fixtures[body]
        turn = random.uniform(*sorted(np.ravel(self._task.regions[str(region)]["yaw_rotation"])[:2]))
        if turn:
            quaternion = np.array([np.cos(turn / 2), 0.0, 0.0, np.sin(turn / 2)])
        start.fixtures[body] = np.array([*place, position[2]]), quaternion
        return place - position[:2]

    def _place(self, name: str, row: int, moved: dict[str, Array], random: np.random.Generator) -> Array:
        """Draw x and y of a thing [m]."""
        region = self._owners.get(name, "")
        place = self._region(region, random)
        if place is not None:
            return place
        span = self._states[:, row : row + 2]
        on = next((displacement for fixture, displacement in moved.items() if region.startswith(fixture)), np.zeros(2))
        return random.uniform(span.min(axis=0), span.max(axis=0)) + on

    def _turn(self, row: int, random: np.random.Generator) -> Array:
        """Draw the quaternion of a thing: as the official ones, which differ in yaw only, if at all."""
        quaternions = self._states[:, row + 3 : row + 7]
        first, relative = quaternions[0], np.empty(4)
        conjugate = first * np.array([1, -1, -1, -1])
        yaws = []
        for quaternion in quaternions:
            mujoco.mju_mulQuat(relative, quaternion, conjugate)
            yaws.append(2 * np.arctan2(relative[3], relative[0]))
        yaws = np.angle(np.exp(1j * np.array(yaws)))
        yaw, turned = random.uniform(yaws.min(), yaws.max()), np.empty(4)
        mujoco.mju_mulQuat(turned, np.array([np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)]), first)
        return turned

    def _overlapping(self, start: Start) -> set[tuple[int, int]]:
        """Return the pairs of bodies that are deep in each other."""
        set_start(self._model, self._data, start)
        contact = self._data.contact
        deep = contact.geom[: self._data.ncon][contact.dist[: self._data.ncon] < -OVERLAP]
        return {(int(one), int(other)) for one, other in np.sort(self._model.geom_bodyid[deep], axis=1)}


def set_start(model: mujoco.MjModel, data: mujoco.MjData, start: Start) -> None:
    """Put a scene into the state of a start, at rest; fixtures are moved in the model."""
    for body, (position, quaternion) in start.fixtures.items():
        model.body(body).pos, model.body(body).quat = position, quaternion
    mujoco.mj_resetData(model, data)
    data.qpos[:] = start.qpos
    mujoco.mj_forward(model, data)
