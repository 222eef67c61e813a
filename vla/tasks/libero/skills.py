"""Skills of LIBERO's planner: each returns the command (7,) for one step, from the present state alone."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np

from vla.spec import Array
from vla.tasks.libero.controller import REACH
from vla.tasks.libero.grasps import LEAN, TOUCHING, Grasp, gap_of, parts, room_of
from vla.tasks.libero.places import LOOSE, Place
from vla.tasks.libero.room import HAND, axes
from vla.tasks.libero.situation import SHUT, THIN, TIP, Situation

GAIN = 3.0  # on the remaining distance, in a command: with less, the hand stops a centimetre short of its target
TURN_GAIN = 1.0  # on the remaining rotation: more is unstable where the arm folds up
HOVER = 0.08  # height over a thing at which it is approached [m]
NEAR, LEVEL, TURNED = 0.008, 0.008, 0.12  # tolerances of a grasp: horizontal [m], in height [m], in yaw [rad]
FUNNEL = 2.5  # height gained per metre of horizontal distance, so that approaches come from above
TURNED_ROOM = 0.05  # room of a grasp per angle that is left of its tolerance [m/rad]
ROOM = 0.03  # largest horizontal distance at which the hand comes down, if it touches nothing [m]
MARGIN = 0.015  # height of open fingers over what they must not touch [m]
FIRM = -0.9  # commanded opening at which the fingers press as much as they can
CARRY = 0.05  # height over all that is on the way [m]
SWEEP = 0.08  # half width of the path of a carried thing, within which it passes over everything [m]
SLOW = 0.012  # lead of the hand over what it drags; with more, it slips [m]
BACK = 0.5  # lean of a hand that pushes [rad]
EMPTY = 0.01  # largest distance between fingers that hold nothing of use [m]
STRAIGHT = 0.97  # least cosine of the tilt of a thing that is let go
RESTS = 0.12  # height over its place at which a thing is let go if it, or a finger, lies on something there [m]
FALLS, SLIPS = 0.03, 0.02  # horizontal distance at which it is, where there is room for it, and where there is none [m]
TWIST = 0.4  # lead of the hand over a knob that it turns [rad]
UP = np.array([0.0, 0.0, 1.0])


def approach(situation: Situation, grasp: Grasp, points: Array, thing: str, opening: float = -1.0) -> Array:
    """Move to a grasp of points (N, 3) of a thing from above, along the hand, and close the fingers there.

    The hand descends where its fingers clear the thing, and corrects the remaining error meanwhile. The height changes
    gradually with the free room, so that no centimetre, which a policy can hardly see, decides between up and down.
    """
    grasp = equivalent_grasp(situation, grasp)
    slope = np.array([*(-np.tan(grasp.lean) * axes(grasp.yaw)[1]), 1.0])  # of the line on which the hand comes
    height = situation.hand[2] - grasp.position[2]
    offset = (situation.hand - grasp.position - max(height, 0.0) * slope) * (1, 1, 0)
    distance = float(np.hypot(*offset[:2]))
    turn = max(abs(grasp.yaw - situation.yaw), abs(situation.lean - grasp.lean))
    # Fingers that have begun to close go on unless the hand is far off.
    factor = 1.0 if situation.opening > 0.5 else 1.6
    if distance < factor * NEAR and turn < factor * TURNED and abs(height) < factor * LEVEL:
        return command(situation, grasp.position, grasp.yaw, 1.0, grasp.lean, grasp.swing)
    obstacles = situation.surroundings(thing, grasp.position, HAND)
    # Heights of the hand at which its fingers are above the thing, and above what stands about.
    thing_top, obstacle_top = (cloud[:, 2].max(initial=-np.inf) + TIP + MARGIN for cloud in (points, obstacles))
    pose = Grasp(grasp.position + offset, situation.yaw, grasp.lean)
    aligned = (NEAR if situation.hand[2] > thing_top - 0.01 else 1.6 * NEAR) - distance
    turn_room = TURNED_ROOM * (1.6 * TURNED - turn)
    # How far [m] the hand is from where it may not come down, past what stands about and past the thing itself.
    obstacle_room = min(max(room_of(situation, thing, pose) - TOUCHING, aligned), ROOM - distance, turn_room)
    thing_room = min(max(gap_of(pose, points), aligned), obstacle_room)
    if opening < 0 and situation.opening < 0.5:  # fingers that are still closed would come down on the thing
        thing_room = -ROOM
    thing_height = lowest(situation, thing_top + _funnel(distance - NEAR), thing_room)
    obstacle_height = lowest(situation, obstacle_top + _funnel(-obstacle_room), obstacle_room)
    rise = max(0.0, thing_height - grasp.position[2], obstacle_height - grasp.position[2])
    target = grasp.position + rise * slope
    # On the way the hand rises over what it would touch, such as the wall of the basket that it is in.
    here = Grasp(situation.hand, situation.yaw, situation.lean)
    way_room = max(room_of(situation, thing, here) - TOUCHING, ROOM - distance)
    way_top = situation.surroundings(thing, situation.hand, HAND)[:, 2].max(initial=-np.inf) + TIP + MARGIN
    target[2] = max(target[2], lowest(situation, way_top, way_room))
    return command(situation, rising_target(situation, target), grasp.yaw, opening, grasp.lean, grasp.swing)


def lowest(situation: Situation, top: float, room: float) -> float:
    """Return the lowest height of the hand [m] among obstacles up to height `top`, with free room `room` [m].

    Where there is room the hand sinks, the faster the more there is; where there is none, it rises to the top.
    """
    return min(top, float(situation.hand[2]) - FUNNEL * room)


def _funnel(distance: float) -> float:
    """Return the height [m] above obstacles at a horizontal distance [m] from where the hand may be lower."""
    return min(max(distance, 0.0) * FUNNEL, HOVER)


def carry(situation: Situation, thing: str, place: Place) -> Array:
    """Carry the held thing to a place, and let go of it there."""
    origin, yaw, lean = situation.origin(thing), situation.yaw + place.turn, LEAN * round(situation.lean / LEAN)
    if place.current_exit is not None:
        return command(situation, situation.hand + place.current_exit + 0.01 * UP, yaw, 1.0, lean)
    if place.exit is not None:  # a roof is over the place: first to where it ends, then straight in
        direction = place.exit / np.linalg.norm(place.exit)
        offset = origin - place.spot
        depth = float(offset @ direction)  # that the thing still has to go in
        deviation = float(np.linalg.norm(offset - depth * direction))
        outside = depth - float(np.linalg.norm(place.exit))  # from the roof, under which it must not rise
        if outside > 0.03 or deviation > (0.02 if outside > -0.03 else 0.05):
            place = Place(place.spot + place.exit, place.turn, 0.0)
        elif depth > 0.004:
            return command(situation, situation.hand + place.spot - origin, yaw, 1.0, lean)
    offset = place.spot - origin
    distance = float(np.hypot(*offset[:2]))
    if is_over(situation, thing, place) and (situation.opening > SHUT or situation.rests(thing)):
        return command(situation, situation.hand, yaw, -1.0, lean)
    if distance < min(0.015, place.slack) and abs(place.turn) < TURNED and offset[2] > -0.012:
        return let_go(situation, thing)
    distance += 0.1 * abs(place.turn)
    target = situation.hand + offset + np.clip(FUNNEL * (distance - 0.6 * place.slack), 0.0, CARRY) * UP
    pass_height = target[2] + max(0.0, _pass_height(situation, thing, place.spot))  # height over all that is on the way
    target[2] = max(target[2], lowest(situation, pass_height, max(place.slack, 0.015) - distance))
    return command(situation, rising_target(situation, target), yaw, 1.0, lean)


def is_over(situation: Situation, thing: str, place: Place) -> bool:
    """Return whether a thing would fall to its place."""
    offset = place.spot - situation.origin(thing)
    is_near = np.hypot(*offset[:2]) < (FALLS if place.slack == LOOSE else SLIPS)
    return bool(is_near and offset[2] > -RESTS and abs(place.turn) < TURNED)


def let_go(situation: Situation, thing: str) -> Array:
    """Let go of a held thing; if it hangs askew, first lower it until what is below it has righted it."""
    points, frame = situation.points(thing), situation.data.xmat[situation.goal.bodies[thing]].reshape(3, 3)
    axis = int(np.argmax(np.abs(frame[2])))
    up = frame[:, axis] * np.sign(frame[2, axis])  # of the thing
    # Height of the hand over the ground once the thing is straight.
    standing = situation.hand @ up - (points @ up).min()
    hangs = up[2] < STRAIGHT and situation.hand[2] - points[:, 2].min() > standing + 0.002
    lower, grip = (0.01 * UP, 1.0) if hangs else (0.0, -1.0)
    return command(situation, situation.hand - lower, situation.yaw, grip, situation.lean)


def equivalent_grasp(situation: Situation, grasp: Grasp) -> Grasp:
    """Return the grasp, equal up to a swap of the fingers, that the hand reaches by the smallest turn."""
    turn = situation.turn_to(grasp.yaw, grasp.swing)
    same = np.cos(situation.yaw + turn - grasp.yaw) > 0
    return replace(grasp, yaw=situation.yaw + turn, lean=grasp.lean if same else -grasp.lean)


def _pass_height(situation: Situation, thing: str, spot: Array) -> float:
    """Return how far above its spot a thing must be to pass over everything on the way there [m]."""
    origin = situation.origin(thing)
    bottom = situation.points(thing)[:, 2].min() - origin[2]
    path = spot[:2] - origin[:2]
    length = float(np.hypot(*path)) + 1e-9
    obstacles = situation.surroundings(thing, (spot + origin) / 2, length / 2 + SWEEP)
    progress = np.clip((obstacles[:, :2] - origin[:2]) @ path / length, 0, length)
    distances = np.linalg.norm(obstacles[:, :2] - origin[:2] - progress[:, None] * path / length, axis=1)
    return float(obstacles[distances < SWEEP, 2].max(initial=-np.inf) - (spot[2] + bottom))


def drag(situation: Situation, thing: str, displacement: Array) -> Array:
    """Move a hollow thing that cannot be grasped by (3,) [m]: closed fingers inside press its wall."""
    points, origin = situation.points(thing), situation.origin(thing)
    heading = displacement / np.linalg.norm(displacement)
    radius = float(np.ptp(points[:, :2], axis=0).min()) / 2
    steps = origin + np.linspace(0.45, 0.0, 6)[:, None] * radius * heading  # the farther out, the higher the bottom is
    floors = np.array([_height_at(points, step) for step in steps])
    flat = floors <= floors[-1] + 0.35 * (points[:, 2].max() - floors[-1])
    spot = np.array([*steps[int(np.argmax(flat))][:2], floors[int(np.argmax(flat))] + TIP])
    is_inside = np.linalg.norm((situation.hand - origin)[:2]) < 0.8 * radius
    yaw = float(np.arctan2(heading[1], heading[0]))
    if is_inside and situation.hand[2] < spot[2] + 0.006:
        target = situation.hand + min(SLOW, float(np.linalg.norm(displacement))) * heading
        return command(situation, np.array([*target[:2], spot[2] - 0.005]), yaw, 1.0)
    return approach(situation, Grasp(spot, yaw), points, thing, closing_command(situation, float(points[:, 2].max())))


def _height_at(points: Array, spot: Array) -> float:
    """Return the height of points (N, 3) at a spot (3,) [m]."""
    distance = np.linalg.norm(points[:, :2] - spot[:2], axis=1)
    return float(points[distance < max(0.012, float(distance.min())), 2].max(initial=points[:, 2].min()))


def pull(situation: Situation, place: str) -> Array:
    """Open a drawer by its handle: the hand comes from the front, one finger over the bar and one under it."""
    joint = int(situation.goal.joints(place)[0])
    axis = -situation.data.xaxis[joint]  # openings are negative
    bar = max(situation.moved_points(joint), key=lambda points: float((points @ axis).max()))
    middle = (bar.max(axis=0) + bar.min(axis=0)) / 2 - 0.006 * axis
    turns = [np.stack([side, np.cross(-axis, side), -axis], axis=1) for side in (UP, -UP)]  # the fingers are alike
    rotation = min(turns, key=lambda turn: float(np.linalg.norm(_turn(situation, turn))))
    offset = situation.hand - middle
    distance = float(offset @ axis)
    deviation, angle = map(np.linalg.norm, (offset - distance * axis, _turn(situation, rotation)))
    if deviation < 1.5 * NEAR and angle < 2 * TURNED and abs(distance) < 2 * LEVEL:
        grips = situation.opening < FIRM and situation.gap > THIN
        return move(situation, middle + (0.012 if grips else 0.0) * axis, rotation, 1.0)  # slowly, or the fingers slip
    if situation.upright and situation.hand[2] < middle[2] - 0.03:
        return command(situation, np.array([*situation.hand[:2], middle[2]]), 0.0, -1.0)
    if distance < 0.09 and situation.hand[2] < tops(situation) and angle > 0.5:
        return move(situation, situation.hand + 0.05 * UP, rotation, -1.0)
    room = min(2 * NEAR - deviation, TURNED_ROOM * (2 * TURNED - angle)) if situation.opening > 0.9 else -ROOM
    return move(situation, middle + np.clip(distance - FUNNEL * room, 0.0, 0.11) * axis, rotation, -1.0)


def twist(situation: Situation, thing: str, turn: float) -> Array:
    """Turn a knob: grasp it from above across its narrow side, and turn the hand by `turn` [rad]."""
    joint = int(situation.goal.joints(thing)[0])
    pieces = situation.moved_points(joint)
    grasp = min(parts(pieces, alone=False), key=lambda pair: pair[0] + 0.02 * abs(situation.turn_to(pair[1].yaw)))[1]
    grasp = Grasp(np.array([*situation.data.xanchor[joint][:2], grasp.position[2]]), grasp.yaw)
    is_near = np.linalg.norm(situation.hand - grasp.position) < 3 * NEAR
    if is_near and situation.opening < FIRM and situation.gap > THIN:
        return command(situation, grasp.position, situation.yaw + turn, 1.0)
    return approach(situation, grasp, np.concatenate(pieces), thing)


def push(situation: Situation, thing: str) -> Array:
    """Close a drawer or a door: push it, from outside, with closed fingers."""
    joint = int(situation.goal.joints(thing)[0])
    points, axis = np.concatenate(situation.moved_points(joint)), situation.data.xaxis[joint]
    direction = axis
    if situation.model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE:
        arms = points - situation.data.xanchor[joint]
        arms -= np.outer(arms @ axis, axis)
        reach = np.linalg.norm(arms, axis=1) / np.linalg.norm(arms, axis=1).max()
        middle = (reach > 0.5) & (reach < 0.7)  # nearer to the hinge it is heavy, farther out the arm must stretch
        points, direction = points[middle], np.cross(axis, arms[middle].mean(axis=0))
        direction = direction / np.linalg.norm(direction)
    depth = points @ direction
    face = points[depth < depth.min() + 0.012]
    contact = np.array([*face[:, :2].mean(axis=0), max(face[:, 2].max() - 0.035, face[:, 2].mean())])
    offset = situation.hand - contact
    distance = float(offset @ direction)
    deviation = float(np.linalg.norm((offset - distance * direction)[:2]))
    # The fingers' broad side pushes, and the hand leans back, so that the arm stays off what is over a drawer.
    pose = equivalent_grasp(situation, Grasp(contact, float(np.arctan2(direction[1], direction[0])), BACK))
    if -0.06 < distance < 0.02 and deviation < 0.03 and abs(offset[2]) < 0.03:
        return command(situation, contact + 0.05 * direction, pose.yaw, 1.0, pose.lean)
    grip = closing_command(situation, tops(situation))
    start = contact - 0.045 * direction
    height = max(tops(situation), contact[2]) + 0.04
    start[2] = max(start[2], lowest(situation, height, ROOM - float(np.hypot(*(situation.hand - start)[:2]))))
    return command(situation, rising_target(situation, start), pose.yaw, grip, pose.lean)


def closing_command(situation: Situation, top: float) -> float:
    """Return the gripper command: close, unless the fingers could close on something below height `top` [m]."""
    are_closed = situation.gap < EMPTY and situation.enclosed_thing() is None
    return 1.0 if are_closed or situation.hand[2] > top + TIP else -1.0


def withdraw(situation: Situation) -> Array:
    """Retract a hand that does not point down, opposite to where it points, then turn it down."""
    obstacles = situation.surroundings("", situation.hand, 0.1)
    if len(obstacles) and np.linalg.norm(obstacles - situation.hand, axis=1).min() < 0.09:
        return back_off(situation)
    inwards = (situation.base - situation.hand)[:2]  # so that the arm is not stretched
    step = np.array([*(0.05 * inwards / np.hypot(*inwards)), 0.02])
    return command(situation, situation.hand + step, 0.0, -1.0)


def back_off(situation: Situation) -> Array:
    """Retract the open hand opposite to where it points."""
    return move(situation, situation.hand - 0.05 * situation.rotation[:, 2], situation.rotation, -1.0)


def tops(situation: Situation) -> float:
    """Return the largest height of what stands near the hand [m]."""
    return float(situation.surroundings("", situation.hand, HAND + 0.05)[:, 2].max(initial=-np.inf))


def rising_target(situation: Situation, target: Array) -> Array:
    """Reduce the horizontal motion while the hand has to rise, so that it hits nothing."""
    rise = target[2] - situation.hand[2]
    if rise > 0.01:
        target = np.array([*(situation.hand[:2] + (target[:2] - situation.hand[:2]) * 0.02 / (0.02 + rise)), target[2]])
    return target


def command(
    situation: Situation, target: Array, yaw: float, grip: float, lean: float = 0.0, swing: float = 0.0
) -> Array:
    """Return the command that moves the hand, pointing down, towards a position, a yaw and a lean.

    `swing`: of the arm afterwards [rad], as of a `Grasp`.
    """
    yaw = situation.yaw + situation.turn_to(yaw, swing)
    closing_axis, cross_axis = (np.array([*axis, 0.0]) for axis in axes(yaw))
    direction = np.sin(lean) * cross_axis - np.cos(lean) * UP
    return move(situation, target, np.stack([closing_axis, np.cross(direction, closing_axis), direction], axis=1), grip)


def move(situation: Situation, target: Array, rotation: Array, grip: float) -> Array:
    """Return the command that moves the hand towards a position and a rotation (3, 3): closing, across, ahead."""
    step = GAIN * (target - situation.hand) / REACH[:3]
    step /= max(1.0, float(np.abs(step).max()))
    turn = TURN_GAIN * _turn(situation, rotation) / REACH[3:]
    return np.array([*step, *(turn / max(1.0, float(np.abs(turn).max()))), grip])


def _turn(situation: Situation, rotation: Array) -> Array:
    """Return the rotation vector (3,), in the world, from the hand's rotation to another one."""
    quaternion, vector = np.empty(4), np.empty(3)
    mujoco.mju_mat2Quat(quaternion, (rotation @ situation.rotation.T).ravel())
    mujoco.mju_quat2Vel(vector, quaternion, 1.0)
    return vector
