"""The page that compares several runs, `comparison.html`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from vla.config.differences import ABSENT, at, differences
from vla.reports.comparison import CASE, RunComparison, remarks, secondary_rows
from vla.reports.html import (
    DIFFERENCE,
    PageTable,
    code,
    difference,
    duration,
    in_words,
    links,
    links_to,
    named,
    rate,
    render,
    secondary,
    value,
)
from vla.reports.posteriors import Outcome, draw_posteriors
from vla.reports.training_curves import colours, draw_runs
from vla.rollouts.moving_picture import Caption, read_moving_pictures
from vla.rollouts.recordings import shown
from vla.runs.folder import RECORDINGS, Run
from vla.spec import IN_DISTRIBUTION

COMPARISON = "comparison.html"
FAILURES = 3  # moving pictures per run


def write_comparison(runs: Mapping[str, Run], compared: Sequence[RunComparison], target: Path) -> Path:
    """Write a page on several runs, by name, and their comparisons into the folder `target`, and return its path.

    Raises:
        UserError: a moving picture is damaged.
    """
    lines = dict(zip(runs, colours(len(runs)), strict=True))
    reports = {name: run.reports[IN_DISTRIBUTION] for name, run in runs.items() if run.report}
    outcomes = {
        name: Outcome(report.successes, report.episodes, (report.success, *report.interval), lines[name])
        for name, report in reports.items()
    }
    return render(
        target / COMPARISON,
        "comparison.html",
        title=f"{len(runs)} runs" if len(runs) > 1 else next(iter(runs)),
        results=_results(runs, lines, target),
        posteriors=draw_posteriors(outcomes, compared) if len(outcomes) == len(runs) else None,
        lines=lines,
        curves=draw_runs({name: run.metrics for name, run in runs.items()}),
        pairs=_pairs(compared),
        remarks=remarks(runs, compared),
        secondary=secondary(secondary_rows(compared), CASE, "Differences in secondary metrics"),
        anytime=any(report.anytime for run in runs.values() for report in run.reports.values()),
        differences=_config_differences(runs),
        rollouts={name: found for name, run in runs.items() if (found := _failures(run))},
        links={name: links(links_to(run.folder, target)) for name, run in runs.items()},
    )


def _results(runs: Mapping[str, Run], lines: Mapping[str, str], target: Path) -> PageTable:
    """Tabulate success under every condition, and costs."""
    conditions = list(dict.fromkeys(condition for run in runs.values() for condition in run.reports))
    heads = ["run", *(f"{in_words(name)} [%]" for name in conditions), *COSTS, ""]
    rows = []
    for name, run in runs.items():
        rates = {each: rate((report.success, *report.interval)) for each, report in run.reports.items()}
        cells = [rates.get(each, ABSENT) for each in conditions]
        rows.append([named(name, lines[name]), *cells, *_costs(run), links(links_to(run.folder, target))])
    return PageTable(heads, rows, "Success and cost")


COSTS = ("policy", "parameters [M]", "action [ms]", "steps", "time")


def _costs(run: Run) -> list[str]:
    logged = max((steps[-1] + 1 for steps, _ in run.metrics.values()), default=ABSENT)
    return [
        run.policy or ABSENT,
        ABSENT if run.parameters is None else f"{run.parameters / 1e6:.2f}",
        f"{run.report.latency_ms:.1f}" if run.report and run.report.latency_ms else ABSENT,
        str(run.training.steps if run.training else logged),
        duration(run.training.seconds) if run.training else ABSENT,
    ]


def _pairs(compared: Sequence[RunComparison]) -> PageTable:
    rows = [
        [
            f"{each.one} and {each.other}",
            in_words(each.condition),
            str(each.found.episodes),
            *(["different episodes", ""] if each.found.only_first is None else _alone(each)),
            *difference(each.found),
        ]
        for each in compared
    ]
    note = (
        "Success of the second run minus that of the first, on the episodes that both played, and in how many of these "
        "one succeeded alone; or, where they played different episodes of the same world, on all of them."
    )
    heads = ("runs", "condition", "episodes", "only the first succeeds", "only the second succeeds", *DIFFERENCE)
    return PageTable(heads, rows, "Differences in success", note)


def _alone(pair: RunComparison) -> list[str]:
    return [str(pair.found.only_first), str(pair.found.only_second)]


def _config_differences(runs: Mapping[str, Run]) -> PageTable:
    """Tabulate the dotted keys that differ, with their value in each run."""
    first, *others = (run.config for run in runs.values())
    keys = dict.fromkeys(key for other in others for key, _, _ in differences(first, other))
    rows = [[code(key), *(value(at(run.config, key)) for run in runs.values())] for key in keys]
    return PageTable(["key", *runs], rows, "Differences in configuration")


def _failures(run: Run) -> list[tuple[Caption, Path]]:
    pictures = read_moving_pictures(run.folder / RECORDINGS)
    return [(caption, pictures[caption]) for caption in shown(pictures, FAILURES, 0)]
