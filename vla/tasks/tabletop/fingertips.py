"""The parts of a gripper that hold a block: named shapes, or the far ends of jaws on a hinge.

Near its hinge a jaw always stays close to the other one, and its mesh collides as a convex hull, which fills the
space between the jaws. Such shapes are cut, and their last centimetres are the fingertips.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import Any

import mujoco
import numpy as np

from vla.io.errors import UserError
from vla.spec import Array
from vla.tasks.rendering.shapes import mesh_triangles
from vla.tasks.tabletop.robot import FINGERTIP_CONTACT, HIDDEN, ROBOT_CONTACT
from vla.tasks.tabletop.robot_file import compile_model, require
from vla.tasks.tabletop.robot_spec import TOOL, add_hull

FAR_END = 0.03  # length of the part of a jaw that holds a block [m]
FAR = 1.0  # largest gap that is measured [m]


def colliding_geoms(spec: mujoco.MjSpec, names: Sequence[str]) -> list[str]:
    """Return the names of colliding geoms in `names` and in the bodies `names`; a site becomes a geom of its shape."""
    geoms, bodies, sites = ({entry.name: entry for entry in kind} for kind in (spec.geoms, spec.bodies, spec.sites))
    require("fingertips", names, (*geoms, *bodies, *sites), "geom, body or site")
    tips: list[Any] = []
    for name in names:
        if name in geoms or name in bodies:
            tips += [geoms[name]] if name in geoms else bodies[name].geoms
        else:
            # With the frames around it, and its angles as quaternion.
            site, at = sites[name], compile_model(spec).site(name)
            tips += [_add(site.parent, f"vla_tip_{name}", site.type, pos=at.pos, quat=at.quat, size=at.size)]
    solid = [tip.name for tip in tips if tip.contype or tip.conaffinity]
    if not solid:
        raise UserError(
            f"task.robot.fingertips names {', '.join(names)}, where nothing collides: add shapes that do, such as "
            "<collision> in a URDF"
        )
    return solid


def _add(body: Any, name: str, kind: mujoco.mjtGeom, **shape: Any) -> Any:
    """Add a shape that collides with the world, is not drawn and weighs nothing."""
    return body.add_geom(name=name, type=kind, mass=0.0, group=HIDDEN, material="", **shape, **ROBOT_CONTACT)


def soften(spec: mujoco.MjSpec, tips: Sequence[str]) -> None:
    """Give shapes the contact parameters of fingertips."""
    for tip in map(spec.geom, tips):
        tip.friction, tip.condim, tip.priority, tip.solref = (
            FINGERTIP_CONTACT[key] for key in ("friction", "condim", "priority", "solref")
        )
        tip.solimp[:3] = FINGERTIP_CONTACT["solimp"]


def gap(model: mujoco.MjModel, data: mujoco.MjData, sides: Sequence[Sequence[str]]) -> tuple[float, Array]:
    """Return the smallest distance between the geoms of both sides, at least 0, and the middle (3,) of the gap [m]."""
    left, right = ([model.geom(name).id for name in side] for side in sides)
    minimum, ends = FAR, np.zeros(6)
    for first, second in product(left, right):
        segment = np.zeros(6)
        distance = mujoco.mj_geomDistance(model, data, first, second, FAR, segment)
        if distance < minimum:
            minimum, ends = distance, segment
    return max(0.0, minimum), (ends[:3] + ends[3:]) / 2


def points(model: mujoco.MjModel, data: mujoco.MjData, tips: Sequence[str], place: Any) -> Array:
    """Return points (N, 3) whose hull contains the geoms `tips`, in the frame of the site `place` [m]."""
    return np.concatenate([_triangles(model, data, tip, place).reshape(-1, 3) for tip in tips])


def _triangles(model: mujoco.MjModel, data: mujoco.MjData, name: str, place: Any) -> Array:
    """Return triangles (T, 3 corners, 3) of a mesh, or of the box around another shape, in the frame of `place`."""
    geom = model.geom(name).id
    if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH:
        vertices, faces = mesh_triangles(model, int(model.geom_dataid[geom]))
    else:
        from scipy.spatial import ConvexHull  # takes a quarter of a second, and only grippers from files need it

        vertices = model.geom_aabb[geom, :3] + np.array([*product((-1, 1), repeat=3)]) * model.geom_aabb[geom, 3:]
        faces = ConvexHull(vertices).simplices
    world = data.geom_xpos[geom] + vertices @ data.geom_xmat[geom].reshape(3, 3).T
    return ((world - place.xpos) @ place.xmat.reshape(3, 3))[faces]


def far_ends(
    spec: mujoco.MjSpec, model: mujoco.MjModel, data: mujoco.MjData, sides: Sequence[Sequence[str]], prefix: str
) -> list[list[str]]:
    """Cut the geoms of both sides across the tool's z axis, so that their last centimetres are geoms of their own.

    Args:
        spec: changed; what remains of a geom still collides.
        model: this spec, compiled, with `prefix` in front of names.
        data: the gripper is closed.
        sides: names of the geoms of either side, in `spec`.
        prefix: of the names in `model`.

    Returns:
        Names of the geoms that reach the end of either side, in `spec`.
    """
    tool = data.site(prefix + TOOL)
    shapes = [{tip: _triangles(model, data, prefix + tip, tool) for tip in side} for side in sides]
    level = min(max(shape[..., 2].max() for shape in side.values()) for side in shapes) - FAR_END
    ends: list[list[str]] = [[], []]
    for side, tips in zip(ends, shapes, strict=True):
        for tip, shape in tips.items():
            body = data.body(prefix + spec.geom(tip).parent.name)
            turn = tool.xmat.reshape(3, 3).T @ body.xmat.reshape(3, 3)
            start = (tool.xpos - body.xpos) @ body.xmat.reshape(3, 3)
            end, rest = (_points_above(shape, sign * (shape[..., 2] - level)) for sign in (1, -1))
            if len(end):
                side.append(_divide(spec, tip, start + end @ turn, start + rest @ turn) if len(rest) else tip)
    return ends


def _points_above(triangles: Array, heights: Array) -> Array:
    """Return points (N, 3) whose hull is that of the part of triangles (T, 3, 3) with heights (T, 3) above 0."""
    starts, ends = triangles.reshape(-1, 3), np.roll(triangles, -1, axis=1).reshape(-1, 3)
    start_heights, end_heights = heights.reshape(-1), np.roll(heights, -1, axis=1).reshape(-1)
    cross = start_heights * end_heights < 0
    share = (start_heights[cross] / (start_heights[cross] - end_heights[cross]))[:, None]
    return np.concatenate([starts[start_heights >= 0], starts[cross] + share * (ends[cross] - starts[cross])])


def _divide(spec: mujoco.MjSpec, tip: str, end: Array, rest: Array) -> str:
    """Replace the collisions of a geom by those of the hulls of its two parts, points (N, 3) in the frame of its body;
    return the name of the hull of `end`, or of the unchanged geom if that hull is flat."""
    if not add_hull(spec, f"{tip}_end", end):
        return tip
    geom = spec.geom(tip)
    geom.contype = geom.conaffinity = 0
    for name in [f"{tip}_end", *([f"{tip}_rest"] if add_hull(spec, f"{tip}_rest", rest) else [])]:
        _add(geom.parent, name, mujoco.mjtGeom.mjGEOM_MESH, meshname=name)
    return f"{tip}_end"
