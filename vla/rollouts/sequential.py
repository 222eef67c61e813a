"""Anytime-valid inference for success rates: p-values and intervals that stay valid under optional stopping.

The capital of bets at the odds of a hypothesis, 1 at first, is a test martingale. If the hypothesis is true, the
capital ever reaches 20 with a probability of at most 1/20 (J. Ville, "Étude critique de la notion de collectif",
1939). The hypotheses with a capital below 20 form a 95 % confidence sequence (I. Waudby-Smith, A. Ramdas, "Estimating
means of bounded random variables by betting", Journal of the Royal Statistical Society B 86, 2024): the intervals cover
the truth simultaneously, for all n, with probability 95 %.

The capital is spread evenly over `BETS` constant bets. For successes and failures it is that of the mixture with the
density Beta(1/2, 1/2) (R. Krichevsky, V. Trofimov, "The performance of universal encoding", IEEE Transactions on
Information Theory 27, 1981), exactly up to 2 `BETS` - 1 observations; for pairs it is the universal portfolio of
T. Cover and E. Ordentlich ("Universal portfolios with side information", ibid. 42, 1996).

Where tasks take turns, this holds after whole rounds: by the inequality of arithmetic and geometric means, bets at the
odds of the mean over tasks then lose.
"""

from __future__ import annotations

from math import log

import numpy as np

from vla.spec import Array

BETS = 512
LEVEL = 0.05  # largest probability of a false statement

# Shares of the capital put on success: the nodes at which equal weights integrate Beta(1/2, 1/2).
ON_SUCCESS = np.cos((2 * np.arange(BETS) + 1) * np.pi / (4 * BETS)) ** 2


def log_capital(mean: float, ones: Array | float, zeros: Array | float, halves: Array | int = 0) -> Array:
    """Return the logarithm of the capital after bets against the hypothesis of this `mean`, which is between 0 and 1.

    The numbers of observations of 1, of 0 and of 1/2 may be arrays of one shape.
    """
    one, zero = ON_SUCCESS / mean, (1 - ON_SUCCESS) / (1 - mean)
    counts = np.stack(np.broadcast_arrays(ones, zeros, halves), -1).astype(float)
    growth = counts @ np.log([one, zero, (one + zero) / 2])
    largest = growth.max(-1)
    return np.asarray(largest + np.log(np.exp(growth - largest[..., None]).mean(-1)))


def excludes(mean: float, ones: int, zeros: int, halves: int = 0, comparisons: int = 1) -> bool:
    """Return whether observations exclude the hypothesis of this `mean`, which is between 0 and 1.

    The number of `comparisons` is for the Bonferroni correction.
    """
    return bool(log_capital(mean, ones, zeros, halves) >= log(comparisons / LEVEL))


def anytime_interval(ones: float, zeros: float, halves: int = 0) -> tuple[float, float]:
    """Return the confidence interval of the mean of observations of 0, 1/2 and 1; (0, 1) without observations.

    An observation x between 0 and 1 may be counted as x ones and 1 - x zeros: by the inequality of arithmetic and
    geometric means, bets on it win at least as much.
    """
    count, limit = ones + zeros + halves, log(1 / LEVEL)
    if count == 0:
        return 0.0, 1.0
    estimate = (ones + halves / 2) / count

    def bound(end: float) -> float:
        """Bisect between a capital below the limit, at the estimate, and one above; it is log-convex in the mean."""
        inside, outside = estimate, end
        for _ in range(40):
            middle = (inside + outside) / 2
            below = log_capital(middle, ones, zeros, halves) < limit
            inside, outside = (middle, outside) if below else (inside, middle)
        return inside

    return 0.0 if ones + halves == 0 else bound(0.0), 1.0 if zeros + halves == 0 else bound(1.0)


# `first`, `second` and `pairs` are the numbers of pairs of episodes in which only the first succeeded, only the second,
# and of all. A pair is an observation of 1 if the second one did better, of 0 if the first did, else of 1/2.


def anytime_difference(first: int, second: int, pairs: int) -> tuple[float, float]:
    """Return the confidence interval of the second success rate minus the first."""
    low, high = anytime_interval(second, first, pairs - first - second)
    return 2 * low - 1, 2 * high - 1


def anytime_p(first: int, second: int) -> float:
    """Return a p-value for equal success, valid at any time: one over the capital from bets on a fair coin.

    Under the null hypothesis a discordant pair favours either one equally; other pairs do not change the capital.
    """
    return float(np.exp(-max(log_capital(0.5, second, first), 0.0)))


def is_decided(first: int, second: int, pairs: int, margin: float, comparisons: int = 1) -> bool:
    """Return whether two success rates are shown to be different, or equivalent within a margin, at any time.

    The number of `comparisons` is for the Bonferroni correction of the test for a difference.
    """
    if excludes(0.5, second, first, comparisons=comparisons):
        return True
    within = abs(second - first) < margin * pairs
    ends = ((1 - margin) / 2, (1 + margin) / 2)
    return within and all(excludes(end, second, first, pairs - first - second) for end in ends)
