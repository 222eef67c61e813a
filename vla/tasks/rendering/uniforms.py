"""The uniforms of a camera: its projections, and lights as in MuJoCo's fixed-function lighting."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from vla.spec import Array
from vla.tasks.rendering.projections import DIRECTIONAL, ModelCameras, shadow_projection
from vla.tasks.rendering.shaders import CAMERA, ROWS
from vla.tasks.rendering.shadows import RIM, Shadows

SPOT = 0  # mjtLightType
GLOBAL = 0.3  # ambient light of a model without lights
ALIGNMENT = 256  # of a camera's block in its buffer [bytes], enough for every machine


def drawn_lights(model: mujoco.MjModel) -> Array:
    """Return the ids of lights of types that MuJoCo's classic renderer draws, active or not."""
    return np.flatnonzero(np.isin(model.light_type, (DIRECTIONAL, SPOT)))


def light_rows(model: mujoco.MjModel) -> Array:
    """Return (1 + lights, ROWS, 4) float32: the headlight, then the drawn lights, still without poses."""
    lights = drawn_lights(model)
    table = np.zeros((1 + len(lights), ROWS, 4), np.float32)
    head, is_active = model.vis.headlight, model.light_active[lights, None].astype(bool)
    if head.active:
        table[0, :3, :3] = head.ambient, head.diffuse, head.specular
    elif not is_active.any():
        table[0, 0, :3] = GLOBAL
    table[0, 5, 0] = 1
    for row, name in enumerate(("ambient", "diffuse", "specular")):
        table[1:, row, :3] = np.where(is_active, getattr(model, f"light_{name}")[lights], 0)
    is_spot = model.light_type[lights] == SPOT
    table[1:, 3, 3], table[1:, 4, 3] = is_spot, np.cos(np.radians(model.light_cutoff[lights]))
    table[1:, 5, :3] = np.where(is_spot[:, None], model.light_attenuation[lights], (1, 0, 0))
    table[1:, 5, 3] = model.light_exponent[lights]
    return table


class CameraUniforms:
    """A buffer with a block per camera: its projection and position, shadow projections, lights."""

    def __init__(self, gl: Any, model: mujoco.MjModel, cameras: ModelCameras, lamps: Sequence[int]) -> None:
        """Take the context, the model, its cameras, and ids of the lights with a shadow map."""
        self._model, self._cameras, self._lamps, self._lights = model, cameras, list(lamps), drawn_lights(model)
        floats = CAMERA + 16 * len(lamps) + 4 * ROWS * (1 + len(self._lights))
        self._blocks = np.zeros((len(cameras.ids), -(-4 * floats // ALIGNMENT) * ALIGNMENT // 4), np.float32)
        self._buffer = gl.buffer(reserve=self._blocks.nbytes)
        self.stale = True  # the lights in the model have changed
        self._places = b""

    def update(self, data: mujoco.MjData, windows: Array | None, shadows: Shadows) -> None:
        """Upload the blocks for a state; if a light has moved, aim the shadow maps again."""
        places = data.light_xpos.tobytes() + data.light_xdir.tobytes()
        if self.stale or places != self._places:
            self.stale, self._places = False, places
            self._place_lights(data, shadows)
        blocks, cameras = self._blocks, self._cameras
        blocks[:, :16] = cameras.place(data, windows).swapaxes(1, 2).reshape(-1, 16)
        blocks[:, 16:19] = cameras.eyes
        head = CAMERA + 16 * len(self._lamps) + 16
        blocks[:, head : head + 3] = -cameras.axes[:, :, 2]  # the direction of the headlight
        self._buffer.write(blocks)

    def _place_lights(self, data: mujoco.MjData, shadows: Shadows) -> None:
        table = light_rows(self._model)
        table[1:, 3, :3], table[1:, 4, :3] = data.light_xpos[self._lights], data.light_xdir[self._lights]
        scale = 0.5 * (1 - RIM / max(1, self._model.vis.quality.shadowsize))
        texture_matrix = np.array([[scale, 0, 0, 0.5], [0, scale, 0, 0.5], [0, 0, 0.5, 0.5], [0, 0, 0, 1]])
        projections = [shadow_projection(self._model, data, lamp) for lamp in self._lamps]
        shadows.aim(data.light_xpos[self._lamps], projections)
        columns = [(texture_matrix @ projection).T.ravel() for projection in projections]
        content = np.concatenate([*columns, table.ravel()])
        self._blocks[:, CAMERA : CAMERA + content.size] = content

    def choose(self, number: int) -> None:
        """Let the shaders read the block of a camera."""
        size = self._blocks[number].nbytes
        self._buffer.bind_to_uniform_block(0, offset=number * size, size=size)
