"""One policy under many conditions."""

from __future__ import annotations

import io
from pathlib import Path

import pytest
from figures import points, spans, texts
from finished_runs import a_report
from matplotlib.figure import Figure
from PIL import Image
from rich.console import Console

from vla.reports.result_tables import conditions_table, plot_conditions
from vla.rollouts.comparison import SUCCESS, Comparison, compare_conditions
from vla.rollouts.results import Report, Result


def compared(first: str, second: str) -> Comparison:
    return compare_conditions({"seen": a_report(first), "dark": a_report(second)}, 0.02)["dark"][SUCCESS]


def test_only_pairs_that_differ_count() -> None:
    # one lost, five won: 2 · (1 + 6) / 2^6
    assert compared("1000001111", "0111111111").p == pytest.approx(14 / 64)
    assert compared("1100", "1100").p == 1.0
    assert compared("1e00", "1000").p == 1.0
    # ten lost, none won: 2 / 2^10
    assert compared("1" * 10, "0" * 10).p == pytest.approx(2 / 1024)
    told = compared("1100e", "10101")
    assert (told.difference, told.episodes, told.only_first, told.only_second) == (0, 4, 1, 1)


def test_reports_on_different_seeds_are_not_compared() -> None:
    with pytest.raises(ValueError, match="same seeds"):
        compared("11", "1")


def test_the_table_and_the_picture_show_every_condition(tmp_path: Path, figures: list[Figure]) -> None:
    hard, wide = (a_report("1" * count + "0" * (20 - count)) for count in (10, 15))
    seen = a_report("1" * 20)
    reports = {"seen": seen, "light_hard": hard, "light_wide": wide}
    console = Console(file=io.StringIO(), width=80)
    console.print(conditions_table(reports, compare_conditions(reports, 0.02)))
    told = console.file.getvalue()  # type: ignore[attr-defined]
    assert "light_hard" in told and "50.0" in told and "29.9-70.1" in told
    # ten lost, none won, and of two comparisons the clearer one counts twice
    assert "-50.0" in told and "0.0039" in told and "worse" in told
    assert told.count("pick_place") == 0 and "as in training" not in told
    console.print(conditions_table({"seen": seen, "light_hard": hard, "mass_wide": seen}, {}))
    told = console.file.getvalue().removeprefix(told)  # type: ignore[attr-defined]
    assert "the same as seen, because they change nothing in the task: mass_wide" in told and told.count("20/20") == 1
    plot_conditions(reports, tmp_path / "suite.png")
    (axes,) = figures[0].axes
    assert points(axes) == [(1.0, 0.0), (0.5, 1.0), (0.75, 2.0)]
    assert spans(axes) == [(0.839, 1.0), (0.299, 0.701), (0.531, 0.888)]
    assert {"seen", "light wide", "light hard", "success, 95 % CI"} <= texts(axes)
    assert Image.open(tmp_path / "suite.png").width > 500


def test_the_table_tells_who_obeys_and_who_stays_where_both_are_asked_for() -> None:
    played = (("pick_place", "success"), ("pick_place", "dropped"), ("stay", "success"))
    seen = Report(tuple(Result(index, outcome, task=task) for index, (task, outcome) in enumerate(played)))
    stays = Report(tuple(Result(index, "did_not_stay", task="stay") for index in range(3)))
    told = conditions_table({"seen": seen, "impossible": stays}, {}).rows
    assert [(row[0], row[2]) for row in told] == [
        ("seen", "2/3"),
        ("  pick_place", "1/2"),
        ("  stay", "1/1"),
        ("impossible", "0/3"),
    ]
