"""What was randomised, as factors with names that a reader understands."""

from __future__ import annotations

from typing import Any

import pytest

from vla.reports.factors import association, factors, groups, in_words
from vla.rollouts.results import Result


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("light.ambient", "light: ambient"),
        ("camera.front.position[1]", "camera front: position 2"),
        ("colour.names[0]", "colour: name of block 1"),
        ("colour.rgb[1][2]", "colour: rgb 2, component 3"),
        ("placement.blocks[2]", "placement: block 3"),
        ("named.half_size", "named: half size"),
        ("n", "n"),
    ],
)
def test_a_draw_is_named_in_words(name: str, words: str) -> None:
    assert in_words(name, {"colour.names": "block", "placement.blocks": "block"}) == words


def episode(seed: int, blocks: int, good: bool) -> Result:
    """One with so many blocks, in a row."""
    draws: dict[str, Any] = {
        "placement": {"blocks": [[0.1 * seed, 0.1 * number] for number in range(blocks)]},
        "mass": {"factor": [seed + 0.5 * number for number in range(blocks)]},
        "arm": {"tcp": [0.1, 0.2, 0.1 * seed]},
    }
    return Result(seed, "success" if good else "dropped", draws=draws)


def test_lists_with_an_item_for_every_block_are_about_the_blocks() -> None:
    found = factors([episode(seed, 3 + seed % 2, True) for seed in range(8)])
    assert set(found) == {
        *(f"placement: block {number}" for number in (1, 2, 3)),
        *(f"mass: factor of block {number}" for number in (1, 2, 3)),
        "arm: tcp 3",
    }
    assert found["mass: factor of block 2"] == [seed + 0.5 for seed in range(8)]


def test_three_numbers_may_be_a_position_so_they_are_counted() -> None:
    found = factors([episode(seed, 3, True) for seed in range(8)])
    assert "mass: factor 1" in found and "arm: tcp 3" in found and "placement: block 3" in found


def test_of_a_colour_the_brightness_counts() -> None:
    draws = [{"table": {"rgb": [0.1 * n, 0.5, 0.9]}, "light": {"direction": [0.0, 0.2 * n, 0.5]}} for n in range(8)]
    found = factors([Result(seed, "success", draws=each) for seed, each in enumerate(draws)])
    assert set(found) == {"table: brightness", "light: direction 2"}
    assert found["table: brightness"] == pytest.approx([(0.1 * n + 1.4) / 3 for n in range(8)])


def test_what_success_depends_on_is_associated_with_it() -> None:
    played = [episode(seed, 4, good=seed >= 10) for seed in range(20)]
    found = factors(played)
    assert [len(group) for group in groups(found["mass: factor of block 1"])] == [4] * 5
    assert association(found["mass: factor of block 1"], played) > 3
    assert association(["a", "b"] * 10, played) == 0


def test_a_draw_under_two_names_is_one_factor() -> None:
    draws: list[dict[str, Any]] = [{"pad": [0.1 * n, 0.2], "pads": [[0.1 * n, 0.2], [0.3, 0.1 * n]]} for n in range(8)]
    found = factors([Result(seed, "success", draws=each) for seed, each in enumerate(draws)])
    assert set(found) == {"pad", "pad 2"}
