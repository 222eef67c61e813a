"""Instructions: a grammar of phrasings and synonyms, part of which is held out from training."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from string import Formatter
from typing import Annotated, Literal

import numpy as np
from annotated_types import MaxLen, MinLen

from vla.io.errors import UserError
from vla.tasks.tabletop.scene import ColourName

Phrasings = Annotated[Sequence[Annotated[str, MaxLen(300)]], MinLen(1)]
Words = Annotated[Sequence[Annotated[str, MinLen(1), MaxLen(60)]], MinLen(1)]

HeldOutKind = Literal["words", "phrasings", "combinations"]


@dataclass(eq=False)
class Grammar:
    """Phrasings with slots: the goal fills {block}, a random synonym fills {put}.

    Held out from training, for evaluation only: some synonyms, some phrasings, and some colours of the named block
    (UserError: a held-out part replaces nothing or overlaps with training, or a slot is malformed).
    """

    phrasings: Phrasings
    words: Mapping[str, Words]  # slot → synonyms
    held_out_phrasings: Phrasings
    held_out_words: Mapping[str, Words]  # slot → synonyms
    held_out_colours: Sequence[ColourName]

    def __post_init__(self) -> None:
        words, held_out = self.words, self.held_out_words
        overlap = {*self.phrasings} & {*self.held_out_phrasings}
        overlap |= {word for slot, terms in held_out.items() for word in terms if word in words.get(slot, ())}
        if overlap:
            raise UserError(f"task.goal.language holds out what training also uses: {sorted(overlap)}")
        if not any(f"{{{slot}}}" in phrasing for phrasing in self.phrasings for slot in held_out):
            raise UserError("task.goal.language.held_out_words has no slot of the phrasings, so it replaces no word")
        phrasings = (*self.phrasings, *self.held_out_phrasings)
        self.slots = {slot for phrasing in phrasings for slot in _slots(phrasing)} - {*words}

    def rename(self, slots: Mapping[str, str]) -> Grammar:
        """Return the grammar with other names for some slots, old → new, which are replaced in that order."""
        grammar = copy(self)
        for old, new in slots.items():
            for name in ("phrasings", "held_out_phrasings"):
                phrasings = (phrasing.replace(f"{{{old}}}", f"{{{new}}}") for phrasing in getattr(grammar, name))
                setattr(grammar, name, tuple(phrasings))
        grammar.slots = {slots.get(slot, slot) for slot in self.slots}
        return grammar

    @property
    def held_out_kinds(self) -> tuple[HeldOutKind, ...]:
        """Kinds of held-out instructions that this grammar can generate."""
        kinds: tuple[HeldOutKind, ...] = ("words", "phrasings") if self.held_out_words else ()
        return (*kinds, "combinations") if self.held_out_colours else kinds

    def say(self, slots: Mapping[str, str], held_out: HeldOutKind | None, random_state: np.random.RandomState) -> str:
        """Draw an instruction with the goal's `slots` filled; one part of it is held out, or nothing if None."""
        phrasings = self.held_out_phrasings if held_out == "phrasings" else self.phrasings
        if held_out == "words":  # only phrasings that have a word to replace
            phrasings = tuple(text for text in phrasings if any(f"{{{slot}}}" in text for slot in self.held_out_words))
        phrasing = phrasings[random_state.randint(len(phrasings))]
        words = {**self.words, **(self.held_out_words if held_out == "words" else {})}
        fillers = {
            slot: words[slot][random_state.randint(len(words[slot]))] for slot in sorted(_slots(phrasing) & set(words))
        }
        return phrasing.format(**fillers, **slots)


class Silence(Grammar):
    """The empty instruction, of which nothing can be held out."""

    def __init__(self) -> None:
        self.phrasings = self.held_out_phrasings = ("",)
        self.words, self.held_out_words, self.held_out_colours, self.slots = {}, {}, (), set()


def _slots(phrasing: str) -> set[str]:
    try:
        fields = list(Formatter().parse(phrasing))
    except ValueError as error:
        raise UserError(f"task.goal.language: {phrasing!r} has braces that do not match: {error}") from error
    slots = {name for _, name, _, _ in fields if name is not None}
    # A field of str.format could also access attributes or pad to any width.
    if not all(name.isidentifier() for name in slots) or any(form or conversion for _, _, form, conversion in fields):
        raise UserError(f"task.goal.language: in {phrasing!r} braces hold more than the name of a slot")
    return slots
