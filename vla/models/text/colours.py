"""N-grams of sentences in which names of colours are replaced by basic terms."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache, lru_cache

import numpy as np
from torch import Tensor

from vla.models.text.ngrams import NGrams, words_of

# The basic colour terms of English (Berlin and Kay, Basic Color Terms, 1969).
TERMS = ("black", "white", "grey", "red", "green", "yellow", "blue", "brown", "orange", "pink", "purple")


class NamedColours(NGrams):
    """N-grams of sentences whose colour names are replaced by basic colour terms: crimson by red.

    The mapping is not learned but comes from a survey, see `terms`; it covers names that training does not contain.
    """

    def tokenize(self, sentences: list[str]) -> Tensor:
        """Return (B, L) int64 hashes of the n-grams of B sentences in basic terms, padded with 0."""
        return super().tokenize([simplified(sentence) for sentence in sentences])


@lru_cache(4096)
def simplified(sentence: str) -> str:
    """Return the words of a sentence in lower case, with names of colours in basic terms."""
    return " ".join(in_basic_terms(words_of(sentence)))


def in_basic_terms(words: Sequence[str]) -> list[str]:
    """Replace each name of a colour, of one or several words, by a basic term: navy blue by blue, crimson by red.

    A name directly after another one is the thing that has the colour, and stays: "jade brick" becomes "green brick".

    Args:
        words: words of a sentence in lower case.
    """
    known, found = terms(), list[str]()
    longest = max(len(name.split()) for name in known)
    start, replaced = 0, False
    while start < len(words):
        ahead = [" ".join(words[start : start + length]) for length in range(longest, 0, -1)]
        name = next((name for name in ahead if name in known), None)
        replaced = name is not None and not replaced  # a name after a name is a thing
        found.append(known[name] if name and replaced else words[start])
        start += len(name.split()) if name and replaced else 1
    return found


@cache
def terms() -> dict[str, str]:
    """Return name of a colour → basic term, for the names of the xkcd colour survey (xkcd.com/color/rgb).

    A name that contains exactly one basic term, as its last word, such as "sky blue", maps to this term. Any other name
    maps to the term of the nearest such name in sRGB.
    """
    from matplotlib.colors import XKCD_COLORS, to_rgb

    colours = {name.removeprefix("xkcd:"): np.array(to_rgb(value)) for name, value in XKCD_COLORS.items()}
    sure = [name for name in colours if name.split()[-1] in TERMS and sum(word in TERMS for word in name.split()) == 1]
    places = np.array([colours[name] for name in sure])
    nearest = {name: sure[np.linalg.norm(places - colour, axis=1).argmin()] for name, colour in colours.items()}
    return {name: (name if name in sure else near).split()[-1] for name, near in nearest.items()}
