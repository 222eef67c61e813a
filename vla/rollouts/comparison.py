"""Differences of success and of other amounts: exact tests, intervals, and the adjustment for several comparisons."""

from __future__ import annotations

from bisect import bisect
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import hypot, sqrt
from typing import NamedTuple, TypeVar

import numpy as np

from vla.rollouts.sequential import LEVEL, anytime_difference, anytime_p
from vla.rollouts.statistics import wilson_interval
from vla.spec import Array

Key = TypeVar("Key")
Amounts = Sequence[float] | Array


class Pairs(NamedTuple):
    """Numbers of episodes with the same seed, by the outcomes of two policies, or of one under two conditions."""

    both: int  # succeeded
    first: int  # succeeded alone
    second: int  # succeeded alone
    neither: int  # succeeded


@dataclass(frozen=True)
class Comparison:
    """Second policy or condition minus the first: the success rate, or the median difference of an amount."""

    difference: float  # a rate's is from -1 to 1
    ci_low: float  # of its 95 % confidence interval
    ci_high: float
    p: float  # two-sided, for equal rates, or for a median difference of zero
    episodes: int  # number of pairs; without pairs, of all episodes
    only_first: int | None = None  # pairs in which only the first succeeded, or had more; None without pairs
    only_second: int | None = None
    p_holm: float | None = None  # adjusted for all comparisons made together, see `concluded`
    verdict: str = ""

    def conclude(self, p_holm: float, margin: float | None) -> Comparison:
        """Return a copy with an adjusted p-value and a verdict: a difference, none worse than `margin`, or neither.

        Not worse than a margin means that the lower end of the interval is above it (the test of non-inferiority at
        2.5 %, not adjusted for the number of comparisons). Without a margin a difference is neither better nor worse.
        """
        if margin is None:
            more = (self.only_second or 0) > (self.only_first or 0)  # the median may be 0
            verdict = "open" if p_holm > LEVEL else "more" if more else "less"
            return replace(self, p_holm=p_holm, verdict=verdict)
        points, bounded = f"{100 * margin:g} points", self.ci_low > -margin
        if p_holm > LEVEL:
            verdict = f"not worse by {points}" if bounded else "open"
        elif self.difference > 0:
            verdict = "better"
        else:
            verdict = f"worse, by less than {points}" if bounded else "worse"
        return replace(self, p_holm=p_holm, verdict=verdict)


def compare_pairs(pairs: Pairs, anytime: bool = False) -> Comparison:
    """Compare success in pairs of episodes: McNemar's exact test and Newcombe's interval.

    With `anytime` both are valid whatever the reason to stop playing, see `vla.rollouts.sequential`.
    """
    played = sum(pairs)
    difference = (pairs.second - pairs.first) / max(played, 1)
    if anytime:
        low, high = anytime_difference(pairs.first, pairs.second, played)
        p = anytime_p(pairs.first, pairs.second)
    else:
        low, high = newcombe_paired(pairs)
        p = mcnemar(pairs.first, pairs.second)
    return Comparison(difference, low, high, p, played, pairs.first, pairs.second)


def compare_samples(won_first: float, first: float, won_second: float, second: float) -> Comparison:
    """Compare success in different episodes, `first` and `second` of them: Fisher's exact test, Newcombe's interval.

    Effective numbers of episodes need not be whole; the test rounds them.
    """
    low, high = newcombe(won_first, first, won_second, second)
    p = fisher(*(round(number) for number in (won_first, first, won_second, second)))
    return Comparison(won_second / second - won_first / first, low, high, p, round(first + second))


def compare_amounts(first: Amounts, second: Amounts, anytime: bool = False) -> Comparison | None:
    """Compare an amount in pairs of episodes: the median difference, its interval, and the exact sign test.

    The sign test is McNemar's with "had more" for "succeeded alone"; pairs without a difference do not count in it. It
    assumes nothing about the distribution. With `anytime` it is valid whatever the reason to stop playing.

    Args:
        first: amounts of the first policy or condition.
        second: those of the second one in the same episodes.

    Returns:
        None if there are too few pairs to find any difference.
    """
    differences = np.subtract(second, first)
    if (interval := median_interval(differences, anytime)) is None:
        return None
    less, more = int((differences < 0).sum()), int((differences > 0).sum())
    p = (anytime_p if anytime else mcnemar)(less, more)
    return Comparison(float(np.median(differences)), *interval, p, len(differences), less, more)


def median_interval(values: Amounts, anytime: bool = False) -> tuple[float, float] | None:
    """Return the 95 % confidence interval of the median, between two of the values; None with too few of them.

    It contains the medians that the sign test does not exclude (W. R. Thompson, "On confidence ranges for the median
    and other expectation distributions", Annals of Mathematical Statistics 7, 1936).
    """
    ordered, test = np.sort(values), anytime_p if anytime else mcnemar
    count = len(ordered)
    outside = bisect(range(count // 2 + 1), LEVEL, key=lambda below: test(below, count - below))
    return (float(ordered[outside - 1]), float(ordered[-outside])) if outside else None


def concluded(comparisons: Mapping[Key, Comparison], margin: float | None) -> dict[Key, Comparison]:
    """Return the comparisons with verdicts that together find a false difference with a probability of at most 5 %.

    S. Holm, "A simple sequentially rejective multiple test procedure", Scandinavian Journal of Statistics 6 (1979).
    Pairs that never differ cannot give a small p-value, so they do not count (R. E. Tarone, "A modified Bonferroni
    method for discrete data", Biometrics 46, 1990).

    Args:
        comparisons: those made together.
        margin: non-inferiority margin of the success rate, 0…1; None if it is not about success.
    """
    left = sum(
        each.only_first is None or each.only_first + (each.only_second or 0) > 0 for each in comparisons.values()
    )
    found, largest = {}, 0.0
    for key, each in sorted(comparisons.items(), key=lambda item: item[1].p):
        largest = max(largest, min(1.0, max(left, 1) * each.p))
        found[key] = each.conclude(largest, margin)
        left -= 1
    return {key: found[key] for key in comparisons}


def mcnemar(lost: int, won: int) -> float:
    """Return the two-sided exact p-value for equal success rates, given the numbers of discordant pairs.

    Under the null hypothesis both kinds of pairs are equally likely (Q. McNemar, "Note on the sampling error of
    the difference between correlated proportions or percentages", Psychometrika 12, 1947).
    """
    from scipy.special import bdtr  # the binomial distribution; importing scipy.stats takes a second

    return min(1.0, 2 * float(bdtr(min(lost, won), lost + won, 0.5)))


def fisher(won_first: int, first: int, won_second: int, second: int) -> float:
    """Return the two-sided p-value of Fisher's exact test for equal success rates: twice that of the smaller tail."""
    from scipy.stats import hypergeom  # the import takes a second

    given = hypergeom(first + second, won_first + won_second, second)
    return float(min(1.0, 2 * given.cdf(won_second), 2 * given.sf(won_second - 1)))


def newcombe(won_first: float, first: float, won_second: float, second: float) -> tuple[float, float]:
    """Return the 95 % confidence interval of the second rate minus the first, of different episodes.

    R. G. Newcombe, "Interval estimation for the difference between independent proportions: comparison of eleven
    methods", Statistics in Medicine 17 (1998), 873-890, method 10: it combines Wilson's intervals of both rates.
    """
    (low, high), (below, above) = wilson_interval(won_first, first), wilson_interval(won_second, second)
    one, two = won_first / first, won_second / second
    return two - one - hypot(two - below, high - one), two - one + hypot(above - two, one - low)


def newcombe_paired(pairs: Pairs) -> tuple[float, float]:
    """Return the 95 % confidence interval of the second rate minus the first, of pairs; (-1, 1) without any.

    R. G. Newcombe, "Improved confidence intervals for the difference between binomial proportions based on paired
    data", Statistics in Medicine 17 (1998), 2635-2650, method 10: it combines Wilson's intervals of both rates with the
    correlation of the pairs, whose numerator has a continuity correction.
    """
    played = sum(pairs)
    if played == 0:
        return -1.0, 1.0
    both, first, second, neither = pairs
    one, two = (both + first) / played, (both + second) / played
    (low, high), (below, above) = wilson_interval(both + first, played), wilson_interval(both + second, played)
    product = (both + first) * (second + neither) * (both + second) * (first + neither)
    apart = both * neither - first * second
    correlation = (max(apart - played / 2, 0.0) if apart > 0 else apart) / sqrt(product) if product else 0.0

    def reach(one: float, two: float) -> float:
        return sqrt(max(one**2 - 2 * correlation * one * two + two**2, 0.0))

    return two - one - reach(two - below, high - one), two - one + reach(above - two, one - low)
