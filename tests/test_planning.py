"""How many episodes are needed: powers against the enumeration of all outcomes, and what the command prints."""

from __future__ import annotations

import itertools
import json
from pathlib import Path

import numpy as np
import pytest
from command_line import here
from finished_runs import a_run
from rich import get_console
from scipy.stats import binom, multinomial

from vla.jobs.plan import _percent
from vla.rollouts.comparison import fisher, mcnemar
from vla.rollouts.planning import (
    MAX_EPISODES,
    episodes_needed,
    power_for_bar,
    power_of_pairs,
    power_of_samples,
    stopping,
)
from vla.rollouts.sequential import excludes
from vla.rollouts.statistics import wilson_interval


@pytest.mark.parametrize(("rate", "bar"), [(0.9, 0.6), (0.6, 0.8), (0.5, 0.2)])
def test_the_power_for_a_bar_is_that_of_wilsons_interval(rate: float, bar: float) -> None:
    for episodes in (7, 30):
        intervals = [wilson_interval(won, episodes) for won in range(episodes + 1)]
        found = [won for won, (low, high) in enumerate(intervals) if (low > bar if rate > bar else high < bar)]
        assert power_for_bar(episodes, rate, bar) == pytest.approx(binom.pmf(found, episodes, rate).sum())


@pytest.mark.parametrize(("discordant", "difference"), [(0.5, 0.3), (0.4, -0.4), (0.9, 0.1)])
def test_the_power_of_pairs_is_that_of_mcnemars_test(discordant: float, difference: float) -> None:
    lost, won = (discordant - abs(difference)) / 2, (discordant + abs(difference)) / 2
    for episodes in (6, 21):
        power = sum(
            multinomial.pmf([one, other, episodes - one - other], episodes, [lost, won, 1 - discordant])
            for one, other in itertools.product(range(episodes + 1), repeat=2)
            if one + other <= episodes and one < other and mcnemar(one, other) <= 0.05
        )
        assert power_of_pairs(episodes, discordant, difference) == pytest.approx(power)


@pytest.mark.parametrize(("one", "other"), [(0.4, 0.9), (0.8, 0.6)])
def test_the_power_of_different_episodes_is_that_of_fishers_test(one: float, other: float) -> None:
    for episodes in (5, 18):
        power = sum(
            binom.pmf(a, episodes, min(one, other)) * binom.pmf(b, episodes, max(one, other))
            for a, b in itertools.product(range(episodes + 1), repeat=2)
            if a < b and fisher(a, episodes, b, episodes) <= 0.05
        )
        assert power_of_samples(episodes, one, other) == pytest.approx(power)


def test_the_number_is_where_the_power_is_reached() -> None:
    needed = episodes_needed(lambda episodes: power_of_pairs(episodes, 0.04, 0.02), 0.8)
    assert needed is not None
    assert power_of_pairs(needed - 1, 0.04, 0.02) < 0.8 <= power_of_pairs(needed, 0.04, 0.02)
    # Of the test without continuity correction (R. J. Connor, Biometrics 43, 1987):
    # (1.960 √0.04 + 0.8416 √(0.04 - 0.02²))² / 0.02² = 781; the exact test needs more.
    assert 781 < needed < 1.1 * 781
    assert episodes_needed(lambda episodes: 0.5, 0.8) is None
    assert episodes_needed(lambda episodes: float(episodes >= 150_000), 0.8) == 150_000
    assert episodes_needed(lambda episodes: float(episodes > MAX_EPISODES), 0.8) is None


def test_stopping_rarely_errs_and_is_early_where_the_difference_is_large() -> None:
    for lost, won, larger in ((0.02, 0.1, 0.2), (0.2, 0.4, 0.6)):
        fixed = episodes_needed(lambda n, lost=lost, won=won: power_of_pairs(n, lost + won, won - lost), 0.8)
        assert fixed is not None
        stops, early = stopping(0.5, won, lost, 0.8, fixed), stopping(0.5, larger, lost, 0.8, fixed)
        assert stops is not None and early is not None
        assert stops.mean < 1.1 * fixed < stops.max_episodes < 2.5 * fixed and early.mean < 0.5 * fixed
        assert 0.005 < stops.type_1_error < 0.05
    assert stopping(0.5, 0.11, 0.1, 0.99, 10) is None


def test_stopping_is_as_late_as_in_simulated_evaluations() -> None:
    random, (lost, won) = np.random.default_rng(0), (0.2, 0.6)
    stops = stopping(0.5, won, lost, 0.8, 50)
    assert stops is not None
    ended = []
    for _ in range(300):
        drawn = random.random(stops.max_episodes)
        counts = np.cumsum(drawn < won), np.cumsum(drawn > 1 - lost)
        decided = [n for n, (ones, zeros) in enumerate(zip(*counts, strict=True), 1) if excludes(0.5, ones, zeros)]
        ended.append(decided[0] if decided else np.inf)
    assert np.mean(np.isfinite(ended)) == pytest.approx(0.8, abs=0.08)
    assert np.minimum(ended, stops.max_episodes).mean() == pytest.approx(stops.mean, rel=0.08)


def test_a_rate_below_one_is_not_rounded_to_it() -> None:
    assert [_percent(rate) for rate in (0.9995, 0.97, 0.97 - 0.95)] == ["99.95 %", "97 %", "2 %"]


def test_the_command_prints_a_row_per_design(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, outcomes in (("one", "s" * 40 + "d" * 10), ("other", "s" * 37 + "d" * 2 + "s" * 11)):
        a_run(tmp_path / name, outcomes)
    where = ("job=plan", "output=planned", "hydra.run.dir=planned", "plan.rates=[0.8,0.95]")
    monkeypatch.setattr(get_console(), "width", 140)  # so that no cell is broken into lines
    told = here(tmp_path, *where, "plan.runs=[one,other]").stdout
    fixed = episodes_needed(lambda episodes: power_of_pairs(episodes, 12 / 50, 0.15), 0.8)
    for words in ("a bar of 80 %", "different episodes", "24 % differ", f" {fixed} "):
        assert words in " ".join(told.split()), words
    assert json.loads((tmp_path / "one/report.json").read_text())["successes"] == 40
    assert "2 % differ" in " ".join(here(tmp_path, *where[:3], "plan.discordant=0.02").stdout.split())  # the least
    both = here(tmp_path, *where, "plan.runs=[one,other]", "plan.discordant=0.2", ok=False)
    assert "plan.discordant is measured on plan.runs: omit one of the two" in both.stderr
    wrong = here(tmp_path, *where, "plan.discordant=0.1", ok=False)
    assert "differ in 15 % to 25 % of the same episodes, not in 10 %" in wrong.stderr
    assert "are equal" in here(tmp_path, *where, "plan.rates=[0.5,0.5]", ok=False).stderr
