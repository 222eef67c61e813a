"""The compiled tabletop: indices into the model, and changes to it without recompilation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import mujoco
import numpy as np

from vla.io.errors import UserError
from vla.spec import Array
from vla.tasks.tabletop.robot import TabletopRobot
from vla.tasks.tabletop.scene import BLOCK_DENSITY, BLOCK_HALF_SIZE, COLOURS, PAD_THICKNESS, PADS, compile_scene

AWAY = (-1.5, 0.0, -3.0)  # position of blocks and pads that are absent [m]


@dataclass(frozen=True)
class Noise:
    """Standard deviations of the sensor noise."""

    image: float = 0.0  # of a colour channel, 0…255
    joints: float = 0.0  # [rad]
    gripper: float = 0.0  # [m]


Kind = Literal["push", "drop", "move_block", "move_target"]


@dataclass(frozen=True)
class Disturbance:
    """Disturbance of an episode, in numbers drawn at its start; see `vla.tasks.tabletop.disturber`."""

    kind: Kind
    times: int  # how often
    delay: int  # number of control steps for which its preconditions hold before it happens
    distance: float  # of a push or a move [m]
    angle: float  # of its horizontal direction; if there is no room, the next free direction is taken [rad]
    low: tuple[float, float]  # corner x, y of the area in which a push or a move ends [m]
    high: tuple[float, float]  # the opposite corner [m]


# Fields of the model that randomisation may change; everything else stays as compiled.
RANDOMISABLE = (
    *("geom_type", "geom_matid", "geom_contype", "geom_conaffinity", "geom_rgba", "geom_size", "geom_friction"),
    *("geom_rbound", "geom_aabb", "bvh_aabb", "body_mass", "body_inertia", "body_gravcomp", "actuator_gainprm"),
    *("actuator_biasprm", "light_pos", "light_dir", "light_diffuse", "cam_pos", "cam_quat", "cam_fovy"),
)


class CompiledScene:
    """The scene as MuJoCo's model and state: indices of its elements, and changes to it without recompilation."""

    def __init__(self, robot: TabletopRobot, blocks: int, shadows: bool = True) -> None:
        """Compile the scene, with or without shadows of the lamp; a UserError if the robot's model does not compile."""
        model = self.model = compile_scene(robot, blocks, shadows)
        self.data, self.robot = mujoco.MjData(model), robot
        self.joints = np.array([model.joint(name).qposadr[0] for name in robot.joints])
        self.velocities = np.array([model.joint(name).dofadr[0] for name in robot.joints])
        self.fingers = np.array([model.joint(name).qposadr[0] for name in robot.fingers])
        self._side = {model.geom(name).id: side for side, tips in enumerate(robot.fingertips) for name in tips}
        self.tcp = model.site(robot.tool).id
        self.arm_actuators = np.array([model.actuator(name).id for name in robot.servos])
        self._grips = np.array([model.actuator(name).id for name in robot.grips])
        self.block_geoms = np.array([model.geom(f"block{index}").id for index in range(blocks)], dtype=int)
        self.block_bodies = model.geom_bodyid[self.block_geoms]
        free_joints = model.body_jntadr[self.block_bodies]
        self.block_positions = model.jnt_qposadr[free_joints]  # address of x y z, quaternion wxyz
        self.block_velocities = model.jnt_dofadr[free_joints]
        self.zones = [int(model.body(f"{name}_pad").mocapid[0]) for name in PADS]
        self.cameras = {"front": model.camera("front").id, "wrist": model.camera(f"{robot.prefix}wrist").id}
        bodies = [model.body(body).name for body in model.geom_bodyid]
        self.robot_geoms = np.flatnonzero([body.startswith(robot.prefix) for body in bodies])
        self._materials = {name: int(model.geom_matid[model.geom(name).id]) for name in ("table", "floor")}
        model.geom_matid[:] = -1  # plain surfaces render faster without a material
        self._nominal = {name: getattr(model, name).copy() for name in RANDOMISABLE}
        self._scratch = mujoco.MjData(model)
        self.stale_textures: set[int] = set()  # ids of textures that a renderer has not uploaded yet

    def restore(self) -> None:
        """Undo all randomisation: nominal model, three blocks in a row, arm at home."""
        mujoco.mj_resetData(self.model, self.data)
        for name, value in self._nominal.items():
            getattr(self.model, name)[:] = value
        count = len(self.block_geoms)
        self.extents = np.full((count, 3), BLOCK_HALF_SIZE)  # half sizes of the blocks, upright [m]
        self.density = np.full(count, BLOCK_DENSITY)  # of each block [kg/m³]
        self.present = min(count, 3)  # blocks on the table, the first ones
        self.latency = 0.0  # from a command to the motors [s]
        self.noise = Noise()
        self.held_out: float = 0.0  # probability of a held-out instruction in an evaluation
        self.paraphrases: dict[str, str] = {}  # phrase → its replacement in the instructions of an evaluation
        self.skip = 0  # number of blocks skipped in the order of naming
        self.disturbance: Disturbance | None = None
        self.paint_blocks(list(COLOURS)[:count], np.array(list(COLOURS.values()))[:count])
        for pad in range(len(PADS)):
            self.place_pad(pad, 0.4, 0.15 * pad)
        for index in range(count):
            column = index - (self.present - 1) / 2 if index < 5 else 3 - index  # a sixth would be out of reach
            self.place_block(index, 0.52, 0.12 * column, 0.0)
        self.place_arm(self.robot.kinematics.home, self.robot.widest)

    def paint_blocks(self, names: Sequence[str], rgb: Array) -> None:
        """Set each block's colour (count, 3) and its name in instructions."""
        self.block_names = names
        self.model.geom_rgba[self.block_geoms, :3] = rgb

    def paint_texture(self, name: str, picture: Array) -> None:
        """Set the texture (TEXTURE, TEXTURE, 3) uint8 of the table or the floor."""
        texture = self.model.texture(name).id
        start = self.model.tex_adr[texture]
        self.model.tex_data[start : start + picture.size] = picture.ravel()
        self.model.geom_matid[self.model.geom(name).id] = self._materials[name]
        self.stale_textures.add(texture)

    def set_block(self, index: int, half_size: Array, round: bool = False) -> None:
        """Make block `index` a box of half sizes (3,) [m], or a cylinder, and update its mass, inertia and bounds."""
        x, y, z = self.extents[index] = half_size
        volume = 2 * np.pi * x**2 * z if round else 8 * x * y * z
        mass = self.density[index] * volume
        model, geom, body = self.model, self.block_geoms[index], self.block_bodies[index]
        kind = mujoco.mjtGeom.mjGEOM_CYLINDER if round else mujoco.mjtGeom.mjGEOM_BOX
        model.geom_type[geom] = int(kind)
        model.geom_size[geom] = (x, z, 0.0) if round else half_size
        model.geom_rbound[geom] = np.hypot(x, z) if round else np.linalg.norm(half_size)
        model.geom_aabb[geom, 3:] = half_size
        start, count = model.body_bvhadr[body], model.body_bvhnum[body]
        model.bvh_aabb[start : start + count, 3:] = half_size
        model.body_mass[body] = mass
        if round:  # solid cylinder
            model.body_inertia[body] = mass * np.array([x**2 / 4 + z**2 / 3, x**2 / 4 + z**2 / 3, x**2 / 2])
        else:
            model.body_inertia[body] = mass / 3 * (np.sum(self.extents[index] ** 2) - self.extents[index] ** 2)

    def scale_density(self, factors: Array) -> None:
        """Multiply each block's density by a factor, (count,); later changes of size or shape keep it."""
        self.density *= factors
        self.model.body_mass[self.block_bodies] *= factors
        self.model.body_inertia[self.block_bodies] *= factors[:, None]

    def finish(self, pads: int) -> None:
        """Make model and state consistent after all changes, with `pads` pads on the table."""
        model, addresses = self.model, self.block_positions[: self.present]
        for start in self.block_positions[self.present :]:
            self.data.qpos[start : start + 7] = (*AWAY, 1, 0, 0, 0)
        absent_geoms = self.block_geoms[self.present :]
        model.geom_contype[absent_geoms] = model.geom_conaffinity[absent_geoms] = 0
        model.body_gravcomp[self.block_bodies[self.present :]] = 1.0
        self.data.mocap_pos[self.zones[pads:]] = AWAY
        mujoco.mj_setConst(model, self._scratch)  # without it, physics explodes after a change of mass
        self.data.qpos[addresses + 2] = self.extents[: self.present, 2]

    def forward_without_servos(self) -> None:
        """Compute all quantities that depend on the state, without forces of the servos."""
        option, flag = self.model.opt, int(mujoco.mjtDisableBit.mjDSBL_ACTUATION)
        option.disableflags |= flag
        mujoco.mj_forward(self.model, self.data)
        option.disableflags &= ~flag

    def require_stable(self) -> None:
        """Raise a UserError if physics has become unstable in this episode."""
        if (counts := self.data.warning.number).any():
            raise UserError(
                f"physics is unstable ({mujoco.mjtWarning(int(counts.argmax())).name}): task.robot or the range of an "
                "axis in task.randomize is beyond what it can compute"
            )

    def place_pad(self, pad: int, x: float, y: float) -> None:
        """Put pad `pad` on the table at (x, y) [m]."""
        self.data.mocap_pos[self.zones[pad]] = (x, y, PAD_THICKNESS)

    def place_arm(self, joints: Array, opening: float) -> None:
        """Set the arm to `joints` (J,) [rad] and the gripper to `opening` between the fingertips [m]."""
        self.data.qpos[self.joints] = joints
        self.data.qpos[self.fingers], self.grip = self.robot.grip(opening)

    def controls(self, commands: Array) -> Array:
        """Return the actuators' controls (N, nu) for commands (N, J + 1): joint targets [rad], gripper command."""
        robot, controls = self.robot, np.empty((len(commands), self.model.nu))
        controls[:, self.arm_actuators] = commands[:, :-1]
        controls[:, self._grips] = robot.closed + commands[:, -1:] * ((robot.opened - robot.closed) / robot.travel)
        return controls

    def turn_camera(self, camera: int, rotation: Array) -> None:
        """Turn camera `camera` by the rotation vector `rotation` (3,) [rad] in its own frame."""
        mujoco.mju_quatIntegrate(self.model.cam_quat[camera], rotation, 1.0)

    def place_block(self, index: int, x: float, y: float, yaw: float) -> None:
        """Put block `index` on the table at (x, y) [m], turned by `yaw` [rad]."""
        start = self.block_positions[index]
        self.data.qpos[start : start + 7] = (x, y, self.extents[index, 2], np.cos(yaw / 2), 0, 0, np.sin(yaw / 2))

    def move_block(self, index: int, x: float, y: float) -> None:
        """Move block `index` horizontally to (x, y) [m] and stop it, in the course of an episode."""
        start, velocity = self.block_positions[index], self.block_velocities[index]
        self.data.qpos[start : start + 2] = x, y
        self.data.qvel[velocity : velocity + 6] = 0.0

    def block_centres(self) -> Array:
        """Return the centres (present, 3) of the blocks on the table [m]."""
        return self.data.geom_xpos[self.block_geoms[: self.present]].copy()

    def touching(self) -> set[tuple[int, int]]:
        """Return (side, block index) of every contact between a fingertip of either side and a block."""
        pairs = set()
        block_of = {int(geom): index for index, geom in enumerate(self.block_geoms)}
        for first, second in self.data.contact.geom[: self.data.ncon].tolist():
            for tip, partner in ((first, second), (second, first)):
                if tip in self._side and partner in block_of:
                    pairs.add((self._side[tip], block_of[partner]))
        return pairs
