"""Randomizers of the instruction, and of events in the course of an episode."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from annotated_types import MinLen, Predicate

from vla.io.errors import UserError
from vla.io.types import Natural, NaturalRange, Share, unique
from vla.tasks.tabletop.compiled_scene import CompiledScene, Disturbance, Kind
from vla.tasks.tabletop.language import Words
from vla.tasks.tabletop.randomize.randomizer import Lengths, Places


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
    """Other words for the blocks and pads that are named in the instructions of an evaluation."""

    words: Annotated[Mapping[str, Words], MinLen(1)]  # phrase of an instruction → phrases to draw from in its place

    def __call__(self, scene: CompiledScene, random_state: np.random.RandomState) -> dict[str, Any]:
        """Draw a replacement for every phrase, whether the instruction has it or not."""
        scene.paraphrases = {phrase: values[random_state.randint(len(values))] for phrase, values in self.words.items()}
        return {"held_out": 1.0}


@dataclass(frozen=True)
class TargetChoice:
    """Choice of a target block other than that of the unmodified episode, in the same scene."""

    skip: Natural  # number of blocks to skip in the order of naming

    def __call__(self, scene: CompiledScene, random_state: np.random.RandomState) -> dict[str, Any]:
        """Set the number; nothing is drawn."""
        scene.skip = self.skip
        return {"skip": self.skip}


def paraphrase(instruction: str, words: Mapping[str, str], names: Iterable[str]) -> str:
    """Replace phrases of an instruction by their `words`, the longest first, so that none of the `names`, such as
    colours, remains (UserError: nothing is replaced, or a name remains)."""
    phrases = sorted(words, key=len, reverse=True)
    sentence = re.sub(rf"\b({'|'.join(map(re.escape, phrases))})\b", lambda match: words[match[0]], instruction)
    if sentence == instruction or set(names) & set(re.findall(r"\w+", sentence)):
        raise UserError(f"task.randomize.phrasing.words must replace everything that is named in {instruction!r}")
    return sentence


@dataclass(frozen=True)
class Disturbances:
    """Pushes of the arm, drops of the held block, and moves of the block or its destination, one kind per episode."""

    kinds: Annotated[Sequence[Kind], MinLen(1), Predicate(unique)]  # to draw from
    times: NaturalRange  # range of the number of disturbances in an episode
    start: NaturalRange  # range of the number of control steps before a push, not counting the first step
    delay: NaturalRange  # the same for other kinds: steps whose preconditions hold before the disturbance happens
    push: Lengths  # range of the distance by which the arm is pushed [m]
    move: Lengths  # range of the distance by which an object is moved [m]
    x: Places  # area of the table in which a push or a move ends [m]
    y: Places

    def __call__(self, scene: CompiledScene, random_state: np.random.RandomState) -> dict[str, Any]:
        """Draw kind, number, time, distance and direction; whether it happens also depends on the agent."""
        # Every level draws the same random numbers.
        kind_share, times, delay, distance, angle = random_state.uniform(size=5).tolist()
        kind = self.kinds[int(kind_share * len(self.kinds))]
        number = _integer_at(self.times, times)
        if number == 0:
            return {"kind": "none", "times": 0, "delay": 0, "distance": 0.0, "angle": 0.0}
        low, high = {"drop": (0.0, 0.0), "push": self.push}.get(kind, self.move)
        values = {
            "kind": kind,
            "times": number,
            "delay": _integer_at(self.start if kind == "push" else self.delay, delay),
            "distance": round(low + distance * (high - low), 5),
            "angle": round(2 * math.pi * angle, 5),
        }
        low_corner, high_corner = zip(self.x, self.y, strict=True)
        scene.disturbance = Disturbance(**values, low=low_corner, high=high_corner)
        return values


def _integer_at(bounds: tuple[int, int], share: float) -> int:
    """Return the integer at a share [0, 1) of a range, both ends included."""
    low, high = bounds
    return low + int(share * (high - low + 1))
