"""Statements that an evaluation is to decide: success is above a bar, or differs from that of another run."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from vla.io.errors import UserError, counted
from vla.rollouts.comparison import ResultPairs, compare_pairs, pairs_of
from vla.rollouts.results import ERROR, Report, Result
from vla.rollouts.sequential import excludes, is_decided


@dataclass(frozen=True)
class BarStatement:
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
class RunStatement:
    """Comparison with another run on the same episodes: a difference in success, or equivalence within `margin`."""

    run: str
    results: Mapping[int, Result]  # seed → result of the other run
    margin: float
    anytime: bool = False  # whether the other run stopped early

    def require_common(self, seeds: Iterable[int]) -> None:
        """Raise a UserError if the other run completed no episode with one of these seeds."""
        if not any(seed in self.results and self.results[seed].outcome != ERROR for seed in seeds):
            raise UserError(
                f"evaluate.against={self.run} has no episode in common with this evaluation: it needs a run with the "
                "same task, randomisation and evaluate.seed"
            )

    def is_decided(self, report: Report) -> bool:
        """Return whether the episodes of a report decide the statement, or the other run has no later ones.

        It is valid after any number of episodes. Raises a UserError if equal seeds are different episodes.
        """
        same_seeds, pairs = self._pairs(report, same_episode=False), pairs_of(self._pairs(report))
        if sum(pairs_of(same_seeds)) and not sum(pairs):
            self.require_common(())
        ended = bool(report.results) and report.results[-1].seed >= max(self.results)
        return ended or is_decided(pairs.first, pairs.second, sum(pairs), self.margin)

    def say(self, report: Report) -> str:
        """Describe the verdict on a finished report in one sentence."""
        test = compare_pairs(pairs_of(self._pairs(report)), self.anytime or report.anytime)
        if not test.episodes:
            return f"no episode in common with {self.run}"
        verdict = test.conclude(test.p, self.margin).verdict
        difference, low, high = (f"{100 * share:+.1f}" for share in (test.difference, test.ci_low, test.ci_high))
        return (
            f"compared with {self.run} on {counted(test.episodes, 'common episode')}: {verdict}, {difference} points "
            f"({low} to {high}), p = {test.p:.2g}"
        )

    def _pairs(self, report: Report, same_episode: bool = True) -> ResultPairs:
        """Return pairs of results, of the other run and of this one, with the same seed.

        `same_episode`: of the same one only; under another goal or level of randomisation a seed gives another episode.
        """
        pairs = [(self.results[result.seed], result) for result in report.results if result.seed in self.results]
        return [(one, two) for one, two in pairs if one.episode == two.episode or not same_episode]


Statement = BarStatement | RunStatement


def differs_clearly(first: Report, margin: float, conditions: int, report: Report) -> bool:
    """Return whether a condition's success is shown to differ from `first`, or to be equivalent within `margin`."""
    pairs = pairs_of(zip(first.results, report.results, strict=False))
    return is_decided(pairs.first, pairs.second, sum(pairs), margin, conditions)
