"""The Panda alone, to draw it as it stands: nothing is simulated or rendered."""

from __future__ import annotations

import mujoco
from dm_control import mjcf

from vla.spec import Array, Shape
from vla.tasks.bound import BoundScene
from vla.tasks.scene import Scene

ROBOT = "panda/"  # begins the names of its bodies


class Arm:
    """The solids of the robot, and where its bodies are for given joints."""

    def __init__(self) -> None:
        scene = Scene(blocks=0)
        self._physics = mjcf.Physics.from_mjcf_model(scene.mjcf_model)
        self._bound = BoundScene(scene, self._physics)

    def shapes(self) -> list[Shape]:
        """The visible solids."""
        return [shape for shape in self._bound.shapes() if shape.body.startswith(ROBOT)]

    def poses(self, joints: Array, opening: float) -> dict[str, Array]:
        """Body name → (7,) position [m] and quaternion wxyz in the frame of the base.

        Args:
            joints: (7,) [rad].
            opening: between the fingertips [m].
        """
        self._bound.place_arm(joints, opening)
        mujoco.mj_kinematics(self._bound.model, self._bound.data)
        return {body: pose for body, pose in self._bound.poses().items() if body.startswith(ROBOT)}
