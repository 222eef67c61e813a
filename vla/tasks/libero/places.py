"""Where to put a thing down: free room on or in what the goal names."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from vla.robots.cartesian import rotation_z
from vla.spec import Array
from vla.tasks.libero.room import CLEAR, clearance, reach_costs
from vla.tasks.libero.situation import Situation

LOOSE = 0.02  # distance from a spot at which a thing may be lowered where there is room [m]
TIGHT = 0.009  # the same where there is none [m]
MARGIN = 0.008  # between a thing and what stands about its place [m]
ASIDE = 0.012  # between a thing and a drawer that is to be opened [m]
SLIT = 0.008  # between a thing and what it passes [m]
PUSHED = 0.06  # by how much a dragged thing may push others [m]
SQUARE = 0.01  # edge of the cells of a horizontal grid, each of which keeps one point [m]
STAY, REACHED = 0.5, 0.05  # cost per metre from where the thing is, up to this distance [m], so that the choice stays
FLOOR = 0.012  # smallest height of an obstacle above the floor of a region [m]
THICK = 0.03  # largest height of a support above the middle of a flat region [m]
GRID = np.stack(np.meshgrid(*[np.linspace(-0.8, 0.8, 7)] * 2), axis=-1).reshape(-1, 2)
WAYS = np.array([[np.cos(angle), np.sin(angle)] for angle in np.arange(16) * np.pi / 8])  # out from under a roof
OBLIQUE = np.where(np.arange(len(WAYS)) % 4, 0.1, 0.0)  # costs of ways that are not along a wall [m]
ROUND = 0.7  # least ratio of the variances along both sides of a thing that is not turned to be put down
ROOFED = 0.05  # cost of a roof over a place, per unit of `_Form.room`


@dataclass(frozen=True)
class Place:
    """Where the origin of a thing is to be when it is let go."""

    spot: Array  # (3,) [m]
    turn: float = 0.0  # of the thing about the vertical, from how it is now [rad]
    slack: float = LOOSE  # largest horizontal distance at which the thing may be lowered [m]
    exit: Array | None = None  # (3,) horizontal displacement from the spot to where no roof is over the thing [m]
    current_exit: Array | None = None  # the same from where the thing is


def place_of(situation: Situation, thing: str, destination: str, is_held: bool) -> Place:
    """Return where to put a thing down on another one, or on or in a region; `is_held`: whether the hand holds it."""
    place = _place_of(situation, thing, destination, is_held)
    offset = situation.origin(thing) - place.spot
    entering = place.exit is not None and np.linalg.norm(offset) < np.linalg.norm(place.exit) + 0.03
    return place if entering else replace(place, current_exit=_hidden(situation, thing, is_held))


def _hidden(situation: Situation, thing: str, held: bool) -> Array | None:
    """Return the displacement (3,) [m] of a thing to where nothing is over it; None: nothing is, or it is blocked."""
    obstacles = situation.surroundings(thing, situation.origin(thing), 0.3)
    return way_out(situation, thing, obstacles[obstacles[:, 2] > situation.points(thing)[:, 2].max()], held)


def way_off_drawer_path(situation: Situation, thing: str, joint: int) -> Array | None:
    """Return the displacement (3,) [m] of a thing out of a drawer's way; None: it is not in the way, or blocked."""
    drawer = np.concatenate(situation.moved_points(joint))
    opening = situation.data.qpos[situation.model.jnt_qposadr[joint]]
    distances = np.linspace(0, situation.model.jnt_range[joint, 0] - opening, 5)
    path = np.concatenate([drawer + distance * situation.data.xaxis[joint] for distance in distances])
    return way_out(situation, thing, path[path[:, 2] > situation.points(thing)[:, 2].max()], False, ASIDE)


def way_out(situation: Situation, thing: str, roof: Array, is_held: bool, margin: float = 2 * MARGIN) -> Array | None:
    """Return the displacement (3,) [m] of a thing from under points (N, 3); None: it is not under them, or blocked."""
    points, origin = situation.points(thing), situation.origin(thing)
    form = _Form(points, origin, 0.0)
    if not form.room(origin[None], roof)[1][0]:
        return None
    starts = np.column_stack([origin[:2] + 0.02 * WAYS, np.full(len(WAYS), points[:, 2].max() - 0.02)])
    gaps = clearance(starts, np.arctan2(WAYS[:, 1], WAYS[:, 0]), _thin(roof))
    obstacles = situation.surroundings(thing, origin, 0.3)
    obstacles = obstacles[obstacles[:, 2] > points[:, 2].min() + FLOOR]
    if is_held:
        return form.exit(origin, obstacles, 0.0, roof, margin, SLIT)
    return form.exit(origin, obstacles, 3 * np.maximum(0, CLEAR - gaps), roof, margin, PUSHED)


def _place_of(situation: Situation, thing: str, destination: str, held: bool) -> Place:
    points, origin = situation.points(thing), situation.origin(thing)
    foot = origin[2] - points[:, 2].min()
    if destination in situation.goal.bodies:
        support, middle = situation.points(destination), situation.origin(destination)
        core = support[np.linalg.norm(support[:, :2] - middle[:2], axis=1) < 0.03]
        return Place(np.array([*middle[:2], (core if len(core) else support)[:, 2].max() + foot + 0.004]))
    site = situation.goal.sites[destination]
    middle, axes = situation.data.site_xpos[site], situation.data.site_xmat[site].reshape(3, 3)
    extent = np.abs(axes) @ situation.model.site_size[site]  # half sizes of the region along the axes of the world
    floor = _floor(situation, destination, middle, extent)
    spots = np.column_stack([middle[:2] + GRID * extent[:2], np.full(len(GRID), floor + foot + 0.01)])
    obstacles = situation.surroundings(thing, middle, float(extent[:2].max()) + 0.15)
    obstacles = obstacles[obstacles[:, 2] > floor + FLOOR]
    off_centre = 0.1 * np.linalg.norm(spots[:, :2] - middle[:2], axis=1)
    options: list[tuple[float, Place]] = []  # room about the thing [m], and its place, for every turn
    for turn in _turns(points):
        form = _Form(points, origin, turn)
        gaps, roofs = form.room(spots, obstacles)
        costs = off_centre + 2 * np.maximum(0, MARGIN - gaps) + ROOFED * roofs
        hands = spots + rotation_z(turn) @ (situation.hand - origin)  # where the hand is then, if it holds the thing
        if held:
            costs += STAY * np.minimum(np.linalg.norm(spots[:, :2] - origin[:2], axis=1), REACHED)
            costs += _hindrance(hands, situation.yaw + turn, obstacles) + reach_costs(situation, hands)
        index = int(np.argmin(costs))
        displacement = form.exit(spots[index], obstacles, OBLIQUE) if roofs[index] else None
        if roofs[index] and displacement is None and not roofs.all():  # nothing can come in there
            index = int(np.argmin(np.where(roofs > 0, np.inf, costs)))
        elif held and displacement is not None:  # the hand must also have room where it comes down
            other_index = int(np.argmin(costs + _hindrance(hands + displacement, situation.yaw + turn, obstacles)))
            other_displacement = form.exit(spots[other_index], obstacles, OBLIQUE) if roofs[other_index] else None
            if other_displacement is not None or not roofs[other_index]:
                index, displacement = other_index, other_displacement
        slack = float(np.clip(gaps[index], TIGHT, LOOSE)) if displacement is None else SLIT
        options.append((float(gaps[index]), Place(spots[index], turn, slack, displacement)))
        if gaps[index] > 0:
            return options[-1][1]
    (first_room, first_place), (room, place) = options[0], max(options, key=lambda option: option[0])
    if room > first_room + MARGIN or extent[2] < THICK:
        return place
    return replace(first_place, slack=LOOSE)  # it fits nowhere, so it lies on what is there


def _hindrance(hands: Array, yaw: float, obstacles: Array) -> Array:
    """Return costs (K,) of what is close to the hand at places (K, 3) [m]."""
    return np.maximum(0, CLEAR - clearance(hands, np.full(len(hands), yaw), obstacles))


def _floor(situation: Situation, region: str, middle: Array, extent: Array) -> float:
    """Return the height [m] of the floor of a region, which has half sizes `extent` (3,) about its middle (3,)."""
    owner = situation.subject(region)
    bottom = float(middle[2] - extent[2])
    if not owner:
        return bottom
    points = situation.points(owner)
    mask = np.linalg.norm(points[:, :2] - middle[:2], axis=1) < 0.03
    mask &= points[:, 2] < middle[2] + max(0.0, THICK - extent[2])
    return max(bottom, float(points[mask, 2].max(initial=bottom)))


def _turns(points: Array) -> tuple[float, ...]:
    """Return turns [rad] worth trying: none, and those that lay a thing's long side along an axis of the world."""
    variances, directions = np.linalg.eigh(np.cov(points[:, :2].T))
    if variances[0] > ROUND * variances[1]:
        return (0.0,)
    angle = float(np.arctan2(directions[1, 1], directions[0, 1]))
    turns = [(quarter - angle + np.pi / 2) % np.pi - np.pi / 2 for quarter in (0, np.pi / 2)]
    return (0.0, *sorted(turns, key=abs))


class _Form:
    """The upright box about a thing, turned about its origin."""

    def __init__(self, points: Array, origin: Array, turn: float) -> None:
        _, directions = np.linalg.eigh(np.cov(points[:, :2].T))
        coordinates = (points[:, :2] - origin[:2]) @ directions
        low, high = coordinates.min(axis=0), coordinates.max(axis=0)
        self._half, self._height = (high - low) / 2, points[:, 2].max() - origin[2]
        self._axes = rotation_z(turn)[:2, :2] @ directions
        self._middle = self._axes @ (high + low) / 2

    def _gaps(self, spots: Array, points: Array) -> Array:
        """Return how far points (N, 3) are outside of the box at places (K, 3): (K, N) [m], negative inside."""
        offset = points[None, :, :2] - spots[:, None, :2] - self._middle
        distances = np.abs(offset @ self._axes) - self._half
        return np.maximum(distances[..., 0], distances[..., 1])

    def room(self, spots: Array, obstacles: Array) -> tuple[Array, Array]:
        """Return the free room (K,) [m] about the box at places (K, 3), and how much roof covers it, (K,) 0…1.25."""
        if not len(obstacles):
            return np.ones(len(spots)), np.zeros(len(spots))
        is_roof = obstacles[:, 2] > spots[0, 2] + self._height
        counts = (self._gaps(spots, _thin(obstacles[is_roof])) < -MARGIN).sum(axis=1)
        gaps = self._gaps(spots, _thin(obstacles[~is_roof]))
        return gaps.min(axis=1, initial=1.0), (counts > 0) / 4 + counts / max(int(counts.max(initial=0)), 1)

    def exit(
        self,
        spot: Array,
        obstacles: Array,
        costs: Array | float,
        roof: Array | None = None,
        margin: float = 2 * MARGIN,
        max_push: float = SLIT,
    ) -> Array | None:
        """Return the cheapest horizontal displacement (3,) [m] from a spot to where nothing is over it, or None.

        Args:
            spot: (3,) of the thing's origin [m].
            obstacles: points (N, 3) of what is in the way [m].
            costs: of the ways (W,), added to the distances [m].
            roof: points (M, 3) to get away from by a margin; None: those of `obstacles` over the thing.
            margin: the margin [m].
            max_push: how far it may push other things [m].
        """
        roof = _thin(obstacles[obstacles[:, 2] > spot[2] + self._height] if roof is None else roof)
        distances = np.arange(0.02, 0.3, 0.02)
        ways = (distances[:, None, None] * WAYS).reshape(-1, 2)
        spots = spot + np.column_stack([ways, np.zeros(len(ways))])
        neighbours = _thin(obstacles[obstacles[:, 2] <= spot[2] + self._height])
        room = self._gaps(spots, neighbours).min(axis=1, initial=1.0).reshape(len(distances), -1)
        free = self._gaps(spots, roof).min(axis=1, initial=1.0) > margin
        squeeze = np.maximum(0, np.maximum(SLIT - room, -np.minimum.accumulate(room, axis=0)))
        free &= (squeeze < max_push).ravel()
        total = np.where(free, (distances[:, None] + 3 * squeeze + np.broadcast_to(costs, len(WAYS))).ravel(), np.inf)
        return np.array([*ways[int(np.argmin(total))], 0.0]) if free.any() else None


def _thin(points: Array) -> Array:
    """Return the points (N, 3) thinned to one per cell of a horizontal grid."""
    squares = np.rint(points[:, :2] / SQUARE).astype(int) @ (1, 1 << 20)
    return points[np.unique(squares, return_index=True)[1]]
