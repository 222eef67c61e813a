"""The scripted expert: a memoryless closed-loop controller on the simulator's truth.

Its action depends only on the current state, so every action is a valid label for its state. Policies therefore learn
to recover from any state that a perturbation leads to.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from vla.io.errors import UserError
from vla.robots.cartesian import DOWN, rotation_z, vector_from_rotation
from vla.spec import Array, Observation, Spec
from vla.tasks.tabletop.goals.goal import SKILLS, Skill

HOVER = 0.08  # height above the block at which an approach starts [m]
CARRY = 0.07  # height of a carried block above its destination [m]
FUNNEL = 2.5  # height gained per metre of horizontal distance, so that approaches come from above
# The loosest values that work: a policy with an error of a centimetre must not stall.
GRASP_XY, GRASP_Z = 0.012, 0.012  # position tolerances at which the gripper closes [m]
PLACE_Z = 0.012  # height tolerance at which the gripper opens [m]
ABOVE = 0.004  # least height of a fingertip above the table [m]
# Far beside its line a push still continues, only slower. Near the destination its direction is so sensitive that a
# policy which is off by half a centimetre would otherwise alternate between pushing and getting behind the block again.
LANE = 0.024  # lateral tolerance of the fingertips in a push [m]
SLOWER = 0.8  # share of the speed of a push that is lost at this tolerance
BEHIND = 0.010  # horizontal distance from the start of a push within which the fingertips descend [m]
PUSH_Z = 0.016  # height tolerance at which a push begins [m]
PUSH_AT = 1.1  # contact height of a push relative to half the block's height, so that the block does not tip
PUSH = 0.015  # largest motion of a push per step [m]
MAX_YAW = 0.9  # largest yaw from neutral for a grasp of the nearest faces [rad]
CLEARANCE = 0.012  # total gap between the open fingers and a block [m]


class Waypoint:
    """Waypoint controller that reaches, grasps, carries, pushes and releases, and recovers from any failure."""

    looks = False
    memoryless = True

    def __init__(self, spec: Spec) -> None:
        """Act in an environment of this spec; a UserError if it is not that of the tabletop."""
        self._low, self._high = np.array(spec.low), np.array(spec.high)
        if spec.robot is None or spec.robot.gripper is None or "faces" not in dict(spec.truth):
            raise UserError("the expert of the tabletop acts in task=tabletop only: choose the expert of this task")
        self._gripper = spec.state.index(spec.robot.gripper)
        self.info: dict[str, Any] = {}

    def reset(self, instruction: str, seed: int) -> None:
        """Do nothing: the expert has no state."""

    def act(self, observation: Observation) -> Array:
        """Return the (7,) action for this state (UserError: the observation lacks the simulator's truth)."""
        truth = observation.require_truth("the scripted expert")
        self.info = {}
        action = self._decide(truth, float(observation.state[self._gripper]))
        return np.clip(action, self._low, self._high).astype(np.float32)

    def _decide(self, truth: dict[str, Array], opening: float) -> Array:
        """Return the (7,) unclipped action for this state."""
        skill = SKILLS[int(truth["skill"][0])]
        if skill == "stay":
            return self._action(truth, np.zeros(3), 0.0, 1.0)
        if skill == "push":
            return self._push(truth)
        if truth["grasped"][0]:
            return self._carry(truth, skill)
        if skill == "place" and _is_placed(truth):
            is_free = opening > 2 * truth["half_size"][0] + CLEARANCE / 2
            return self._action(truth, np.array([0.0, 0.0, HOVER if is_free else 0.0]), 0.0, 1.0)
        return self._reach(truth, opening)

    def _reach(self, truth: dict[str, Array], opening: float) -> Array:
        tool, block, width = truth["commanded"][:3, 3], truth["block"], 2 * truth["half_size"][0]
        offset = block - tool
        yaw = _yaw_to_faces(truth)
        distance = float(np.hypot(offset[0], offset[1]))
        encloses = distance < GRASP_XY + 0.004 and abs(offset[2]) < GRASP_Z + 0.004
        closes = encloses and width - 0.006 < opening < truth["widest"][0] - 0.004
        aligned = distance < GRASP_XY and abs(offset[2]) < GRASP_Z
        if closes or (aligned and opening > width - 0.006):
            return self._action(truth, offset, yaw, 0.0)
        # Descend only straight above the block with open fingers; otherwise stay above it.
        height = min(FUNNEL * max(distance - GRASP_XY / 2, 0.0), HOVER)
        if opening < width + CLEARANCE:
            height = max(height, 0.045) if not encloses else HOVER
        offset[2] += height
        return self._action(truth, _rise_first(offset), yaw, 1.0)

    def _carry(self, truth: dict[str, Array], skill: Skill) -> Array:
        offset, tolerance = truth["destination"] - truth["block"], truth["tolerance"][0]
        distance = float(np.hypot(offset[0], offset[1]))
        if skill == "hold":
            return self._action(truth, offset, 0.0, 0.0)
        height = min(FUNNEL * max(distance - tolerance / 2, 0.0), CARRY)
        opens = distance < tolerance and abs(offset[2]) < PLACE_Z
        offset[2] += height
        return self._action(truth, _rise_first(offset), 0.0, 1.0 if opens else 0.0)

    def _push(self, truth: dict[str, Array]) -> Array:
        """Move behind the block, opposite its destination, and push it with closed fingers.

        Wide fingers close to a wedge, which would press a block down or lift it. They push with their narrow, upright
        side and leave the block sideways before they rise, and no excursion begins while they touch it.
        """
        block, (half, _, half_height) = truth["block"], truth["half_size"]
        fingertip, breadth, depth, middle = truth["tip"]
        beside = truth["commanded"][:3, 1] * middle  # from the tool point to the middle of the closed fingertips
        tool = truth["commanded"][:3, 3] + beside
        path = (truth["destination"] - block)[:2]
        distance = float(np.hypot(*path))
        direction = path / max(distance, 1e-6)
        normal = np.array([-direction[1], direction[0]])
        progress, deviation = (tool - block)[:2] @ direction, (tool - block)[:2] @ normal
        separation, top, low = np.hypot(progress, deviation), block[2] + half_height, depth + ABOVE
        yaw, touches = 0.0, False
        if breadth > fingertip:
            touches = bool(separation < np.sqrt(2) * half + fingertip and tool[2] - depth < top)
            yaw, self.info = _yaw_to_way(truth, direction), {"must_turn": True, "steady": touches}
        elif separation < half + fingertip and low + half_height < tool[2] < top + fingertip:
            # The fingers enclose the block: release it and rise.
            return self._action(truth, np.array([0.0, 0.0, HOVER]), 0.0, 1.0)
        height = max(low, min(PUSH_AT * half, 0.9 * half_height))
        standoff = np.sqrt(2) * half + fingertip + 0.006  # for any yaw of the block
        if tool[2] < height + PUSH_Z and -standoff - 0.03 < progress < -half and abs(deviation) < LANE:
            forward = min(distance, PUSH) * (1 - SLOWER * (deviation / LANE) ** 2)
            offset = np.append(forward * direction - deviation * normal, height - tool[2])
            return self._action(truth, offset + self._swing(beside, yaw), yaw, 0.0)
        if touches:
            offset = np.append((tool - block)[:2] / max(separation, 1e-6) * PUSH, 0.0)
            return self._action(truth, offset, 0.0, 0.0)
        offset = np.append(block[:2] - (standoff + 0.004) * direction, height) - tool
        separation = float(np.hypot(offset[0], offset[1]))
        offset[2] += min(FUNNEL * max(separation - BEHIND, 0.0), HOVER)
        return self._action(truth, _rise_first(offset) + self._swing(beside, yaw), yaw, 0.0)

    def _swing(self, beside: Array, yaw: float) -> Array:
        """Return the motion (3,) of the tool that keeps the point `beside` it in place while the tool turns."""
        return beside - rotation_z(float(np.clip(yaw, self._low[5], self._high[5]))) @ beside

    def _action(self, truth: dict[str, Array], offset: Array, yaw: float, gripper: float) -> Array:
        """Return the action that moves by `offset`, scaled uniformly to the bounds of a step, and turns by `yaw`."""
        rotation = truth["commanded"][:3, :3]
        upright = rotation_z(np.arctan2(rotation[1, 0], rotation[0, 0]) + yaw) @ DOWN
        scale = max(1.0, float(np.max(np.abs(offset) / self._high[:3])))
        return np.concatenate([offset / scale, vector_from_rotation(upright @ rotation.T), [gripper]])


def _rise_first(offset: Array) -> Array:
    """Reduce horizontal motion while the tool has to rise, so that it does not hit other blocks."""
    if offset[2] > 0.01:
        offset[:2] *= 0.02 / (0.02 + offset[2])
    return offset


def _is_placed(truth: dict[str, Array]) -> bool:
    """Return whether the block is close enough to its destination."""
    offset = truth["destination"] - truth["block"]
    return bool(np.hypot(offset[0], offset[1]) < 1.5 * truth["tolerance"][0] and abs(offset[2]) < PLACE_Z)


def _yaw_to_way(truth: dict[str, Array], direction: Array) -> float:
    """Return the turn [rad] after which the tool's x axis is parallel to a horizontal direction (2,)."""
    rotation, half_turn = truth["commanded"][:3, :3], np.pi
    turn = np.arctan2(direction[1], direction[0]) - np.arctan2(rotation[1, 0], rotation[0, 0])
    return float((turn + half_turn / 2) % half_turn - half_turn / 2)


def _yaw_to_faces(truth: dict[str, Array]) -> float:
    """Return the turn [rad] that aligns the fingers with the block's nearest faces, close to the arm's neutral yaw.

    The nearest faces, because a cube is symmetric under quarter turns: a farther choice would be ambiguous.
    """
    rotation, (cosine, sine) = truth["commanded"][:3, :3], truth["faces"]
    yaw = np.arctan2(rotation[1, 0], rotation[0, 0])
    correction = np.clip(yaw, -MAX_YAW, MAX_YAW) - yaw  # turn back into the range of allowed yaws
    quarter = np.pi / 2
    return float(correction + (np.arctan2(sine, cosine) / 4 - correction + quarter / 2) % quarter - quarter / 2)
