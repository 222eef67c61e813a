"""Instructions: a grammar of phrasings and synonyms, part of which training never hears."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from string import Formatter
from typing import Annotated, Literal

import numpy as np
from annotated_types import MaxLen, MinLen

Phrasings = Annotated[Sequence[Annotated[str, MaxLen(300)]], MinLen(1)]
Words = Annotated[Sequence[Annotated[str, MinLen(1), MaxLen(60)]], MinLen(1)]

Novelty = Literal["words", "phrasings", "combinations"]


class Grammar:
    """Phrasings with slots such as {block}, which the goal fills, and {put}, which stands for any of several words.

    What is held out: words that stand for others, whole phrasings, and colours that this goal never names.
    """

    def __init__(
        self,
        phrasings: Phrasings,
        words: Mapping[str, Words],
        held_out_phrasings: Phrasings,
        held_out_words: Mapping[str, Words],
        held_out_colours: Sequence[str] = (),
    ) -> None:
        """Args: what is said in training, slot → words for it; the same for what is new; colours of blocks that are
        not named in training.

        Raises:
            ValueError: a held-out part is empty, or heard in training after all, or braces in a phrasing are not those
                of a slot.
        """
        self.phrasings, self.words = tuple(phrasings), {slot: tuple(said) for slot, said in words.items()}
        self.held_out_phrasings = tuple(held_out_phrasings)
        self.held_out_words = {slot: tuple(said) for slot, said in held_out_words.items()}
        self.held_out_colours = tuple(held_out_colours)
        leaked = set(phrasings) & set(held_out_phrasings)
        leaked |= {word for slot, said in held_out_words.items() for word in said if word in words.get(slot, ())}
        if leaked or not held_out_phrasings or not held_out_words:
            what = f"also in the part that training hears: {sorted(leaked)}" if leaked else "empty"
            raise ValueError(f"the held-out part of task.goal.language is {what}")
        self.slots = {slot for phrasing in (*phrasings, *held_out_phrasings) for slot in _slots(phrasing)} - {*words}

    @property
    def novelties(self) -> tuple[Novelty, ...]:
        """The ways in which a held-out instruction of this grammar may be new."""
        return ("words", "phrasings", "combinations") if self.held_out_colours else ("words", "phrasings")

    def say(self, slots: Mapping[str, str], novelty: Novelty | None, random_state: np.random.RandomState) -> str:
        """An instruction whose goal's slots are filled; nothing in it is new, or one thing is."""
        phrasings = self.held_out_phrasings if novelty == "phrasings" else self.phrasings
        if novelty == "words":  # only where there is a word to replace
            phrasings = tuple(one for one in phrasings if any(f"{{{slot}}}" in one for slot in self.held_out_words))
        phrasing = phrasings[random_state.randint(len(phrasings))]
        said = {**self.words, **(self.held_out_words if novelty == "words" else {})}
        chosen = {
            slot: said[slot][random_state.randint(len(said[slot]))] for slot in sorted(_slots(phrasing) & set(said))
        }
        return phrasing.format(**chosen, **slots)


def _slots(phrasing: str) -> set[str]:
    try:
        fields = list(Formatter().parse(phrasing))
    except ValueError as error:
        raise ValueError(f"task.goal.language: {phrasing!r} has braces that do not match: {error}") from error
    slots = {name for _, name, _, _ in fields if name is not None}
    # A field of str.format may also reach into attributes and pad without bound.
    if not all(name.isidentifier() for name in slots) or any(form or turned for _, _, form, turned in fields):
        raise ValueError(f"task.goal.language: in {phrasing!r} braces hold more than the name of a slot")
    return slots
