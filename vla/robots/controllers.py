"""Which controller executes the actions of a policy on its arm."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from vla.io.types import Point
from vla.robots import panda
from vla.spec import Array, Spec

GRIPPER = "gripper"  # last action component, which opens the gripper at 1 and closes it at 0


class Controller(Protocol):
    """Turns the motion of an action, all but the gripper, into joint targets."""

    motion: tuple[tuple[str, str], ...]  # names and units of the action components that it takes

    def reset(self, joints: Array) -> None:
        """Set the last commanded joints (J,) [rad]."""
        ...

    def step(self, motion: Array) -> Array:
        """Return joint targets (J,) [rad] one control period ahead."""
        ...


def controller_for(spec: Spec, workspace: tuple[Point, Point]) -> Controller:
    """Build the controller of the arm in `spec`; the only one there is has the kinematics of the Panda and FR3.

    Args:
        spec: of the policy.
        workspace: opposite corners of the box for the tool point, in the base frame [m].

    Raises:
        ValueError: the arm or the actions are of another kind.
    """
    model, joints = spec.require_robot("deployment"), len(panda.CHAIN) - 1
    differs = ""
    if len(model.joints) != joints:
        differs = f"has {len(model.joints)} joints, the Panda {joints}"
    elif model.chain and not np.allclose(model.chain, panda.CHAIN):
        differs = "has another kinematic chain than the Panda"
    if differs:
        raise ValueError(f"the policy's arm {differs}: another arm needs a controller in vla/robots/controllers.py")
    controller = panda.CartesianController(1 / spec.control_hz, *workspace)
    found, expected = list(zip(spec.action, spec.units, strict=True)), [*controller.motion, (GRIPPER, "1")]
    if found != expected:
        raise ValueError(f"the policy's action is {_listed(found)}, expected {_listed(expected)}")
    return controller


def _listed(components: list[tuple[str, str]]) -> str:
    return ", ".join(f"{name} [{unit}]" for name, unit in components)
