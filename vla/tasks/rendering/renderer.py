"""The protocol of off-screen renderers."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Protocol

import mujoco

from vla.spec import Array


@dataclass(frozen=True)
class Views:
    """Cameras and elements of a model to draw, and the size of the images."""

    cameras: Sequence[int]  # ids in the model, in the order of the pictures
    height: int  # of every picture [px]
    width: int  # of every picture [px]
    geom_groups: Collection[int] = (0, 1, 2)
    site_groups: Collection[int] = ()
    aspect: float | None = None  # width over height of all that a camera sees; None: of the pictures


class Renderer(Protocol):
    """Off-screen renderer of one model; it may be bound to the thread that made it."""

    def update(self, textures: Collection[int] = ()) -> None:
        """Apply all changes of the model since the last call: call it after every change, such as at resets.

        Args:
            textures: ids of textures whose pixels have changed; other changes need not be named.
        """

    def render(self, data: mujoco.MjData, windows: Array | None = None) -> tuple[Array, Array]:
        """Draw every camera's picture of a state.

        Args:
            data: the state.
            windows: crop of each camera's field of view that its picture shows, (cameras, 4): top, left, bottom, right
                as fractions of height and width; None: no crop.

        Returns:
            Colours (cameras, height, width, 3) uint8, and depth along the optical axis (cameras, height, width)
            float32 [m], 0 where nothing is; a sky counts, at 0.7 to 1 times the distance of the far clipping plane.
        """

    def close(self) -> None:
        """Free the renderer's GL objects."""


class RendererFactory(Protocol):
    """Makes renderers of one kind with the same settings."""

    def open(self, model: mujoco.MjModel, views: Views) -> Renderer:
        """Make a renderer of `model`."""


class LazyRenderer:
    """A renderer that is made with the first picture, because blind worlds need no GL."""

    def __init__(
        self, factory: RendererFactory, model: mujoco.MjModel, views: Views, textures: set[int] | None = None
    ) -> None:
        """Take the factory, the model, the views, and the ids of textures with new pixels, which `render` clears."""
        self._open, self._textures = partial(factory.open, model, views), set() if textures is None else textures
        self._renderer: Renderer | None = None
        self.changed = False  # whether the model has changed since the last picture

    def render(self, data: mujoco.MjData, windows: Array | None = None) -> tuple[Array, Array]:
        """Draw every camera's picture, as `Renderer.render`."""
        if self._renderer is None:
            self._renderer = self._open()
        elif self.changed:
            self._renderer.update(self._textures)
        self._textures.clear()
        self.changed = False
        return self._renderer.render(data, windows)

    def close(self) -> None:
        """Close the renderer, if there is one."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None
