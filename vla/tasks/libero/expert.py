"""A planner for LIBERO that knows the truth: a memoryless closed-loop controller of a few skills.

Its action depends on the present state alone, so every action is a valid label for its state. What must be done next is
read from the goal's predicates; where to grasp is computed from what collides, not from a table of things.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from vla.io.errors import UserError
from vla.spec import Array, Observation, Spec
from vla.tasks.libero.controller import REACH
from vla.tasks.libero.environment import STATE, action_of
from vla.tasks.libero.goal import Goal
from vla.tasks.libero.package import ALL, Task, tasks_of
from vla.tasks.libero.scene import load_scene
from vla.tasks.libero.starts import Start, set_start

GAIN = 3.0  # of the distance to go, in a command: less leaves the hand a centimetre away from where it is to be
TURN_GAIN = 1.0  # of the rotation to go: more is unstable where the arm folds up
WIDEST = 0.074  # of a thing between the open fingers [m]
PALM = 0.030  # highest that a thing may stand above the point between the fingertips [m]
TIP = 0.012  # of the fingers below that point [m]
RIM = 0.012  # depth of a grasp below the edge of a wall [m]
INWARDS = 0.004  # offset of such a grasp towards the inside [m]
HOVER = 0.08  # height over a thing at which it is approached [m]
CLEAR = 0.045  # distance between a finger or the hand and anything else [m]
NEAR, LEVEL, TURNED = 0.008, 0.008, 0.12  # tolerances of a grasp: across [m], in height [m], in yaw [rad]
FUNNEL = 2.5  # height gained per metre of horizontal distance, so that approaches come from above
HAND = 0.10  # half of the width of the hand over the fingers [m]
MARGIN = 0.015  # height of open fingers over what they must not touch [m]
FINGER, OPEN = 0.012, 0.037  # half of a finger's breadth; distance of an open finger from the middle [m]
THIN = 0.004  # least of what the fingers hold [m]
FIRM = -0.9  # at which they press as much as they can
HELD = -0.3  # largest commanded opening at which the fingers press
ARM = (0.34, 0.72)  # horizontal distances from the base between which the arm neither folds up nor stretches [m]
CARRY = 0.05  # height over all that is on the way [m]
SPACING = 0.015  # between points on surfaces [m]
UP = np.array([0.0, 0.0, 1.0])
UPRIGHT = -0.9  # largest vertical component of where a hand that points down points
YAWS = np.radians(np.arange(-90, 91, 15))
ORDER = ("open", "turnon", "on", "in", "close", "turnoff")  # in which parts of a goal are done


@dataclass(frozen=True)
class Grasp:
    """Where the hand closes."""

    position: Array  # (3,) of the point between the fingertips [m]
    yaw: float  # of the fingers, 0: they close along y [rad]


class Planner:
    """Expert of all tasks of LIBERO."""

    looks = False
    memoryless = True

    def __init__(self, *, spec: Spec) -> None:
        """Args: the environment's spec.

        Raises:
            UserError: it is not that of LIBERO.
        """
        if spec.state != STATE:
            raise UserError("expert=libero acts in task=libero only: choose the expert of this task")
        self.info: dict[str, Any] = {}
        self._known: dict[tuple[int, ...], Situation] = {}

    def reset(self, instruction: str, seed: int) -> None:
        """Do nothing: the planner has no state."""

    def act(self, observation: Observation) -> Array:
        """Return the (7,) float32 action.

        Raises:
            UserError: the observation lacks the simulator's truth.
        """
        truth = observation.truth
        if truth is None:
            raise UserError("expert=libero needs the simulator's truth, which this observation lacks")
        key = tuple(int(number) for number in truth["task"])
        if key not in self._known:
            self._known[key] = Situation(tasks_of(ALL[key[0]])[key[1]])
        situation = self._known[key]
        situation.take(truth)
        return action_of(situation.decide())


class Situation:
    """A task at one state, and what to do in it."""

    def __init__(self, task: Task) -> None:
        """Args: the task."""
        self.task, self.model = task, load_scene(task.scene, (), None)
        self.data, self.goal = mujoco.MjData(self.model), Goal(self.model, task.goal)
        self.parts = sorted(task.goal, key=lambda part: ORDER.index(part[0]))
        self._geoms = {name: self._shape(body) for name, body in self.goal.bodies.items()}
        self._shapes = {
            name: {body: np.concatenate(parts) for body, parts in geoms.items()} for name, geoms in self._geoms.items()
        }
        self._site = self.model.site("gripper0_grip_site").id
        self._base = self.model.body("robot0_base").pos.copy()
        self._fingers = [
            {n for n in range(self.model.nbody) if self.model.body(n).name == f"gripper0_{side}finger"}
            | {n for n in range(self.model.nbody) if self.model.body(n).name == f"gripper0_finger_joint{number}_tip"}
            for side, number in (("left", 1), ("right", 2))
        ]

    def take(self, truth: dict[str, Array]) -> None:
        """Take over a state from the simulator's truth."""
        bodies = [one["body"] for one in self.task.fixtures.values()]
        poses = {body: (pose[:3], pose[3:]) for body, pose in zip(bodies, truth["fixtures"], strict=True)}
        set_start(self.model, self.data, Start(truth["positions"], poses))
        self.opening = float(truth["opening"][0])
        self.gap = float(self.data.qpos[7] - self.data.qpos[8])  # between the fingers [m]
        self.hand = self.data.site_xpos[self._site].copy()
        self.rotation = self.data.site_xmat[self._site].reshape(3, 3).copy()
        self.yaw = float(np.arctan2(-self.rotation[0, 0], self.rotation[0, 1]))

    def decide(self) -> Array:
        """Return the command (7,) for this state."""
        todo = [part for part in self.parts if not self.goal.holds(self.data, *part)]
        touched = self._touched()
        if not todo or (touched is not None and all(self._subject(part[1]) != touched for part in todo)):
            return self._command(self.hand, self.yaw, -1.0)  # let go of what is where it should be
        held = touched if self.opening < HELD else None
        part = next((part for part in todo if held is not None and part[1] == held), todo[0])
        if part[0] in ("on", "in") and part[1] != held and self._shut(part[2]):
            part = ("open", part[2])
        if part[0] == "open":
            return self._pull(part[1])
        if self.rotation[2, 2] > UPRIGHT:
            return self._withdraw()
        if part[0] == "turnon":
            return self._twist(part[1], touched)
        if part[0] == "close":
            return self._push(part[1])
        return self._carry(part[1], part[2]) if part[1] == held else self._reach(part[1], part[2])

    # Skills

    def _reach(self, thing: str, place: str) -> Array:
        """Grasp a thing from above that is then carried to a place."""
        return self._approach(self.grasp(thing, place), self.points(thing), thing)

    def _approach(self, grasp: Grasp, points: Array, thing: str) -> Array:
        """Move to a grasp of points (N, 3) of a thing from above, and close the fingers there."""
        offset = grasp.position - self.hand
        away, turn = float(np.hypot(*offset[:2])), abs(grasp.yaw - self.yaw)
        there = away < NEAR and turn < TURNED
        if there and abs(offset[2]) < LEVEL:
            return self._command(grasp.position, grasp.yaw, 1.0)
        # Until it is aligned, the hand stays above all that its fingers could come down on.
        rest = self._others(thing)
        beside = rest[np.linalg.norm(rest[:, :2] - grasp.position[:2], axis=1) < HAND, 2]
        over = max(points[:, 2].max(), beside.max(initial=-np.inf)) + TIP + MARGIN
        sinking = self.hand[2] < over - 0.01 and away < 1.6 * NEAR and turn < 1.6 * TURNED
        target = grasp.position.copy()
        if self.opening < 0.5 or not (there or sinking):
            target[2] = over + min(max(away - NEAR, 0.0) * FUNNEL, HOVER)
        return self._command(self._rising(target), grasp.yaw, -1.0)

    def _carry(self, thing: str, place: str) -> Array:
        """Carry the held thing to a place, and let go of it there."""
        origin = self.data.xpos[self.goal.bodies[thing]]
        spot = self.spot(thing, place)
        offset = spot - origin
        away = float(np.hypot(*offset[:2]))
        if away < 0.015 and offset[2] > -0.012:
            return self._command(self.hand, self.yaw, -1.0)
        lift = (
            0.0
            if away < 0.012
            else min(FUNNEL * away, CARRY) + max(0.0, self._above(thing, spot) if away > 0.02 else 0.0)
        )
        return self._command(self._rising(self.hand + offset + np.array([0.0, 0.0, lift])), self.yaw, 1.0)

    def _pull(self, place: str) -> Array:
        """Open a drawer by its handle: the hand comes from the front, one finger over the bar and one under it."""
        joint = int(self.goal.joints(place)[0])
        way = -self.data.xaxis[joint]  # openings are negative
        parts = self._moving(joint)
        bar = max(parts, key=lambda points: float((points @ way).max()))
        middle = (bar.max(axis=0) + bar.min(axis=0)) / 2 - 0.006 * way
        turned = np.stack([UP, np.cross(-way, UP), -way], axis=1)
        offset = self.hand - middle
        before, aside = float(offset @ way), float(np.linalg.norm(offset - (offset @ way) * way))
        wrong = float(np.linalg.norm(self._turn(turned)))
        if aside < 1.5 * NEAR and wrong < 2 * TURNED and abs(before) < 2 * LEVEL:
            grips = self.opening < FIRM and self.gap > THIN
            return self._move(middle + (0.012 if grips else 0.0) * way, turned, 1.0)  # slowly, or the fingers slip
        if aside < 2 * NEAR and wrong < 2 * TURNED and self.opening > 0.9:
            return self._move(middle, turned, -1.0)
        if before < 0.09 and self.hand[2] < self._tops().max() and wrong > 0.5:
            return self._move(self.hand + np.array([0, 0, 0.05]), turned, -1.0)
        return self._move(middle + 0.11 * way, turned, -1.0)

    def _twist(self, thing: str, touched: str | None) -> Array:
        """Turn a knob: grasp it from above across its narrow side, and turn the hand."""
        joint = int(self.goal.joints(thing)[0])
        options = list(self._parts(self._moving(joint)))
        grasp = min(options, key=lambda one: one[0] + 0.02 * abs(one[1].yaw - self.yaw))[1]
        anchor = self.data.xanchor[joint]
        grasp = Grasp(np.array([*anchor[:2], grasp.position[2]]), grasp.yaw)
        if touched is not None and self.opening < HELD:
            return self._command(grasp.position, self.yaw + 0.4, 1.0)
        return self._approach(grasp, np.concatenate(self._moving(joint)), thing)

    def _push(self, thing: str) -> Array:
        """Close a drawer or a door: push it, from outside, with closed fingers at its far end."""
        joint = int(self.goal.joints(thing)[0])
        points = np.concatenate(self._moving(joint))
        axis, anchor = self.data.xaxis[joint], self.data.xanchor[joint]
        way = np.tile(axis, (len(points), 1))
        if self.model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE:
            arms = points - anchor - np.outer((points - anchor) @ axis, axis)
            far = np.linalg.norm(arms, axis=1)
            points, arms = points[far > 0.8 * far.max()], arms[far > 0.8 * far.max()]
            way = np.cross(axis, arms)
        ahead = way.mean(axis=0) / np.linalg.norm(way.mean(axis=0))
        depth = points @ ahead
        face = points[depth < depth.min() + 0.012]
        contact = np.array([*face[:, :2].mean(axis=0), max(face[:, 2].max() - 0.02, face[:, 2].mean())])
        offset = self.hand - contact
        before = float(offset @ ahead)
        aside = float(np.linalg.norm((offset - before * ahead)[:2]))
        yaw = float(np.arctan2(ahead[1], ahead[0]))
        yaw = (yaw + np.pi / 2) % np.pi - np.pi / 2  # the fingers' broad side pushes
        if -0.06 < before < 0.02 and aside < 0.03 and abs(offset[2]) < 0.03:
            return self._command(contact + 0.05 * ahead, yaw, 1.0)
        start = contact - 0.045 * ahead
        if np.linalg.norm((self.hand - start)[:2]) > 0.012:
            start[2] = max(self._tops(thing).max(), contact[2]) + 0.04
        return self._command(self._rising(start), yaw, 1.0)

    def _withdraw(self) -> Array:
        """Move a hand that does not point down away from where it points, then let it point down."""
        near = np.linalg.norm(self._others("") - self.hand, axis=1).min() < 0.09
        if near:
            return self._move(self.hand - 0.05 * self.rotation[:, 2], self.rotation, -1.0)
        return self._command(self.hand + np.array([0, 0, 0.03]), 0.0, -1.0)

    def _subject(self, name: str) -> str:
        """Return the thing that a name is of: itself, or what a region belongs to."""
        if name in self.goal.bodies:
            return name
        owner = self.goal.owner[self.model.site_bodyid[self.goal.sites[name]]]
        return next((thing for thing, root in self.goal.bodies.items() if root == owner), "")

    def _shut(self, place: str) -> bool:
        """Return whether a place is in a drawer or behind a door that must be opened first."""
        if place in self.goal.bodies or not len(self.goal.joints(place)):
            return False
        return self._subject(place).startswith(("wooden_cabinet", "white_cabinet")) and not self.goal.holds(self.data, "open", place)

    # Geometry

    def _moving(self, joint: int) -> list[Array]:
        """Return points (N, 3) on each geom of the body that a joint moves [m]."""
        body = int(self.model.jnt_bodyid[joint])
        turn, place = self.data.xmat[body].reshape(3, 3), self.data.xpos[body]
        thing = next(name for name, root in self.goal.bodies.items() if root == self.goal.owner[body])
        return [local @ turn.T + place for local in self._geoms[thing][body]]

    def _tops(self, thing: str = "") -> Array:
        """Return heights (N,) of what stands near the hand [m]."""
        rest = self._others("")
        near = np.linalg.norm(rest[:, :2] - self.hand[:2], axis=1) < HAND + 0.05
        return np.append(rest[near, 2], -np.inf)

    def points(self, thing: str) -> Array:
        """Return points (N, 3) on the surface of a thing [m]."""
        return np.concatenate(
            [
                local @ self.data.xmat[body].reshape(3, 3).T + self.data.xpos[body]
                for body, local in self._shapes[thing].items()
            ]
        )

    def _others(self, thing: str) -> Array:
        """Return points (N, 3) on all that stands about but one thing [m]."""
        return np.concatenate([self.points(name) for name in self._shapes if name != thing])

    def grasp(self, thing: str, place: str) -> Grasp:
        """Choose where to grasp a thing from above: across it, by a wall, or by a narrow part such as a handle."""
        points, others = self.points(thing), self._others(thing)
        others = others[np.linalg.norm(others[:, :2] - points[:, :2].mean(axis=0), axis=1) < 0.25]
        way = self.spot(thing, place) - self.data.xpos[self.goal.bodies[thing]]
        kinds = [list(kind) for kind in (self._across(points), self._walls(points), self._parts(self._pieces(thing)))]
        fitting = ([(width, one) for width, one in kind if self._fits(one, points)] for kind in kinds)
        options = next((kind for kind in fitting if kind), kinds[1])
        costs = [
            self._cost(width, one, others) + self._far(one.position) + self._far(one.position + way)
            for width, one in options
        ]
        return options[int(np.argmin(costs))][1]

    def _across(self, points: Array) -> Iterator[tuple[float, Grasp]]:
        bottom, top = points[:, 2].min(), points[:, 2].max()
        height = max(top - PALM, bottom + TIP + 0.003)
        ring = points[np.abs(points[:, 2] - height) < 0.012]
        ring = points if len(ring) < 8 else ring
        for yaw in YAWS:
            closing, along = _axes(yaw)
            across, length = ring[:, :2] @ closing, ring[:, :2] @ along
            if np.ptp(across) <= WIDEST:
                middle = closing * (across.max() + across.min()) / 2 + along * (length.max() + length.min()) / 2
                yield float(np.ptp(across)), Grasp(np.array([*middle, height]), float(yaw))

    def _walls(self, points: Array) -> Iterator[tuple[float, Grasp]]:
        upper = points[points[:, 2] > (points[:, 2].max() + points[:, 2].min()) / 2]
        for yaw in YAWS:
            closing, _ = _axes(yaw)
            for side in (1, -1):
                spot = upper[np.argmax(upper[:, :2] @ (side * closing)), :2]
                edge = points[np.linalg.norm(points[:, :2] - spot, axis=1) < 0.012, 2].max()
                yield 0.01, Grasp(np.array([*(spot - side * INWARDS * closing), edge - RIM]), float(yaw))

    def _pieces(self, thing: str) -> list[Array]:
        """Return points (N, 3) on each geom of a thing [m]."""
        return [
            local @ self.data.xmat[body].reshape(3, 3).T + self.data.xpos[body]
            for body, geoms in self._geoms[thing].items()
            for local in geoms
        ]

    def _parts(self, pieces: Sequence[Array]) -> Iterator[tuple[float, Grasp]]:
        top = max(points[:, 2].max() for points in pieces)
        for points in pieces:
            height = max(points[:, 2].max() - 0.02, points[:, 2].min() + TIP, top - PALM)
            if height > points[:, 2].max() - 0.004:
                continue
            for yaw in YAWS:
                width = float(np.ptp(points[:, :2] @ _axes(yaw)[0]))
                if width < WIDEST / 2:
                    middle = (points[:, :2].max(axis=0) + points[:, :2].min(axis=0)) / 2
                    yield width, Grasp(np.array([*middle, height]), float(yaw))

    def _fits(self, grasp: Grasp, points: Array) -> bool:
        """Return whether the open fingers do not come down on the thing itself."""
        closing, along = _axes(grasp.yaw)
        offset = points[:, :2] - grasp.position[:2]
        near = (np.abs(offset @ along) < FINGER) & (points[:, 2] > grasp.position[2] - TIP)
        aside = np.abs(offset[near] @ closing)
        return not bool(((aside > OPEN) & (aside < OPEN + 0.02)).any())

    def _far(self, position: Array) -> float:
        """Return the cost of a place [m] for which the arm must stretch or fold up."""
        distance = float(np.hypot(*(position - self._base)[:2]))
        return 3 * max(0.0, distance - ARM[1], ARM[0] - distance)

    def _walls(self, points: Array) -> Any:
        upper = points[points[:, 2] > (points[:, 2].max() + points[:, 2].min()) / 2]
        for yaw in YAWS:
            closing = np.array([-np.sin(yaw), np.cos(yaw)])
            for side in (1, -1):
                spot = upper[np.argmax(upper[:, :2] @ (side * closing)), :2]
                edge = points[np.linalg.norm(points[:, :2] - spot, axis=1) < 0.012, 2].max()
                yield 0.01, Grasp(np.array([*(spot - side * INWARDS * closing), edge - RIM]), float(yaw))

    def _cost(self, width: float, grasp: Grasp, others: Array) -> float:
        """Return the cost of a grasp: wide ones, far turns, and what the hand or the open fingers might hit."""
        closing, _ = _axes(grasp.yaw)
        spot, height = grasp.position[:2], grasp.position[2]
        hand = spot + np.linspace(-0.1, 0.1, 9)[:, None] * closing
        tall, beside = others[others[:, 2] > height + 0.03, :2], others[others[:, 2] > height - 0.02, :2]
        gap = np.linalg.norm(tall[:, None] - hand, axis=2).min(initial=1.0)
        for side in (1, -1):
            gap = min(gap, np.linalg.norm(beside - (spot + side * 0.05 * closing), axis=1).min(initial=1.0))
        # What is near the hand costs less: the choice stays the same while the hand approaches.
        stay = 0.02 * abs(grasp.yaw - self.yaw) + 0.5 * min(float(np.linalg.norm(spot - self.hand[:2])), HAND)
        return width + stay + 0.01 * abs(grasp.yaw) + 3 * max(0.0, CLEAR - gap)

    def spot(self, thing: str, place: str) -> Array:
        """Return where the origin (3,) of a thing is to be when it is let go [m]."""
        data, points = self.data, self.points(thing)
        below = data.xpos[self.goal.bodies[thing], 2] - points[:, 2].min()
        if place in self.goal.bodies:
            support = self.points(place)
            middle = data.xpos[self.goal.bodies[place]]
            near = support[np.linalg.norm(support[:, :2] - middle[:2], axis=1) < 0.03]
            return np.array([*middle[:2], (near if len(near) else support)[:, 2].max() + below + 0.004])
        site = self.goal.sites[place]
        middle, size, turn = data.site_xpos[site], self.model.site_size[site], data.site_xmat[site].reshape(3, 3)
        extent = np.abs(turn) @ size  # of the region along the axes of the world
        floor = middle[2] - extent[2]
        rest = self._others(thing)
        rest = rest[(rest[:, 2] > floor + 0.012) & (np.abs(rest[:, :2] - middle[:2]) < extent[:2] + 0.15).all(axis=1), :2]
        radius = float(np.linalg.norm(points[:, :2] - points[:, :2].mean(axis=0), axis=1).max())
        steps = np.stack(np.meshgrid(*[np.linspace(-0.8, 0.8, 7)] * 2), axis=-1).reshape(-1, 2)
        spots = middle[:2] + steps * extent[:2]
        gaps = np.linalg.norm(spots[:, None] - rest, axis=2).min(axis=1, initial=1.0)
        costs = 2 * np.maximum(0.0, radius + 0.005 - gaps) + 0.1 * np.linalg.norm(steps * extent[:2], axis=1)
        return np.array([*spots[int(np.argmin(costs))], floor + below + 0.01])

    def _above(self, thing: str, spot: Array) -> float:
        """Return by how much a thing must be higher than its spot to pass over all between it and the spot [m]."""
        points = self.points(thing)
        origin = self.data.xpos[self.goal.bodies[thing]]
        lowest = points[:, 2].min() - origin[2]
        way, rest = spot[:2] - origin[:2], self._others(thing)
        length = float(np.hypot(*way)) + 1e-9
        along = np.clip((rest[:, :2] - origin[:2]) @ way / length, 0, length)
        beside = np.linalg.norm(rest[:, :2] - origin[:2] - along[:, None] * way / length, axis=1)
        tops = rest[beside < 0.08, 2]
        return float(tops.max(initial=0.0) - (spot[2] + lowest)) if len(tops) else 0.0

    def _touched(self) -> str | None:
        """Return what both fingers touch."""
        contact, owner = self.data.contact, self.goal.owner
        bodies = self.model.geom_bodyid[contact.geom[: self.data.ncon]]
        touched = []
        for fingers in self._fingers:
            mine = np.isin(bodies, list(fingers))
            touched.append(
                {
                    int(owner[other])
                    for pair, own in zip(bodies, mine, strict=True)
                    if own.sum() == 1
                    for other in pair[~own]
                }
            )
        both = touched[0] & touched[1]
        return next((name for name, body in self.goal.bodies.items() if body in both), None)

    def _shape(self, root: int) -> dict[int, list[Array]]:
        """Return body → points (N, 3) on each geom, in its frame, of a body and those that hang on it."""
        shapes: dict[int, list[Array]] = {}
        for geom in range(self.model.ngeom):
            body = int(self.model.geom_bodyid[geom])
            if self.goal.owner[body] != root:
                continue
            if self.model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH:
                mesh = self.model.geom_dataid[geom]
                first = self.model.mesh_vertadr[mesh]
                points = self.model.mesh_vert[first : first + self.model.mesh_vertnum[mesh]]
            else:
                size = self.model.geom_size[geom]
                points = _surface(
                    size[[0, 0, 1]] if self.model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_CYLINDER else size
                )
            turn = np.empty(9)
            mujoco.mju_quat2Mat(turn, self.model.geom_quat[geom])
            shapes.setdefault(body, []).append(points @ turn.reshape(3, 3).T + self.model.geom_pos[geom])
        return shapes

    # Motion

    def _rising(self, target: Array) -> Array:
        """Reduce the motion across while the hand has to rise, so that it hits nothing."""
        rise = target[2] - self.hand[2]
        if rise > 0.01:
            target = np.array([*(self.hand[:2] + (target[:2] - self.hand[:2]) * 0.02 / (0.02 + rise)), target[2]])
        return target

    def _command(self, target: Array, yaw: float, grip: float) -> Array:
        """Return the command that moves the hand, pointing down, towards a position and a yaw."""
        sine, cosine = np.sin(yaw), np.cos(yaw)
        return self._move(target, np.array([[-sine, cosine, 0], [cosine, sine, 0], [0, 0, -1]]), grip)

    def _move(self, target: Array, turned: Array, grip: float) -> Array:
        """Return the command that moves the hand towards a position and a rotation (3, 3): closing, across, ahead."""
        move = GAIN * (target - self.hand) / REACH[:3]
        move /= max(1.0, float(np.abs(move).max()))
        turn = TURN_GAIN * self._turn(turned) / REACH[3:]
        return np.array([*move, *(turn / max(1.0, float(np.abs(turn).max()))), grip])

    def _turn(self, wanted: Array) -> Array:
        """Return the rotation vector (3,), in the world, from the hand's rotation to another one."""
        quaternion, vector = np.empty(4), np.empty(3)
        mujoco.mju_mat2Quat(quaternion, (wanted @ self.rotation.T).ravel())
        mujoco.mju_quat2Vel(vector, quaternion, 1.0)
        return vector


def _surface(size: Array) -> Array:
    """Return points (N, 3) on the faces of a box of half sizes (3,), at most `SPACING` apart [m]."""
    axes = [np.linspace(-half, half, 2 + int(2 * half / SPACING)) for half in size]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    return grid[(np.abs(np.abs(grid) - size) < 1e-9).any(axis=1)]


def _axes(yaw: float) -> tuple[Array, Array]:
    """Return the horizontal directions (2,) in which the fingers close, and across it."""
    return np.array([-np.sin(yaw), np.cos(yaw)]), np.array([np.cos(yaw), np.sin(yaw)])
