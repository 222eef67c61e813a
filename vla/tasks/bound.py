"""The compiled tabletop: where things are in the model, and how to change them without compiling again."""

from __future__ import annotations

from typing import Literal

import mujoco
import numpy as np
from dm_control import mjcf

from vla.spec import Array, Shape
from vla.tasks.control import HOME, MAX_OPENING
from vla.tasks.scene import BLOCK_DENSITY, COLOURS, PAD_THICKNESS, PADS, Scene


class BoundScene:
    """A scene's elements in its compiled model: indices to read and write, and the nominal model to return to."""

    # Model fields that randomisation may change; everything else stays as compiled.
    RANDOMISABLE = (
        "geom_type",
        "geom_contype",
        "geom_conaffinity",
        "geom_rgba",
        "geom_size",
        "geom_friction",
        "geom_rbound",
        "geom_aabb",
        "body_mass",
        "body_inertia",
        "body_gravcomp",
        "actuator_gainprm",
        "actuator_biasprm",
        "light_pos",
        "light_dir",
        "light_diffuse",
        "cam_pos",
        "cam_quat",
        "cam_fovy",
        "bvh_aabb",
    )

    def __init__(self, scene: Scene, physics: mjcf.Physics) -> None:
        """Args: the scene and the physics it was compiled into."""
        self.model: mujoco.MjModel = physics.model.ptr
        self.data: mujoco.MjData = physics.data.ptr
        bind = physics.bind
        self.joints = np.array([bind(joint).qposadr for joint in scene.panda.joints]).ravel()
        self.velocities = np.array([bind(joint).dofadr for joint in scene.panda.joints]).ravel()
        self.fingers = np.array([bind(finger).qposadr for finger in scene.panda.fingers]).ravel()
        self.pads = [int(bind(pad).element_id) for pad in scene.panda.pads]
        self.tcp = int(bind(scene.panda.tcp).element_id)
        self.block_geoms = np.array([bind(block.geom).element_id for block in scene.blocks], dtype=int)
        self.block_bodies = self.model.geom_bodyid[self.block_geoms]
        free = self.model.body_jntadr[self.block_bodies]
        self.block_positions = self.model.jnt_qposadr[free]  # of x y z, quaternion wxyz
        self.block_velocities = self.model.jnt_dofadr[free]
        self.zones = [int(self.model.body(f"{name}_pad").mocapid[0]) for name in PADS]
        self.cameras = {"front": self.model.camera("front").id, "wrist": self.model.camera("panda/wrist").id}
        self._nominal = {name: getattr(self.model, name).copy() for name in self.RANDOMISABLE}
        self._scratch = mujoco.MjData(self.model)

    def restore(self) -> None:
        """Undo every randomisation: nominal model, blocks in a row, arm at home."""
        for name, value in self._nominal.items():
            getattr(self.model, name)[:] = value

        count = len(self.block_geoms)
        self.paint_blocks(list(COLOURS)[:count], np.array(list(COLOURS.values()))[:count])
        self.place_pad(0.4, 0.0)
        for index in range(count):
            self.place_block(index, 0.52, 0.12 * (index - (count - 1) / 2), 0.0)
        self.place_arm(HOME, MAX_OPENING)

    def paint_blocks(self, names: list[str], rgb: Array) -> None:
        """Give each block a colour (count, 3) and the name that instructions call it by."""
        self.block_names = names
        self.model.geom_rgba[self.block_geoms, :3] = rgb

    def set_block(self, index: int, half_size: float) -> None:
        """Resize block `index` to a cube of `half_size` [m], with its mass and all that MuJoCo derives from them."""
        mass = BLOCK_DENSITY * (2 * half_size) ** 3
        model, geom, body = self.model, self.block_geoms[index], self.block_bodies[index]
        model.geom_size[geom] = half_size
        model.geom_rbound[geom] = half_size * np.sqrt(3)
        model.geom_aabb[geom, 3:] = half_size
        start, count = model.body_bvhadr[body], model.body_bvhnum[body]
        model.bvh_aabb[start : start + count, 3:] = half_size
        model.body_mass[body] = mass
        model.body_inertia[body] = mass * (2 * half_size) ** 2 / 6

    def finish(self) -> None:
        """Make model and state consistent after all changes."""
        mujoco.mj_setConst(self.model, self._scratch)  # without it, physics explodes after a change of mass
        self.data.qpos[self.block_positions + 2] = self.model.geom_size[self.block_geoms, 2]

    def place_pad(self, x: float, y: float) -> None:
        """Put the target pad on the table at (x, y) [m]."""
        self.data.mocap_pos[self.pad] = (x, y, PAD_THICKNESS)

    def place_arm(self, joints: Array, opening: float) -> None:
        """Put the arm at rest in `joints` (7,) [rad], with `opening` between the fingertips [m]."""
        self.data.qpos[self.joints] = joints
        self.data.qpos[self.fingers] = opening / 2

    def turn_camera(self, camera: int, rotation: Array) -> None:
        """Turn camera number `camera` by the rotation vector `rotation` (3,) [rad] in its own frame."""
        turn, turned = np.empty(4), np.empty(4)
        angle = float(np.linalg.norm(rotation))
        mujoco.mju_axisAngle2Quat(turn, rotation / angle if angle > 0 else np.array([1.0, 0, 0]), angle)
        mujoco.mju_mulQuat(turned, self.model.cam_quat[camera], turn)
        self.model.cam_quat[camera] = turned

    def place_block(self, index: int, x: float, y: float, yaw: float) -> None:
        """Rest block `index` on the table at (x, y) [m], turned by `yaw` [rad]."""
        height = self.model.geom_size[self.block_geoms[index], 2]
        start = self.block_positions[index]
        self.data.qpos[start : start + 7] = (x, y, height, np.cos(yaw / 2), 0, 0, np.sin(yaw / 2))

    def block_position(self, index: int) -> Array:
        """(3,) centre of block `index` [m]."""
        return self.data.geom_xpos[self.block_geoms[index]].copy()

    def touching(self) -> set[tuple[int, int]]:
        """(pad number, block index) of every fingertip that touches a block."""
        pairs = set()
        block_of = {int(geom): index for index, geom in enumerate(self.block_geoms)}
        for first, second in self.data.contact.geom[: self.data.ncon].tolist():
            for pad, other in ((first, second), (second, first)):
                if pad in self.pads and other in block_of:
                    pairs.add((self.pads.index(pad), block_of[other]))
        return pairs

    def shapes(self) -> list[Shape]:
        """The visible solids, for recorders."""
        model, shapes = self.model, []
        kinds: dict[int, Literal["mesh", "box", "cylinder"]] = {
            int(mujoco.mjtGeom.mjGEOM_MESH): "mesh",
            int(mujoco.mjtGeom.mjGEOM_BOX): "box",
            int(mujoco.mjtGeom.mjGEOM_CYLINDER): "cylinder",
        }
        for geom in np.flatnonzero(model.geom_group == 2):
            kind = kinds.get(int(model.geom_type[geom]))
            if kind is None:
                continue
            vertices = faces = None
            if kind == "mesh":
                mesh = model.geom_dataid[geom]
                vertex, face = model.mesh_vertadr[mesh], model.mesh_faceadr[mesh]
                vertices = model.mesh_vert[vertex : vertex + model.mesh_vertnum[mesh]].copy()
                faces = model.mesh_face[face : face + model.mesh_facenum[mesh]].copy()
            name = model.geom(geom).name or f"geom{geom}"
            body = model.body(model.geom_bodyid[geom]).name
            place = (model.geom_pos[geom].copy(), model.geom_quat[geom].copy(), model.geom_size[geom].copy())
            shapes.append(Shape(body, name, kind, *place, model.geom_rgba[geom].copy(), vertices, faces))
        return shapes

    def poses(self) -> dict[str, Array]:
        """Body name → (7,) position [m] and quaternion wxyz in the world."""
        pose = np.concatenate([self.data.xpos, self.data.xquat], axis=1)
        return {self.model.body(body).name: pose[body] for body in range(self.model.nbody)}
