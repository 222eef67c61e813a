"""One policy under many conditions."""

from __future__ import annotations

import io
from pathlib import Path

import pytest
from PIL import Image
from rich.console import Console

from vla.evaluate import FIRST_SEED, Report, Result
from vla.suite import mcnemar, plot_suite, suite_table


def a_report(outcomes: str) -> Report:
    """A success for every 1, an error for every e."""
    names = {"1": "success", "0": "dropped", "e": "error"}
    return Report(tuple(Result(FIRST_SEED + index, names[outcome]) for index, outcome in enumerate(outcomes)))


def test_only_pairs_that_differ_count() -> None:
    # one lost, five won: 2 · (1 + 6) / 2^6
    assert mcnemar(a_report("1000001111"), a_report("0111111111")) == pytest.approx(14 / 64)
    assert mcnemar(a_report("1100"), a_report("1100")) == 1.0
    assert mcnemar(a_report("1e00"), a_report("1000")) == 1.0
    # ten lost, none won: 2 / 2^10
    assert mcnemar(a_report("1" * 10), a_report("0" * 10)) == pytest.approx(2 / 1024)


def test_reports_on_different_seeds_are_not_compared() -> None:
    with pytest.raises(ValueError, match="same seeds"):
        mcnemar(a_report("11"), a_report("1"))


def test_the_table_and_the_picture_show_every_condition(tmp_path: Path) -> None:
    reports = {"seen": a_report("1" * 20), "light_hard": a_report("1" * 10 + "0" * 10)}
    console = Console(file=io.StringIO(), width=100)
    console.print(suite_table(reports))
    told = console.file.getvalue()  # type: ignore[attr-defined]
    assert "light_hard" in told and "50.0" in told and "29.9-70.1" in told and "0.002" in told
    plot_suite(reports, tmp_path / "suite.png")
    assert Image.open(tmp_path / "suite.png").width > 500
