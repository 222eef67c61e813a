"""Robot models in MJCF or URDF: read, and made alike for the tabletop.

The files are data, which MuJoCo compiles. Names that they lack, files that are missing and models that do not compile
end in one sentence.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from vla.io.suggestion import suggestion
from vla.robots.cartesian import DOWN
from vla.spec import Array
from vla.tasks.rendering.shapes import mesh_triangles
from vla.tasks.tabletop.robot import CORNERS, FINGERTIP_CONTACT, HIDDEN, ROBOT_CONTACT, VISIBLE, look_at, spread

HAND = "hand_"  # in front of the names in a hand's own file
TOOL, SERVO, WRIST = "vla_tool", "vla_servo_", "wrist"  # names of what is added
ALIGNED = 0.9  # smallest cosine between the axes of the tool's site and forward, left, down at home
FOVY = 75.0  # of the wrist camera [degrees]
SEEN_GROUPS = 3  # the first groups, which MuJoCo draws
UNCOLOURED = (0.5, 0.5, 0.5, 1.0)  # what MuJoCo gives geoms without a colour
LISTED = 30  # names in an error


def read(key: str, file: Path) -> mujoco.MjSpec:
    """Read a model, with absolute paths of its meshes; `key` names the file in errors.

    Raises:
        ValueError: there is no such file, or MuJoCo does not compile it.
    """
    path = Path(file).absolute()
    if not path.is_file():
        raise ValueError(f"task.robot.{key}={file}: there is no such file")
    try:
        spec = mujoco.MjSpec.from_file(str(path))
        folder = path.parent / (spec.compiler.meshdir or "")
        for mesh in spec.meshes:
            if mesh.file:
                mesh.file = str(folder / (Path(mesh.file).name if spec.strippath else mesh.file))
        spec.compiler.meshdir = ""
        # URDF: keep shapes that do not collide, and links that do not move, which the tool may be one of.
        spec.compiler.discardvisual = spec.compiler.fusestatic = False
        spec.compile()
    except (ValueError, mujoco.FatalError) as error:
        raise ValueError(f"task.robot.{key}={file} does not compile: {' '.join(str(error).split())}") from error
    return spec


def compiled(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """Compile a model that was changed.

    Raises:
        ValueError: it does not compile.
    """
    try:
        return spec.compile()
    except (ValueError, mujoco.FatalError) as error:
        raise ValueError(f"task.robot does not compile: {' '.join(str(error).split())}") from error


def require(key: str, names: Iterable[str], known: Iterable[str], kind: str) -> None:
    """Raise a ValueError that lists the `kind` of elements that there are if one of `names` is not among them."""
    there = [name for name in known if name]
    for name in names:
        if name not in there:
            listed = ", ".join(there[:LISTED]) + (", …" if len(there) > LISTED else "")
            hint = suggestion(name, there) or ":"
            raise ValueError(f"task.robot.{key} names {name}, which is no {kind}{hint} there are {listed or 'none'}")


def attach_hand(spec: mujoco.MjSpec, hand: mujoco.MjSpec, mount: str | None) -> None:
    """Attach a hand to the site or body `mount` of an arm."""
    names = [element.name for element in (*spec.sites, *spec.bodies)]
    require("mount", [mount or ""], names, "site or body of the arm")
    site, body = spec.site(mount), spec.body(mount)
    if site is not None:
        spec.attach(hand, site=site, prefix=HAND)
    else:
        spec.attach(hand, frame=body.add_frame(), prefix=HAND)


def simplify(spec: mujoco.MjSpec, joints: Collection[str], grips: Collection[str]) -> None:
    """Keep of a model what the tabletop needs: the arm's `joints`, the hand, and the actuators `grips` of the gripper.

    Joints below the hand that are not the arm's are fixed. Lamps, cameras, planes, sensors, key frames, and materials
    but for their colour are left out.
    """
    model = compiled(spec)
    last = model.joint(list(joints)[-1]).id
    hand = descendants(model, int(model.jnt_bodyid[last]))
    fixed = [j.name for j in map(model.joint, range(model.njnt)) if j.name not in joints and j.bodyid[0] not in hand]
    for body, masses in zip(spec.bodies, range(model.nbody), strict=True):
        _fix_inertia(body, model, masses)
        body.name = body.name or f"vla_body{masses}"
    for element in [*spec.actuators]:
        if element.name not in grips:
            spec.delete(element)
    for element in [*spec.joints]:
        if element.name in fixed or (not element.name and model.jnt_bodyid[element.id] not in hand):
            spec.delete(element)
        else:
            element.name = element.name or f"vla_joint{element.id}"
    for element in (*spec.lights, *spec.cameras, *spec.sensors, *spec.keys, *spec.textures):
        spec.delete(element)
    _simplify_geoms(spec, model)
    for element in (*spec.sites, *spec.tendons):
        element.material = ""
    for element in [*spec.materials]:
        spec.delete(element)


def descendants(model: mujoco.MjModel, body: int) -> set[int]:
    """Return a body and all bodies that it carries."""
    found = {body}
    for child in range(body + 1, model.nbody):  # parents come before their children
        if model.body_parentid[child] in found:
            found.add(child)
    return found


def _fix_inertia(body: Any, model: mujoco.MjModel, index: int) -> None:
    """Give a body the mass of the compiled one, and let its servos carry no weight."""
    body.gravcomp = 1.0
    if index and model.body_mass[index]:
        body.explicitinertial, body.fullinertia = True, np.full(6, np.nan)
        body.mass, body.inertia = model.body_mass[index], model.body_inertia[index]
        body.ipos, body.iquat = model.body_ipos[index], model.body_iquat[index]


def _simplify_geoms(spec: mujoco.MjSpec, model: mujoco.MjModel) -> None:
    """Let every shape collide with the world only, and draw the shapes that do not collide where a body has any."""
    solid = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    drawn = (model.geom_group < SEEN_GROUPS) & (model.geom_rgba[:, 3] > 0)
    shells = set(model.geom_bodyid[drawn & ~solid].tolist())
    for index, geom in enumerate([*spec.geoms]):
        if geom.type == mujoco.mjtGeom.mjGEOM_PLANE:
            spec.delete(geom)
            continue
        material = model.geom_matid[index]
        if material >= 0 and np.allclose(model.geom_rgba[index], UNCOLOURED):
            geom.rgba = model.mat_rgba[material]
        geom.material = ""
        geom.name = geom.name or f"vla_geom{index}"
        if solid[index]:
            geom.contype, geom.conaffinity = ROBOT_CONTACT["contype"], ROBOT_CONTACT["conaffinity"]
        visible = drawn[index] and not (solid[index] and model.geom_bodyid[index] in shells)
        geom.group = VISIBLE if visible else HIDDEN


def set_armature(spec: mujoco.MjSpec, joints: Iterable[str], least: float) -> None:
    """Give joints a reflected inertia of their motors of at least `least` [kg m²]."""
    for name in joints:
        joint = spec.joint(name)
        joint.armature = max(joint.armature, least)


def make_fingertips(spec: mujoco.MjSpec, names: Sequence[str]) -> list[str]:
    """Make the geoms, or those of the bodies, `names` fingertips; return the names of those geoms."""
    geoms, bodies = {geom.name: geom for geom in spec.geoms}, {body.name: body for body in spec.bodies}
    require("fingertips", names, (*geoms, *bodies), "geom or body")
    tips = [tip for name in names for tip in ([geoms[name]] if name in geoms else bodies[name].geoms)]
    tips = [tip for tip in tips if tip.contype or tip.conaffinity]
    if not tips:
        raise ValueError(f"task.robot.fingertips names {', '.join(names)}, where nothing collides")
    for tip in tips:
        tip.friction, tip.condim, tip.priority = (
            FINGERTIP_CONTACT[each] for each in ("friction", "condim", "priority")
        )
        tip.solref = FINGERTIP_CONTACT["solref"]
        tip.solimp[:3] = FINGERTIP_CONTACT["solimp"]
    return [tip.name for tip in tips]


def add_servo(spec: mujoco.MjSpec, joint: str, stiffness: float, damping: float, force: float | None) -> str:
    """Add a position servo to a joint; return its name."""
    servo = spec.add_actuator(name=SERVO + joint, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    # Nothing is left to the defaults of the file.
    servo.dyntype, servo.gaintype = mujoco.mjtDyn.mjDYN_NONE, mujoco.mjtGain.mjGAIN_FIXED
    servo.biastype, servo.gear = mujoco.mjtBias.mjBIAS_AFFINE, np.eye(6)[0]
    servo.gainprm[:] = servo.biasprm[:] = 0.0
    servo.gainprm[0], servo.biasprm[1:3] = stiffness, (-stiffness, -damping)
    servo.ctrllimited = servo.actlimited = mujoco.mjtLimited.mjLIMITED_FALSE
    servo.forcelimited, servo.forcerange = force is not None, (-(force or 0.0), force or 0.0)
    return SERVO + joint


def add_tool(
    spec: mujoco.MjSpec, name: str, home: dict[str, float], base: Array, offset: Array
) -> tuple[Any, Array, Array]:
    """Add the site of the tool, whose axes are those of the site or body `name`.

    Args:
        spec: changed.
        name: of a site or body.
        home: joint → position; in this posture the tool's x axis is the one that points forward, its z axis down.
        base: (3, 3) rotation of the base.
        offset: (3,) from `name` in the frame of the tool [m].

    Returns:
        Body that it is on, position (3,) [m] and rotation (3, 3) of the tool in that body.

    Raises:
        ValueError: no such name, or no axes that point there.
    """
    model = compiled(spec)
    require("tool", [name], (element.name for element in (*spec.sites, *spec.bodies)), "site or body")
    data = mujoco.MjData(model)
    for joint, position in home.items():
        data.joint(joint).qpos[0] = position
    mujoco.mj_kinematics(model, data)
    site = spec.site(name)
    body = site.parent if site is not None else spec.body(name)
    at = data.site(name) if site is not None else data.body(name)
    axes = (base @ at.xmat.reshape(3, 3)).T @ DOWN  # columns: forward, right, down as seen from it
    turn = np.round(axes)
    if np.abs(axes).max(axis=0).min() < ALIGNED or abs(np.linalg.det(turn) - 1) > 0.1:
        raise ValueError(
            f"task.robot.home leaves the axes of {name} askew: one must point down and one forward, up to "
            f"{np.degrees(np.arccos(ALIGNED)):.0f} degrees; in its frame down is {np.round(axes[:, 2], 2).tolist()}, "
            f"forward {np.round(axes[:, 0], 2).tolist()}"
        )
    around = data.body(body.name) if body.name else data.body(body.id)
    frame = around.xmat.reshape(3, 3)
    rotation = frame.T @ at.xmat.reshape(3, 3) @ turn
    position = frame.T @ (at.xpos - around.xpos) + rotation @ offset
    body.add_site(name=TOOL, pos=position, quat=quaternion(rotation), size=(0.004,) * 3, group=4, material="")
    return body, position, rotation


def add_camera(body: Any, position: Array, rotation: Array, camera: Array, target: Array) -> None:
    """Add the wrist camera to the body of the tool, whose pose in it is given.

    It is at `camera` and looks at `target`, (3,) in the frame of the tool [m].
    """
    axes = look_at(camera, target, (1, 0, 0))
    body.add_camera(name=WRIST, pos=position + rotation @ camera, quat=quaternion(rotation @ axes), fovy=FOVY)


def use_convex_hulls(spec: mujoco.MjSpec, model: mujoco.MjModel) -> None:
    """Draw the convex hull of a few vertices in place of every mesh; collisions stay as they are."""
    hulls: dict[str, bool] = {}
    for geom in [geom for geom in spec.geoms if geom.group == VISIBLE and geom.meshname]:
        hull = f"vla_hull_{geom.meshname}"
        if hull not in hulls:
            hulls[hull] = _add_hull(spec, model, geom.meshname, hull)
        if not hulls[hull]:
            continue
        if geom.contype or geom.conaffinity:
            seen = geom.parent.add_geom(name=f"{geom.name}_seen", type=mujoco.mjtGeom.mjGEOM_MESH, meshname=hull)
            seen.pos, seen.quat, seen.rgba, seen.group = geom.pos, geom.quat, geom.rgba, VISIBLE
            seen.material, seen.mass, seen.contype, seen.conaffinity = "", 0.0, 0, 0
            geom.group = HIDDEN
        else:
            geom.meshname = hull


def _add_hull(spec: mujoco.MjSpec, model: mujoco.MjModel, mesh: str, name: str) -> bool:
    """Add the convex hull of a mesh as mesh `name`; return False, and add nothing, for a flat mesh."""
    index = model.mesh(mesh).id
    points = np.asarray(mesh_triangles(model, index)[0], float)
    if np.linalg.matrix_rank(points - points.mean(0), tol=1e-3) < 3:
        return False
    turn = np.empty(9)
    mujoco.mju_quat2Mat(turn, model.mesh_quat[index])  # vertices are stored in the mesh's own frame of inertia
    corners = spread(points @ turn.reshape(3, 3).T + model.mesh_pos[index], CORNERS)
    spec.add_mesh(name=name, uservert=corners.ravel())
    return True


def corners(model: mujoco.MjModel, geom: int) -> Array:
    """Return points (N, 3) in the frame of a geom whose hull contains it [m]: vertices of a mesh, else of a box."""
    if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH:
        return np.asarray(mesh_triangles(model, int(model.geom_dataid[geom]))[0], float)
    return model.geom_aabb[geom, :3] + np.array([*product((-1, 1), repeat=3)]) * model.geom_aabb[geom, 3:]


def quaternion(rotation: Array) -> Array:
    """Return the quaternion wxyz of a (3, 3) rotation."""
    result = np.empty(4)
    mujoco.mju_mat2Quat(result, np.ascontiguousarray(rotation).ravel())
    return result
