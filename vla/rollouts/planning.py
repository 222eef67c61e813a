"""Number of episodes that an evaluation needs to tell two success rates apart."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import ceil, log, sqrt

import numpy as np

from vla.rollouts.sequential import LEVEL, log_capital
from vla.rollouts.statistics import NORMAL_QUANTILE
from vla.spec import Array

MOST = 200_000  # episodes
FAR = 9.0  # standard deviations beyond which outcomes are too rare to count
SIMULATIONS = 10_000
PART = 4096  # numbers of observations per batch, which limits memory
HORIZON = 4  # length of a simulated evaluation, as a multiple of the fixed number of episodes


def episodes_needed(power: Callable[[int], float], enough: float) -> int | None:
    """Return the number of episodes at which `power` comes to be `enough`; None if it is more than `MOST`.

    As outcomes are discrete, power may fall below it again by a little for a few larger numbers.
    """
    low, high = 0, 1
    while power(high) < enough:
        if high == MOST:
            return None
        low, high = high, min(2 * high, MOST)
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if power(middle) >= enough else (middle, high)
    return high


def power_for_bar(episodes: int, rate: float, bar: float) -> float:
    """Return the probability that Wilson's interval of a success rate excludes a bar, on the side of the true rate."""
    from scipy.stats import binom  # the import takes a second

    won = np.arange(episodes + 1)
    apart = (won / episodes - bar) * (1 if rate > bar else -1)
    beside = apart > NORMAL_QUANTILE * sqrt(bar * (1 - bar) / episodes)  # solves Wilson's interval for its end
    return float(binom.pmf(won, episodes, rate)[beside].sum())


def power_of_pairs(episodes: int, discordant: float, difference: float) -> float:
    """Return the probability that McNemar's exact test finds a difference of two policies on the same episodes.

    Args:
        episodes: of each policy.
        discordant: share of the episodes in which only one succeeds.
        difference: of the success rates.
    """
    from scipy.stats import binom

    differ, spread = episodes * discordant, FAR * sqrt(episodes * discordant) + FAR
    counts = np.arange(max(0, int(differ - spread)), min(episodes, int(differ + spread)) + 1)
    most = binom.ppf(LEVEL / 2, counts, 0.5)
    most -= binom.cdf(most, counts, 0.5) > LEVEL / 2  # the largest number lost that is significant
    against = (discordant - abs(difference)) / 2 / discordant
    return float(binom.pmf(counts, episodes, discordant) @ binom.cdf(most, counts, against))


def power_of_samples(episodes: int, one: float, other: float) -> float:
    """Return the probability that Fisher's exact test finds the difference of two rates, each of so many episodes."""
    from scipy.special import gammaln
    from scipy.stats import binom

    one, other = sorted((one, other))
    ways = (
        gammaln(episodes + 1) - gammaln(np.arange(episodes + 1) + 1) - gammaln(episodes - np.arange(episodes + 1) + 1)
    )
    first, second = (binom.pmf(np.arange(episodes + 1), episodes, rate) for rate in (one, other))
    reach = FAR * sqrt(episodes * max(one * (1 - one), other * (1 - other))) + FAR
    low, high = max(0, int(episodes * one - reach)), min(episodes, int(episodes * other + reach))
    found = 0.0
    for total in range(2 * low, 2 * high + 1):
        won = np.arange(max(low, total - high), min(high, total - low) + 1)  # by the better policy
        likely = np.exp(ways[won] + ways[total - won] - np.logaddexp.reduce(ways[won] + ways[total - won]))
        rejected = np.cumsum(likely[::-1])[::-1] <= LEVEL / 2  # as hypergeometric numbers, given the total
        found += float(first[total - won[rejected]] @ second[won[rejected]])
    return found


@dataclass(frozen=True)
class Stopping:
    """Numbers of episodes of evaluations that stop when it is clear, by simulation."""

    most: int  # number of episodes after which the share `enough` of the evaluations is decided
    mean: float  # mean number of episodes if evaluations end after `most`
    wrong: float  # type I error: share of the evaluations that are decided although there is no difference


def stopping(mean: float, one: float, zero: float, enough: float, fixed: int) -> Stopping | None:
    """Simulate `SIMULATIONS` evaluations that stop as soon as observations of 0 and 1 exclude a mean.

    Args:
        mean: the one to exclude: a bar, or 1/2 for pairs, of which those count that differ.
        one: true probability of a 1 in an episode.
        zero: of a 0.
        enough: share of the evaluations to be decided.
        fixed: number of episodes without stopping.

    Returns:
        None if too few evaluations are decided after `HORIZON` times the fixed number.
    """
    random, counting = np.random.default_rng(0), one + zero
    horizon = ceil(HORIZON * fixed * counting) + 10
    parts = np.array_split(np.arange(1, horizon + 1), 1 + horizon // PART)
    lower, upper = (np.concatenate(ends) for ends in zip(*(_decisive(mean, part) for part in parts), strict=True))
    bounds = lower, upper
    ended = np.sort(_ends(random, bounds, one / counting, counting))
    most = ended[ceil(enough * SIMULATIONS) - 1]
    if not np.isfinite(most):
        return None
    without = _ends(random, bounds, mean, counting)
    return Stopping(int(most), float(np.minimum(ended, most).mean()), float((without <= most).mean()))


def _decisive(mean: float, counts: Array) -> tuple[Array, Array]:
    """Return the largest and the smallest numbers of ones among observations that exclude a mean, as real numbers."""
    limit, found = log(1 / LEVEL), []
    for end in (0 * counts - 1.0, counts + 1.0):
        inside, outside = mean * counts, end
        for _ in range(24):
            middle = (inside + outside) / 2
            ones = np.clip(middle, 0, counts)
            beyond = (log_capital(mean, ones, counts - ones) >= limit) | (middle != ones)
            inside, outside = np.where(beyond, inside, middle), np.where(beyond, middle, outside)
        found.append(outside)
    return found[0], found[1]


def _ends(random: np.random.Generator, bounds: tuple[Array, Array], share: float, counting: float) -> Array:
    """Return the numbers of episodes, infinite where nothing was decided, of simulated evaluations.

    Args:
        random: source of the observations.
        bounds: as `_decisive` returns them.
        share: of ones among observations.
        counting: share of the episodes that give an observation.
    """
    ended = np.full(SIMULATIONS, np.inf)
    for part in np.array_split(np.arange(SIMULATIONS), 100):  # for their memory
        ones = np.cumsum(random.random((len(part), len(bounds[0]))) < share, axis=1)
        decided = (ones <= bounds[0]) | (ones >= bounds[1])
        first = decided.argmax(1) + 1
        between = random.negative_binomial(first, counting) if counting < 1 else 0
        ended[part] = np.where(decided.any(1), first + between, np.inf)
    return ended
