"""Intervals of success rates, against what is known of them and against what they promise."""

from __future__ import annotations

import numpy as np
import pytest

from vla.rollouts.statistics import pooled_interval, wilson_interval

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


def test_of_one_training_every_episode_counts() -> None:
    assert pooled_interval(outcomes("1101101111")) == pytest.approx(wilson_interval(8, 10))
    assert pooled_interval([{}]) == (0, 1)


def test_trainings_that_do_the_same_tell_no_more_than_one() -> None:
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
