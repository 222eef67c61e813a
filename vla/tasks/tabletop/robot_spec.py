"""Adaptation of robot models to the tabletop."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from typing import Any

import mujoco
import numpy as np

from vla.io.errors import UserError
from vla.io.types import Names
from vla.robots.cartesian import DOWN
from vla.spec import Array
from vla.tasks.rendering.shapes import mesh_triangles
from vla.tasks.tabletop.robot import HIDDEN, ROBOT_CONTACT, VISIBLE, look_at, spread
from vla.tasks.tabletop.robot_file import compile_model, require

TOOL, SERVO, WRIST = "vla_tool", "vla_servo_", "wrist"  # names of what is added
ALIGNED = 0.9  # smallest cosine between the axes of the tool's site and forward, left, down at home
FOVY = 75.0  # of the wrist camera [degrees]
SEEN_GROUPS = 3  # the first groups, which MuJoCo draws
UNCOLOURED = (0.5, 0.5, 0.5, 1.0)  # what MuJoCo gives geoms without a colour
Eq = mujoco.mjtEq


def require_home(spec: mujoco.MjSpec, joints: Names, home: Sequence[float]) -> dict[str, float]:
    """Return joint → position at home (UserError: no such joint, one that is not a hinge or not in order, or a position
    out of its limits)."""
    require("joints", joints, (joint.name for joint in spec.joints), "joint")
    if len(home) != len(joints):
        raise UserError(f"task.robot.home has {len(home)} positions for {len(joints)} joints")
    model = compile_model(spec)
    subtree = set(range(model.nbody))
    for name, position in zip(joints, home, strict=True):
        joint = model.joint(name)
        if int(joint.bodyid[0]) not in subtree:
            raise UserError(f"task.robot.joints names {name} after a joint that does not carry it: base to tip")
        subtree = descendants(model, int(joint.bodyid[0]))
        if joint.type[0] != mujoco.mjtJoint.mjJNT_HINGE:
            raise UserError(f"task.robot.joints names {name}, which is not a hinge")
        low, high = joint.range
        if model.jnt_limited[joint.id] and not low <= position <= high:
            raise UserError(f"task.robot.home has {name} at {position}, outside its limits, {low:.3f} to {high:.3f}")
    return dict(zip(joints, home, strict=True))


def descendants(model: mujoco.MjModel, body: int) -> set[int]:
    """Return a body and all bodies that it carries."""
    bodies = {body}
    for child in range(body + 1, model.nbody):  # parents come before their children
        if model.body_parentid[child] in bodies:
            bodies.add(child)
    return bodies


def simplify(spec: mujoco.MjSpec, joints: Collection[str], grips: Collection[str]) -> None:
    """Reduce a model to what the tabletop needs: the arm's `joints`, the hand, and the gripper's actuators `grips`.

    Joints of neither the arm nor the hand are fixed, and their couplings removed, like lamps, cameras, planes, contact
    pairs, sensors, key frames, and materials except for their colours.
    """
    model = compile_model(spec)
    hand = descendants(model, int(model.joint(list(joints)[-1]).bodyid[0]))
    for index, body in enumerate(spec.bodies):
        body.name, body.gravcomp = body.name or f"vla_body{index}", 1.0  # its servos carry no weight
        if index and model.body_mass[index]:  # as compiled, whatever happens to its shapes
            body.explicitinertial, body.fullinertia = True, np.full(6, np.nan)
            body.mass, body.inertia = model.body_mass[index], model.body_inertia[index]
            body.ipos, body.iquat = model.body_ipos[index], model.body_iquat[index]
    for joint in spec.joints:
        joint.name = joint.name or f"vla_joint{joint.id}"
    fixed = {j.name: j for j in spec.joints if j.name not in joints and model.jnt_bodyid[j.id] not in hand}
    slack = _drop_couplings(spec, model, fixed)
    for element in [*spec.actuators]:
        targets = slack if element.trntype == mujoco.mjtTrn.mjTRN_TENDON else fixed
        if element.name not in grips or element.target in targets:
            spec.delete(element)
    for element in (*fixed.values(), *spec.lights, *spec.cameras, *spec.sensors, *spec.keys, *spec.pairs, *spec.tuples):
        spec.delete(element)
    _simplify_geoms(spec, model)
    for element in (*spec.sites, *spec.tendons, *spec.skins):
        element.material = ""
    for element in [*spec.materials]:
        spec.delete(element)


def _drop_couplings(spec: mujoco.MjSpec, model: mujoco.MjModel, fixed: Collection[str]) -> set[str]:
    """Delete tendons and constraints of `fixed` joints, or within bodies that move as one; return the tendon names."""
    moving_bodies = {int(model.jnt_bodyid[joint.id]) for joint in spec.joints if joint.name not in fixed}
    part = np.arange(model.nbody)  # the first of the bodies that move as one with a body
    for body in range(1, model.nbody):
        part[body] = body if body in moving_bodies else part[model.body_parentid[body]]
    slack: set[str] = set()
    for tendon in [*spec.tendons]:
        targets = [wrap.target for wrap in tendon.path if wrap.target is not None]  # all joints, or all sites or geoms
        if isinstance(targets[0], mujoco.MjsJoint):
            useless = any(joint.name in fixed for joint in targets)
        else:
            useless = len({part[target.parent.id] for target in targets}) < 2
        if useless:
            slack.add(tendon.name)
            spec.delete(tendon)
    deleted_names = {Eq.mjEQ_JOINT: fixed, Eq.mjEQ_TENDON: slack}
    for tie, *ends in zip([*spec.equalities], model.eq_obj1id, model.eq_obj2id, strict=True):
        if tie.type in (Eq.mjEQ_CONNECT, Eq.mjEQ_WELD):
            bodies = model.site_bodyid[ends] if tie.objtype == mujoco.mjtObj.mjOBJ_SITE else ends
            useless = part[bodies[0]] == part[bodies[1]]
        else:
            useless = not {tie.name1, tie.name2}.isdisjoint(deleted_names.get(tie.type, ()))
        if useless:
            spec.delete(tie)
    return slack


def _simplify_geoms(spec: mujoco.MjSpec, model: mujoco.MjModel) -> None:
    """Let every colliding geom collide with the world only; draw the visual geoms of a body, or else the others."""
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


def set_armature(spec: mujoco.MjSpec, joints: Iterable[str], minimum: float) -> None:
    """Give joints a reflected inertia of their motors of at least `minimum` [kg m²]."""
    for joint in map(spec.joint, joints):
        joint.armature = max(joint.armature, minimum)


def add_servo(spec: mujoco.MjSpec, joint: str, stiffness: float, damping: float, force: float | None) -> str:
    """Add a position servo to a joint; return its name. It does not depend on the defaults of the file."""
    servo = spec.add_actuator(name=SERVO + joint, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    servo.dyntype, servo.gear = mujoco.mjtDyn.mjDYN_NONE, np.eye(6)[0]
    servo.gainprm[:] = servo.biasprm[:] = 0.0
    servo.set_to_position(kp=stiffness, kv=damping)
    servo.ctrllimited = servo.actlimited = mujoco.mjtLimited.mjLIMITED_FALSE
    servo.forcelimited, servo.forcerange = force is not None, (-(force or 0.0), force or 0.0)
    spec.joint(joint).actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE  # no effort limit of a URDF
    return SERVO + joint


def compile_at_home(spec: mujoco.MjSpec, home: dict[str, float]) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """Compile a model and place its joints at `home`, joint → position."""
    model = compile_model(spec)
    data = mujoco.MjData(model)
    for name, position in home.items():
        data.joint(name).qpos[0] = position
    mujoco.mj_forward(model, data)
    return model, data


def stiffness(spec: mujoco.MjSpec, home: dict[str, float], frequency: float) -> list[float]:
    """Return the stiffnesses [N m/rad] that give the joints a natural `frequency` [rad/s] with the arm at `home`."""
    model, data = compile_at_home(spec, home)
    inertia = np.empty((model.nv, model.nv))
    mujoco.mj_fullM(model, data, inertia)
    return [frequency**2 * inertia[dof, dof] for dof in (model.joint(name).dofadr[0] for name in home)]


def add_tool(
    spec: mujoco.MjSpec, name: str, home: dict[str, float], base: Array, offset: Array
) -> tuple[Any, Array, Array]:
    """Add the site of the tool at `offset` (3,) [m] from the site or body `name`, along the axes of that.

    The x axis is the one that points forward at `home`, the z axis the one that points down; `base` (3, 3) is the
    rotation of the base.

    Returns:
        Body that it is on, position (3,) [m] and rotation (3, 3) of the tool in that body.

    Raises:
        UserError: no such name, or no axes that point there.
    """
    require("tool", [name], (element.name for element in (*spec.sites, *spec.bodies)), "site or body")
    _, data = compile_at_home(spec, home)
    site = spec.site(name)
    body = site.parent if site is not None else spec.body(name)
    origin, parent = data.site(name) if site is not None else data.body(name), data.body(body.id)
    axes = (base @ origin.xmat.reshape(3, 3)).T @ DOWN  # columns: forward, right, down as seen from it
    turn = np.round(axes)
    if np.abs(axes).max(axis=0).min() < ALIGNED or abs(np.linalg.det(turn) - 1) > 0.1:
        raise UserError(
            f"task.robot.home leaves the axes of {name} askew: one must point down and one forward, each within "
            f"{np.degrees(np.arccos(ALIGNED)):.0f} degrees; in its frame down is {np.round(axes[:, 2], 2).tolist()}, "
            f"forward {np.round(axes[:, 0], 2).tolist()}"
        )
    frame = parent.xmat.reshape(3, 3)
    rotation = frame.T @ origin.xmat.reshape(3, 3) @ turn
    position = frame.T @ (origin.xpos - parent.xpos) + rotation @ offset
    body.add_site(name=TOOL, pos=position, quat=quaternion(rotation), size=(0.004,) * 3, group=4, material="")
    return body, position, rotation


def add_camera(body: Any, position: Array, rotation: Array, camera: Array, target: Array) -> None:
    """Add the wrist camera, which is at `camera` (3,) and looks at `target` (3,) in the frame of the tool [m], to the
    tool's body, in which its pose is given."""
    axes = look_at(camera, target, (1, 0, 0))
    body.add_camera(name=WRIST, pos=position + rotation @ camera, quat=quaternion(rotation @ axes), fovy=FOVY)


def move_tool(spec: mujoco.MjSpec, shift: Array) -> None:
    """Move the tool, with its camera, by `shift` (3,) in its own frame [m]."""
    tool, offset = spec.site(TOOL), np.empty(3)
    mujoco.mju_rotVecQuat(offset, shift, tool.quat)
    for element in (tool, spec.camera(WRIST)):
        element.pos = element.pos + offset


def use_convex_hulls(spec: mujoco.MjSpec) -> None:
    """Draw the convex hull of a few vertices in place of every mesh; collisions stay as they are."""
    model, hulls = compile_model(spec), dict[str, bool]()
    for geom in [geom for geom in spec.geoms if geom.group == VISIBLE and geom.meshname]:
        hull = f"vla_hull_{geom.meshname}"
        if hull not in hulls:
            index, turn = model.mesh(geom.meshname).id, np.empty(9)
            mujoco.mju_quat2Mat(turn, model.mesh_quat[index])  # vertices are in the mesh's own frame of inertia
            vertices = mesh_triangles(model, index)[0].astype(float) @ turn.reshape(3, 3).T + model.mesh_pos[index]
            hulls[hull] = add_hull(spec, hull, vertices)
        if hulls[hull] and (geom.contype or geom.conaffinity):
            visual = geom.parent.add_geom(name=f"{geom.name}_seen", type=mujoco.mjtGeom.mjGEOM_MESH, meshname=hull)
            visual.pos, visual.quat = _frame_of(model, geom)
            visual.rgba, visual.group = geom.rgba, VISIBLE
            visual.material, visual.mass, visual.contype, visual.conaffinity = "", 0.0, 0, 0
            geom.group = HIDDEN
        elif hulls[hull]:
            geom.meshname = hull


def _frame_of(model: mujoco.MjModel, geom: Any) -> tuple[Array, Array]:
    """Return position [m] and quaternion of a mesh's own frame in the body of a compiled geom.

    An element of a spec has these as they were written: without the frames around it, and by angles or axes.
    """
    compiled_geom, mesh = model.geom(geom.name), model.mesh(geom.meshname)
    inverse, turn, offset = np.empty(4), np.empty(4), np.empty(3)
    mujoco.mju_negQuat(inverse, model.mesh_quat[mesh.id])  # the compiled geom is in the mesh's frame of inertia
    mujoco.mju_mulQuat(turn, compiled_geom.quat, inverse)
    mujoco.mju_rotVecQuat(offset, model.mesh_pos[mesh.id], turn)
    return compiled_geom.pos - offset, turn


def add_hull(spec: mujoco.MjSpec, name: str, points: Array) -> bool:
    """Add the convex hull of a few of (N, 3) points as mesh `name`, unless it is flat; return whether it was added."""
    if np.linalg.matrix_rank(points - points.mean(0), tol=1e-3) < 3:
        return False
    # A scale that the file gives to its own meshes by default must not apply.
    spec.add_mesh(name=name, uservert=spread(points).ravel(), scale=np.ones(3))
    return True


def quaternion(rotation: Array) -> Array:
    """Return the quaternion wxyz of a (3, 3) rotation."""
    result = np.empty(4)
    mujoco.mju_mat2Quat(result, np.ascontiguousarray(rotation).ravel())
    return result
