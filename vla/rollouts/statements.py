"""Statements that an evaluation is to decide: success is above a bar, or differs from that of another run."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from vla.io.errors import UserError
from vla.rollouts.comparison import Comparison, compare_pairs
from vla.rollouts.results import ERROR, Report, Result, pairs_of
from vla.rollouts.sequential import excludes, is_decided


@dataclass(frozen=True)
class AgainstBar:
    """Comparison of the success rate with a `bar`, between 0 and 1."""

    bar: float

    def is_decided(self, report: Report) -> bool:
        """Return whether the episodes of a report decide the statement; valid after any number of episodes."""
        return excludes(self.bar, report.successes, report.episodes - report.successes)

    def say(self, report: Report) -> str:
        """Describe the verdict on a finished report in one sentence."""
        low, high = report.interval
        bar = f"the bar of {100 * self.bar:g} %"
        if low <= self.bar <= high:
            return f"open: success may be above or below {bar}"
        return f"success is {'above' if low > self.bar else 'below'} {bar}"


@dataclass(frozen=True)
class AgainstRun:
    """Difference from the success of another run on the same episodes, or a bound on it, `margin`."""

    run: str
    results: Mapping[int, Result]  # seed → result of the other run
    margin: float
    anytime: bool = False  # whether the other run stopped when something was clear

    def is_decided(self, report: Report) -> bool:
        """Return whether the episodes of a report decide the statement, or the other run has no later ones.

        It is valid after any number of episodes.

        Raises:
            UserError: the other run has other episodes with the same seeds.
        """
        found = self._compared(report)
        if not found.episodes and self._completed(report):
            raise self._apart()
        assert found.only_first is not None and found.only_second is not None
        if report.results and report.results[-1].seed >= max(self.results):
            return True
        return is_decided(found.only_first, found.only_second, found.episodes, self.margin)

    def require_common(self, seeds: Iterable[int]) -> None:
        """Raise a UserError if the other run completed no episode with one of these seeds."""
        if not any(seed in self.results and self.results[seed].outcome != ERROR for seed in seeds):
            raise self._apart()

    def say(self, report: Report) -> str:
        """Describe the verdict on a finished report in one sentence."""
        found = self._compared(report)
        if not found.episodes:
            return f"no episode in common with {self.run}"
        verdict = found.conclude(found.p, self.margin).verdict
        difference, low, high = (f"{100 * share:+.1f}" for share in (found.difference, found.ci_low, found.ci_high))
        return (
            f"compared with {self.run} on {found.episodes} common episodes: {verdict}, {difference} points "
            f"({low} to {high}), p = {found.p:.2g}"
        )

    def _completed(self, report: Report) -> list[tuple[Result, Result]]:
        """Return results of the other run and of this one for the seeds that both completed."""
        pairs = [(self.results[mine.seed], mine) for mine in report.results if mine.seed in self.results]
        return [pair for pair in pairs if ERROR not in (pair[0].outcome, pair[1].outcome)]

    def _compared(self, report: Report) -> Comparison:
        # The same seed gives another episode under another goal or level of randomisation.
        same = [
            (their, mine)
            for their, mine in self._completed(report)
            if (their.instruction, their.draws) == (mine.instruction, mine.draws)
        ]
        return compare_pairs(pairs_of(same), self.anytime or report.anytime)

    def _apart(self) -> UserError:
        return UserError(
            f"evaluate.against={self.run} has no episode in common with this evaluation: it needs a run with the same "
            "task, randomisation and evaluate.seed"
        )


Statement = AgainstBar | AgainstRun


def differs_clearly(first: Report, margin: float, conditions: int, report: Report) -> bool:
    """Return whether a condition's success is shown to differ from `first`, or to be equivalent within `margin`."""
    pairs = pairs_of(zip(first.results, report.results, strict=False))
    return is_decided(pairs.first, pairs.second, sum(pairs), margin, conditions)
