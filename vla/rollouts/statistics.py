"""Confidence intervals of success rates, means and medians, and the exact test for pairs."""

from __future__ import annotations

from bisect import bisect
from collections.abc import Mapping, Sequence
from math import sqrt

import numpy as np

from vla.rollouts.sequential import LEVEL, anytime_p
from vla.spec import Array

NORMAL_QUANTILE = 1.959964  # of 0.975: an interval of 95 %


def wilson_interval(successes: float, trials: float) -> tuple[float, float]:
    """Return the 95 % confidence interval of a proportion; (0, 1) without trials.

    Wilson's score interval: E. B. Wilson, "Probable inference, the law of succession, and statistical inference",
    Journal of the American Statistical Association 22 (1927).
    """
    if trials == 0:
        return 0.0, 1.0
    share, spread = successes / trials, NORMAL_QUANTILE**2 / trials
    centre = (share + spread / 2) / (1 + spread)
    half_width = sqrt(spread * (share * (1 - share) + spread / 4)) / (1 + spread)
    # Without successes, or failures, the exact bound is 0, or 1; avoid rounding errors.
    low = centre - half_width if successes else 0.0
    return low, centre + half_width if successes < trials else 1.0


def stratified_interval(strata: Sequence[tuple[int, int, float]]) -> tuple[float, float, float]:
    """Return the weighted mean of proportions and its 95 % confidence interval; (0, 0, 1) without trials.

    Only chance within a stratum counts: strata, such as the tasks of a benchmark, are fixed. It is Wilson's interval at
    the effective sample size, at which the binomial variance equals the estimated one. In estimating the variance,
    half a success and half a failure are added to every stratum, else one without failures would seem certain; the
    estimate is scaled to be unbiased at a rate of one half, else few trials per stratum would give too small ones.

    Args:
        strata: successes, trials (at least one) and weight of each; the weights sum to 1.
    """
    if not strata:
        return 0.0, 0.0, 1.0
    successes, trials, weights = np.array(strata, float).T
    smooth = (successes + 0.5) / (trials + 1)
    # With n trials the expectation of smooth * (1 - smooth) is (n^2 + n + 1) / (n + 1)^2 of p (1 - p) at p = 1/2.
    variances = smooth * (1 - smooth) * np.square(trials + 1) / (np.square(trials) + trials + 1)
    mean, variance = weights @ smooth, np.square(weights) @ (variances / trials)
    effective_size = float(mean * (1 - mean) / variance)
    rate = float(weights @ (successes / trials))
    return rate, *wilson_interval(rate * effective_size, effective_size)


def bounded_mean_interval(values: Sequence[float], maximum: float) -> tuple[float, float]:
    """Return the 95 % confidence interval of the mean of at least one value from 0 to `maximum`.

    Wilson's interval at the effective sample size, at which the binomial variance equals the estimated one; half a zero
    and half a `maximum` are added in estimating it, else equal values would seem certain. If all values are 0 or
    `maximum` it is Wilson's interval of their share.
    """
    shares = np.asarray(values, float) / maximum
    count, total = len(shares), float(shares.sum())
    smooth = (total + 0.5) / (count + 1)
    variance = (float(np.square(shares).sum()) + 0.5) / (count + 1) - smooth**2
    effective_size = count * smooth * (1 - smooth) / variance
    low, high = wilson_interval(total / count * effective_size, effective_size)
    return maximum * low, maximum * high


def median_interval(values: Sequence[float] | Array, anytime: bool = False) -> tuple[float, float] | None:
    """Return the 95 % confidence interval of the median, between two of the values; None with too few of them.

    It contains the medians that the sign test does not exclude (W. R. Thompson, "On confidence ranges for the median
    and other expectation distributions", Annals of Mathematical Statistics 7, 1936).
    """
    sorted_values, test = np.sort(values), anytime_p if anytime else mcnemar
    count = len(sorted_values)
    tail = bisect(range(count // 2 + 1), LEVEL, key=lambda below: test(below, count - below))
    return (float(sorted_values[tail - 1]), float(sorted_values[-tail])) if tail else None


def mcnemar(losses: int, wins: int) -> float:
    """Return the two-sided exact p-value for equal success rates, given the numbers of discordant pairs.

    Under the null hypothesis both kinds of pairs are equally likely (Q. McNemar, "Note on the sampling error of
    the difference between correlated proportions or percentages", Psychometrika 12, 1947).
    """
    from scipy.special import bdtr  # the binomial distribution; importing scipy.stats takes a second

    return min(1.0, 2 * float(bdtr(min(losses, wins), losses + wins, 0.5)))


def mean_interval(values: Array) -> tuple[Array, Array]:
    """Return the 95 % confidence intervals of the means of (E, D) non-negative values, as two arrays (D,).

    Student's t interval over the E rows; with a single row it is unbounded.
    """
    mean, rows = values.mean(0), len(values)
    if rows < 2:
        return np.zeros_like(mean), np.full_like(mean, np.inf)
    from scipy.stats import t  # the import takes a second

    half_width = t.ppf(0.975, rows - 1) * values.std(0, ddof=1) / sqrt(rows)
    return np.maximum(mean - half_width, 0), mean + half_width


def pooled_interval(trainings: Sequence[Mapping[int, bool]]) -> tuple[float, float]:
    """Return the 95 % confidence interval of success over several trainings, each scene seed → success.

    It is Wilson's for `effective_episodes`. Two or three trainings estimate the variance between trainings poorly:
    where it exceeds the variance between scenes, the coverage is about 80 % instead of 95 %.
    """
    return wilson_interval(*effective_episodes(trainings))


def effective_episodes(trainings: Sequence[Mapping[int, bool]]) -> tuple[float, float]:
    """Return the numbers of successes and of independent episodes that the episodes of several trainings are worth.

    Episodes are correlated within a training and within a scene, so the effective sample size is smaller than their
    number. It is the one whose binomial variance equals the variance of the mean, estimated with trainings, with
    scenes, and with both as clusters (A. C. Cameron, J. B. Gelbach, D. L. Miller, "Robust inference with multiway
    clustering", Journal of Business & Economic Statistics 29, 2011); the largest of the three estimates is used, as
    there are few trainings. If all succeed or all fail, it is the number of scenes.

    Args:
        trainings: scene seed → success, for each training.
    """
    success = np.array([won for training in trainings for won in training.values()], float)
    if not len(success):
        return 0.0, 0.0
    episodes, rate = float(len(success)), float(success.mean())
    if len(trainings) > 1:
        scene = np.array([seed for training in trainings for seed in training])
        training = np.repeat(np.arange(len(trainings)), [len(training) for training in trainings])
        excess = success - rate
        by_run, by_scene = _squares(excess, training) * len(trainings) / (len(trainings) - 1), _squares(excess, scene)
        squares = max(by_run, by_scene, by_run + by_scene - float(excess @ excess))
        variance = max(squares, 1e-9) / len(success) ** 2
        effective_size = len(np.unique(scene)) if rate in (0, 1) else rate * (1 - rate) / variance
        episodes = min(episodes, effective_size)
    return rate * episodes, episodes


def _squares(values: Array, groups: Array) -> float:
    """Σ_g (Σ_{i∈g} x_i)²."""
    _, indices = np.unique(groups, return_inverse=True)
    return float(np.square(np.bincount(indices, values)).sum())
