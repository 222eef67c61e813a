"""A robot arm with a gripper from files in MJCF or URDF.

Joints, limits, masses, shapes and the kinematic chain are those of the compiled model. What all robots of the tabletop
share is added to it: position servos with gravity compensation, contacts with the world only, fingertips that do not
slip, a tool frame and a wrist camera.
"""

from __future__ import annotations

from importlib.util import find_spec
from itertools import pairwise, product
from os.path import normpath
from pathlib import Path
from typing import Annotated, Literal

import mujoco
import numpy as np
from annotated_types import MinLen
from dm_control import mjcf
from dm_control.mujoco.wrapper import MjModel

from vla.io.types import Inherited, Names, Point, Positive, Text
from vla.robots.cartesian import LIMIT_MARGIN, Kinematics, rotation_z
from vla.spec import Array, RobotModel
from vla.tasks.tabletop import robot_spec
from vla.tasks.tabletop.robot import TIMESTEP, Robot

PREFIX = "robot/"  # of the names of all elements in the scene
FREQUENCY = 100.0  # natural frequency of a joint of the arm with its servo, at home [rad/s]
LEAD = 0.05  # damping over stiffness of the servos [s], as of the Panda's, so that joints are overdamped
ARMATURE = 0.1  # smallest reflected rotor inertia of a joint of the arm [kg m²], as of the Panda's
SOFTNESS = 0.1  # share of a finger's travel after which its servo gives its whole force
FASTEST = 0.02  # time in which its whole force moves a finger through its travel, at least [s]
CLOSING = 0.2  # shortest time in which the gripper closes [s]
OPENINGS, SETTLING = 17, 250  # commands at which the opening is measured; steps in which the fingers come to rest
LEAST_TRAVEL = 0.02  # change of the opening of a gripper that can hold a block [m]
ASIDE = 0.08  # largest distance between the tool point and the middle between the closed fingertips [m]
FAR = 1.0  # up to which an opening is measured [m]

Values = Annotated[dict[str, float], MinLen(1)]


class RobotFile(Robot):
    """An arm in a file, with its hand or with the hand in a file of its own."""

    prefix, travel, finger_speed, lead = PREFIX, 1.0, 1 / CLOSING, LEAD

    def __init__(
        self,
        file: Path,
        hand: Path | None,
        mount: Text | None,
        place: Point,
        yaw: float,
        joints: Names,
        home: list[float],
        speed: Positive,
        tool: Text,
        offset: Point,
        open: Values,
        closed: Values,
        force: Positive,
        fingertips: tuple[Names, Names],
        camera: Point,
        target: Point,
    ) -> None:
        """Read the files and measure the gripper.

        Args:
            file: arm, in MJCF or URDF.
            hand: file of its hand, the names in which get `hand_` in front; None: `file` contains the hand.
            mount: site or body of the arm that carries this hand.
            place: position of the base; the table's top is at height 0 [m].
            yaw: of the base [rad].
            joints: J hinges of the arm, base to tip; other joints below the hand are fixed.
            home: (J,) positions in which the gripper points down over the table and closes sideways [rad].
            speed: largest speed of the joints [rad/s].
            tool: site or body of the hand whose axes are the tool's: x is the one that points forward at home, z down.
            offset: of the tool point, between the fingertips, in this frame [m].
            open: actuator or joint of the gripper → its value when open; joints get position servos.
            closed: the same when closed.
            force: largest force of these servos [N], or torque [N m].
            fingertips: names of the geoms, or bodies, that hold a block: of either side.
            camera: position of the wrist camera in the tool's frame [m].
            target: point that it looks at [m].

        Raises:
            ValueError: a file is missing or does not compile, a name is not in it, or a value does not fit it.
        """
        self._spec, self._place, self._yaw = robot_spec.read("file", file), place, yaw
        if hand is not None:
            robot_spec.attach_hand(self._spec, robot_spec.read("hand", hand), mount)
        start = self._checked_home(joints, home)
        if open.keys() != closed.keys():
            raise ValueError(f"task.robot.open names {', '.join(open)}, task.robot.closed {', '.join(closed)}")
        robot_spec.simplify(self._spec, joints, open)
        robot_spec.set_armature(self._spec, joints, ARMATURE)
        body, position, rotation = robot_spec.add_tool(self._spec, tool, start, rotation_z(yaw), np.array(offset))
        robot_spec.add_camera(body, position, rotation, np.array(camera), np.array(target))
        tips = [robot_spec.make_fingertips(self._spec, side) for side in fingertips]
        servos = self._add_servos(start)
        grips = [self._grip(name, open[name], closed[name], force) for name in open]
        self.joints, self.servos, self.grips = ([PREFIX + name for name in names] for names in (joints, servos, grips))
        self.fingertips, self.tool = [[PREFIX + name for name in side] for side in tips], PREFIX + robot_spec.TOOL
        self.closed, self.opened = (np.array([values[name] for name in open]) for values in (closed, open))
        self._model = robot_spec.compiled(self._attached(mujoco.MjSpec()))
        self._data = mujoco.MjData(self._model)
        names = [self._model.joint(index).name for index in range(self._model.njnt)]
        self.fingers = [name for name in names if name not in self.joints]
        self._measure_gripper(np.array(home))
        self.kinematics = self._kinematics(np.array(home), speed)
        velocities = tuple(f"{joint}_velocity" for joint in joints)
        self.arm = RobotModel(tuple(joints), "world", velocities, "gripper", self._chain(), tuple(home))

    def draw(self, meshes: Literal["light", "full"]) -> None:
        """Choose how meshes look: hulls of few vertices ("light"), or as they are ("full")."""
        if meshes == "light":
            robot_spec.use_convex_hulls(self._spec, robot_spec.compiled(self._spec))

    def _attached(self, scene: mujoco.MjSpec) -> mujoco.MjSpec:
        turn = (np.cos(self._yaw / 2), 0.0, 0.0, np.sin(self._yaw / 2))
        scene.attach(self._spec.copy(), frame=scene.worldbody.add_frame(pos=self._place, quat=turn), prefix=PREFIX)
        return scene

    def compile(self, scene: mjcf.RootElement) -> mjcf.Physics:
        """Compile a scene together with the robot."""
        world = mujoco.MjSpec.from_string(scene.to_xml_string(), assets=scene.get_assets())
        return mjcf.Physics.from_model(MjModel(robot_spec.compiled(self._attached(world))))

    def _checked_home(self, joints: Names, home: list[float]) -> dict[str, float]:
        """Return joint → position at home.

        Raises:
            ValueError: no such joint, one that is not a hinge or not in order, or a position out of its limits.
        """
        robot_spec.require("joints", joints, (joint.name for joint in self._spec.joints), "joint")
        if len(home) != len(joints):
            raise ValueError(f"task.robot.home has {len(home)} positions for {len(joints)} joints")
        model = robot_spec.compiled(self._spec)
        carried = set(range(model.nbody))
        for name, position in zip(joints, home, strict=True):
            joint = model.joint(name)
            if int(joint.bodyid[0]) not in carried:
                raise ValueError(f"task.robot.joints names {name} after a joint that does not carry it: base to tip")
            carried = robot_spec.descendants(model, int(joint.bodyid[0]))
            if joint.type[0] != mujoco.mjtJoint.mjJNT_HINGE:
                raise ValueError(f"task.robot.joints names {name}, which is not a hinge")
            low, high = joint.range
            if model.jnt_limited[joint.id] and not low <= position <= high:
                raise ValueError(
                    f"task.robot.home has {name} at {position}, outside its limits, {low:.3f} to {high:.3f}"
                )
        return dict(zip(joints, home, strict=True))

    def _add_servos(self, home: dict[str, float]) -> list[str]:
        """Add servos to the joints of the arm that are as stiff as the arm's inertia at home allows."""
        model = robot_spec.compiled(self._spec)
        data = mujoco.MjData(model)
        for name, position in home.items():
            data.joint(name).qpos[0] = position
        mujoco.mj_forward(model, data)
        inertia = np.empty((model.nv, model.nv))
        mujoco.mj_fullM(model, data, inertia)
        stiffness = [FREQUENCY**2 * inertia[dof, dof] for dof in (model.joint(name).dofadr[0] for name in home)]
        return [
            robot_spec.add_servo(self._spec, name, k, LEAD * k, None) for name, k in zip(home, stiffness, strict=True)
        ]

    def _grip(self, name: str, opened: float, closed: float, force: float) -> str:
        """Return the name of the gripper's actuator `name`, or of a position servo added to the joint `name`."""
        if self._spec.actuator(name) is not None:
            return name
        known = [element.name for element in (*self._spec.actuators, *self._spec.joints)]
        robot_spec.require("open", [name], known, "actuator or joint")
        travel = max(abs(opened - closed), 1e-3)
        robot_spec.set_armature(self._spec, [name], force * FASTEST**2 / (2 * travel))
        stiffness = force / (SOFTNESS * travel)
        return robot_spec.add_servo(self._spec, name, stiffness, LEAD * stiffness, force)

    def _measure_gripper(self, home: Array) -> None:
        """Tabulate the positions of the finger joints and the opening for commands from open to closed, by simulation.

        Raises:
            ValueError: the opening does not change.
        """
        model, data = self._model, self._data
        model.opt.timestep, model.opt.integrator = TIMESTEP, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        commands, rows = np.linspace(1.0, 0.0, OPENINGS), []
        for name, servo, position in zip(self.joints, self.servos, home, strict=True):
            data.joint(name).qpos[0] = data.actuator(servo).ctrl[0] = position
        for command in commands:
            for name, value in zip(self.grips, self.closed + command * (self.opened - self.closed), strict=True):
                data.actuator(name).ctrl[0] = value
            mujoco.mj_step(model, data, SETTLING)
            mujoco.mj_kinematics(model, data)
            rows.append([self.opening(model, data), *(data.joint(name).qpos[0] for name in self.fingers)])
        table = np.array(rows)[::-1]
        self._openings, self._positions = np.maximum.accumulate(table[:, 0]), table[:, 1:]
        self._commands, self.narrowest, self.widest = commands[::-1], *self._openings[[0, -1]].tolist()
        tool, tips = data.site(self.tool), [data.geom(name).xpos for side in self.fingertips for name in side]
        middle = tool.xmat.reshape(3, 3).T @ (np.mean(tips, axis=0) - tool.xpos)
        self.tip = self._extents(data)
        if np.linalg.norm(middle) > ASIDE:
            raise ValueError(
                f"task.robot.offset: the middle between the fingertips is at {np.round(middle, 2).tolist()} m from the "
                "tool point, forward, to the right and down: the tool point belongs there"
            )
        if not self.widest - self.narrowest > LEAST_TRAVEL:
            raise ValueError(
                f"task.robot.open and task.robot.closed leave the fingertips {1000 * self.widest:.0f} and "
                f"{1000 * self.narrowest:.0f} mm apart, which holds no block"
            )

    def _extents(self, data: mujoco.MjData) -> tuple[float, float, float]:
        """Return the extents of the fingertips in the frame of the tool, as of `Robot.tip`."""
        tool, model = data.site(self.tool), self._model
        corners = []
        for geom in (model.geom(name).id for side in self.fingertips for name in side):
            points = robot_spec.corners(model, geom)
            corners.append(data.geom_xpos[geom] + points @ data.geom_xmat[geom].reshape(3, 3).T)
        inside = (np.concatenate(corners) - tool.xpos) @ tool.xmat.reshape(3, 3)
        forward, aside, down = np.abs(inside[:, 0]).max(), np.abs(inside[:, 1]).max(), inside[:, 2].max()
        return float(forward), float(aside), float(down)

    def grip(self, opening: float) -> tuple[Array, float]:
        """Interpolate in the table of the gripper."""
        positions = [np.interp(opening, self._openings, column) for column in self._positions.T]
        return np.array(positions), float(np.interp(opening, self._openings, self._commands))

    def opening(self, model: mujoco.MjModel, data: mujoco.MjData) -> float:
        """Return the smallest distance between the fingertips of both sides [m]."""
        left, right = ([model.geom(name).id for name in side] for side in self.fingertips)
        return max(0.0, min(mujoco.mj_geomDistance(model, data, a, b, FAR, None) for a, b in product(left, right)))

    def _kinematics(self, home: Array, speed: float) -> Kinematics:
        model, data = self._model, self._data
        joints = [model.joint(name) for name in self.joints]
        positions, dofs = (
            [int(at[0]) for at in each] for each in zip(*((j.qposadr, j.dofadr) for j in joints), strict=True)
        )
        limits = np.array([j.range if model.jnt_limited[j.id] else (-np.inf, np.inf) for j in joints])
        site = model.site(self.tool).id
        jacobian = np.empty((6, model.nv))

        def forward(joints: Array) -> tuple[Array, Array]:
            data.qpos[positions] = joints
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_jacSite(model, data, jacobian[:3], jacobian[3:], site)
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = data.site_xmat[site].reshape(3, 3), data.site_xpos[site]
            return pose, jacobian[:, dofs]

        low, high = np.minimum(limits[:, 0] + LIMIT_MARGIN, home), np.maximum(limits[:, 1] - LIMIT_MARGIN, home)
        return Kinematics(forward, home, low, high, np.full(len(home), speed))

    def _chain(self) -> tuple[tuple[float, ...], ...]:
        """Return the chain of the arm, as in `vla.spec.RobotModel`, with every joint's axis as its z axis."""
        tool, _ = self.kinematics.forward(np.zeros(len(self.joints)))
        indices = [self._model.joint(name).id for name in self.joints]
        frames = [_frame(self._data.xanchor[index], self._data.xaxis[index]) for index in indices]
        return tuple(_relative(before, frame) for before, frame in pairwise([np.eye(4), *frames, tool]))


class InstalledRobot(RobotFile):
    """An arm whose files are in an installed package, which is not imported."""

    def __init__(self, file: Text, hand: Text | None, **inherited: Inherited) -> None:
        """Args: paths that begin with the name of a package, such as dm_control/third_party/kinova/jaco_arm.xml.

        Raises:
            ValueError: no such package, or a path out of it.
        """
        super().__init__(file=_installed(file), hand=_installed(hand) if hand else None, **inherited)


def _installed(path: str) -> Path:
    package, _, rest = path.partition("/")
    found = find_spec(package) if package.isidentifier() else None
    folder = Path(found.origin).parent if found and found.origin else None
    file = Path(normpath(folder / rest)) if folder else None
    if folder is None or file is None or folder not in file.parents:
        raise ValueError(f"task.robot: {path} must begin with the name of an installed package and stay within it")
    return file


def _frame(position: Array, axis: Array) -> Array:
    """Return a pose (4, 4) with the z axis along `axis`."""
    pose, turn = np.eye(4), np.empty(4)
    mujoco.mju_quatZ2Vec(turn, axis)
    rotation = np.empty(9)
    mujoco.mju_quat2Mat(rotation, turn)
    pose[:3, :3], pose[:3, 3] = rotation.reshape(3, 3), position
    return pose


def _relative(before: Array, pose: Array) -> tuple[float, ...]:
    """Return offset [m] and quaternion wxyz of a pose in the one before."""
    within = np.linalg.inv(before) @ pose
    return tuple(np.round([*within[:3, 3], *robot_spec.quaternion(within[:3, :3])], 9).tolist())
