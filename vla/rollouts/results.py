"""Results of an evaluation: rates with intervals, by task and by tier, and comparisons of reports on the same seeds."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from operator import attrgetter
from typing import Any

import numpy as np

from vla.io.errors import UserError
from vla.rollouts.comparison import Comparison, Key, Pairs, compare_amounts, compare_pairs, concluded, median_interval
from vla.rollouts.motion import AMOUNTS, Motion
from vla.rollouts.sequential import anytime_interval
from vla.rollouts.statistics import bounded_mean_interval, stratified_interval, wilson_interval

ERROR = "error"  # outcome of an episode that was not completed


@dataclass(frozen=True)
class Result:
    """Result of one episode."""

    seed: int
    outcome: str  # "success", the name of a failure, or "error"
    instruction: str = ""
    steps: int = 0
    draws: dict[str, Any] = field(default_factory=dict)  # randomisation axis → drawn values
    task: str = ""
    milestones: tuple[str, ...] = ()  # in alphabetical order
    error: str = ""  # message, if the outcome is "error"
    completed: tuple[int, int] | None = None  # instructions completed, of how many; None if there is only one
    motion: Motion | None = None  # None if the outcome is "error", or in reports of before it was measured

    @property
    def success(self) -> bool:
        """Whether the outcome is "success"."""
        return self.outcome == "success"


@dataclass(frozen=True)
class Median:
    """Median over episodes, with its 95 % confidence interval."""

    median: float
    ci_low: float | None  # None with too few episodes
    ci_high: float | None
    episodes: int

    def __str__(self) -> str:
        """Format both with three digits."""
        return f"{self.median:.3g}" + ("" if self.ci_low is None else f" ({self.ci_low:.3g}-{self.ci_high:.3g})")


@dataclass(frozen=True)
class Report:
    """Results of all episodes, in the order of their seeds.

    Errors are of the program, not of the policy: they count neither as successes nor as failures.
    """

    results: tuple[Result, ...]
    tiers: Mapping[str, Sequence[str]] = field(default_factory=dict)  # tier of a benchmark → its tasks
    anytime: bool = False  # intervals and p-values are valid whatever the reason to stop playing

    @property
    def errors(self) -> list[Result]:
        """Episodes that were not completed."""
        return [result for result in self.results if result.outcome == ERROR]

    @property
    def episodes(self) -> int:
        """Number of completed episodes."""
        return len(self.results) - len(self.errors)

    @property
    def successes(self) -> int:
        """Number of successes."""
        return self.outcome_counts.get("success", 0)

    @property
    def success(self) -> float:
        """Share of successes among completed episodes, 0…1; 0 if there are none."""
        return self.successes / self.episodes if self.episodes else 0.0

    @property
    def interval(self) -> tuple[float, float]:
        """95 % confidence interval of `success`; with tiers, the tasks are fixed strata."""
        if self.anytime or not self.tiers:
            return self.interval_of(self.successes)
        played = [part for part in self.tasks.values() if part.episodes]
        known = sum(part.episodes for part in played)  # an error in `seen` leaves other conditions without its task
        return stratified_interval([part._stratum(known) for part in played])[1:]

    def interval_of(self, count: float) -> tuple[float, float]:
        """Return the 95 % confidence interval of the rate of an event that `count` completed episodes had."""
        return anytime_interval(count, self.episodes - count) if self.anytime else wilson_interval(count, self.episodes)

    def _stratum(self, episodes: float) -> tuple[int, int, float]:
        """Return successes, completed episodes and weight, their share of `episodes`, as a stratum of an interval."""
        return self.successes, self.episodes, self.episodes / episodes

    @property
    def milestones(self) -> dict[str, int]:
        """Milestone → number of episodes in which it was reached, sorted by name."""
        return dict(sorted(Counter(name for result in self.results for name in result.milestones).items()))

    @property
    def amounts(self) -> dict[str, list[float]]:
        """Field of `Motion` → its values in successful episodes, without fields that nobody measured."""
        motions = [result.motion for result in self.results if result.success]
        values = {name: [getattr(motion, name, None) for motion in motions] for name in AMOUNTS}
        known = {name: [value for value in each if value is not None] for name, each in values.items()}
        return {name: each for name, each in known.items() if each}

    @property
    def medians(self) -> dict[str, Median]:
        """Field of `Motion` → its median in successful episodes, see `amounts`."""
        return {
            name: Median(
                float(np.median(values)), *(median_interval(values, self.anytime) or (None, None)), len(values)
            )
            for name, values in self.amounts.items()
        }

    @property
    def _chains(self) -> list[tuple[int, int]]:
        """Instructions completed, of how many, per episode with several."""
        return [result.completed for result in self.results if result.completed]

    @property
    def in_a_row(self) -> dict[str, int]:
        """Number of episodes that completed at least n of several instructions, by a label such as 1/4.

        Empty if the episodes have only one instruction.
        """
        length = max((length for _, length in self._chains), default=0)
        return {f"{n}/{length}": sum(done >= n for done, _ in self._chains) for n in range(1, length + 1)}

    @property
    def mean_in_a_row(self) -> tuple[float, float, float] | None:
        """Mean number of instructions completed, with its 95 % confidence interval; None if episodes have only one."""
        if not self._chains:
            return None
        done, length = [done for done, _ in self._chains], max(length for _, length in self._chains)
        if self.anytime:  # bets on shares of a success lose more than bets on the values would
            share = sum(done) / length
            low, high = (length * bound for bound in anytime_interval(share, len(done) - share))
        else:
            low, high = bounded_mean_interval(done, length)
        return sum(done) / len(done), low, high

    @property
    def outcome_counts(self) -> dict[str, int]:
        """Outcome → number of episodes, the most frequent first."""
        return dict(Counter(result.outcome for result in self.results).most_common())

    @property
    def tasks(self) -> dict[str, Report]:
        """Task → report of its episodes, sorted by name; without errors of unknown task."""
        names = sorted({result.task for result in self.results if result.task})
        return {name: self._part([name]) for name in names}

    @property
    def by_task(self) -> dict[str, Report]:
        """The same where there are several, or tiers of them; otherwise empty."""
        return self.tasks if len(self.tasks) > 1 or self.tiers else {}

    @property
    def by_tier(self) -> dict[str, Report]:
        """Tier → report of its episodes; without tiers of which no episode was completed."""
        parts = {tier: self._part(tasks, {tier: tasks}) for tier, tasks in self.tiers.items()}
        return {tier: part for tier, part in parts.items() if part.episodes}

    def _part(self, tasks: Sequence[str], tiers: Mapping[str, Sequence[str]] | None = None) -> Report:
        return replace(
            self, results=tuple(result for result in self.results if result.task in tasks), tiers=tiers or {}
        )

    @property
    def mean_over_tiers(self) -> tuple[float, float, float] | None:
        """Mean of the tiers' success rates, 0…1, with its 95 % confidence interval.

        None with fewer than two tiers, or if it must be valid whatever the reason to stop playing.
        """
        tiers = list(self.by_tier.values())
        if len(tiers) < 2 or self.anytime:
            return None
        return stratified_interval(
            [
                part._stratum(len(tiers) * tier.episodes)
                for tier in tiers
                for part in tier.tasks.values()
                if part.episodes
            ]
        )

    @property
    def mean_label(self) -> str:
        """Name of `mean_over_tiers`, which says so if tasks of the tiers are missing from it."""
        listed = {task for tasks in self.tiers.values() for task in tasks}
        known = sum(part.episodes > 0 for task, part in self.tasks.items() if task in listed)
        return "mean over tiers" if known == len(listed) else f"mean over tiers ({known} of {len(listed)} tasks)"

    def compare(self, other: Report) -> Comparison:
        """Compare the success of another report, as the second, with this one, the first, on the same seeds.

        Pairs with an error do not count. Where episodes were played until it was clear, one report may be longer.

        Raises:
            UserError: the reports have different seeds.
        """
        return compare_pairs(pairs_of(self._together(other)), self.anytime or other.anytime)

    def compare_secondary(self, other: Report) -> dict[str, Comparison]:
        """Compare milestones and motion of another report with those of this one, see `compare` and `secondary_of`."""
        return secondary_of(self._together(other), self.anytime or other.anytime)

    def _together(self, other: Report) -> list[tuple[Result, Result]]:
        together = list(zip(self.results, other.results, strict=False))
        if any(one.seed != two.seed for one, two in together) or (
            len(self.results) != len(other.results) and not (self.anytime or other.anytime)
        ):
            raise UserError("only reports on the same seeds can be compared")
        return together

    def __str__(self) -> str:
        """Format failures, errors, milestones, motion, several instructions, several tasks, tiers and, last, the
        success rate with its interval."""
        lines = [f"{name} {count}" for name, count in self.outcome_counts.items() if name not in ("success", ERROR)]
        if self.errors:
            first = self.errors[0]
            lines.append(f"errors {len(self.errors)}, the first at seed {first.seed}: {first.error}")
        lines += [f"{name} {self._rate(count)}" for name, count in self.milestones.items()]
        if medians := [f"{AMOUNTS[name]} {median}" for name, median in self.medians.items()]:
            lines.append(f"medians of the successes, {self._ci}: {', '.join(medians)}")
        lines += [f"{name} completed in {self._rate(count)}" for name, count in self.in_a_row.items()]
        if row := self.mean_in_a_row:
            mean, low, high = (f"{value:.2f}" for value in row)
            lines.append(f"completed in a row on average {mean} ({self._ci} {low}-{high})")
        if len(self.tasks) > 1:
            lines += [f"{task} {report._rate()}" for task, report in self.tasks.items()]
        lines += [f"{tier.replace('_', ' ')} {report._rate()}" for tier, report in self.by_tier.items()]
        if mean := self.mean_over_tiers:
            rate, low, high = (f"{100 * value:.1f}" for value in mean)
            lines.append(f"{self.mean_label} {rate} % (95 % CI {low}-{high})")
        return "\n".join([*lines, f"success {self._rate()}"])

    def _rate(self, count: int | None = None) -> str:
        """Format the rate of an event that `count` completed episodes had, by default that of success."""
        if not self.episodes:
            return "0/0 (no episode was completed)"
        count, (low, high) = (self.successes, self.interval) if count is None else (count, self.interval_of(count))
        share = count / self.episodes
        return f"{count}/{self.episodes} ({100 * share:.1f} %, {self._ci} {100 * low:.1f}-{100 * high:.1f})"

    @property
    def _ci(self) -> str:
        return "anytime-valid 95 % CI" if self.anytime else "95 % CI"


def pairs_of(
    together: Iterable[tuple[Result, Result]], happened: Callable[[Result], bool] = attrgetter("success")
) -> Pairs:
    """Count what happened in pairs of episodes, without those of which one was not completed."""
    counts = Counter((happened(one), happened(two)) for one, two in together if ERROR not in (one.outcome, two.outcome))
    return Pairs(counts[True, True], counts[True, False], counts[False, True], counts[False, False])


def secondary_of(together: Sequence[tuple[Result, Result]], anytime: bool) -> dict[str, Comparison]:
    """Compare, in pairs of episodes, motion where both succeeded, and how often each milestone was reached in the same
    task.

    Returns:
        Field of `Motion` or milestone → comparison, without fields of which too few pairs are known.
    """
    found = {}
    for name in AMOUNTS:
        pairs = [
            (getattr(one.motion, name), getattr(two.motion, name))
            for one, two in together
            if one.success and two.success and one.motion and two.motion
        ]
        known = np.array([pair for pair in pairs if None not in pair], float).reshape(-1, 2)
        if compared := compare_amounts(known[:, 0], known[:, 1], anytime):
            found[name] = compared
    alike = [(one, two) for one, two in together if one.task == two.task]  # another task may not have the milestone
    for name in sorted({name for pair in alike for result in pair for name in result.milestones}):
        found[name] = compare_pairs(pairs_of(alike, lambda result, name=name: name in result.milestones), anytime)
    return found


def compare_conditions(reports: Mapping[str, Report], margin: float) -> dict[str, Comparison]:
    """Return condition → comparison of its success with that of the first condition, which has none.

    Args:
        reports: by condition.
        margin: non-inferiority margin of the success rate, 0…1.
    """
    (_, first), *others = reports.items()
    return concluded({name: first.compare(report) for name, report in others}, margin)


def compare_secondary_metrics(reports: Mapping[str, Report]) -> dict[str, dict[str, Comparison]]:
    """Return condition → comparisons of milestones and motion with those of the first condition, which has none.

    Verdicts take all of them into account, but not the comparisons of success.
    """
    (_, first), *others = reports.items()
    return concluded_secondary({name: first.compare_secondary(report) for name, report in others})


def concluded_secondary(secondary: Mapping[Key, Mapping[str, Comparison]]) -> dict[Key, dict[str, Comparison]]:
    """Return what `secondary_of` found in several cases, with verdicts that take all of it into account."""
    flat = {(case, name): compared for case, metrics in secondary.items() for name, compared in metrics.items()}
    found = concluded(flat, None)
    return {case: {name: found[case, name] for name in metrics} for case, metrics in secondary.items()}
