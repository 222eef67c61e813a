"""A state of a LIBERO task as its planner sees it: the hand, and points on the surface of everything that collides."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from functools import cached_property

import mujoco
import numpy as np

from vla.spec import Array
from vla.tasks.libero.goal import Goal
from vla.tasks.libero.package import Task
from vla.tasks.libero.scene import load_scene
from vla.tasks.libero.starts import Start, set_start
from vla.tasks.rendering.shapes import mesh_triangles

SPACING = 0.015  # between points on surfaces [m]
CUBE = 0.012  # voxel size to which the points of obstacles are thinned [m]
HELD = -0.3  # largest commanded opening at which the fingers press
SHUT = -0.99  # largest commanded opening at which the fingers press as much as they can
THIN = 0.003  # least distance of fingers that hold something [m]
WRIST = 2.7  # largest turn of the last joint either way, whose limit is 2.9 [rad]
SMALL = 0.2  # turn that is executed at any position of the last joint [rad]
SLANT = 0.3  # largest vertical component of the direction in which the fingers of an upright hand close
PALM = 0.030  # largest height of a thing above the point between the fingertips [m]
TIP = 0.012  # of the fingers below that point [m]
FINGER = 0.012  # half of a finger's breadth [m]
UPRIGHT = -0.6  # largest vertical component of the direction in which an upright hand points


class Situation:
    """A task in one state."""

    def __init__(self, task: Task) -> None:
        """Take the task; it has no state yet."""
        self.task, self.model = task, load_scene(task.scene, (), None)
        self.data, self.goal = mujoco.MjData(self.model), Goal(self.model, task.goal)
        self._shapes, owners = self._read_shapes(), self.goal.owner
        self._bodies = {
            name: [body for body in self._shapes if owners[body] == root] for name, root in self.goal.bodies.items()
        }
        self._sparse = {name: _sparse([self._shapes[body] for body in bodies]) for name, bodies in self._bodies.items()}
        self._placements: dict[int, tuple[Array, list[Array]]] = {}
        self._site = self.model.site("gripper0_grip_site").id
        self.base = self.model.body("robot0_base").pos.copy()  # of the arm (3,) [m]
        names = {self.model.body(number).name: number for number in range(self.model.nbody)}
        free_bodies = self.model.jnt_bodyid[self.model.jnt_type == mujoco.mjtJoint.mjJNT_FREE]
        self._movable = set(self.goal.owner[free_bodies].tolist())
        self._fingers = [
            [names[name] for name in (f"gripper0_{side}finger", f"gripper0_finger_joint{number}_tip") if name in names]
            for side, number in (("left", 1), ("right", 2))
        ]

    def take(self, truth: dict[str, Array]) -> None:
        """Set the state from the simulator's truth."""
        bodies = [fixture["body"] for fixture in self.task.fixtures.values()]
        poses = {body: (pose[:3], pose[3:]) for body, pose in zip(bodies, truth["fixtures"], strict=True)}
        set_start(self.model, self.data, Start(truth["positions"], poses))
        self.opening = float(truth["opening"][0])  # commanded, 1 open and -1 closed
        self.gap = float(self.data.qpos[7] - self.data.qpos[8])  # between the fingers [m]
        self.hand = self.data.site_xpos[self._site].copy()  # of the point between the fingertips (3,) [m]
        self.rotation = self.data.site_xmat[self._site].reshape(3, 3).copy()  # columns: closing, across, ahead
        closing, across, ahead = self.rotation.T
        self.yaw = float(np.arctan2(-closing[0], closing[1] if self.upright else across[0]))
        self.lean = float(np.arctan2(ahead[:2] @ (np.cos(self.yaw), np.sin(self.yaw)), -ahead[2]))
        self.__dict__.pop("all_points", None)
        self._points: dict[str, Array] = {}

    @property
    def upright(self) -> bool:
        """Whether the hand points down, possibly leaning, with fingers that close horizontally."""
        return bool(self.rotation[2, 2] < UPRIGHT and abs(self.rotation[2, 0]) < SLANT)

    def turn_to(self, yaw: float, swing: float = 0.0) -> float:
        """Return the rotation [rad] to a yaw: the fingers are alike, so half a turn more or less is the same.

        The last joint turns against the yaw, and then with the arm by its `swing` [rad], and must stay off its limits.
        """
        turns = yaw - self.yaw + np.pi * np.arange(-3, 4)
        wrist = self.data.qpos[6] - turns
        strained = (np.maximum(np.abs(wrist), np.abs(wrist + swing)) > WRIST) & (np.abs(turns) > SMALL)
        return float(turns[int(np.lexsort((np.abs(turns), strained))[0])])

    def swing(self, start: Array, goal: Array) -> float:
        """Return the angle [rad] by which the arm turns about its base from a place (3,) to another one [m]."""
        angles = [np.arctan2(*(place - self.base)[1::-1]) for place in (start, goal)]
        return float(angles[1] - angles[0])

    def origin(self, thing: str) -> Array:
        """Return the origin (3,) of a thing [m]."""
        return self.data.xpos[self.goal.bodies[thing]]

    def pieces(self, thing: str) -> list[Array]:
        """Return points (N, 3) on each geom of a thing [m]."""
        return [points for body in self._bodies[thing] for points in self._place(body)]

    def points(self, thing: str) -> Array:
        """Return points (N, 3) on the surface of a thing [m]."""
        if thing not in self._points:
            self._points[thing] = np.concatenate(self.pieces(thing))
        return self._points[thing]

    def moved_points(self, joint: int) -> list[Array]:
        """Return points (N, 3) on each geom of the body that a joint moves [m]."""
        return self._place(int(self.model.jnt_bodyid[joint]))

    def surroundings(self, thing: str, middle: Array, radius: float) -> Array:
        """Return points (N, 3) on all but one thing, in a square of half width `radius` about `middle` (2,) [m]."""
        points, owners = self.all_points
        mask = (np.abs(points[:, :2] - middle[:2]) < radius).all(axis=1)
        mask &= owners != self.goal.bodies.get(thing, -1)
        return points[mask]

    @cached_property
    def all_points(self) -> tuple[Array, Array]:
        """Points (N, 3) on all things [m], and the bodies (N,) that they belong to."""
        points = [self.points(thing)[rows] for thing, rows in self._sparse.items()]
        owners = [np.full(len(cloud), body) for cloud, body in zip(points, self.goal.bodies.values(), strict=True)]
        return np.concatenate(points), np.concatenate(owners)

    def subject(self, name: str) -> str:
        """Return the thing that a name refers to: the thing itself, or the owner of a region; "" if it has none."""
        if name in self.goal.bodies:
            return name
        owner = self.goal.owner[self.model.site_bodyid[self.goal.sites[name]]]
        return next((thing for thing, root in self.goal.bodies.items() if root == owner), "")

    def grasped_thing(self) -> str | None:
        """Return the movable thing that both fingers touch, or one of them if they are commanded shut and yet apart."""
        bodies = self.model.geom_bodyid[self.data.contact.geom[: self.data.ncon]]
        contacts = []
        for fingers in self._fingers:
            on_finger = np.isin(bodies, fingers)
            is_pair = on_finger.sum(axis=1) == 1
            contacts.append(set(self.goal.owner[bodies[is_pair][~on_finger[is_pair]]].tolist()))
        is_shut = self.opening < SHUT and self.gap > THIN
        held = contacts[0] | contacts[1] if is_shut else contacts[0] & contacts[1]
        return next((name for name, body in self.goal.bodies.items() if body in held and body in self._movable), None)

    def enclosed_thing(self) -> str | None:
        """Return the movable thing of which a part is between the fingers."""
        for name, body in self.goal.bodies.items():
            if body in self._movable:
                closing, across, ahead = ((self.points(name) - self.hand) @ self.rotation).T
                between = (np.abs(closing) < self.gap / 2 + THIN) & (np.abs(across) < FINGER)
                if (between & (ahead > -PALM) & (ahead < 0)).any():
                    return name
        return None

    def rests(self, thing: str) -> bool:
        """Return whether a held thing, or a finger, touches another thing that can be moved."""
        root, pairs = self.goal.bodies[thing], self.model.geom_bodyid[self.data.contact.geom[: self.data.ncon]]
        owners = self.goal.owner[pairs]
        is_held = (owners == root) | np.isin(pairs, [body for finger in self._fingers for body in finger])
        return bool(np.isin(owners[is_held.any(axis=1)], list(self._movable - {root})).any())

    def _place(self, body: int) -> list[Array]:
        """Return points (N, 3) on each geom of a body [m], which are cached until the body moves."""
        pose = np.concatenate([self.data.xpos[body], self.data.xmat[body]])
        if body not in self._placements or not np.array_equal(self._placements[body][0], pose):
            turn = pose[3:].reshape(3, 3).T
            self._placements[body] = pose, [local @ turn + pose[:3] for local in self._shapes.get(body, [])]
        return self._placements[body][1]

    def _read_shapes(self) -> dict[int, list[Array]]:
        """Return body → points (N, 3) on each of its geoms, in its frame [m], for all bodies of things."""
        model, shapes = self.model, defaultdict[int, list[Array]](list)
        for geom in np.flatnonzero(self.goal.owner[model.geom_bodyid]):
            if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH:
                points = mesh_triangles(model, int(model.geom_dataid[geom]))[0]
            else:
                round_ = model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_CYLINDER
                points = _surface(model.geom_size[geom][[0, 0, 1]] if round_ else model.geom_size[geom])
            turn = np.empty(9)
            mujoco.mju_quat2Mat(turn, model.geom_quat[geom])
            shapes[int(model.geom_bodyid[geom])].append(points @ turn.reshape(3, 3).T + model.geom_pos[geom])
        return shapes


def _sparse(shapes: Sequence[Sequence[Array]]) -> Array:
    """Return the rows of one point per body and voxel among the concatenated points of all bodies' geoms."""
    bodies = [np.full(sum(map(len, geoms)), body) for body, geoms in enumerate(shapes)]
    points = np.concatenate([points for geoms in shapes for points in geoms])
    cubes = np.column_stack([np.concatenate(bodies), np.rint(points / CUBE)])
    return np.unique(cubes, axis=0, return_index=True)[1]


def _surface(size: Array) -> Array:
    """Return points (N, 3) on the faces of a box of half sizes (3,), at most `SPACING` apart [m]."""
    axes = [np.linspace(-half, half, 2 + int(2 * half / SPACING)) for half in size]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    return grid[(np.abs(np.abs(grid) - size) < 1e-9).any(axis=1)]
