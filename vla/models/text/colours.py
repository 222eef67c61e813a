"""Names of colours as basic colour terms: crimson is read as red, even if it never occurs in training."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np

# The basic colour terms of English (Berlin and Kay, Basic Color Terms, 1969).
TERMS = ("black", "white", "grey", "red", "green", "yellow", "blue", "brown", "orange", "pink", "purple")


def to_basic_terms(words: Sequence[str]) -> list[str]:
    """Replace each name of a colour, of one or several words, by a basic term: navy blue by blue, crimson by red.

    The mapping is not learned but comes from a survey, see `terms`; it covers names that training does not contain.
    A name directly after another one is the thing that has the colour, and stays: "jade brick" becomes "green brick".

    Args:
        words: words of a sentence in lower case.
    """
    basic_terms, result = terms(), list[str]()
    longest = max(len(name.split()) for name in basic_terms)
    start, replaced = 0, False
    while start < len(words):
        phrases = [" ".join(words[start : start + length]) for length in range(longest, 0, -1)]
        name = next((name for name in phrases if name in basic_terms), None)
        replaced = name is not None and not replaced  # a name after a name is a thing
        result.append(basic_terms[name] if name and replaced else words[start])
        start += len(name.split()) if name and replaced else 1
    return result


@cache
def terms() -> dict[str, str]:
    """Return name of a colour → basic term, for the names of the xkcd colour survey (xkcd.com/color/rgb).

    A name that contains exactly one basic term, as its last word, such as "sky blue", maps to this term. Any other name
    maps to the term of the nearest such name in sRGB.
    """
    from matplotlib.colors import XKCD_COLORS, to_rgb

    rgb = {name.removeprefix("xkcd:"): np.array(to_rgb(value)) for name, value in XKCD_COLORS.items()}
    anchors = [name for name in rgb if name.split()[-1] in TERMS and sum(word in TERMS for word in name.split()) == 1]
    places = np.array([rgb[name] for name in anchors])
    nearest = {name: anchors[np.linalg.norm(places - colour, axis=1).argmin()] for name, colour in rgb.items()}
    return {name: (name if name in anchors else anchor).split()[-1] for name, anchor in nearest.items()}
