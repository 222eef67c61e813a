"""`job=plan`: number of episodes needed to distinguish two success rates, with and without early stopping."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

from rich.table import Table

from vla.config.experiment import Experiment
from vla.config.nodes import Power
from vla.io.errors import UserError
from vla.io.printable import show
from vla.reports.comparison import common_episodes, read_runs
from vla.rollouts.comparison import compare_pairs, pairs_of
from vla.rollouts.planning import (
    MOST,
    Stopping,
    episodes_needed,
    power_for_bar,
    power_of_pairs,
    power_of_samples,
    stopping,
)
from vla.rollouts.results import Result
from vla.rollouts.sequential import decided_after
from vla.spec import IN_DISTRIBUTION


def run(experiment: Experiment) -> None:
    """Print a table, with a row per way to compare."""
    asked = experiment.options(Power)
    one, other = asked.rates
    if one == other:
        raise UserError(f"plan.rates={asked.rates} are equal: no number of episodes tells them apart")
    if asked.runs and asked.discordant is not None:
        raise UserError("plan.discordant is measured on plan.runs: omit one of the two")
    common = _common(asked.runs) if asked.runs else []
    share = sum(one.success != two.success for one, two in common) / len(common) if common else asked.discordant
    show(plan_table(one, other, asked.power, share))
    show(
        "All numbers are exact; those with early stopping are for the same power. evaluate.until=decided also stops "
        "when two policies differ by less than evaluate.margin: set that below the difference."
    )
    if common:
        show(_replayed(common, experiment.evaluate.margin))


def plan_table(one: float, other: float, power: float, discordant: float | None) -> Table:
    """Tabulate numbers of episodes, of each policy if there are two.

    Args:
        one: success rate of the first policy, or a bar.
        other: success rate of the second policy.
        power: probability of finding the difference.
        discordant: share of the episodes in which only one of them succeeds; None: the limits of what it can be.

    Raises:
        UserError: the rates cannot differ in such a share.
    """
    difference, apart = abs(other - one), one * (1 - other) + other * (1 - one)
    largest = min(one + other, 2 - one - other)
    if discordant is None:
        shares = {" (independent failures)": apart, " (the better never fails alone)": difference}
    elif difference - 1e-9 <= discordant <= largest + 1e-9:
        shares = {"": max(discordant, difference)}
    else:
        raise UserError(
            f"policies of {_percent(one)} and {_percent(other)} differ in {_percent(difference)} to "
            f"{_percent(largest)} of the same episodes, not in {_percent(discordant)}: change plan.rates"
        )
    table = Table("compared", "episodes", "until=decided: at most", "on average", "false differences")
    fixed = episodes_needed(partial(power_for_bar, rate=other, bar=one), power)
    stops = stopping(one, other, 1 - other, power, fixed) if fixed else None
    table.add_row(f"one policy, {_percent(other)} against a bar of {_percent(one)}", *_numbers(fixed, stops))
    fixed = episodes_needed(partial(power_of_samples, one=one, other=other), power)
    table.add_row("two policies, different episodes", *_numbers(fixed, None))
    for how, share in shares.items():
        fixed = episodes_needed(partial(power_of_pairs, discordant=share, difference=difference), power)
        stops = stopping(0.5, (share + difference) / 2, (share - difference) / 2, power, fixed) if fixed else None
        table.add_row(f"two policies, same episodes, {_percent(share)} differ{how}", *_numbers(fixed, stops))
    return table


def _numbers(fixed: int | None, stops: Stopping | None) -> tuple[str, ...]:
    if stops is None:
        return (f"{fixed}" if fixed else f"more than {MOST}",)
    return str(fixed), str(stops.most), f"{stops.mean:.0f}", _percent(stops.wrong)


def _common(runs: Sequence[str]) -> list[tuple[Result, Result]]:
    """Return the results of two runs in every episode that both completed."""
    one, other = read_runs([Path(folder) for folder in runs]).values()
    if common := common_episodes(one, other, IN_DISTRIBUTION):
        return common
    raise UserError(
        f"plan.runs={runs} have no episode in common: give the share of differing ones, plan.discordant=0.05"
    )


def _replayed(common: Sequence[tuple[Result, Result]], margin: float) -> str:
    """Describe how early the evaluation of the second run could have stopped."""
    tasks = [one.task for one, _ in common]
    different = len({*tasks})
    turns = different if tasks[different:] == tasks[:-different] else 1
    stop = decided_after([(one.success, two.success) for one, two in common], margin, turns)
    if stop is None:
        return f"On the {len(common)} common episodes of these runs evaluate.until=decided never stops."
    found = compare_pairs(pairs_of(common[:stop]), anytime=True)
    return (
        f"Of the {len(common)} common episodes of these runs evaluate.until=decided plays {stop}, which saves "
        f"{_percent(1 - stop / len(common))}: the second is {found.conclude(found.p, margin).verdict}."
    )


def _percent(share: float) -> str:
    return f"{100 * share:.3g} %"
