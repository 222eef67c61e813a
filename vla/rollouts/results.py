"""Results of an evaluation: rates with intervals, by task and by tier."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from typing import Any, NamedTuple

import numpy as np

from vla.rollouts.motion import AMOUNTS, Motion
from vla.rollouts.sequential import anytime_interval
from vla.rollouts.statistics import bounded_mean_interval, median_interval, stratified_interval, wilson_interval

Rate = tuple[float, float, float]  # an estimate, and its 95 % confidence interval

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
    motion: Motion | None = None  # None if the outcome is "error", or in reports from before it was measured

    @property
    def success(self) -> bool:
        """Whether the outcome is "success"."""
        return self.outcome == "success"

    @property
    def episode(self) -> tuple[str, str, dict[str, Any]]:
        """What tells episodes of one seed apart, in worlds that record their draws: task, instruction and draws."""
        return self.task, self.instruction, self.draws


def recording_name(seed: int, outcome: str) -> str:
    """Return the name of the recording of an episode; in alphabetical order failures come first, and seeds ascend."""
    return f"success-{seed:08d}" if outcome == "success" else f"failure-{seed:08d}-{outcome}"


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


class EventRate(NamedTuple):
    """Number of completed episodes with an event, such as success, and its confidence interval."""

    count: int
    of: int
    ci_low: float  # of the 95 % confidence interval of the rate
    ci_high: float

    @property
    def rate(self) -> float:
        """Share of the episodes, 0…1; 0 if there are none."""
        return self.count / self.of if self.of else 0.0


@dataclass(frozen=True)
class Report:
    """Results of all episodes, in the order of their seeds.

    Errors are of the program, not of the policy: they count neither as successes nor as failures.
    """

    results: tuple[Result, ...]
    tiers: Mapping[str, Sequence[str]] = field(default_factory=dict)  # tier of a benchmark → its tasks, or patterns
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
    def outcome_counts(self) -> dict[str, int]:
        """Outcome → number of episodes, the most frequent first."""
        return dict(Counter(result.outcome for result in self.results).most_common())

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
            return self.event_rate(self.successes)[2:]
        # Known tasks only: an error in `seen` leaves other conditions without its task.
        return self._stratified([self.tasks])[1:]

    @property
    def milestones(self) -> dict[str, int]:
        """Milestone → number of episodes in which it was reached, sorted by name."""
        return dict(sorted(Counter(name for result in self.results for name in result.milestones).items()))

    @property
    def medians(self) -> dict[str, Median]:
        """Field of `Motion` → its median in successful episodes, without fields that were never measured."""
        motions, medians = [result.motion for result in self.results if result.success], dict[str, Median]()
        for name in AMOUNTS:
            amounts = [getattr(motion, name, None) for motion in motions]
            if values := [value for value in amounts if value is not None]:
                low, high = median_interval(values, self.anytime) or (None, None)
                medians[name] = Median(float(np.median(values)), low, high, len(values))
        return medians

    @property
    def completion_counts(self) -> dict[str, int]:
        """Number of episodes that completed at least n of several instructions, by a label such as 1/4.

        Empty if the episodes have only one instruction.
        """
        chains = [result.completed for result in self.results if result.completed]
        length = max((length for _, length in chains), default=0)
        return {f"{n}/{length}": sum(count >= n for count, _ in chains) for n in range(1, length + 1)}

    @property
    def mean_completed(self) -> Rate | None:
        """Mean number of instructions completed, with its 95 % confidence interval; None if episodes have only one."""
        chains = [result.completed for result in self.results if result.completed]
        if not chains:
            return None
        counts, length = [count for count, _ in chains], max(length for _, length in chains)
        if self.anytime:  # conservative: bets on shares of successes gain less than bets on the values
            share = sum(counts) / length
            low, high = (length * bound for bound in anytime_interval(share, len(counts) - share))
        else:
            low, high = bounded_mean_interval(counts, length)
        return sum(counts) / len(counts), low, high

    @property
    def tasks(self) -> dict[str, Report]:
        """Task → report of its episodes, sorted by name; without errors of unknown task."""
        names = sorted({result.task for result in self.results if result.task})
        return {name: self._part([name]) for name in names}

    @property
    def tier_reports(self) -> dict[str, Report]:
        """Tier → report of its episodes; without tiers of which no episode was completed."""
        parts = {tier: self._part(self._matching(tasks), {tier: tasks}) for tier, tasks in self.tiers.items()}
        return {tier: part for tier, part in parts.items() if part.episodes}

    def event_rate(self, count: int | None = None) -> EventRate:
        """Return the rate of an event that `count` completed episodes had, by default of success."""
        if count is None:
            return EventRate(self.successes, self.episodes, *self.interval)
        episodes = self.episodes
        interval = anytime_interval(count, episodes - count) if self.anytime else wilson_interval(count, episodes)
        return EventRate(count, episodes, *interval)

    @property
    def rates(self) -> dict[str, dict[str, EventRate]]:
        """Kind → name → rate, besides overall success: milestones, instructions completed in a row, success by task (if
        there are several, or tiers), and success by tier."""
        tasks = self.tasks if len(self.tasks) > 1 or self.tiers else {}
        return {
            "milestones": {name: self.event_rate(count) for name, count in self.milestones.items()},
            "in_a_row": {name: self.event_rate(count) for name, count in self.completion_counts.items()},
            "tasks": {name: part.event_rate() for name, part in tasks.items()},
            "tiers": {name: part.event_rate() for name, part in self.tier_reports.items()},
        }

    def _matching(self, patterns: Sequence[str]) -> list[str]:
        """Return the tasks whose names match one of the `patterns`, in which * stands for any text."""
        names = {result.task for result in self.results}
        return [task for task in names if any(fnmatchcase(task, pattern) for pattern in patterns)]

    def _part(self, tasks: Sequence[str], tiers: Mapping[str, Sequence[str]] | None = None) -> Report:
        results = tuple(result for result in self.results if result.task in tasks)
        return replace(self, results=results, tiers=tiers or {})

    @property
    def mean_over_tiers(self) -> Rate | None:
        """Mean of the tiers' success rates, 0…1, with its 95 % confidence interval.

        None with fewer than two tiers, or if it must be valid whatever the reason to stop playing.
        """
        tiers = list(self.tier_reports.values())
        return None if len(tiers) < 2 or self.anytime else self._stratified([tier.tasks for tier in tiers])

    @staticmethod
    def _stratified(groups: Sequence[Mapping[str, Report]]) -> Rate:
        """Return the mean rate over groups of tasks, within which all episodes have equal weight."""
        strata = [[task for task in group.values() if task.episodes] for group in groups]
        totals = [len(groups) * sum(task.episodes for task in tasks) for tasks in strata]
        return stratified_interval(
            [
                (task.successes, task.episodes, task.episodes / total)
                for tasks, total in zip(strata, totals, strict=True)
                for task in tasks
            ]
        )

    @property
    def mean_label(self) -> str:
        """Name of `mean_over_tiers`, which says so if tasks of the tiers are missing from it."""
        patterns = {task for tasks in self.tiers.values() for task in tasks}
        played_tasks = {result.task for result in self.results if result.outcome != ERROR}
        count = sum(any(fnmatchcase(task, pattern) for task in played_tasks) for pattern in patterns)
        return "mean over tiers" if count == len(patterns) else f"mean over tiers ({count} of {len(patterns)} tasks)"

    def __str__(self) -> str:
        """Format failures, errors, motion, all rates and, last, the success rate with its interval."""
        ci = "anytime-valid 95 % CI" if self.anytime else "95 % CI"
        lines = [f"{name} {count}" for name, count in self.outcome_counts.items() if name not in ("success", ERROR)]
        if self.errors:
            first = self.errors[0]
            lines.append(f"errors {len(self.errors)}, the first at seed {first.seed}: {first.error}")
        if medians := [f"{AMOUNTS[name]} {median}" for name, median in self.medians.items()]:
            lines.append(f"medians of the successes, {ci}: {', '.join(medians)}")
        if row := self.mean_completed:
            lines.append("completed in a row on average {:.2f} ({ci} {:.2f}-{:.2f})".format(*row, ci=ci))
        rates = [item for kind in self.rates.values() for item in kind.items()]
        lines += [f"{name.replace('_', ' ')} {_text(counted, ci)}" for name, counted in rates]
        if mean := self.mean_over_tiers:
            rate, low, high = (100 * value for value in mean)
            lines.append(f"{self.mean_label} {rate:.1f} % ({ci} {low:.1f}-{high:.1f})")
        return "\n".join([*lines, f"success {_text(self.event_rate(), ci)}"])


def _text(counted: EventRate, ci: str) -> str:
    if not counted.of:
        return "0/0 (no episode was completed)"
    low, high = 100 * counted.ci_low, 100 * counted.ci_high
    return f"{counted.count}/{counted.of} ({100 * counted.rate:.1f} %, {ci} {low:.1f}-{high:.1f})"
