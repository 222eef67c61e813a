"""Output of an evaluation: report.json and report.png."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from vla.io.files import write_json
from vla.reports.factors import episode_panels
from vla.reports.pictures import save
from vla.rollouts.comparison import Comparison
from vla.rollouts.results import Report


def write_report(
    report: Report,
    path: Path,
    checkpoint: str | None,
    config: Mapping[str, Any],
    facts: Mapping[str, Any] | None = None,
    conditions: Mapping[str, Report] | None = None,
    comparisons: Mapping[str, Mapping[str, Comparison]] | None = None,
) -> None:
    """Write the report of the first condition as JSON atomically, with the evaluated policy and the resolved config.

    `facts` are further entries, such as chosen options, parameters and latency. `conditions` are the reports of other
    conditions on the same seeds, `comparisons` their comparisons with the first.
    """
    content = {
        **summary(report),
        "seeds": [result.seed for result in report.results],
        "checkpoint": checkpoint,
        **(facts or {}),
        "conditions": {
            name: {
                **summary(other),
                "compared": {key: asdict(comparison) for key, comparison in (comparisons or {}).get(name, {}).items()},
                "outcomes": [result.outcome for result in other.results],
                "reached": [result.milestones for result in other.results],
                "motions": [result.motion and asdict(result.motion) for result in other.results],
            }
            for name, other in (conditions or {}).items()
        },
        "config": config,
        "per_episode": [asdict(result) for result in report.results],
    }
    write_json(path, content)


def summary(report: Report) -> dict[str, Any]:
    """Summarise a report for JSON: rates with intervals, outcomes and motion."""
    low, high = report.interval
    content: dict[str, Any] = {
        "success": report.success,
        "ci_low": low,
        "ci_high": high,
        "episodes": report.episodes,
        "successes": report.successes,
        "errors": len(report.errors),
        "outcome_counts": report.outcome_counts,
        "motion": {name: asdict(median) for name, median in report.medians.items()},
        "anytime": report.anytime,
    }
    for kind, rates in report.rates.items():
        content[kind] = {name: {"rate": counted.rate, **counted._asdict()} for name, counted in rates.items()}
    for name, mean in (("mean_in_a_row", report.mean_completed), ("mean_over_tiers", report.mean_over_tiers)):
        if mean:
            content[name] = dict(zip(("mean", "ci_low", "ci_high"), mean, strict=True))
    return content


def plot_report(report: Report, path: Path) -> None:
    """Plot outcomes, episode lengths, and success over the randomised factors with the strongest association."""
    save(path, episode_panels(report), 4, title=str(report).splitlines()[-1])
