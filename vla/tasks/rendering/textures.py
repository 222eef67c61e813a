"""The textures of a model in OpenGL."""

from __future__ import annotations

from collections.abc import Collection

import moderngl
import mujoco
import numpy as np

from vla.spec import Array


class Textures:
    """Textures with three or four channels, by their id in the model."""

    def __init__(self, gl: moderngl.Context, model: mujoco.MjModel) -> None:
        self._model = model
        self.placed: dict[int, moderngl.Texture | moderngl.TextureCube] = {}
        for texture in np.flatnonzero(model.tex_nchannel >= 3).tolist():
            width, height = int(model.tex_width[texture]), int(model.tex_height[texture])
            flat = bool(model.tex_type[texture] == mujoco.mjtTexture.mjTEXTURE_2D)
            gl_texture = gl.texture((width, height), 4) if flat else gl.texture_cube((width, width), 4)
            gl_texture.filter = moderngl.LINEAR_MIPMAP_LINEAR, moderngl.LINEAR
            self.placed[texture] = gl_texture
        self.upload(self.placed)

    def is_cube(self, texture: int) -> bool:
        """Return whether a texture has six faces."""
        return isinstance(self.placed[texture], moderngl.TextureCube)

    def upload(self, textures: Collection[int]) -> None:
        """Upload the pixels of textures, given by their ids in the model."""
        for number in sorted({*textures} & {*self.placed}):
            texture, pixels = self.placed[number], self._pixels(number)
            if isinstance(texture, moderngl.TextureCube):
                width = texture.size[0]
                faces = pixels.reshape(-1, width, width, 4)  # one for all sides, or six
                for side in range(6):
                    texture.write(side, np.ascontiguousarray(faces[side % len(faces)]))
            else:
                texture.write(pixels)
            texture.build_mipmaps()

    def _pixels(self, texture: int) -> Array:
        """Return (height, width, 4) uint8, linear as MuJoCo's renderer shows it."""
        model = self._model
        shape = int(model.tex_height[texture]), int(model.tex_width[texture]), int(model.tex_nchannel[texture])
        pixels, start = np.full((*shape[:2], 4), 255, np.uint8), int(model.tex_adr[texture])
        pixels[..., : shape[2]] = model.tex_data[start : start + np.prod(shape)].reshape(shape)
        if model.tex_colorspace[texture] == mujoco.mjtColorSpace.mjCOLORSPACE_SRGB:
            encoded = np.arange(256) / 255
            linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
            pixels[..., :3] = np.rint(255 * linear).astype(np.uint8)[pixels[..., :3]]
        return pixels
