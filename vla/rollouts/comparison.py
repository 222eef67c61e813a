"""Differences in success and other metrics: exact tests, confidence intervals, adjustment for multiple comparisons."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import sqrt
from operator import attrgetter
from typing import NamedTuple, TypeVar

import numpy as np

from vla.io.errors import UserError
from vla.rollouts.motion import AMOUNTS
from vla.rollouts.results import ERROR, Report, Result
from vla.rollouts.sequential import LEVEL, anytime_difference, anytime_p
from vla.rollouts.statistics import mcnemar, median_interval, wilson_interval
from vla.spec import Array

Key = TypeVar("Key")
Amounts = Sequence[float] | Array
ResultPairs = Sequence[tuple[Result, Result]]  # of two policies, or of one under two conditions, in the same episodes

SUCCESS = "success"  # what is compared first; the others are fields of `Motion`, and milestones


class Pairs(NamedTuple):
    """Numbers of pairs of episodes, by the episodes of the pair in which an event, such as success, happened."""

    both: int  # in both
    first: int  # in the first alone
    second: int
    neither: int


@dataclass(frozen=True)
class Comparison:
    """Second policy or condition minus the first: difference in a rate, such as success, or median one in an amount."""

    difference: float  # a rate's is from -1 to 1
    ci_low: float  # of its 95 % confidence interval
    ci_high: float
    p: float  # two-sided, for equal rates, or for a median difference of zero
    episodes: int  # number of pairs; without pairs, of all episodes
    only_first: int | None = None  # pairs in which only the first succeeded, or had more; None without pairs
    only_second: int | None = None
    p_holm: float | None = None  # adjusted for all comparisons made together, see `conclude_cases`
    verdict: str = ""

    def conclude(self, p_holm: float, margin: float | None) -> Comparison:
        """Return a copy with an adjusted p-value and a verdict: a difference, no loss beyond `margin`, or neither.

        "Not worse" means that the lower end of the interval is above -`margin` (the test of non-inferiority at 2.5 %,
        not adjusted for multiple comparisons). Without a margin a difference is "more" or "less", not better or worse.
        """
        decided = p_holm <= LEVEL
        if margin is None:
            is_more = (self.only_second or 0) > (self.only_first or 0)  # the median may be 0
            return replace(self, p_holm=p_holm, verdict="open" if not decided else "more" if is_more else "less")
        points, bounded = f"{100 * margin:g} point{'' if margin == 0.01 else 's'}", self.ci_low > -margin
        if not decided:
            verdict = f"not worse by {points}" if bounded else "open"
        elif self.difference > 0:
            verdict = "better"
        else:
            verdict = f"worse, by less than {points}" if bounded else "worse"
        return replace(self, p_holm=p_holm, verdict=verdict)


def compare_pairs(pairs: Pairs, anytime: bool = False) -> Comparison:
    """Compare rates in pairs of episodes: McNemar's exact test and Newcombe's interval.

    With `anytime` both are valid whatever the reason to stop playing, see `vla.rollouts.sequential`.
    """
    _, first, second, _ = pairs
    episodes = sum(pairs)
    low, high = anytime_difference(first, second, episodes) if anytime else newcombe_paired(pairs)
    p = (anytime_p if anytime else mcnemar)(first, second)
    return Comparison((second - first) / max(episodes, 1), low, high, p, episodes, first, second)


def compare_samples(first_successes: float, first: float, second_successes: float, second: float) -> Comparison:
    """Compare success in different episodes, `first` and `second` of them: Fisher's exact test, Newcombe's interval.

    Effective numbers of episodes need not be whole; the test rounds them.
    """
    low, high = newcombe(first_successes, first, second_successes, second)
    p = fisher(*(round(number) for number in (first_successes, first, second_successes, second)))
    return Comparison(second_successes / second - first_successes / first, low, high, p, round(first + second))


def compare_amounts(first: Amounts, second: Amounts, anytime: bool = False) -> Comparison | None:
    """Compare an amount in pairs of episodes: the median difference, its interval, and the exact sign test.

    The sign test is McNemar's with "had more" for "succeeded alone"; pairs without a difference do not count in it. It
    assumes nothing about the distribution. With `anytime` it is valid whatever the reason to stop playing. Returns None
    if there are too few pairs to find any difference.
    """
    differences = np.subtract(second, first)
    if (interval := median_interval(differences, anytime)) is None:
        return None
    decreases, increases = int((differences < 0).sum()), int((differences > 0).sum())
    p = (anytime_p if anytime else mcnemar)(decreases, increases)
    return Comparison(float(np.median(differences)), *interval, p, len(differences), decreases, increases)


def fisher(first_successes: int, first: int, second_successes: int, second: int) -> float:
    """Return the two-sided p-value of Fisher's exact test for equal success rates: twice that of the smaller tail."""
    from scipy.stats import hypergeom  # the import takes a second

    distribution = hypergeom(first + second, first_successes + second_successes, second)
    return float(min(1.0, 2 * distribution.cdf(second_successes), 2 * distribution.sf(second_successes - 1)))


def newcombe(
    first_successes: float, first: float, second_successes: float, second: float, correlation: float = 0.0
) -> tuple[float, float]:
    """Return the 95 % confidence interval of the second rate minus the first; 0 is the correlation of separate samples.

    R. G. Newcombe, "Interval estimation for the difference between independent proportions: comparison of eleven
    methods", Statistics in Medicine 17 (1998), 873-890, method 10: it combines Wilson's intervals of both rates.
    """
    low_one, high_one = wilson_interval(first_successes, first)
    low_two, high_two = wilson_interval(second_successes, second)
    one, two = first_successes / first, second_successes / second

    def reach(one: float, two: float) -> float:
        return sqrt(max(one**2 - 2 * correlation * one * two + two**2, 0.0))

    return two - one - reach(two - low_two, high_one - one), two - one + reach(high_two - two, one - low_one)


def newcombe_paired(pairs: Pairs) -> tuple[float, float]:
    """Return the 95 % confidence interval of the second rate minus the first, for pairs; (-1, 1) without any.

    R. G. Newcombe, "Improved confidence intervals for the difference between binomial proportions based on paired
    data", Statistics in Medicine 17 (1998), 2635-2650, method 10: the numerator of the correlation has a continuity
    correction.
    """
    size = sum(pairs)
    if size == 0:
        return -1.0, 1.0
    both, first, second, neither = pairs
    product = (both + first) * (second + neither) * (both + second) * (first + neither)
    numerator = both * neither - first * second
    correlation = (max(numerator - size / 2, 0.0) if numerator > 0 else numerator) / sqrt(product) if product else 0.0
    return newcombe(both + first, size, both + second, size, correlation)


def pairs_of(
    pairs: Iterable[tuple[Result, Result]], happened: Callable[[Result], bool] = attrgetter("success")
) -> Pairs:
    """Count in which episodes of each pair an event happened, without pairs in which one was not completed."""
    counts = Counter((happened(one), happened(two)) for one, two in pairs if ERROR not in (one.outcome, two.outcome))
    return Pairs(counts[True, True], counts[True, False], counts[False, True], counts[False, False])


def compare_results(results: ResultPairs, anytime: bool) -> dict[str, Comparison]:
    """Compare pairs of episodes in success, in motion where both succeeded, and in milestones of the same task.

    Returns `SUCCESS`, field of `Motion` or milestone → comparison, without fields that too few pairs have.
    """
    comparisons = {SUCCESS: compare_pairs(pairs_of(results), anytime)}
    motions = [(one.motion, two.motion) for one, two in results if one.success and two.success]
    for name in AMOUNTS:
        pairs = [(getattr(one, name, None), getattr(two, name, None)) for one, two in motions]
        amounts = np.array([pair for pair in pairs if None not in pair], float).reshape(-1, 2)
        if comparison := compare_amounts(amounts[:, 0], amounts[:, 1], anytime):
            comparisons[name] = comparison
    alike = [(one, two) for one, two in results if one.task == two.task]  # another task may not have the milestone
    for name in sorted({name for pair in alike for result in pair for name in result.milestones}):
        comparisons[name] = compare_pairs(pairs_of(alike, lambda result, name=name: name in result.milestones), anytime)
    return comparisons


def compare_conditions(reports: Mapping[str, Report], margin: float) -> dict[str, dict[str, Comparison]]:
    """Return condition → its comparisons with the first condition, which has none, with verdicts.

    Pairs with an error do not count. After early stopping, one report may be longer than the other. The `margin` of
    non-inferiority is a difference of rates, 0…1. Raises a UserError if reports have different seeds.
    """
    (_, first), *others = reports.items()
    comparisons = {}
    for name, other in others:
        together, anytime = list(zip(first.results, other.results, strict=False)), first.anytime or other.anytime
        uneven = len(first.results) != len(other.results) and not anytime
        if uneven or any(one.seed != two.seed for one, two in together):
            raise UserError("only reports on the same seeds can be compared")
        comparisons[name] = compare_results(together, anytime)
    return conclude_cases(comparisons, margin)


def conclude_cases(
    cases: Mapping[Key, Mapping[str, Comparison]], margin: float | None
) -> dict[Key, dict[str, Comparison]]:
    """Return the comparisons of all cases with verdicts, adjusted within two families: success, and all other metrics.

    The family-wise error rate of each is at most 5 %: S. Holm, "A simple sequentially rejective multiple test
    procedure", Scandinavian Journal of Statistics 6 (1979). Pairs that never differ cannot give a small
    p-value, so they do not count (R. E. Tarone, "A modified Bonferroni method for discrete data", Biometrics 46, 1990).
    """
    verdicts: dict[tuple[Key, str], Comparison] = {}
    for of_success in (True, False):
        family = [((case, name), test) for case, tests in cases.items() for name, test in tests.items()]
        family = [(key, test) for key, test in family if (key[1] == SUCCESS) == of_success]
        can_differ = [test.only_first is None or test.only_first + (test.only_second or 0) > 0 for _, test in family]
        remaining, adjusted = sum(can_differ), 0.0
        for key, test in sorted(family, key=lambda item: item[1].p):
            adjusted = max(adjusted, min(1.0, max(remaining, 1) * test.p))
            verdicts[key] = test.conclude(adjusted, margin if of_success else None)
            remaining -= 1
    return {case: {name: verdicts[case, name] for name in tests} for case, tests in cases.items()}
