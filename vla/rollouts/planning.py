"""Number of episodes that an evaluation needs to tell two success rates apart; all probabilities are exact."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable
from dataclasses import dataclass
from math import ceil, log, sqrt

import numpy as np
from scipy.special import betaln
from scipy.stats import binom

from vla.rollouts.sequential import LEVEL
from vla.rollouts.statistics import NORMAL_QUANTILE
from vla.spec import Array

MAX_EPISODES = 200_000  # episodes
MAX_DEVIATION = 9.0  # standard deviations beyond which outcomes are too rare to count
HORIZON = 4  # largest length of an evaluation with early stopping, as a multiple of the fixed number of episodes


def episodes_needed(power: Callable[[int], float], target: float) -> int | None:
    """Return the number of episodes at which `power` reaches `target`; None if it is more than `MAX_EPISODES`.

    As outcomes are discrete, power may fall below it again by a little for a few larger numbers.
    """
    high = 1
    while power(high) < target:
        if high == MAX_EPISODES:
            return None
        high = min(2 * high, MAX_EPISODES)
    return bisect_left(range(high), target, high // 2 + 1, key=power)


def power_for_bar(episodes: int, rate: float, bar: float) -> float:
    """Return the probability that Wilson's interval of a success rate excludes a bar, on the side of the true rate."""
    successes = np.arange(episodes + 1)
    distances = (successes / episodes - bar) * (1 if rate > bar else -1)
    decisive = distances > NORMAL_QUANTILE * sqrt(bar * (1 - bar) / episodes)  # then Wilson's interval excludes the bar
    return float(binom.pmf(successes, episodes, rate)[decisive].sum())


def power_of_pairs(episodes: int, discordant: float, difference: float) -> float:
    """Return the probability that McNemar's exact test finds a `difference` of two policies on the same episodes.

    In the share `discordant` of them only one succeeds.
    """
    mean, spread = episodes * discordant, MAX_DEVIATION * sqrt(episodes * discordant) + MAX_DEVIATION
    counts = np.arange(max(0, int(mean - spread)), min(episodes, int(mean + spread)) + 1)
    limits = binom.ppf(LEVEL / 2, counts, 0.5)
    limits -= binom.cdf(limits, counts, 0.5) > LEVEL / 2  # the largest number lost that is significant
    loss_share = (discordant - abs(difference)) / 2 / discordant
    return float(binom.pmf(counts, episodes, discordant) @ binom.cdf(limits, counts, loss_share))


def power_of_samples(episodes: int, one: float, other: float) -> float:
    """Return the probability that Fisher's exact test finds the difference of two rates, each of so many episodes."""
    one, other = sorted((one, other))
    counts = np.arange(episodes + 1)
    ways = binom.logpmf(counts, episodes, 0.5)  # and a constant, which cancels
    first, second = (binom.pmf(counts, episodes, rate) for rate in (one, other))
    reach = MAX_DEVIATION * sqrt(episodes * max(one * (1 - one), other * (1 - other))) + MAX_DEVIATION
    low, high = max(0, int(episodes * one - reach)), min(episodes, int(episodes * other + reach))
    power = 0.0
    for total in range(2 * low, 2 * high + 1):
        wins = np.arange(max(low, total - high), min(high, total - low) + 1)  # by the better policy
        probabilities = np.exp(ways[wins] + ways[total - wins] - np.logaddexp.reduce(ways[wins] + ways[total - wins]))
        rejected = np.cumsum(probabilities[::-1])[::-1] <= LEVEL / 2  # as hypergeometric numbers, given the total
        power += float(first[total - wins[rejected]] @ second[wins[rejected]])
    return power


@dataclass(frozen=True)
class Stopping:
    """Numbers of episodes of evaluations that stop as soon as they are decided."""

    max_episodes: int  # number of episodes after which the target share of the evaluations is decided
    mean: float  # mean number of episodes if evaluations end after `max_episodes`
    type_1_error: float  # type I error: share of the evaluations that are decided although there is no difference


def stopping(mean: float, one: float, zero: float, target: float, fixed: int) -> Stopping | None:
    """Return how long evaluations take that stop as soon as their observations, 0 or 1, exclude a `mean`.

    For one policy every episode is an observation, and `mean` is the bar; for two, every pair of episodes in which
    exactly one policy succeeds, and `mean` is 1/2. An episode gives a 1 and a 0 with the probabilities `one` and
    `zero`. The share `target` of the evaluations is to be decided, which takes `fixed` episodes without early stopping.
    Returns None if a smaller share is decided after `HORIZON` times as many.
    """
    rate = one + zero  # observations per episode
    counts = np.arange(1, ceil(HORIZON * fixed * rate) + 11)  # of observations
    bounds = _largest_decisive(mean, counts), counts - _largest_decisive(1 - mean, counts)
    ends, chance_ends = _ends(bounds, one / rate), _ends(bounds, mean)

    def decided(ends: Array, episodes: int) -> float:
        """Return the share of evaluations in which the observations of so many episodes decide."""
        return float(ends @ binom.sf(counts - 1, episodes, rate))

    most = episodes_needed(lambda episodes: decided(ends, episodes), target) if ends.sum() > target else None
    if most is None:
        return None
    # Wald: of the episodes until the m-th observation, or `max_episodes`, the share `rate` are observations.
    waits = np.cumsum(binom.sf(counts - 1, most, rate)) / rate
    return Stopping(most, float(ends @ waits + (1 - ends.sum()) * most), decided(chance_ends, most))


def _largest_decisive(mean: float, counts: Array) -> Array:
    """Return the largest numbers of ones among `counts` observations that show a smaller mean; -1 if none does.

    The capital is that of `vla.rollouts.sequential.log_capital` in its closed form.
    """
    low, high = np.full_like(counts, -1), np.floor(mean * counts).astype(counts.dtype)
    while (high - low > 1).any():
        middle = np.maximum((low + high) // 2, 0)
        capital = betaln(middle + 0.5, counts - middle + 0.5) - betaln(0.5, 0.5)
        decisive = capital - middle * log(mean) - (counts - middle) * log(1 - mean) >= log(1 / LEVEL)
        open_ = high - low > 1
        low, high = np.where(decisive & open_, middle, low), np.where(decisive | ~open_, high, middle)
    return low


def _ends(bounds: tuple[Array, Array], share: float) -> Array:
    """Return the probabilities that the n-th observation decides, n = 1, 2, …, given the `share` of ones.

    `bounds` are the largest and the smallest numbers of ones that decide, for every n.
    """
    undecided, ends = np.zeros(len(bounds[0]) + 2), np.zeros(len(bounds[0]))  # undecided: by the number of ones
    undecided[0], first, last = 1.0, 0, 0
    for place, (low, high) in enumerate(zip(*bounds, strict=True)):
        ones = share * undecided[first : last + 1]
        undecided[first : last + 1] -= ones
        undecided[first + 1 : last + 2] += ones
        for decisive in (slice(first, low + 1), slice(high, last + 2)):
            ends[place] += undecided[decisive].sum()
            undecided[decisive] = 0
        first, last = max(low + 1, 0), min(last + 1, high - 1)
    return ends
