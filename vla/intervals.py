"""Confidence intervals of success rates."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import sqrt

import numpy as np

NORMAL_QUANTILE = 1.959964  # of 0.975: an interval of 95 %


def wilson_interval(successes: float, trials: float) -> tuple[float, float]:
    """95 % confidence interval of a proportion; (0, 1) without trials.

    Wilson's score interval: E. B. Wilson, "Probable inference, the law of succession, and statistical inference",
    Journal of the American Statistical Association 22 (1927).
    """
    if trials == 0:
        return 0.0, 1.0
    share, spread = successes / trials, NORMAL_QUANTILE**2 / trials
    centre = (share + spread / 2) / (1 + spread)
    half_width = sqrt(spread * (share * (1 - share) + spread / 4)) / (1 + spread)
    # At the ends the interval begins or ends exactly there, but for rounding.
    low = centre - half_width if successes else 0.0
    return low, centre + half_width if successes < trials else 1.0


def pooled_interval(trainings: Sequence[Mapping[int, bool]]) -> tuple[float, float]:
    """95 % confidence interval of success over several trainings, of each of which seed of the scene → success.

    Trainings differ, and all of them play the same scenes, so their episodes tell less than as many independent ones.
    Wilson's interval is taken of so many as would vary as much: the variance of the mean is estimated with trainings,
    with scenes, and with both as clusters (A. C. Cameron, J. B. Gelbach, D. L. Miller, "Robust inference with multiway
    clustering", Journal of Business & Economic Statistics 29, 2011), and the largest of the three counts, as there are
    few trainings. Where nothing failed, or nothing succeeded, scenes count once. Two or three trainings hardly tell how
    much trainings differ: where that is more than scenes do, four in five intervals cover, and not nineteen in twenty.
    """
    success = np.array([won for training in trainings for won in training.values()], float)
    if not len(success):
        return wilson_interval(0, 0)
    independent, rate = float(len(success)), float(success.mean())
    if len(trainings) > 1:
        scene = np.array([seed for training in trainings for seed in training])
        training = np.repeat(np.arange(len(trainings)), [len(training) for training in trainings])
        apart = success - rate
        between, within = _squares(apart, training) * len(trainings) / (len(trainings) - 1), _squares(apart, scene)
        squares = max(between, within, between + within - float(apart @ apart))
        alike = len(np.unique(scene)) if rate in (0, 1) else len(success) ** 2 * rate * (1 - rate) / max(squares, 1e-9)
        independent = min(independent, alike)
    return wilson_interval(rate * independent, independent)


def _squares(values: np.ndarray, groups: np.ndarray) -> float:
    """Sum over the groups of the square of what the values of one sum up to."""
    _, place = np.unique(groups, return_inverse=True)
    return float(np.square(np.bincount(place, values)).sum())
