"""`job=plan`: number of episodes needed to distinguish two success rates, with and without early stopping."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from vla.config.experiment import Experiment
from vla.config.nodes import Power
from vla.io.errors import UserError
from vla.io.printable import show
from vla.reports.tables import Table
from vla.rollouts.planning import (
    MAX_EPISODES,
    Stopping,
    episodes_needed,
    power_for_bar,
    power_of_pairs,
    power_of_samples,
    stopping,
)
from vla.spec import IN_DISTRIBUTION

NOTE = (
    "All numbers are exact; those with early stopping are for the same power. evaluate.until=decided also stops when "
    "two policies differ by less than evaluate.margin: set that below the difference."
)


def run(experiment: Experiment) -> None:
    """Print a table with a row per kind of comparison."""
    show(plan_table(experiment.options(Power)))


def plan_table(power: Power) -> Table:
    """Tabulate numbers of episodes, for each policy if there are two; raise a UserError if the rates are equal."""
    one, other = power.rates
    if one == other:
        raise UserError(f"plan.rates={power.rates} are equal: no number of episodes tells them apart")
    fixed = episodes_needed(partial(power_for_bar, rate=other, bar=one), power.power)
    stops = stopping(one, other, 1 - other, power.power, fixed) if fixed else None
    rows = [[f"one policy, {_percent(other)} against a bar of {_percent(one)}", *_numbers(fixed, stops)]]
    fixed = episodes_needed(partial(power_of_samples, one=one, other=other), power.power)
    rows.append(["two policies, different episodes", *_numbers(fixed, None)])
    difference = abs(other - one)
    for case, share in _shares(power, one, other).items():
        fixed = episodes_needed(partial(power_of_pairs, discordant=share, difference=difference), power.power)
        ones, zeros = (share + difference) / 2, (share - difference) / 2
        stops = stopping(0.5, ones, zeros, power.power, fixed) if fixed else None
        rows.append([f"two policies, same episodes, {_percent(share)} differ{case}", *_numbers(fixed, stops)])
    heads = ("compared", "episodes", "until=decided: at most", "on average", "false differences")
    return Table(heads, rows, note=NOTE)


def _shares(asked: Power, one: float, other: float) -> dict[str, float]:
    """Return case → share of the episodes in which only one of two policies succeeds.

    Unless it is given or measured, there are two cases: independent failures, and the smallest possible share.
    """
    if asked.runs and asked.discordant is not None:
        raise UserError("plan.discordant is measured on plan.runs: omit one of the two")
    share = _measured_share(asked.runs) if asked.runs else asked.discordant
    difference, largest = abs(other - one), min(one + other, 2 - one - other)
    if share is None:
        independent = one * (1 - other) + other * (1 - one)
        return {" (independent failures)": independent, " (the better never fails alone)": difference}
    if difference - 1e-9 <= share <= largest + 1e-9:
        return {"": max(share, difference)}
    raise UserError(
        f"policies of {_percent(one)} and {_percent(other)} differ in {_percent(difference)} to {_percent(largest)} of "
        f"the same episodes, not in {_percent(share)}: change plan.rates or plan.discordant"
    )


def _measured_share(folders: tuple[str, str]) -> float:
    """Return the share of the common episodes of two runs in which only one succeeded."""
    from vla.reports.comparison import common_episodes, read_runs  # imports matplotlib

    one, other = read_runs([Path(folder) for folder in folders]).values()
    if pairs := common_episodes(one, other, IN_DISTRIBUTION):
        return sum(first.success != second.success for first, second in pairs) / len(pairs)
    raise UserError(
        f"plan.runs={folders} have no episode in common: replace them by plan.discordant=0.05, the share that differs"
    )


def _numbers(fixed: int | None, stops: Stopping | None) -> tuple[str, ...]:
    if stops is None:
        return f"{fixed}" if fixed else f"more than {MAX_EPISODES}", "", "", ""
    return str(fixed), str(stops.max_episodes), f"{stops.mean:.0f}", _percent(stops.type_1_error)


def _percent(share: float) -> str:
    return f"{100 * share:.4g} %"  # of 99.95 % three digits would be 100
