"""Where to grasp a thing, computed from points on its surface and on the surfaces around it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np

from vla.robots.cartesian import rotation_z
from vla.spec import Array
from vla.tasks.libero.places import Place
from vla.tasks.libero.room import CLEAR, HAND, axes, clearance, reach_costs
from vla.tasks.libero.situation import FINGER, PALM, THIN, TIP, Situation

WIDEST = 0.074  # of a thing between the open fingers [m]
RIM = 0.012  # depth of a grasp below the edge of a wall [m]
SHIFTS = ((0.01, 0.004), (0.03, -0.014))  # cost and offset of such a grasp towards the inside [m]
SIDEWAYS = ((0.0, 0.0), (0.02, 0.025), (0.02, -0.025))  # cost and offset from the middle of a grasp of a long thing [m]
LONG = 0.45  # largest distance from the middle of a long thing at which a finger holds it, relative to its length
OPEN, THICK = 0.037, 0.02  # distance of an open finger from the middle, and its depth [m]
RIDGE = 0.02  # radius of what counts as the highest part of a thing [m]
UPRIGHT = 0.9  # least cosine of the tilt of a thing that stands
TOUCHING = 0.02  # room at which the hand most likely hits something [m]
SQUARE = 0.9  # least cosine between the direction in which the fingers close and the normal of a wall
KINDS = (0.0, 0.08, 0.10, 0.12)  # costs of grasps across a thing, by a wall, by a narrow part and leaning
LEAN = 0.45  # of the hand where something stands in its way [rad]
OBLIQUE = 0.003  # largest excess of the width of a part over its smallest one [m]
DESCENT = 0.3  # height of the wrist over a grasp at which a leaning hand begins to come down [m]
YAWS = np.radians(np.arange(-90, 90, 15))


@dataclass(frozen=True)
class Grasp:
    """Where the hand closes."""

    position: Array  # (3,) of the point between the fingertips [m]
    yaw: float  # of the fingers, 0: they close along y [rad]
    lean: float = 0.0  # of the hand about the axis along which the fingers close [rad]
    swing: float = 0.0  # of the arm about its base, with the thing [rad]


def choose_grasp(situation: Situation, thing: str, place: Place) -> Grasp | None:
    """Return the cheapest grasp from above of a thing to be brought to a place; None if there is none."""
    points = situation.points(thing)
    # Whichever of its axes is up.
    is_tilted = np.abs(situation.data.xmat[situation.goal.bodies[thing], 6:]).max() < UPRIGHT
    kinds = [crest(points)]
    if not is_tilted:
        kinds = [grasps_across(points), walls(points), parts(situation.pieces(thing)), leaning_grasps(points)]
    best_grasp: Grasp | None = None
    lowest_cost = hindrance = math.inf  # cost of the best one, and the part of it that is due to its kind and obstacles
    for base_cost, kind in zip(KINDS, kinds, strict=False):
        if hindrance < base_cost:
            break  # its obstacles cost less than another kind of grasp
        if not (candidates := [(width, grasp) for width, grasp in kind if gap_of(grasp, points) > 0]):
            continue
        widths, grasps = zip(*candidates, strict=True)
        moves, hindrances = _costs(situation, thing, grasps, place)
        costs = base_cost + np.array(widths) + moves + hindrances
        index = int(np.argmin(costs))
        if costs[index] < lowest_cost:
            best_grasp, lowest_cost = grasps[index], float(costs[index])
            hindrance = float(base_cost + hindrances[index])
    return best_grasp and replace(best_grasp, swing=situation.swing(best_grasp.position, place.spot))


def room_of(situation: Situation, thing: str, grasp: Grasp) -> float:
    """Return the free room about the hand at a grasp [m]."""
    obstacles = situation.surroundings(thing, grasp.position, 2 * HAND)
    return float(clearance(grasp.position[None], np.array([grasp.yaw]), obstacles, np.array([grasp.lean]))[0])


def _costs(situation: Situation, thing: str, grasps: Sequence[Grasp], place: Place) -> tuple[Array, Array]:
    """Return costs (K,) of the motion of the hand, and of what hinders it where it grasps and where it lets go."""
    spots = np.array([grasp.position for grasp in grasps])
    yaws, leans = np.array([grasp.yaw for grasp in grasps]), np.array([grasp.lean for grasp in grasps])
    targets = place.spot + (spots - situation.origin(thing)) @ rotation_z(place.turn).T
    swing = situation.swing(situation.origin(thing), place.spot)
    turns = np.array([situation.turn_to(yaw, swing) for yaw in yaws])
    # What is near the hand costs less: the choice stays the same while the hand approaches.
    distance = np.minimum(np.linalg.norm(spots[:, :2] - situation.hand[:2], axis=1), HAND)
    moves = 0.02 * np.abs(turns) + 0.02 * np.abs(leans - situation.lean) + 0.5 * distance + 0.01 * np.abs(yaws)
    releases = _hindrances(situation, thing, targets, yaws + place.turn, leans)
    if place.exit is None:
        releases -= releases.min()  # a basket's walls are close to every hand, and things may fall the last centimetres
    return moves, _hindrances(situation, thing, spots, yaws, leans) + releases


def _hindrances(situation: Situation, thing: str, spots: Array, yaws: Array, leans: Array) -> Array:
    """Return costs (K,) of obstacles close to the hand at places (K, 3) [m], and of reaching these places."""
    middle = (spots.max(axis=0) + spots.min(axis=0)) / 2
    obstacles = situation.surroundings(thing, middle, float(np.ptp(spots[:, :2], axis=0).max()) / 2 + HAND + CLEAR)
    gaps = clearance(spots, yaws, obstacles, leans)
    wrists = spots.copy()
    wrists[:, :2] -= DESCENT * np.tan(leans)[:, None] * np.column_stack([np.cos(yaws), np.sin(yaws)])
    return 3 * np.maximum(0, CLEAR - gaps) + 10 * np.maximum(0, TOUCHING - gaps) + reach_costs(situation, wrists)


def grasps_across(points: Array) -> Iterator[tuple[float, Grasp]]:
    """Yield width [m] and grasp across a whole thing."""
    bottom, top = points[:, 2].min(), points[:, 2].max()
    height = max(top - PALM, bottom + TIP + 0.003)
    ring = points[np.abs(points[:, 2] - height) < 0.012]
    ring = points if len(ring) < 8 else ring
    for yaw in YAWS:
        closing, cross_axis = axes(yaw)
        widths, lengths = ring[:, :2] @ closing, ring[:, :2] @ cross_axis
        if np.ptp(widths) > WIDEST:
            continue
        centre = (lengths.max() + lengths.min()) / 2
        for cost, shift in SIDEWAYS:
            if shift and abs(shift) + FINGER > LONG * np.ptp(lengths):
                break
            middle = closing * (widths.max() + widths.min()) / 2 + cross_axis * (centre + shift)
            yield cost + float(np.ptp(widths)), Grasp(np.array([*middle, height]), float(yaw))


def crest(points: Array) -> Iterator[tuple[float, Grasp]]:
    """Yield width [m] and grasp about the highest point of a thing, such as a bowl that leans on something."""
    top = points[np.argmax(points[:, 2])]
    ridge = points[np.linalg.norm(points - top, axis=1) < RIDGE]
    middle = (ridge[:, :2].max(axis=0) + ridge[:, :2].min(axis=0)) / 2
    for yaw in YAWS:
        width = float(np.ptp(ridge[:, :2] @ axes(yaw)[0]))
        yield width, Grasp(np.array([*middle, top[2] - RIM]), float(yaw))


def walls(points: Array) -> Iterator[tuple[float, Grasp]]:
    """Yield width [m] and grasp of the wall of a hollow thing, at its edge."""
    upper_points = points[points[:, 2] > (points[:, 2].max() + points[:, 2].min()) / 2]
    middle = (points[:, :2].max(axis=0) + points[:, :2].min(axis=0)) / 2
    for yaw in YAWS:
        closing, _ = axes(yaw)
        for side in (1, -1):
            spot = upper_points[np.argmax(upper_points[:, :2] @ (side * closing)), :2]
            outwards = spot - middle
            if side * (outwards @ closing) < SQUARE * np.linalg.norm(outwards):
                continue  # the wall is oblique, as that of a tilted bowl
            edge = points[np.linalg.norm(points[:, :2] - spot, axis=1) < 0.012, 2].max()
            for width, inwards in SHIFTS:
                yield width, Grasp(np.array([*(spot - side * inwards * closing), edge - RIM]), float(yaw))


def leaning_grasps(points: Array) -> Iterator[tuple[float, Grasp]]:
    """Yield width [m] and grasp of a wall, or across a whole thing, with a hand that leans to a side."""
    corner = np.array([0.0, 0.0, FINGER * np.sin(LEAN)])  # depth of the lower corner of a leaning fingertip
    across = ((width, replace(grasp, position=grasp.position + corner)) for width, grasp in grasps_across(points))
    for width, grasp in chain(walls(points), across):
        for lean in (-LEAN, LEAN):
            yield width, replace(grasp, lean=lean)


def parts(pieces: Sequence[Array], alone: bool = True) -> Iterator[tuple[float, Grasp]]:
    """Yield width [m] and grasp of single parts of a thing that stand up, such as a handle.

    `alone`: nothing else of the thing may be between the fingers.
    """
    cloud = np.concatenate(pieces)
    top = cloud[:, 2].max()
    for points in pieces:
        height = max(points[:, 2].max() - 0.02, points[:, 2].min() + TIP, top - PALM)
        if height > points[:, 2].max() - 0.004:
            continue
        middle = (points[:, :2].max(axis=0) + points[:, :2].min(axis=0)) / 2
        options = []
        for yaw in YAWS:
            closing, cross_axis = axes(yaw)
            width = float(np.ptp(points[:, :2] @ closing))
            band = cloud[(np.abs((cloud[:, :2] - middle) @ cross_axis) < FINGER) & (cloud[:, 2] > height - TIP)]
            offsets = np.abs((band[:, :2] - middle) @ closing)
            if width < WIDEST / 2 and not (alone and offsets[offsets < OPEN].max(initial=0.0) > width / 2 + THIN):
                options.append((width, Grasp(np.array([*middle, height]), float(yaw))))
        # Fingers that close obliquely turn a narrow part, and the thing with it.
        narrowest = min((width for width, _ in options), default=0.0)
        yield from (option for option in options if option[0] < narrowest + OBLIQUE)


def gap_of(grasp: Grasp, points: Array) -> float:
    """Return the gap between the open fingers that come down and the thing [m]; negative: they come down on it."""
    closing, cross_axis = axes(grasp.yaw)
    offset = points[:, :2] - grasp.position[:2]
    mask = (np.abs(offset @ cross_axis) < FINGER) & (points[:, 2] > grasp.position[2] - TIP)
    distances = np.abs(offset[mask] @ closing)
    return float(np.maximum(OPEN - distances, distances - OPEN - THICK).min(initial=np.inf))
