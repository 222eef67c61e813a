"""Intervals of success rates, against what is known of them and against what they promise."""

from __future__ import annotations

import numpy as np
import pytest

from vla.rollouts.statistics import pooled_interval, stratified_interval, wilson_interval

Trainings = list[dict[int, bool]]


def outcomes(*trainings: str) -> Trainings:
    """Of each training, scene by scene, 1 where it succeeded."""
    return [{seed: won == "1" for seed, won in enumerate(training)} for training in trainings]


def test_wilson_interval_equals_values_worked_out_by_hand() -> None:
    # 8 of 10: centre (0.8 + 3.8415/20) / 1.38415 = 0.71674,
    # half width 1.95996 √(0.8·0.2/10 + 3.8415/400) / 1.38415 = 0.22659
    np.testing.assert_allclose(wilson_interval(8, 10), (0.49016, 0.94332), atol=1e-5)
    # None of 10: from 0 to z² / (n + z²) = 3.8415 / 13.8415
    np.testing.assert_allclose(wilson_interval(0, 10), (0, 0.27753), atol=1e-5)
    np.testing.assert_allclose(wilson_interval(10, 10), (1 - 0.27753, 1), atol=1e-5)
    assert wilson_interval(0, 0) == (0, 1)


def test_trainings_that_do_the_same_tell_no_more_than_one_whose_every_episode_counts() -> None:
    assert pooled_interval(outcomes("1101101111")) == pytest.approx(wilson_interval(8, 10))
    assert pooled_interval([{}]) == (0, 1)
    for same in ("1101101111", "1111111111", "0000000000"):
        assert pooled_interval(outcomes(same, same, same)) == pytest.approx(pooled_interval(outcomes(same)))


def test_trainings_that_differ_tell_less_than_their_episodes() -> None:
    steady = pooled_interval(outcomes("1100110010", "0011001101", "1010010101"))
    moody = pooled_interval(outcomes("1111111111", "0000000000", "1010010101"))
    assert moody[1] - moody[0] > 1.4 * (steady[1] - steady[0])
    assert moody[0] < 0.5 < moody[1]


@pytest.mark.parametrize(("spread", "promised", "without"), [(0.0, 0.94, 0.9), (0.4, 0.9, 0.8), (0.7, 0.8, 0.65)])
def test_it_covers_what_other_trainings_would_do_on_other_scenes(
    spread: float, promised: float, without: float
) -> None:
    random = np.random.default_rng(0)

    def rates(trainings: np.ndarray, scenes: np.ndarray) -> np.ndarray:
        return 1 / (1 + np.exp(-(1 + spread * trainings + 2 * scenes)))

    truth = rates(random.normal(size=100_000), random.normal(size=100_000)).mean()
    covered = {"pooled": 0, "independent": 0}
    for _ in range(400):
        won = random.random((3, 100)) < rates(random.normal(size=(3, 1)), random.normal(size=(1, 100)))
        trainings = [dict(enumerate(map(bool, training))) for training in won]
        intervals = {"pooled": pooled_interval(trainings), "independent": wilson_interval(int(won.sum()), won.size)}
        for name, (low, high) in intervals.items():
            covered[name] += low <= truth <= high
    assert covered["pooled"] > promised * 400 > without * 400 > covered["independent"]


def test_one_stratum_is_wilsons_interval_and_none_tells_nothing() -> None:
    # Half a success and half a failure more change the variance a little.
    assert stratified_interval([(80, 100, 1.0)]) == pytest.approx((0.8, *wilson_interval(80, 100)), abs=2e-3)
    assert stratified_interval([]) == (0, 0, 1)


def test_what_differs_between_strata_is_not_chance() -> None:
    apart, alike = [(10, 10, 0.5), (0, 10, 0.5)], [(5, 10, 0.5), (5, 10, 0.5)]
    assert stratified_interval(apart)[0] == stratified_interval(alike)[0] == 0.5
    wide, narrow = np.diff(stratified_interval(alike)[1:]), np.diff(stratified_interval(apart)[1:])
    assert 0 < narrow < wide < np.diff(wilson_interval(10, 20)) * 1.1


def test_without_a_failure_it_is_a_little_wider_than_that_of_one_task() -> None:
    rate, low, high = stratified_interval([(10, 10, 0.02)] * 50)
    assert rate == pytest.approx(1) == high and wilson_interval(450, 450)[0] < low < wilson_interval(500, 500)[0]


@pytest.mark.parametrize("episodes", [10, 2, 1])
@pytest.mark.parametrize(
    "rates", [(0.95, 0.4, 0.3, 0.4), (1.0, 0.98, 0.9, 0.95), (0.3, 0.02, 0.0, 0.05), (0.7, 0.7, 0.7, 0.7)]
)
def test_it_covers_the_mean_over_tiers_of_fixed_tasks(rates: tuple[float, ...], episodes: int) -> None:
    random, sizes = np.random.default_rng(0), (28, 11, 6, 5)
    spread = [np.clip(rate + random.normal(0, 0.1, size), 0, 1) for rate, size in zip(rates, sizes, strict=True)]
    truth, true = np.mean([tier.mean() for tier in spread]), np.concatenate(spread)
    weights = np.concatenate([np.full(size, 1 / (4 * size)) for size in sizes])
    covered = 0
    for _ in range(1000):
        won = random.binomial(episodes, true)
        _, low, high = stratified_interval([(int(k), episodes, w) for k, w in zip(won, weights, strict=True)])
        covered += low <= truth <= high
    assert covered / 1000 > 0.935
