"""The Panda's geometry and kinematics for visualisation, without simulation or rendering."""

from __future__ import annotations

import mujoco

from vla.robots.panda import CHAIN
from vla.spec import Array, Shape
from vla.tasks.tabletop.compiled_scene import CompiledScene
from vla.tasks.tabletop.panda import Panda
from vla.tasks.tabletop.scene import Scene


class Arm:
    """Shapes of the robot, and poses of its bodies for given joint positions: a `vla.spec.Shell`."""

    chain = CHAIN

    def __init__(self) -> None:
        scene = Scene(robot=Panda(), blocks=0)
        self._physics = scene.compile()
        self._compiled = CompiledScene(scene, self._physics)

    def shapes(self) -> list[Shape]:
        """Return the visible shapes."""
        return [shape for shape in self._compiled.shapes() if shape.body.startswith(Panda.prefix)]

    def poses(self, joints: Array, opening: float) -> dict[str, Array]:
        """Return body name → (7,) position [m] and quaternion wxyz in the base frame.

        Args:
            joints: (7,) [rad].
            opening: distance between the fingertips [m].
        """
        self._compiled.place_arm(joints, opening)
        mujoco.mj_kinematics(self._compiled.model, self._compiled.data)
        return {body: pose for body, pose in self._compiled.poses().items() if body.startswith(Panda.prefix)}
