"""Shadow maps: the depth of the scene from every lamp, drawn once for all cameras."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import moderngl
import mujoco
import numpy as np

from vla.spec import Array
from vla.tasks.rendering import shaders
from vla.tasks.rendering.geometry import Buffers, ElementTriangles

SLOPE, UNITS = 1.5, 4.0  # polygon offset of shadow maps, against self-shadowing, as in MuJoCo
RIM = 2  # empty border of a shadow map, both sides together [texels]: shadows at its edge would never end
STATE = moderngl.DEPTH_TEST | moderngl.CULL_FACE
Span = tuple[int, int]  # first index of triangles, and number of indices


class Shadows:
    """Shadow maps of the lamps of a model.

    Static elements are drawn again only if one of them or a lamp has moved. Every frame copies their map and adds the
    moving elements.

    Attributes:
        maps: depth texture of each lamp.
        program: the shader program.
    """

    def __init__(self, gl: Any, model: mujoco.MjModel, lamps: Sequence[int], soft: int) -> None:
        """Take the context, the model, ids of the lights, and texels over which the edges of shadows are averaged."""
        self._gl, self._lamps, self._soft = gl, list(lamps), soft
        self._edge = int(model.vis.quality.shadowsize)
        self._static_targets, self._targets = ([self._target() for _ in self._lamps] for _ in range(2))
        self.maps = [target.depth_attachment for target in self._targets]
        self.program = gl.program(**shaders.SHADOW_PROGRAM)
        self._buffers = Buffers(gl)
        content = [(self._buffers.vertices, "3f 1f", "in_position", "in_element")]
        self._casters = gl.vertex_array(self.program, content, self._buffers.indices)
        is_static = (model.body_weldid == 0) & (model.body_mocapid < 0)
        self._fixed = np.flatnonzero(np.append(is_static[model.geom_bodyid], is_static[model.site_bodyid]))  # elements
        self._state: bytes | None = None  # poses of the static elements in their maps

    def _target(self) -> Any:
        """Make the framebuffer of a map, with an unused colour attachment: without one moderngl copies nothing."""
        gl, size = self._gl, (self._edge, self._edge)
        depth = gl.depth_texture(size)
        depth.compare_func = "<="
        depth.repeat_x = depth.repeat_y = False
        depth.filter = (moderngl.LINEAR,) * 2 if self._soft else (moderngl.NEAREST,) * 2
        target = gl.framebuffer([gl.renderbuffer(size, 1)], depth)
        target.color_mask = False, False, False, False
        return target

    def update(self, casters: Sequence[ElementTriangles]) -> None:
        """Upload the triangles that cast shadows."""
        fixed = set(self._fixed.tolist())
        kinds = [(is_static, is_closed) for is_static in (True, False) for is_closed in (True, False)]
        groups = [[item.casting for item in casters if (item.element in fixed, item.closed) == kind] for kind in kinds]
        self._buffers.update([part for group in groups for part in group])
        ends = np.cumsum([0, *(sum(part.triangles.size for part in group) for group in groups)]).tolist()
        self._spans: list[Span] = [(start, end - start) for start, end in pairwise(ends)]
        self._state = None

    def aim(self, lamps: Array, projections: Sequence[Array]) -> None:
        """Set the positions (lamps, 3) [m] of the lamps, and the projections (4, 4) of the world into their maps."""
        self._uniforms = [
            {"projection": projection.T.astype(np.float32).tobytes(), "lamp": lamp.astype(np.float32).tobytes()}
            for projection, lamp in zip(projections, lamps, strict=True)
        ]
        self._state = None

    def cast(self, poses: Array) -> None:
        """Draw the maps; `poses` are those of the elements (E, 3, 4)."""
        gl = self._gl
        state = poses[self._fixed].tobytes()
        stale, self._state = state != self._state, state
        gl.front_face = "ccw"
        gl.polygon_offset = SLOPE + 2.0 * self._soft, UNITS  # averages reach across texels
        for uniforms, static_target, target in zip(self._uniforms, self._static_targets, self._targets, strict=True):
            for name, content in uniforms.items():
                self.program[name].write(content)
            if stale:
                static_target.viewport = 0, 0, self._edge, self._edge
                static_target.clear(depth=1.0)
                self._draw(static_target, *self._spans[:2])
            gl.copy_framebuffer(target, static_target)
            self._draw(target, *self._spans[2:])
        gl.polygon_offset = 0.0, 0.0

    def _draw(self, target: Any, closed_span: Span, open_span: Span) -> None:
        """Draw the front faces of closed surfaces, the nearest to a lamp outside, and both sides of open ones."""
        target.use()
        target.viewport = RIM // 2, RIM // 2, self._edge - RIM, self._edge - RIM
        for state, (start, count) in ((STATE, closed_span), (moderngl.DEPTH_TEST, open_span)):
            if count:
                self._gl.enable_only(state)
                self._casters.render(moderngl.TRIANGLES, vertices=count, first=start)
