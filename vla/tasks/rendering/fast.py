"""A renderer with few draw calls, on one framebuffer for all cameras.

All geometry is in one buffer, and each vertex names its element. Poses and appearance are textures with a row per
element. A frame uploads the poses, draws one shadow map per lamp for all cameras, then each camera's picture with few
calls per texture, and reads all of them back at once. The sky is drawn only for cameras whose depth has gaps.
"""

from __future__ import annotations

import logging
from collections.abc import Collection
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

import moderngl
import mujoco
import numpy as np
from annotated_types import Ge, Le

from vla.io.errors import UserError
from vla.spec import Array
from vla.tasks.gl import has_egl
from vla.tasks.rendering import shaders, shapes, uniforms
from vla.tasks.rendering.context import Context, shared_context
from vla.tasks.rendering.decimate import decimate
from vla.tasks.rendering.geometry import Buffers, Elements, Geometry, elements_of, unsupported_features
from vla.tasks.rendering.projections import ModelCameras, clip_range
from vla.tasks.rendering.renderer import Renderer, Views
from vla.tasks.rendering.shadows import STATE, Shadows
from vla.tasks.rendering.textures import Textures

log = logging.getLogger(__name__)
BEHIND = 0.3  # factor on the alpha of a plane seen from behind, as in MuJoCo
GAP = 120  # largest number of invisible indices drawn to join two calls, which is faster than a second call
MARGIN = 1.01  # factor on the radius of elements, against rounding
PACKAGES = "libegl1, libgl1 and libgl1-mesa-dri"


@dataclass(frozen=True)
class _DrawCall:
    """Triangles that one call draws."""

    texture: int  # id, or -1
    start: int  # of the indices
    count: int  # of the indices


@dataclass(frozen=True)
class Fast:
    """Factory of the fast renderer, with its settings."""

    samples: Literal[1, 4]  # per pixel, which are averaged; 4 draws twice as many rows and columns, for smooth edges
    soft: Annotated[int, Ge(0), Le(4)]  # texels around the nearest one over which the edges of shadows are averaged
    faces: Annotated[int, Ge(100)] | None  # most faces of a mesh, heavier ones are decimated for pictures; None: all
    coarser: ClassVar[int] = 0  # mipmap levels by which textures are coarser than needed

    @staticmethod
    def substitute() -> tuple[str, str] | None:
        """Return why this machine cannot use the renderer, and the option to use instead; None where it can."""
        if has_egl():
            return None
        return f"the fast renderer needs EGL, which this machine lacks (packages {PACKAGES})", "mujoco"

    def open(self, model: mujoco.MjModel, views: Views) -> Renderer:
        """Make a renderer of `model`; a UserError without EGL: no other replaces it, as stores name their renderer."""
        try:
            context = shared_context()
        except Exception as error:  # moderngl raises plain exceptions
            raise UserError(
                f"the fast renderer needs EGL, which this machine lacks ({error}): install the packages "
                f"{PACKAGES}, or choose task/renderer=mujoco"
            ) from error
        return FastRenderer(context, model, views, self)


class Detailed(Fast):
    """Factory of the fast renderer with all faces, four samples per pixel, and textures as coarse as in MuJoCo, which
    looks a texture up once per pixel, not once per sample."""

    coarser = 1

    def __init__(self) -> None:
        super().__init__(samples=4, soft=0, faces=None)


class FastRenderer:
    """Pictures of one model by OpenGL 3.3."""

    def __init__(self, context: Context, model: mujoco.MjModel, views: Views, settings: Fast) -> None:
        self._context, self._gl, self._model, self._views, self._settings = context, context.gl, model, views, settings
        self._cameras = ModelCameras(model, views)
        if missing_features := unsupported_features(model, views):
            log.warning(f"the fast renderer leaves out {', '.join(missing_features)}; task/renderer=mujoco draws them")
        sky = np.flatnonzero(model.tex_type == mujoco.mjtTexture.mjTEXTURE_SKYBOX)
        self._sky = int(sky[0]) if len(sky) else -1
        self._geometry = Geometry(model, self._mesh)
        casts_shadow = model.light_castshadow if model.vis.quality.shadowsize else np.zeros(model.nlight, bool)
        self._lamps = [int(light) for light in uniforms.drawn_lights(model) if casts_shadow[light]]
        with context.make_current():
            self._make_targets()
            self._shadows = Shadows(self._gl, model, self._lamps, settings.soft)
            self._make_tables()
            self._textures = Textures(context.gl, model)
            self._make_programs()
            self._make_buffers()
            self._uniforms = uniforms.CameraUniforms(self._gl, model, self._cameras, self._lamps)
        self.update()

    def _mesh(self, mesh: int, textured: bool) -> shapes.Surface:
        vertices, faces = shapes.mesh_triangles(self._model, mesh)
        if self._settings.faces is not None and len(faces) > self._settings.faces:
            texcoord = shapes.mesh_texcoord(self._model, mesh) if textured else None
            return shapes.smooth_surface(*decimate(vertices, faces, texcoord, self._settings.faces))
        return shapes.mesh(self._model, mesh)

    def _make_targets(self) -> None:
        """Make the framebuffer with the cameras' pictures one above the other, so that one reading takes them all."""
        gl, width, height = self._gl, self._views.width, self._views.height * len(self._views.cameras)
        self._fine = 2 if self._settings.samples == 4 else 1  # rows and columns per pixel
        size = self._fine * width, self._fine * height
        self._framebuffer = gl.framebuffer(gl.renderbuffer(size, 4), self._context.depth_renderbuffer(size))
        self._averaged = gl.framebuffer(gl.renderbuffer((width, height), 4)) if self._fine == 2 else self._framebuffer

    def _make_tables(self) -> None:
        """Make the textures of poses and appearance; an element is moved or changed by writing its row."""
        count = self._model.ngeom + self._model.nsite + 1  # the last one is the sky
        self._poses = np.zeros((count, shaders.POSE, 4), np.float32)
        self._poses[-1] = np.eye(3, 4)
        self._pose_texture = self._gl.texture((shaders.POSE, count), 4, dtype="f4")
        self._table_texture = self._gl.texture((shaders.TEXELS, count), 4, dtype="f4")
        for texture in (self._pose_texture, self._table_texture):
            texture.filter = moderngl.NEAREST, moderngl.NEAREST

    def _make_programs(self) -> None:
        """Compile the shaders, one program per kind of texture, and assign units to the textures that all read."""
        gl, settings, lights = self._gl, self._settings, uniforms.drawn_lights(self._model).tolist()
        is_spot = self._model.light_type == uniforms.SPOT
        pixel = bool(is_spot[lights].any())  # light at vertices, as in MuJoCo, would miss the edge of a spot
        lamps = {1 + lights.index(lamp): bool(is_spot[lamp]) for lamp in self._lamps}
        kinds: tuple[shaders.Skin, ...] = ("none", "2d", "cube")
        options = pixel, settings.soft, settings.coarser
        self._programs = {
            kind: gl.program(**shaders.scene_program(1 + len(lights), lamps, kind, *options)) for kind in kinds
        }
        units = {"poses": self._pose_texture, "table": self._table_texture}
        units |= {f"shadow{number}": depth for number, depth in enumerate(self._shadows.maps)}
        self._units = list(units.values())
        self._skin = len(units)  # unit of the texture of the element being drawn
        for unit, name in enumerate((*units, "skin")):
            for program in (*self._programs.values(), self._shadows.program):
                if name in program:
                    program[name] = unit

    def _make_buffers(self) -> None:
        """Make the buffer of all geometry, and a vertex array per program, without the attributes it does not use."""
        self._buffers = Buffers(self._gl)
        names = "in_position", "in_normal", "in_coordinate", "in_element"
        self._scene = {}
        for kind, program in self._programs.items():
            fields = [name if name in program else None for name in names]
            form = " ".join(f"{n}f" if name else f"{4 * n}x" for n, name in zip((3, 3, 3, 1), fields, strict=True))
            content = [(self._buffers.vertices, form, *(name for name in fields if name))]
            self._scene[kind] = self._gl.vertex_array(program, content, self._buffers.indices)

    def update(self, textures: Collection[int] = ()) -> None:
        """Upload what has changed in the model; `textures` are the ids of textures with changed pixels."""
        with self._context.make_current():
            self._textures.upload(textures)
            elements = self._elements = elements_of(self._model, self._views)
            self._planes = np.flatnonzero(elements.visible & (elements.kind == mujoco.mjtGeom.mjGEOM_PLANE)).tolist()
            self._geometry.update(elements, self._sky >= 0)
            self._place_elements()
            self._cameras.update()
            self._uniforms.stale = True
            sites = np.linalg.norm(elements.size[self._model.ngeom :], axis=1)
            self._bounds = np.append(self._model.geom_rbound, sites)  # radius of each element [m]
            self._table_texture.write(self._table(elements))

    def _place_elements(self) -> None:
        """Upload the elements' triangles, and store their places in the buffer."""
        placed, sky = self._geometry.elements, len(self._elements.kind)
        self._buffers.update([shape.visible for shape in placed])
        ends = np.cumsum([0, *(shape.visible.triangles.size for shape in placed)]).tolist()
        self._calls = {
            shape.element: _DrawCall(self._texture_of(shape.element), start, shape.visible.triangles.size)
            for shape, start in zip(placed, ends, strict=False)
        }
        order = list(self._calls)
        solid, self._transparent = order[: self._geometry.solid_count], order[self._geometry.solid_count :]
        self._opaque = np.array([element for element in solid if element != sky], int)
        radius = {shape.element: shape.radius for shape in placed}
        radius |= dict.fromkeys(self._planes, np.inf)  # they may move along with a camera
        self._radii = MARGIN * np.array([radius[element] for element in self._opaque])
        # Elements rarely enter or leave a picture, so the merged calls are cached for every set of visible elements.
        self._batches: dict[bytes, list[_DrawCall]] = {}  # whether each opaque element is in sight → what to draw
        self._shadows.update([shape for shape in placed if shape.element != sky])

    def _texture_of(self, element: int) -> int:
        texture = self._sky if element == len(self._elements.kind) else int(self._elements.texture[element])
        return texture if texture in self._textures.placed else -1

    def _kind(self, texture: int) -> shaders.Skin:
        return "none" if texture < 0 else "cube" if self._textures.is_cube(texture) else "2d"

    def _draw(self, call: _DrawCall) -> None:
        if call.texture >= 0:
            self._textures.placed[call.texture].use(self._skin)
        self._scene[self._kind(call.texture)].render(moderngl.TRIANGLES, vertices=call.count, first=call.start)

    def _table(self, elements: Elements) -> Array:
        """Return (E + 1, TEXELS, 4) float32, the appearance of all elements and the sky."""
        table = np.zeros((len(elements.kind) + 1, shaders.TEXELS, 4), np.float32)
        table[:-1, 0], table[:-1, 1, :3] = elements.rgba, elements.light
        table[:-1, 1, 2] *= 128  # shininess, the exponent
        for plane in self._planes:
            table[plane, 2, :2] = elements.size[plane, :2] <= 0  # an infinite plane moves along with the camera
            if elements.texture[plane] >= 0:
                repeat = self._model.mat_texrepeat[elements.material[plane]]
                table[plane, 3, :2] = [0.5, -0.5] * np.where(repeat > 0, repeat, 1.0)
        table[-1, 0, 3], table[-1, 1, 3], table[-1, 2, :3] = 1, 1, 1  # the sky: not lit, always around the camera
        return table

    def render(self, data: mujoco.MjData, windows: Array | None = None) -> tuple[Array, Array]:
        """Draw colours (cameras, H, W, 3) uint8 and depth (cameras, H, W) float32 [m]."""
        with self._context.make_current():
            for unit, texture in enumerate(self._units):  # another renderer may have bound its own
                texture.use(unit)
            self._upload_poses(data)
            self._uniforms.update(data, windows, self._shadows)
            self._shadows.cast(self._poses)
            self._framebuffer.use()
            self._gl.enable_only(STATE)
            self._gl.front_face = "cw"  # in pictures that are upside down
            self._framebuffer.clear(depth=1.0)
            self._draw_opaque()
            depth = self._draw_skies()
            self._draw_transparent()
            return self._read_colours(), self._metres(np.ascontiguousarray(depth[:, :: self._fine, :: self._fine]))

    def _upload_poses(self, data: mujoco.MjData) -> None:
        geoms, poses = self._model.ngeom, self._poses
        poses[:geoms, :, :3], poses[:geoms, :, 3] = data.geom_xmat.reshape(-1, 3, 3), data.geom_xpos
        poses[geoms:-1, :, :3], poses[geoms:-1, :, 3] = data.site_xmat.reshape(-1, 3, 3), data.site_xpos
        self._pose_texture.write(poses)

    def _aim(self, number: int) -> None:
        """Choose the camera that the next calls draw for."""
        width, height = self._fine * self._views.width, self._fine * self._views.height
        self._uniforms.choose(number)
        self._gl.viewport = 0, number * height, width, height

    def _draw_opaque(self) -> None:
        """Draw the opaque elements that the cameras may see."""
        masks = self._cameras.may_see(self._poses[self._opaque, :, 3], self._radii)
        for number, mask in enumerate(masks):
            self._aim(number)
            calls = self._batches.get(key := mask.tobytes())
            if calls is None:
                calls = self._batches[key] = _merge([self._calls[element] for element in self._opaque[mask].tolist()])
            for call in calls:
                self._draw(call)

    def _draw_skies(self) -> Array:
        """Draw the sky for the cameras that see it; return the depth buffer as `_read_depth` does.

        Depth has to be read anyway, and reading it is cheaper than drawing a sky that is completely hidden.
        """
        depth = self._read_depth()
        numbers = [number for number, pixels in enumerate(depth) if self._sky >= 0 and pixels.max() >= 1]
        for number in numbers:
            self._aim(number)
            self._draw(self._calls[len(self._elements.kind)])
        return self._read_depth() if numbers else depth

    def _draw_transparent(self) -> None:
        """Blend transparent elements and planes seen from behind."""
        for number in range(len(self._cameras.ids)):
            planes = [plane for plane in self._planes if self._cameras.sees_from_behind(number, self._poses[plane])]
            if self._transparent or planes:
                self._aim(number)
                self._blend(self._cameras.eyes[number], planes)

    def _blend(self, eye: Array, planes: list[int]) -> None:
        """Blend a camera's transparent elements as MuJoCo does: from near to far, and back again."""
        distance = {
            element: float(np.linalg.norm(self._poses[element, :, 3] - eye) - self._bounds[element])
            for element in {*self._transparent, *planes}
        }
        distance |= {plane: np.inf for plane in self._planes if plane in distance}
        order = sorted(distance, key=lambda element: (distance[element], element))
        gl = self._gl
        gl.enable(moderngl.BLEND)
        gl.blend_func = moderngl.SRC_ALPHA, moderngl.ONE_MINUS_SRC_ALPHA
        self._framebuffer.depth_mask = False  # what is transparent hides nothing, and has no depth
        self._leave_out_shadows(True)
        for element in [*order, *order[::-1]]:
            call, alpha = self._calls[element], float(self._elements.rgba[element, 3])
            self._programs[self._kind(call.texture)]["alpha"] = alpha * (BEHIND if element in planes else 1.0)
            if element in planes:
                gl.disable(moderngl.CULL_FACE)
            self._draw(call)
            gl.enable(moderngl.CULL_FACE)
        self._leave_out_shadows(False)
        self._framebuffer.depth_mask = True
        gl.disable(moderngl.BLEND)

    def _leave_out_shadows(self, value: bool) -> None:
        for program in self._programs.values():
            if "unshadowed" in program:
                program["unshadowed"] = float(value)

    def _read_depth(self) -> Array:
        """Read the depth buffer (cameras, rows, columns) float32, 0 at the near plane and 1 at the far one."""
        views = self._views
        depth = np.empty((len(views.cameras), self._fine * views.height, self._fine * views.width), np.float32)
        self._framebuffer.read_into(depth, attachment=-1, components=1, dtype="f4", alignment=1)
        return depth

    def _read_colours(self) -> Array:
        rgb = np.empty((len(self._views.cameras), self._views.height, self._views.width, 3), np.uint8)
        if self._averaged is not self._framebuffer:
            self._context.halve(self._framebuffer, self._averaged)
        self._averaged.read_into(rgb, components=3, alignment=1)
        return rgb

    def _metres(self, reading: Array) -> Array:
        """Convert readings of the depth buffer, 0 at the near plane and 1 at the far one, to depth [m], in place."""
        near, far = clip_range(self._model)
        background = reading >= 1
        reading *= near - far
        reading += far
        np.divide(near * far, reading, out=reading)
        reading[background] = 0.0
        return reading

    def close(self) -> None:
        """Free the renderer's GL objects."""
        context = self._context
        vars(self).clear()
        context.clean()


def _merge(calls: Collection[_DrawCall]) -> list[_DrawCall]:
    """Join calls with the same texture that follow each other with a small gap, if any."""
    result: list[_DrawCall] = []
    for call in calls:
        previous = result[-1] if result else None
        if previous and previous.texture == call.texture and call.start - previous.start - previous.count <= GAP:
            result.pop()
            call = _DrawCall(call.texture, previous.start, call.start + call.count - previous.start)
        result.append(call)
    return result
