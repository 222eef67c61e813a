"""What was randomised, as factors over which success is compared."""

from __future__ import annotations

from typing import Any

from vla.reports.factors import association, factors, groups
from vla.rollouts.results import Result


def episode(seed: int, blocks: int, good: bool) -> Result:
    """One with so many blocks, in a row."""
    draws: dict[str, Any] = {
        "placement": {"blocks": [[0.1 * seed, 0.1 * number] for number in range(blocks)]},
        "mass": {"factor": [seed + 0.5 * number for number in range(blocks)]},
        "arm": {"tcp": [0.1, 0.2, 0.1 * seed]},
    }
    return Result(seed, "success" if good else "dropped", draws=draws)


def test_items_and_points_that_all_episodes_have_are_factors() -> None:
    found = factors([episode(seed, 3 + seed % 2, True) for seed in range(8)])
    names = [f"{list_}[{number}]" for list_ in ("placement.blocks", "mass.factor") for number in range(3)]
    assert [*found] == [*names, "arm.tcp[2]"]
    assert found["mass.factor[1]"] == [seed + 0.5 for seed in range(8)]
    assert found["placement.blocks[2]"][1] == (0.1, 0.2)


def test_what_success_depends_on_is_associated_with_it() -> None:
    played = [episode(seed, 4, good=seed >= 10) for seed in range(20)]
    found = factors(played)
    assert [len(group) for group in groups(found["mass.factor[0]"])] == [4] * 5
    assert association(found["mass.factor[0]"], played) > 3
    assert association(["a", "b"] * 10, played) == 0


def test_a_draw_under_two_names_is_one_factor() -> None:
    draws: list[dict[str, Any]] = [{"pad": [0.1 * n, 0.2], "pads": [[0.1 * n, 0.2], [0.3, 0.1 * n]]} for n in range(8)]
    found = factors([Result(seed, "success", draws=each) for seed, each in enumerate(draws)])
    assert set(found) == {"pad", "pads[1]"}


def test_words_that_all_differ_are_each_compared_with_few_others() -> None:
    class Word(str):
        compared = 0
        __hash__ = str.__hash__

        def __eq__(self, other: object) -> bool:
            Word.compared += 1
            return str.__eq__(self, other)

    words = [Word(number % 1000) for number in range(2000)]
    assert sorted(groups(words)) == [[number, number + 1000] for number in range(1000)]
    assert Word.compared < 20_000
