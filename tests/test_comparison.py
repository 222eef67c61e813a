"""Differences of success rates and of amounts: values of other programs, and what intervals and tests
promise by exact enumeration."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy.stats import fisher_exact, multinomial, quantile_test

from vla.rollouts.comparison import (
    SUCCESS,
    Comparison,
    Pairs,
    compare_amounts,
    compare_samples,
    conclude_cases,
    fisher,
    median_interval,
    newcombe,
    newcombe_paired,
)


def a_comparison(p: float, difference: float = 0.1, low: float = -0.1, differ: int = 9) -> Comparison:
    return Comparison(difference, low, 0.5, p, 100, differ, differ)


def test_intervals_equal_those_of_other_programs() -> None:
    # Newcombe_square_and_add_CI_paired_2x2(rbind(c(59, 6), c(16, 80))) in the tests of R's contingencytables
    np.testing.assert_allclose(newcombe_paired(Pairs(59, 16, 6, 80)), (-0.1186, -0.0046), atol=5e-5)
    # confint_proportions_2indep(…, method="newcomb") of statsmodels 0.15.0
    np.testing.assert_allclose(newcombe(48, 80, 56, 70), (0.052431, 0.333873), atol=1e-6)
    np.testing.assert_allclose(newcombe(3, 10, 19, 20), (0.294207, 0.846558), atol=1e-6)
    assert newcombe_paired(Pairs(0, 0, 0, 0)) == (-1, 1)
    low, high = newcombe_paired(Pairs(20, 3, 9, 8))
    assert newcombe_paired(Pairs(20, 9, 3, 8)) == pytest.approx((-high, -low))  # the order only changes the sign


@pytest.mark.parametrize("shares", [(0.88, 0.07, 0.03, 0.02), (0.5, 0.2, 0.2, 0.1), (0.2, 0.1, 0.6, 0.1)])
def test_the_interval_of_pairs_covers_the_difference(shares: tuple[float, ...]) -> None:
    episodes, covered = 30, 0.0
    tables = [
        Pairs(both, first, second, episodes - both - first - second)
        for both, first, second in itertools.product(range(episodes + 1), repeat=3)
        if both + first + second <= episodes
    ]
    likely = multinomial.pmf(np.array(tables), episodes, shares)
    for pairs, probability in zip(tables, likely, strict=True):
        if probability > 1e-6:
            low, high = newcombe_paired(pairs)
            covered += probability * (low <= shares[2] - shares[1] <= high)
    assert covered > 0.94


def test_the_test_of_different_episodes_is_fishers() -> None:
    for one, two in ((5, 9), (10, 3), (0, 12), (7, 8)):
        table = [[two, 20 - two], [one, 10 - one]]
        smaller = min(fisher_exact(table, side).pvalue for side in ("less", "greater"))
        assert fisher(one, 10, two, 20) == pytest.approx(min(1.0, 2 * smaller))
    told = compare_samples(5, 10, 19, 20)
    assert (told.difference, told.episodes, told.only_first) == (pytest.approx(0.45), 30, None)


def test_p_values_are_adjusted_step_by_step() -> None:
    others = {"grasped": a_comparison(0.5)}  # which are adjusted among each other
    cases = {
        name: {SUCCESS: a_comparison(p), **others} for name, p in zip("abcd", (0.01, 0.04, 0.03, 0.005), strict=True)
    }
    found = conclude_cases(cases, 0.02)
    assert list(found) == list("abcd")
    assert [each[SUCCESS].p_holm for each in found.values()] == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert {each["grasped"].p_holm for each in found.values()} == {1.0}
    # Pairs that never differ could not have told anything.
    found = conclude_cases({"a": {SUCCESS: a_comparison(0.03)}, "b": {SUCCESS: a_comparison(1.0, 0.0, differ=0)}}, 0.02)
    assert [each[SUCCESS].p_holm for each in found.values()] == pytest.approx([0.03, 1.0])
    assert conclude_cases({}, 0.02) == {}


def test_the_interval_of_a_median_is_scipys() -> None:
    random = np.random.default_rng(0)
    for count in (6, 7, 20, 51):
        values = random.normal(size=count)
        assert median_interval(values) == quantile_test(values).confidence_interval(0.95)
    assert median_interval([1.0] * 5) is None


def test_amounts_are_compared_by_their_signs() -> None:
    found = compare_amounts([5.0] * 12, [4.0] * 9 + [5.0] * 2 + [6.0])
    assert found is not None and (found.only_first, found.only_second, found.episodes) == (9, 1, 12)
    # nine less and one more: 2 · (1 + 10) / 2^10; two are equal
    assert (found.difference, found.p) == (-1.0, pytest.approx(22 / 1024))
    assert (found.ci_low, found.ci_high) == (-1.0, 0.0)
    assert found.conclude(found.p, None).verdict == "less" and found.conclude(0.1, None).verdict == "open"
    later = compare_amounts([5.0] * 12, [4.0] * 9 + [5.0] * 2 + [6.0], anytime=True)
    assert later is not None and later.p > found.p and later.ci_high >= found.ci_high
    assert compare_amounts([1.0], [2.0]) is None


def test_the_verdict_is_a_difference_or_its_absence_or_nothing() -> None:
    for p, difference, low, verdict in (
        (0.01, 0.1, 0.04, "better"),
        (0.01, -0.1, -0.2, "worse"),
        (0.01, -0.01, -0.015, "worse, by less than 2 points"),
        (0.6, -0.001, -0.012, "not worse by 2 points"),
        (0.6, 0.001, -0.03, "open"),
    ):
        assert a_comparison(p, difference, low).conclude(p, 0.02).verdict == verdict
