"""Success of several policies as violins of its posterior distribution, and letters that tell which of them differ."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from string import ascii_lowercase
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

from vla.reports.comparison import RunComparison
from vla.reports.style import Interval, as_svg, svg_style
from vla.rollouts.comparison import concluded
from vla.rollouts.sequential import LEVEL
from vla.spec import IN_DISTRIBUTION

FEWEST, MOST = 3, len(ascii_lowercase)  # policies in one figure


class Outcome(NamedTuple):
    """Success of a policy under one condition."""

    successes: float
    episodes: float  # independent ones, see `effective_episodes`
    interval: Interval
    colour: str


def draw_posteriors(outcomes: Mapping[str, Outcome], compared: Sequence[RunComparison]) -> str | None:
    """Draw the success of policies, the highest first, as SVG; None if they are few or were not all compared.

    A violin is the posterior distribution of a success rate after a uniform prior, Beta(1 + successes, 1 + failures).

    Args:
        outcomes: by name.
        compared: comparisons of all pairs of names, among others.
    """
    found = {(each.one, each.other): each.found for each in compared if each.condition == IN_DISTRIBUTION}
    if not FEWEST <= len(outcomes) <= MOST or len(found) < len(outcomes) * (len(outcomes) - 1) / 2:
        return None
    from scipy.stats import beta  # the import takes a second

    ordered = sorted(outcomes, key=lambda name: -outcomes[name].interval[0])
    apart = [pair for pair, each in concluded(found, None).items() if (each.p_holm or 0) <= LEVEL]
    letters = compact_letters(ordered, apart)
    with svg_style("posteriors"):
        figure = Figure(figsize=(9, 0.6 + 0.45 * len(ordered)), layout="constrained")
        axes = figure.add_subplot()
        for row, name in enumerate(ordered):
            outcome = outcomes[name]
            posterior = beta(1 + outcome.successes, 1 + outcome.episodes - outcome.successes)
            rates = posterior.ppf(np.linspace(0.0005, 0.9995, 200))
            reach = 0.42 * posterior.pdf(rates) / posterior.pdf(rates).max()
            colour = outcome.colour
            axes.fill_between(rates, row - reach, row + reach, color=colour, alpha=0.45, linewidth=0)
            success, *bounds = outcome.interval
            axes.plot(bounds, [row, row], color=colour, linewidth=1.2)
            axes.plot(success, row, "o", color=colour, markersize=5, clip_on=False)
            axes.annotate(letters[name], (1.02, row), xycoords=axes.get_yaxis_transform(), va="center", fontsize=11)
        axes.set_yticks(range(len(ordered)), ordered)
        axes.set_ylim(len(ordered) - 0.4, -0.6)
        left, right = axes.get_xlim()
        axes.set_xlim(max(left, 0), min(right, 1))
        axes.set_xlabel("success")
        axes.grid(axis="x", alpha=0.12)
        axes.spines[["top", "right"]].set_visible(False)
        axes.tick_params(width=0.6)
        return as_svg(figure)


def compact_letters(names: Sequence[str], apart: Collection[tuple[str, str]]) -> dict[str, str]:
    """Return name → letters, so that two names share a letter unless they are `apart`.

    H.-P. Piepho, "An algorithm for a letter-based representation of all-pairwise comparisons", Journal of Computational
    and Graphical Statistics 13 (2004): insert and absorb. Letters are in the order of the first name that has them.
    """
    groups = [set(names)]
    for one, other in apart:
        split = [group - {name} for group in groups if {one, other} <= group for name in (one, other)]
        kept = [group for group in groups if not {one, other} <= group]
        for group in split:
            if not any(group <= large for large in kept):
                kept = [small for small in kept if not small <= group] + [group]
        groups = kept
    groups.sort(key=lambda group: [name not in group for name in names])
    return {name: "".join(_letter(number) for number, group in enumerate(groups) if name in group) for name in names}


def _letter(number: int) -> str:
    return ascii_lowercase[number] if number < MOST else f"({number + 1})"
