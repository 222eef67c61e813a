"""What evaluation and preview leave behind."""

from __future__ import annotations

import json
import warnings
from pathlib import Path

import numpy as np
import pytest
from figures import bars
from matplotlib.figure import Figure
from PIL import Image
from toy import ToyEnvironment
from toy_recordable import make_environment

from vla.reports.evaluation import plot_report, write_report
from vla.reports.factors import factors
from vla.reports.observations import draws_table, reset_panels
from vla.reports.pictures import save, svgs
from vla.rollouts.results import Report, Result
from vla.rollouts.statistics import wilson_interval
from vla.spec import FIRST_SEED


def a_report(episodes: int = 60) -> Report:
    random = np.random.default_rng(0)
    results = []
    for index in range(episodes):
        place, colour = random.uniform(-1, 1, 2).tolist(), str(random.choice(["red", "blue"]))
        draws = {"placement": {"block": place, "sizes": random.uniform(0, 1, 3).tolist()}, "colour": colour}
        outcome = "success" if place[0] > 0 else "missed_grasp"
        results.append(Result(FIRST_SEED + index, outcome, f"lift the {colour} block", 10 + index % 7, draws))
    return Report((*results, Result(FIRST_SEED + episodes, "error", error="ValueError: broken")))


def test_report_json_tells_everything(tmp_path: Path) -> None:
    report, path = a_report(), tmp_path / "report.json"
    write_report(report, path, "runs/best.ckpt", {"model": {"width": 16}})
    content = json.loads(path.read_text(encoding="utf-8"))
    assert content["success"] == report.successes / 60
    assert (content["episodes"], content["successes"], content["errors"]) == (60, report.successes, 1)
    assert (content["ci_low"], content["ci_high"]) == wilson_interval(report.successes, 60)
    assert content["seeds"] == list(range(FIRST_SEED, FIRST_SEED + 61))
    assert content["outcome_counts"] == {**report.outcome_counts}
    assert (content["checkpoint"], content["config"]) == ("runs/best.ckpt", {"model": {"width": 16}})
    assert content["per_episode"][0]["draws"] == report.results[0].draws
    assert content["per_episode"][-1]["error"] == "ValueError: broken"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("report", [a_report(), a_report(1), a_report(0)], ids=["sixty", "one", "none"])
def test_plots_are_drawn_whatever_happened(report: Report, tmp_path: Path, figures: list[Figure]) -> None:
    plot_report(report, tmp_path / "report.png")
    outcomes, lengths, *others = figures[0].axes
    assert bars(outcomes) == [*report.outcome_counts.values()]
    played = [result for result in report.results if result.outcome != "error"]
    # Stacked: those of the failures stand on those of the successes.
    tops = [bar.get_y() + bar.get_height() for bar in lengths.patches]  # type: ignore[attr-defined]
    assert max(tops) > 0 if played else not any(tops)
    assert bool(others) == (len(played) > 1)
    assert all(axes.has_data() and axes.get_title() in factors(played) for axes in others)
    assert Image.open(tmp_path / "report.png").width > 700


def test_rates_share_a_scale_that_shows_their_intervals(tmp_path: Path, figures: list[Figure]) -> None:
    mass = np.random.default_rng(0).uniform(0.5, 2, 1000).tolist()
    played = [
        Result(FIRST_SEED + index, "success" if index % 50 else "dropped", draws={"mass": factor, "even": index % 2})
        for index, factor in enumerate(mass)
    ]
    plot_report(Report(tuple(played)), tmp_path / "report.png")
    panels = figures[0].axes[2:]
    lowest = min(axes.dataLim.y0 for axes in panels)
    assert len(panels) == 2 and 0.9 < lowest < 0.96  # 20 of 500 in one half, whose interval begins at 94 %
    assert {axes.get_ylim() for axes in panels} == {(0.9, 1.0)}


def test_equal_lengths_have_one_tick(tmp_path: Path, figures: list[Figure]) -> None:
    plot_report(Report((Result(FIRST_SEED, "success", steps=100),)), tmp_path / "report.png")
    low, high = figures[0].axes[1].get_xlim()
    assert [tick for tick in figures[0].axes[1].get_xticks() if low <= tick <= high] == [100]


def test_success_without_a_failure_depends_on_nothing(tmp_path: Path, figures: list[Figure]) -> None:
    played = [Result(FIRST_SEED + index, "success", draws={"even": index % 2}) for index in range(20)]
    plot_report(Report(tuple(played)), tmp_path / "report.png")
    assert len(figures[0].axes) == 2


def test_texts_of_a_page_are_left_to_the_fonts_of_the_browser(tmp_path: Path) -> None:
    chinese = "拿起红色方块"
    assert f">{chinese}<" in svgs({"": lambda axes: axes.text(0, 0, chinese)})[""]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        save(tmp_path / "title.png", {chinese: lambda axes: axes.axis("off")}, 1)


@pytest.mark.parametrize("environment", [make_environment(), ToyEnvironment()], ids=["depth", "colour alone"])
def test_a_contact_sheet_shows_the_observations(
    environment: ToyEnvironment, tmp_path: Path, figures: list[Figure]
) -> None:
    seeds = [FIRST_SEED, FIRST_SEED + 1, FIRST_SEED + 2]
    observations = [environment.reset(seed) for seed in seeds]
    save(tmp_path / "sheet.png", reset_panels(seeds, observations), 2)
    for seed, seen, axes in zip(seeds, observations, figures[0].axes, strict=True):
        assert axes.get_title() == f"seed {seed}: {seen.instruction}"
        shown = np.asarray(axes.images[0].get_array())
        images = np.concatenate([*seen.rgb.values()], axis=1)
        assert np.array_equal(shown[:, : images.shape[1]], images)
        assert (shown.shape[1] > images.shape[1]) == bool(seen.depth)


def test_draws_table_tells_ranges_and_words() -> None:
    draws = [
        {"light": {"tint": [0.1, 0.2]}, "colour": "red", "blocks": 3},
        {"light": {"tint": [0.5, 0.3]}, "colour": "blue", "blocks": 2},
    ]
    rows = {name: (seen, first) for name, seen, first in draws_table([7, 8], draws).rows}
    assert rows == {
        "light.tint": ("0.1 … 0.5", "0.1 0.2"),
        "colour": ("blue, red", "red"),
        "blocks": ("2 … 3", "3"),
    }


def test_a_picture_of_thousands_of_rows_is_no_longer_than_can_be_drawn(tmp_path: Path) -> None:
    save(tmp_path / "sweep.png", {"success": lambda axes: None}, 1, (1, 700))
    with Image.open(tmp_path / "sweep.png") as picture:
        assert picture.height <= 2**16
