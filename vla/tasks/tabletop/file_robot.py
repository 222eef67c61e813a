"""An arm with a gripper that was read from files.

Joints, limits, masses, shapes and the kinematic chain are those of the compiled model. What all robots of the tabletop
share is added to it: position servos with gravity compensation, contacts with the world only, fingertips that do not
slip, a tool frame and a wrist camera.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Literal

import mujoco
import numpy as np

from vla.io.errors import UserError
from vla.robots.cartesian import LIMIT_MARGIN, Kinematics, rotation_z
from vla.spec import Array, RobotModel
from vla.tasks.tabletop import fingertips, robot_spec
from vla.tasks.tabletop.expert import CLEARANCE
from vla.tasks.tabletop.robot import PHYSICS, TabletopRobot, attributes
from vla.tasks.tabletop.robot_file import RobotFile, compile_model, require
from vla.tasks.tabletop.scene import BLOCK_HALF_SIZE

PREFIX = "robot/"  # of the names of all elements in the scene
FREQUENCY = 100.0  # natural frequency of a joint of the arm with its servo, at home [rad/s]
LEAD = 0.05  # damping over stiffness of the servos [s], as of the Panda's, so that joints are overdamped
ARMATURE = 0.1  # smallest reflected rotor inertia of a joint of the arm [kg m²], as of the Panda's
SOFTNESS = 0.1  # share of a finger's travel after which its servo gives its whole force
FASTEST = 0.02  # shortest time in which its whole force moves a finger through its travel [s]
CLOSING = 0.2  # shortest time in which the gripper closes [s]
OPENINGS, SETTLING = 17, 250  # commands at which the opening is measured; steps in which the fingers come to rest
LEAST_TRAVEL = 0.02  # change of the opening of a gripper that can hold a block [m]
LEAST_OPENING = 2 * BLOCK_HALF_SIZE + CLEARANCE  # [m]
ASIDE = 0.08  # largest distance between the tool point and the middle between the closed fingertips [m]
AROUND_BLOCK = 0.06  # opening with room for a block, in the middle of which the tool point belongs [m]
BESIDE = 0.005  # how far beside this middle it may be [m]
BELOW = 0.012  # how far fingertips may reach below the tool point, so that they do not touch the table [m]


class FileRobot(TabletopRobot):
    """The arm of a `RobotFile`."""

    prefix, travel, finger_speed, lead = PREFIX, 1.0, 1 / CLOSING, LEAD

    def __init__(self, file: RobotFile, meshes: Literal["light", "full"]) -> None:
        """Read the files and measure the gripper; meshes are drawn as hulls of few vertices ("light"), or as they are.

        Raises:
            UserError: a file is missing or does not compile, a name is not in it, or a value does not fit it.
        """
        self._file, self._spec = file, file.read()
        spec, home = self._spec, robot_spec.require_home(self._spec, file.joints, file.home)
        if file.open.keys() != file.closed.keys():
            raise UserError(f"task.robot.open and closed must name the same, not {[*file.open]} and {[*file.closed]}")
        robot_spec.simplify(spec, file.joints, file.open)
        robot_spec.set_armature(spec, file.joints, ARMATURE)
        tool = robot_spec.add_tool(spec, file.tool, home, rotation_z(file.yaw), np.array(file.offset))
        if np.linalg.norm(np.cross(np.subtract(file.target, file.camera), np.eye(3)[0])) < 1e-6:
            raise UserError("task.robot.camera and task.robot.target must differ, and not only along the tool's x axis")
        robot_spec.add_camera(*tool, np.array(file.camera), np.array(file.target))
        sides = [fingertips.colliding_geoms(spec, side) for side in file.fingertips]
        strength = zip(home, robot_spec.stiffness(spec, home, FREQUENCY), strict=True)  # as much as its inertia allows
        servos = [robot_spec.add_servo(spec, name, k, LEAD * k, None) for name, k in strength]
        grips = [self._grip(name, max(abs(file.open[name] - file.closed[name]), 1e-3)) for name in file.open]
        self.joints, self.servos, self.grips = ([PREFIX + name for name in names] for names in (home, servos, grips))
        self.closed, self.opened = (np.array([pose[name] for name in file.open]) for pose in (file.closed, file.open))
        self._measure_gripper(sides)
        self.kinematics = self._kinematics()
        velocities = tuple(f"{joint}_velocity" for joint in file.joints)
        self.arm = RobotModel(tuple(file.joints), "world", velocities, "gripper", self._chain(), tuple(file.home))
        if meshes == "light":
            robot_spec.use_convex_hulls(spec)

    def complete(self, scene: mujoco.MjSpec) -> None:
        """Add the robot to an exported scene: as MJCF text, for PyMJCF, its numbers would have only six digits."""
        turn = (np.cos(self._file.yaw / 2), 0.0, 0.0, np.sin(self._file.yaw / 2))
        place = scene.worldbody.add_frame(pos=self._file.place, quat=turn)
        scene.attach(self._spec.copy(), frame=place, prefix=PREFIX)

    def _grip(self, name: str, travel: float) -> str:
        """Return the name of the gripper's actuator `name`, or of a position servo added to the joint `name`."""
        spec, force = self._spec, self._file.force
        if spec.actuator(name) is not None:
            return name
        names = [element.name for element in (*spec.actuators, *spec.joints)]
        require("open", [name], names, "actuator or joint")
        robot_spec.set_armature(spec, [name], force * FASTEST**2 / (2 * travel))
        stiffness = force / (SOFTNESS * travel)
        return robot_spec.add_servo(spec, name, stiffness, LEAD * stiffness, force)

    def _measure_gripper(self, sides: list[list[str]]) -> None:
        """Tabulate the opening, divide jaws that stay close at a hinge, and move the tool point between the fingertips
        (UserError: the opening does not change, or the tool point is far from the fingertips)."""
        middles = self._close(sides)
        if self.widest - self.narrowest <= LEAST_TRAVEL:
            sides = fingertips.far_ends(self._spec, self._model, self._data, sides, PREFIX)
            middles = self._close(sides)
        self._require_grasp()
        shift, depth = float(np.interp(AROUND_BLOCK, self._openings, middles[:, 1])), max(0.0, self.tip[2] - BELOW)
        if abs(shift) > BESIDE or depth:
            robot_spec.move_tool(self._spec, np.array([0.0, shift, depth]))
            self.tip = self._extents(float(self._close(sides)[0, 1]))
        for side in sides:
            fingertips.soften(self._spec, side)

    def _require_grasp(self) -> None:
        """Raise a UserError if the fingertips are far from the tool point or hold no block."""
        tool, tips = self._data.site(self.tool), [self._data.geom(tip).xpos for side in self.fingertips for tip in side]
        middle = tool.xmat.reshape(3, 3).T @ (np.mean(tips, axis=0) - tool.xpos)
        if np.linalg.norm(middle) > ASIDE:
            raise UserError(
                f"task.robot.offset: the middle between the fingertips is at {np.round(middle, 2).tolist()} m from the "
                "tool point, forward, to the right and down: the tool point belongs there"
            )
        if self.widest - self.narrowest <= LEAST_TRAVEL or self.widest < LEAST_OPENING:
            raise UserError(
                f"task.robot.open and task.robot.closed leave the fingertips {1000 * self.widest:.0f} and "
                f"{1000 * self.narrowest:.0f} mm apart, which holds no block: that takes {1000 * LEAST_OPENING:.0f} "
                f"mm, and {1000 * LEAST_TRAVEL:.0f} mm of travel; task.robot.fingertips may name sites at the ends of "
                "the jaws"
            )

    def _close(self, sides: list[list[str]]) -> Array:
        """Tabulate the positions of the finger joints and the opening for commands from open to closed, by simulation.

        Returns the middle between the fingertips, the geoms `sides`, in the frame of the tool, for openings in
        ascending order, (N, 3) [m].
        """
        scene = mujoco.MjSpec.from_string(f"<mujoco><option {attributes(**PHYSICS)}/></mujoco>")
        self.complete(scene)
        self._model = model = compile_model(scene)
        self._data = data = mujoco.MjData(model)
        self.fingertips, self.tool = [[PREFIX + tip for tip in side] for side in sides], PREFIX + robot_spec.TOOL
        names = [model.joint(index).name for index in range(model.njnt)]
        self.fingers = [name for name in names if name not in self.joints]
        for name, servo, position in zip(self.joints, self.servos, self._file.home, strict=True):
            data.joint(name).qpos[0] = data.actuator(servo).ctrl[0] = position
        commands, tool, rows = np.linspace(1.0, 0.0, OPENINGS), data.site(self.tool), []
        for command in commands:
            for name, value in zip(self.grips, self.closed + command * (self.opened - self.closed), strict=True):
                data.actuator(name).ctrl[0] = value
            mujoco.mj_step(model, data, SETTLING)
            mujoco.mj_kinematics(model, data)
            opening, middle = fingertips.gap(model, data, self.fingertips)
            point = (middle - tool.xpos) @ tool.xmat.reshape(3, 3)
            rows.append([opening, *point, *(data.joint(name).qpos[0] for name in self.fingers)])
        table = np.array(rows)[::-1]
        self._openings, self._positions = np.maximum.accumulate(table[:, 0]), table[:, 4:]
        self._commands, self.narrowest, self.widest = commands[::-1], *self._openings[[0, -1]].tolist()
        self.tip = self._extents()
        return table[:, 1:4]

    def _extents(self, middle: float = 0.0) -> tuple[float, float, float, float]:
        """Return the extents of the closed fingertips about `middle` on the tool's y axis, see `tip`."""
        tips = [tip for side in self.fingertips for tip in side]
        corners = fingertips.points(self._model, self._data, tips, self._data.site(self.tool))
        half_length, half_width = np.abs(corners[:, :2] - [0.0, middle]).max(axis=0)
        return float(half_length), float(half_width), float(corners[:, 2].max()), middle

    def grip(self, opening: float) -> tuple[Array, float]:
        """Interpolate in the table of the gripper."""
        positions = [np.interp(opening, self._openings, column) for column in self._positions.T]
        return np.array(positions), float(np.interp(opening, self._openings, self._commands))

    def opening(self, model: mujoco.MjModel, data: mujoco.MjData) -> float:
        """Return the smallest distance between the fingertips of both sides [m]."""
        return fingertips.gap(model, data, self.fingertips)[0]

    def _kinematics(self) -> Kinematics:
        model, data, home = self._model, self._data, np.array(self._file.home)
        joints = [model.joint(name) for name in self.joints]
        positions, dofs = [int(joint.qposadr[0]) for joint in joints], [int(joint.dofadr[0]) for joint in joints]
        limits = np.array([j.range if model.jnt_limited[j.id] else (-np.inf, np.inf) for j in joints])
        site, jacobian = model.site(self.tool).id, np.empty((6, model.nv))

        def forward(joints: Array) -> tuple[Array, Array]:
            data.qpos[positions] = joints
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_jacSite(model, data, jacobian[:3], jacobian[3:], site)
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = data.site_xmat[site].reshape(3, 3), data.site_xpos[site]
            return pose, jacobian[:, dofs]

        low, high = np.minimum(limits[:, 0] + LIMIT_MARGIN, home), np.maximum(limits[:, 1] - LIMIT_MARGIN, home)
        return Kinematics(forward, home, low, high, np.full(len(home), self._file.speed))

    def _chain(self) -> tuple[tuple[float, ...], ...]:
        """Return the chain of the arm, as in `vla.spec.RobotModel`, with every joint's axis as its z axis."""
        tool, _ = self.kinematics.forward(np.zeros(len(self.joints)))
        frames, turn, rotation = [np.eye(4)], np.empty(4), np.empty(9)
        for index in (self._model.joint(name).id for name in self.joints):
            mujoco.mju_quatZ2Vec(turn, self._data.xaxis[index])
            mujoco.mju_quat2Mat(rotation, turn)
            frames.append(np.eye(4))
            frames[-1][:3, :3], frames[-1][:3, 3] = rotation.reshape(3, 3), self._data.xanchor[index]
        links = (np.linalg.inv(parent) @ frame for parent, frame in pairwise([*frames, tool]))
        rows = ([*link[:3, 3], *robot_spec.quaternion(link[:3, :3])] for link in links)
        return tuple(tuple(np.round(row, 9).tolist()) for row in rows)
