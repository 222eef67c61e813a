"""Statements that are valid whenever one stops: closed forms, how often they err, and evaluations that use them."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import toy_recordable as toy
from finished_runs import a_report
from scipy.special import betaln

from vla.parallel.pool import Cluster
from vla.rollouts.comparison import Pairs, compare_pairs
from vla.rollouts.evaluate import _Score, evaluate
from vla.rollouts.results import Report, Result
from vla.rollouts.sequential import anytime_difference, anytime_interval, anytime_p, excludes, is_decided, log_capital
from vla.rollouts.statements import BarStatement, RunStatement
from vla.rollouts.statistics import wilson_interval
from vla.spec import FIRST_SEED

SIMULATIONS, MOST = 10_000, 300
SEEDS = range(FIRST_SEED, FIRST_SEED + 60)


@pytest.mark.parametrize("mean", [0.1, 0.5, 0.95])
def test_the_capital_is_the_closed_form_of_the_beta_mixture(mean: float) -> None:
    for ones, zeros in ((0, 0), (3, 0), (30, 10), (600, 400)):
        mixture = betaln(ones + 0.5, zeros + 0.5) - betaln(0.5, 0.5)
        fair = ones * np.log(mean) + zeros * np.log(1 - mean)
        assert float(log_capital(mean, ones, zeros)) == pytest.approx(mixture - fair)


def test_the_capital_is_fair_if_the_hypothesis_holds() -> None:
    for shares in ((0.2, 0.3, 0.5), (0.1, 0.1, 0.8), (0.7, 0.2, 0.1)):  # of 1, 0 and 1/2
        mean, counts = shares[0] + shares[2] / 2, np.array([9, 4, 11])
        before = np.exp(log_capital(mean, *counts))
        after = [np.exp(log_capital(mean, *(counts + step))) for step in np.eye(3, dtype=int)]
        assert np.dot(shares, after) == pytest.approx(before)


def test_pairs_that_do_not_differ_change_no_p_value_but_narrow_the_interval() -> None:
    assert anytime_p(2, 12) == compare_pairs(Pairs(80, 2, 12, 6), anytime=True).p
    low, high = anytime_difference(2, 12, 100)
    wide, wider = anytime_difference(2, 12, 14)
    assert wide < low < 0.1 < high < wider
    assert anytime_p(0, 0) == anytime_p(5, 5) == 1 and anytime_p(0, 9) < 0.05 < anytime_p(0, 3)
    assert anytime_interval(0, 0) == (0, 1) and anytime_difference(0, 0, 0) == (-1, 1)


def test_what_is_decided_agrees_with_the_intervals() -> None:
    for won, lost in ((95, 5), (99, 1), (60, 40), (9, 1)):
        (low, high), (inner, outer) = anytime_interval(won, lost), wilson_interval(won, won + lost)
        assert low <= inner < outer <= high and excludes(0.9, won, lost) == (not low <= 0.9 <= high)
    for first, second, pairs in ((0, 5, 20), (1, 20, 100), (5, 6, 90), (5, 5, 2000), (3, 3, 400)):
        low, high = anytime_difference(first, second, pairs)
        assert is_decided(first, second, pairs, 0.03) == (not low <= 0 <= high or (low > -0.03 and high < 0.03))


@pytest.mark.parametrize("bar", [0.5, 0.9])
def test_a_bar_is_rarely_excluded_by_a_policy_that_is_at_it(bar: float) -> None:
    won = np.cumsum(np.random.default_rng(0).random((SIMULATIONS, MOST)) < bar, axis=1)
    excluded, naive = np.zeros((2, MOST + 1, MOST + 1), bool)  # by the numbers won and played
    for played in range(1, MOST + 1):
        for count in range(played + 1):
            low, high = wilson_interval(count, played)
            excluded[count, played] = excludes(bar, count, played - count)
            naive[count, played] = played >= 20 and not low <= bar <= high
    wrong, often = (table[won, np.arange(1, MOST + 1)].any(1).mean() for table in (excluded, naive))
    assert wrong <= 0.05 < 0.2 < often  # an interval for a fixed number errs if it is looked at again and again


@pytest.mark.parametrize("lost", [0.04, 0.02])
def test_policies_that_are_equal_or_a_margin_apart_are_rarely_called_otherwise(lost: float) -> None:
    won, looks = 0.04, range(50, 1501, 50)
    drawn = np.random.default_rng(0).multinomial(50, [lost, won, 1 - lost - won], (SIMULATIONS, len(looks)))
    decided, interval, wrong = cache(is_decided), cache(anytime_difference), 0
    for counts in drawn.cumsum(axis=1)[:, :, :2].tolist():
        for (one, other), pairs in zip(counts, looks, strict=True):
            if decided(one, other, pairs, 0.02):
                low, high = interval(one, other, pairs)
                wrong += not low <= won - lost <= high
                break
    assert wrong <= 0.05 * SIMULATIONS


def test_an_evaluation_stops_when_it_is_clear_whatever_the_number_of_workers() -> None:
    until = BarStatement(0.5).is_decided
    alone = evaluate(toy.make_environment, toy.make_agent, None, SEEDS, until=until)
    assert evaluate(toy.make_environment, toy.make_agent, None, SEEDS, Cluster(2, "beside"), until=until) == alone
    assert alone.anytime and [result.seed for result in alone.results] == [*SEEDS[: alone.episodes]]
    assert until(alone) and not any(until(Report(alone.results[:played])) for played in range(alone.episodes))
    assert alone.interval[0] > 0.5 and "anytime-valid 95 % CI" in str(alone)
    assert BarStatement(0.5).say(alone) == "success is above the bar of 50 %"
    everything = evaluate(toy.make_environment, toy.make_agent, None, SEEDS[:4], until=BarStatement(0.7).is_decided)
    assert everything.episodes == 4 and "open" in BarStatement(0.7).say(everything)


def test_tasks_that_take_turns_are_played_in_whole_rounds() -> None:
    report = evaluate(toy.make_environment, toy.make_agent, None, SEEDS, until=lambda report: True, turns=2)
    assert report.episodes == 2
    tiers = {"easy": ["reach", "push", "pull"], "hard": ["stack"]}
    assert replace(report, tiers=tiers).mean_over_tiers is None


@pytest.mark.parametrize(("turns", "last_gap"), [(1, 4), (3, 6)])
def test_the_more_episodes_there_are_the_more_pass_before_they_are_counted_again(turns: int, last_gap: int) -> None:
    seeds, counted = range(FIRST_SEED, FIRST_SEED + 4000), list[int]()
    results = {seed: Result(seed, "success") for seed in seeds}
    assert not _Score(seeds, results, lambda report: counted.append(len(report.results)) is not None, turns).advance()
    gaps = np.diff([0, *counted])
    assert (gaps[: 1000 // turns] == turns).all() and not (gaps % turns).any() and gaps[-1] == last_gap


def test_a_run_is_compared_on_the_episodes_that_both_played() -> None:
    other = RunStatement("A", {result.seed: result for result in a_report("0" * 12).results}, 0.02)
    assert not other.is_decided(a_report("111e11", True)) and other.is_decided(a_report("1" * 9, True))
    assert other.say(a_report("1" * 10 + "e111", True)).startswith(
        "compared with A on 11 common episodes: better, +100.0 points"
    )
    stopped, some = replace(other, anytime=True), a_report("1" * 6)
    assert ": better, " in other.say(some) and ": open, " in stopped.say(some)  # six pairs, chosen by when it stopped
    ended = replace(other, results={FIRST_SEED: a_report("0").results[0]})
    assert ended.is_decided(a_report("1", True))  # no later episode can decide
    failed = RunStatement("A", {result.seed: result for result in a_report("e" + "0" * 12).results}, 0.02)
    assert not failed.is_decided(a_report("1", True))  # the other run did not complete that episode
    failed.require_common([FIRST_SEED, FIRST_SEED + 1])
    with pytest.raises(ValueError, match="has no episode in common"):
        failed.require_common([FIRST_SEED, FIRST_SEED + 13])
    elsewhere = RunStatement("A", {FIRST_SEED: Result(FIRST_SEED, "success", "push")}, 0.02)
    assert elsewhere.say(a_report("1", True)) == "no episode in common with A"
    with pytest.raises(ValueError, match="has no episode in common"):
        elsewhere.is_decided(a_report("1", True))
    same = a_report("1").results[0]
    swapped = RunStatement("A", {FIRST_SEED: replace(same, task="goal_swap_0")}, 0.02)
    assert swapped.say(a_report("1", True)) == "no episode in common with A"  # though sentence and draws are equal
