"""Randomizers of instructions."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from annotated_types import MinLen

from vla.io.errors import UserError
from vla.io.types import Natural, Share
from vla.tasks.tabletop.compiled_scene import CompiledScene
from vla.tasks.tabletop.language import Words


@dataclass(frozen=True)
class Phrasing:
    """Share of held-out instructions in an evaluation."""

    held_out: Share  # share of an evaluation's episodes, 0…1

    def __call__(self, scene: CompiledScene, random_state: np.random.RandomState) -> dict[str, Any]:
        """Set the share; the task draws from its own stream."""
        scene.held_out = self.held_out
        return {"held_out": self.held_out}


@dataclass(frozen=True)
class Paraphrase:
    """Other words for the blocks and pads that an instruction of an evaluation names."""

    words: Annotated[Mapping[str, Words], MinLen(1)]  # phrase of an instruction → phrases to draw from in its place

    def __call__(self, scene: CompiledScene, random_state: np.random.RandomState) -> dict[str, Any]:
        """Draw a replacement for every phrase, whether the instruction has it or not."""
        scene.paraphrases = {phrase: others[random_state.randint(len(others))] for phrase, others in self.words.items()}
        return {"held_out": 1.0}


@dataclass(frozen=True)
class TargetChoice:
    """Choice of another target block than the unmodified episode has, in the same scene."""

    skip: Natural  # number of blocks to skip in the order of naming

    def __call__(self, scene: CompiledScene, random_state: np.random.RandomState) -> dict[str, Any]:
        """Set the number; nothing is drawn."""
        scene.skip = self.skip
        return {"skip": self.skip}


def paraphrase(instruction: str, words: Mapping[str, str], names: Iterable[str]) -> str:
    """Replace phrases of an instruction, the longest first, so that none of the `names` remains.

    Args:
        words: phrase → what replaces it.
        names: what the instruction names, such as colours.

    Raises:
        UserError: nothing is replaced, or a name remains.
    """
    phrases = sorted(words, key=len, reverse=True)
    replaced = re.sub(rf"\b({'|'.join(map(re.escape, phrases))})\b", lambda found: words[found[0]], instruction)
    if replaced == instruction or set(names) & set(re.findall(r"\w+", replaced)):
        raise UserError(f"task.randomize.phrasing.words has no other words for all that is named in {instruction!r}")
    return replaced
