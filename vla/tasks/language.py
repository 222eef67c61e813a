"""Instructions: a grammar of phrasings and synonyms, part of which training never hears."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np

Novelty = Literal["words", "phrasings", "combinations"]


class Grammar:
    """Phrasings with slots such as {block}, which the goal fills, and {put}, which stands for any of several words.

    What is held out: words that stand for others, whole phrasings, and colours that this goal never names.
    """

    def __init__(
        self,
        phrasings: Sequence[str],
        words: Mapping[str, Sequence[str]],
        held_out_phrasings: Sequence[str],
        held_out_words: Mapping[str, Sequence[str]],
        held_out_colours: Sequence[str] = (),
    ) -> None:
        """Args: what is said in training, slot → words for it; the same for what is new; colours of blocks that are
        not named in training.

        Raises:
            ValueError: a held-out part is empty, or heard in training after all.
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
    return set(re.findall(r"{(\w+)}", phrasing))
