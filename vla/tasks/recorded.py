"""A world of which only recordings exist."""

from __future__ import annotations

from vla.io.types import ImageSize, Positive, Text
from vla.spec import Cameras, Names, Numbers, RobotModel, Spec, SpecOnly


class Recorded(SpecOnly):
    """The layout of recorded steps, of any robot.

    Args:
        cameras: their names.
        image_size: height and width of the images that a policy sees [px].
        control_hz: rate of the steps [Hz].
        state: names of its components.
        action: names of its components.
        units: of all components of state and action, or of some by name; "1" without a unit, or if unknown.
        low, high: bounds of the action.
        joints: components that are positions of the robot's joints, base to tip; "all": all of the action; None: no
            deployment as a ROS 2 node.

    Raises:
        ValueError: arguments contradict each other.
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
        joints: Names | Text | None,
    ) -> None:
        def unit(name: str) -> str:
            return units if isinstance(units, str) else units.get(name, "1")

        if not isinstance(units, str) and (unknown := [name for name in units if name not in (*state, *action)]):
            known = ", ".join(dict.fromkeys((*state, *action)))
            raise ValueError(f"task.units names {', '.join(unknown)}, the components are {known}")
        if isinstance(joints, str):
            if joints != "all":
                raise ValueError(f"task.joints must be a list of names, all or null, got {joints}")
            joints = tuple(action)
        spec = Spec(
            cameras=tuple(cameras),
            image_size=(image_size[0], image_size[1]),
            state=tuple(state),
            state_units=tuple(map(unit, state)),
            action=tuple(action),
            units=tuple(map(unit, action)),
            low=tuple(low),
            high=tuple(high),
            control_hz=float(control_hz),
            robot=None if joints is None else RobotModel(tuple(joints), frame=""),
        )
        self.spec = Spec.from_dict(spec.to_dict(), "task=recorded")
