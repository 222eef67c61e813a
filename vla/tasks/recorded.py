"""A world of which only recordings exist."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

from vla.io.errors import UserError
from vla.io.types import ImageSize, Positive, Text
from vla.robots.controllers import UNITS
from vla.spec import Cameras, Names, Numbers, RobotModel, Spec, SpecOnly


def units_of(
    units: str | Mapping[str, str], state: Sequence[str], action: Sequence[str]
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the units of all components of state and action. `units` is one unit for all, or name → unit for some,
    where the others get "1"; a UserError if there is no component of such a name."""
    if isinstance(units, str):
        return (units,) * len(state), (units,) * len(action)
    if unknown_names := [name for name in units if name not in (*state, *action)]:
        components = ", ".join(dict.fromkeys((*state, *action)))
        raise UserError(f"task.units names {', '.join(unknown_names)}, the components are {components}")
    return tuple(units.get(name, "1") for name in state), tuple(units.get(name, "1") for name in action)


class Recorded(SpecOnly):
    """The layout of recorded steps, of any robot.

    Args:
        cameras: their names.
        image_size: height and width of the images that a policy sees [px].
        control_hz: rate of the steps [Hz].
        state: names of its components.
        action: names of its components.
        units: one unit for all components of state and action, or name → unit for some; "1": none, or unknown.
        low, high: bounds of the action.
        joints: components that are positions of the robot's joints, base to tip; "all": all components of the action;
            None: no deployment as a ROS 2 node.

    Raises a UserError if arguments contradict each other, or a joint has no unit of a position.
    """

    def __init__(
        self,
        cameras: Cameras,
        image_size: ImageSize,
        control_hz: Positive,
        state: Names,
        action: Names,
        units: Text | dict[str, Text],
        low: Numbers,
        high: Numbers,
        joints: Names | Literal["all"] | None,
    ) -> None:
        state_units, action_units = units_of(units, state, action)
        if joints == "all":
            joints = tuple(action)
        known_units = {**dict(zip(state, state_units, strict=True)), **dict(zip(action, action_units, strict=True))}
        if misfits := [name for name in joints or () if known_units.get(name, "rad") not in UNITS]:
            raise UserError(
                f"task.joints names {', '.join(misfits)}, whose unit must be one of {', '.join(UNITS)}: name it with "
                "task.units, or leave the joint out"
            )
        spec = Spec(
            cameras=tuple(cameras),
            image_size=(image_size[0], image_size[1]),
            state=tuple(state),
            state_units=state_units,
            action=tuple(action),
            units=action_units,
            low=tuple(low),
            high=tuple(high),
            control_hz=float(control_hz),
            robot=None if joints is None else RobotModel(tuple(joints), frame=""),
        )
        self.spec = Spec.from_dict(spec.to_dict(), "task=recorded")
