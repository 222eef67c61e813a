"""Words of messages."""

from __future__ import annotations

import pytest

from vla.io.errors import counted


@pytest.mark.parametrize(
    ("number", "noun", "words"),
    [
        (0, "seed", "0 seeds"),
        (1, "held-out seed", "1 held-out seed"),
        (1, "batch", "1 batch"),
        (2, "batch", "2 batches"),
    ],
)
def test_a_noun_is_in_the_plural_unless_there_is_one(number: int, noun: str, words: str) -> None:
    assert counted(number, noun) == words
