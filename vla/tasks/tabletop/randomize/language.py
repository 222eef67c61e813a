"""Randomizers of instructions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from vla.io.types import Natural, Share
from vla.tasks.tabletop.compiled_scene import CompiledScene


@dataclass(frozen=True)
class Phrasing:
    """Share of held-out instructions in an evaluation."""

    held_out: Share  # share of an evaluation's episodes, 0…1

    def __call__(self, scene: CompiledScene, random_state: np.random.RandomState) -> dict[str, Any]:
        """Set the share; the task draws from its own stream."""
        scene.held_out = self.held_out
        return {"held_out": self.held_out}


@dataclass(frozen=True)
class TargetChoice:
    """Choice of another target block than the unmodified episode has, in the same scene."""

    skip: Natural  # number of blocks to skip in the order of naming

    def __call__(self, scene: CompiledScene, random_state: np.random.RandomState) -> dict[str, Any]:
        """Set the number; nothing is drawn."""
        scene.skip = self.skip
        return {"skip": self.skip}
