"""Controllers that execute the actions of a policy on its arm.

Shapes: J joints.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np

from vla.io.errors import UserError
from vla.io.types import Point
from vla.robots.cartesian import CartesianController, Kinematics
from vla.robots.chain import forward_of
from vla.spec import Array, RobotModel, Spec

GRIPPER = "gripper"  # action component that opens the gripper at 1 and closes it at 0, unless it is a joint
SLACK = 0.1  # by which the bounds of an opening may exceed 0 and 1
UNITS = {"rad": 1.0, "deg": math.pi / 180, "m": 1.0}  # unit of a joint → factor to [rad], or to [m] of a prismatic one


class JointController:
    """Takes actions that are joint targets."""

    def __init__(self, order: list[int], factors: Array) -> None:
        """Take each joint's index among the components of the motion, (J,), and factor from its unit to [rad]."""
        self._order, self._factors = order, factors

    def reset(self, joints: Array) -> None:
        """Do nothing: targets are absolute."""

    def step(self, motion: Array) -> Array:
        """Return the targets (J,) [rad]."""
        return motion[self._order] * self._factors

    def motion_between(self, joints_before: Array, joints_after: Array) -> Array:
        """Return `joints_after` (J,) in the order and units of the action."""
        motion = np.empty(len(joints_after))
        motion[self._order] = joints_after / self._factors
        return motion


def controller_for(
    spec: Spec, workspace: tuple[Point, Point] | None, limits: tuple[Array, Array, Array] | None = None
) -> CartesianController | JointController:
    """Build the controller for the actions in `spec`: joint positions, or Cartesian motion.

    Args:
        spec: of the policy.
        workspace: opposite corners of the box for the tool point of Cartesian motion, in the frame of that [m].
        limits: (J,) smallest and largest positions [rad] and speeds [rad/s] of the arm; None: there are none.

    Raises:
        UserError: the kinematics are not known, the actions are of another kind, or the box cannot be kept.
    """
    model = spec.require_robot("deployment")
    if acts_on_joints(spec):
        return _joint_controller(spec, model, workspace)
    arm = _kinematics(model, limits)
    action = list(zip(spec.action, spec.units, strict=True))
    expected = [*CartesianController.motion, (GRIPPER, "1")]
    if action != expected:
        raise UserError(f"the policy's action is {_listing(action)}, expected {_listing(expected)}, or all joints")
    if workspace is None:
        raise UserError("Cartesian motion needs a box for the tool point: set deploy.safety.workspace to its corners")
    if ((arm.home < arm.lowest) | (arm.home > arm.highest)).any():
        raise UserError(
            "the home posture of the policy's arm is outside the limits of deploy.robot: is it another arm?"
        )
    return CartesianController(arm, 1 / spec.control_hz, *np.sort(workspace, axis=0))


def _kinematics(model: RobotModel, limits: tuple[Array, Array, Array] | None) -> Kinematics:
    count = len(model.joints)
    if not model.chain or not model.home:
        raise UserError(
            f"Cartesian actions need the kinematics of the arm of {count} joints, and the checkpoint lacks its "
            f"{'home posture' if model.chain else 'kinematic chain'}: train with task/robot=file, or with actions that "
            "are joint positions"
        )
    low, high, speed = limits or np.full((3, count), np.inf) * [[-1], [1], [1]]
    return Kinematics(forward_of(model.chain), np.array(model.home), low, high, speed)


def _joint_controller(spec: Spec, model: RobotModel, workspace: tuple[Point, Point] | None) -> JointController:
    if extra_names := [name for name in spec.action if name not in (*model.joints, GRIPPER)]:
        raise UserError(f"the policy's action has {', '.join(extra_names)}, which are no joints of its robot")
    # The units of the state must be known too.
    _factors(model.joints, dict(zip(spec.state, spec.state_units, strict=True)))
    if workspace is not None:
        raise UserError(
            "deploy.safety.workspace cannot be kept by a policy that acts with joint positions: set it to null, and "
            "narrow deploy.robot.low and high where the arm must not go"
        )
    gripper = gripper_index(spec)
    if gripper is not None and (spec.low[gripper] < -SLACK or spec.high[gripper] > 1 + SLACK):
        raise UserError(
            f"the action {GRIPPER} must be an opening from 0, closed, to 1, open, and is from {spec.low[gripper]:g} to "
            f"{spec.high[gripper]:g}: scale it before training, as expert.scale does for a dataset"
        )
    motion = [name for index, name in enumerate(spec.action) if index != gripper]
    units = dict(zip(spec.action, spec.units, strict=True))
    return JointController([motion.index(name) for name in model.joints], _factors(model.joints, units))


def acts_on_joints(spec: Spec) -> bool:
    """Return whether the actions in `spec` are joint positions; a UserError if it has no robot."""
    return {*spec.require_robot("deployment").joints} <= {*spec.action}


def recorded_controller(spec: Spec) -> CartesianController | JointController:
    """Build the controller for recorded actions, without limits of the workspace (UserError: no arm, unknown
    kinematics, or actions of another kind)."""
    return controller_for(spec, None if acts_on_joints(spec) else ((-math.inf,) * 3, (math.inf,) * 3))


def gripper_index(spec: Spec) -> int | None:
    """Return the index of the gripper's opening in an action; None if there is none or it is a joint of the arm."""
    joints = spec.require_robot("deployment").joints
    return spec.action.index(GRIPPER) if GRIPPER in spec.action and GRIPPER not in joints else None


def _factors(joints: Iterable[str], units: dict[str, str]) -> Array:
    if misfits := [(name, units[name]) for name in joints if units[name] not in UNITS]:
        raise UserError(
            f"the joints {_listing(misfits)} must have one of the units {', '.join(UNITS)}: name it with task.units "
            "before training"
        )
    return np.array([UNITS[units[name]] for name in joints])


def _listing(components: list[tuple[str, str]]) -> str:
    return ", ".join(f"{name} [{unit}]" for name, unit in components)
