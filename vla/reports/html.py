"""Self-contained HTML pages of a run, of a comparison of runs, and of a sweep."""

from __future__ import annotations

import os
from base64 import b64encode
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any
from urllib.parse import quote

import yaml
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from vla.config.differences import ABSENT, at, differences
from vla.data.index import listed
from vla.io.files import write_text
from vla.reports.comparison import CASE, RunComparison, remarks, secondary_rows
from vla.reports.conditions import SecondaryRows, comparison_texts, secondary_head, secondary_names, secondary_texts
from vla.reports.posteriors import Outcome, draw_posteriors
from vla.reports.style import BLUE, GREEN, GREY, RED, Interval
from vla.reports.training_curves import colours, draw_run, draw_runs
from vla.rollouts.motion import AMOUNTS
from vla.rollouts.results import Report
from vla.runs.folder import ERRORS_PLOT, PAGE, PLOT, RECORDING, SAMPLES, SUITE, Run, read_run
from vla.spec import IN_DISTRIBUTION

COMPARISON, SWEEP = "comparison.html", "sweep.html"
FAILURES, SUCCESSES = 6, 3  # filmstrips on a run's page
NAMED = 5  # maximum number of tasks in a title
COMPARED = 3  # failures per run on a comparison

Rate = tuple[Interval, str, Sequence[str]]  # count of episodes, and comparison with the first condition

# Heads of the columns, and rows of words and cells, which are difference, interval and whether that is decided.
SecondaryTable = tuple[list[str], list[tuple[Sequence[str], list[tuple[str, str, bool] | None]]]]


@dataclass(frozen=True)
class TableRow:
    """A row of a table of results."""

    words: Sequence[str]  # name of the run, or choices of a sweep's row
    intervals: Mapping[str, Interval]  # by condition
    costs: Sequence[str]
    links: Mapping[str, str] = field(default_factory=dict)  # text → address
    colour: str = ""  # of its curves


def write_page(folder: Path) -> Path:
    """Write the page of a run from the files in its folder, and return its path; missing files are omitted.

    Raises:
        ValueError: a file is damaged.
    """
    run = read_run(folder)
    pictures = {name: folder / name for name in (SAMPLES, PLOT, SUITE, ERRORS_PLOT) if (folder / name).is_file()}
    return _write(
        folder / PAGE,
        "run.html",
        title=_title(run),
        run=run,
        anytime=any(report.anytime for report in run.reports.values()),
        facts=_facts(run),
        all_steps=at(run.config, "trainer.max_steps", None),
        tables=_rate_tables(run),
        report=run.reports.get(IN_DISTRIBUTION),
        amounts=AMOUNTS,
        secondary=_secondary(
            {(name,): part.secondary for name, part in run.report.conditions.items()} if run.report else {}
        ),
        errors=_error_table(run),
        curves=draw_run(run.metrics),
        strips=_filmstrips(run, FAILURES, SUCCESSES),
        pictures=pictures,
    )


def write_comparison(runs: Mapping[str, Run], compared: Sequence[RunComparison], target: Path) -> Path:
    """Write a page on several runs, by name, and their comparisons into the folder `target`, and return its path.

    Raises:
        ValueError: a recording is damaged.
    """
    lines = [
        TableRow(
            [name],
            {condition: (report.success, *report.interval) for condition, report in run.reports.items()},
            _costs(run),
            _links(run.folder, target),
            colour,
        )
        for (name, run), colour in zip(runs.items(), colours(len(runs)), strict=True)
    ]
    outcomes = {
        line.words[0]: Outcome(report.successes, report.episodes, line.intervals[IN_DISTRIBUTION], line.colour)
        for line, run in zip(lines, runs.values(), strict=True)
        if (report := run.reports.get(IN_DISTRIBUTION))
    }
    return _write(
        target / COMPARISON,
        "comparison.html",
        title=f"{len(runs)} runs" if len(runs) > 1 else next(iter(runs)),
        lines=lines,
        heads=(["run"], ["policy", "parameters [M]", "action [ms]", "steps", "time"], ""),
        posteriors=draw_posteriors(outcomes, compared) if len(outcomes) == len(runs) else None,
        curves=draw_runs({name: run.metrics for name, run in runs.items()}),
        pairs=[(each, comparison_texts(each.found)) for each in compared],
        remarks=remarks(runs, compared),
        secondary=_secondary(secondary_rows(compared)),
        case=CASE,
        anytime=any(report.anytime for run in runs.values() for report in run.reports.values()),
        differences=_config_differences(runs),
        strips={name: strips for name, run in runs.items() if (strips := _filmstrips(run, COMPARED, 0))},
        links={name: _links(run.folder, target) for name, run in runs.items()},
    )


def write_sweep(
    folder: Path,
    choices: Sequence[str],
    lines: Sequence[TableRow],
    cells: Sequence[Run],
    compared: Sequence[RunComparison],
    posteriors: str | None,
    failed: Sequence[str],
) -> Path:
    """Write the page of a sweep with its tables, plots and training curves, and return its path.

    Args:
        folder: of the sweep.
        choices: keys of the choices that distinguish the rows.
        lines: rows of the table; their links are named by cells.
        cells: of the sweep.
        compared: rows with the first one.
        posteriors: figure of the rows' success, SVG.
        failed: name, choices and reason of every failed cell.
    """
    runs = {cell.folder.name: cell for cell in cells}
    captions = {cell: f"{cell}: {' '.join(line.words)}" for line in lines for cell in line.links}
    overview = folder / "sweep.png"
    return _write(
        folder / SWEEP,
        "sweep.html",
        title=f"Sweep {folder.resolve().name}",
        lines=lines,
        heads=(choices, ["each seed [%]", "parameters [M]", "action [ms]"], "cells"),
        posteriors=posteriors,
        compared=[(each, comparison_texts(each.found)) for each in compared],
        secondary=_secondary(secondary_rows(compared)),
        case=("row", "minus", "condition"),
        anytime=any(report.anytime for run in cells for report in run.reports.values()),
        curves=draw_runs({name: run.metrics for name, run in runs.items()}),
        failed=failed,
        cells=dict(zip(map(captions.get, runs), colours(len(runs)), strict=True)),
        pictures={overview.name: overview} if overview.is_file() else {},
    )


def _write(path: Path, template: str, **content: Any) -> Path:
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).with_name("templates")),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(percent=_percent, duration=_duration, brief=_brief, embedded=_embedded, svg=Markup)
    named: dict[str, Any] = {"green": GREEN, "red": RED, "blue": BLUE, "grey": GREY}
    environment.globals.update(named)
    page = environment.get_template(template).render(written=f"{datetime.now():%Y-%m-%d %H:%M}", **content)
    write_text(path, page)
    return path


def _title(run: Run) -> str:
    tasks = ", ".join(run.tasks) if len(run.tasks) <= NAMED else f"{len(run.tasks)} tasks"
    return " · ".join(part for part in (run.policy, tasks.replace("_", " ")) if part) or run.folder.resolve().name


def _facts(run: Run) -> dict[str, str]:
    """Return the facts at the top of a run's page: name → text."""
    training, report = run.training, run.report or run.errors
    facts = {}
    if run.parameters is not None:
        facts["parameters"] = f"{run.parameters / 1e6:.2f} M"
    if report and report.latency_ms:
        facts["time per action"] = f"{report.latency_ms:.1f} ms"
    if training:
        facts["training"] = f"{training.steps} steps in {_duration(training.seconds)}"
    if report and report.wall_time_s:
        of_another = "evaluation, and training of the policy" if report.checkpoint else "evaluation"
        parts = "collection, training, evaluation" if training else of_another
        facts[parts] = _duration(report.wall_time_s)
    if run.metrics and (demonstrations := at(run.config, "collect.episodes")) != ABSENT:
        facts["demonstrations"] = str(demonstrations)
    if report and report.seeds:
        seeds = f"seeds {min(report.seeds)} to {max(report.seeds)}"
        facts["evaluated on"] = seeds if run.report else f"the held-out episodes {listed(report.seeds)}"
    if report and report.checkpoint:
        folder, checkpoint = (Path(os.path.realpath(path)) for path in (run.folder, report.checkpoint))
        inside = checkpoint.is_relative_to(folder)
        facts["checkpoint"] = str(checkpoint.relative_to(folder) if inside else report.checkpoint)
    return facts


def _error_table(run: Run) -> list[tuple[str, str, str]]:
    """Return component, error with its interval, and error of a constant action."""
    rows = []
    for each in run.errors.components if run.errors else ():
        unit, error, interval, constant = each.readable()
        rows.append((each.name, f"{error} ({interval}) {unit}", f"{constant} {unit}"))
    return rows


def _rate_tables(run: Run) -> dict[str, dict[str, Rate]]:
    """Return table → name → row of a run's page."""
    first, conditions = run.reports.get(IN_DISTRIBUTION, Report(())), run.report.conditions if run.report else {}
    mean = first.mean_over_tiers
    compared = {name: comparison_texts(each.comparison) for name, each in conditions.items() if each.comparison}
    return {
        "condition": {name: (*_rate(report)[:2], compared.get(name, ())) for name, report in run.reports.items()},
        "tier": {
            **{name: _rate(part) for name, part in first.by_tier.items()},
            **({first.mean_label: (mean, "", ())} if mean else {}),
        },
        "task": {name: _rate(part) for name, part in first.by_task.items()},
        "milestone": {name: _rate(first, count) for name, count in first.milestones.items()},
        "completed": {name: _rate(first, count) for name, count in first.in_a_row.items()},
    }


def _rate(report: Report, count: int | None = None) -> Rate:
    """Return the rate of an event that `count` completed episodes had, by default that of success."""
    interval = report.interval if count is None else report.interval_of(count)
    count = report.successes if count is None else count
    return (count / max(report.episodes, 1), *interval), f"{count}/{report.episodes}", ()


def _secondary(rows: SecondaryRows) -> SecondaryTable:
    names = secondary_names(rows)
    return [secondary_head(name) for name in names], [
        (words, [secondary_texts(name, metrics[name]) if name in metrics else None for name in names])
        for words, metrics in rows.items()
        if metrics
    ]


def _costs(run: Run) -> list[str]:
    logged = max((steps[-1] + 1 for steps, _ in run.metrics.values()), default=ABSENT)
    return [
        run.policy or ABSENT,
        ABSENT if run.parameters is None else f"{run.parameters / 1e6:.2f}",
        f"{run.report.latency_ms:.1f}" if run.report and run.report.latency_ms else ABSENT,
        str(run.training.steps if run.training else logged),
        _duration(run.training.seconds) if run.training else ABSENT,
    ]


def _links(run: Path, page: Path) -> dict[str, str]:
    """Return name → address, relative to the folder `page`, of a run's page and recording."""
    return {
        name: quote(os.path.relpath(run / name, page).replace(os.sep, "/"))
        for name in (PAGE, RECORDING)
        if (run / name).is_file()
    }


def _config_differences(runs: Mapping[str, Run]) -> dict[str, list[Any]]:
    """Return dotted key → its value in each run, for all keys that differ."""
    first, *others = (run.config for run in runs.values())
    keys = dict.fromkeys(key for other in others for key, _, _ in differences(first, other))
    return {key: [at(run.config, key) for run in runs.values()] for key in keys}


def _filmstrips(run: Run, failures: int, successes: int) -> list[Any]:
    if not (run.folder / RECORDING).is_file():
        return []
    from vla.reports.filmstrips import read_filmstrips  # imports rerun

    return read_filmstrips(run.folder / RECORDING, failures, successes)


def _percent(share: float) -> str:
    return f"{100 * share:.1f}"


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    if minutes >= 60:
        return f"{minutes // 60} h {minutes % 60:02d} min"
    return f"{minutes} min {rest:02d} s" if minutes else f"{rest} s"


def _brief(value: Any) -> str:
    """Format a config value on one line of YAML; empty if it is absent."""
    if value == ABSENT:
        return ""
    text = yaml.safe_dump(value, default_flow_style=True, width=10**6, allow_unicode=True, sort_keys=False).strip()
    return text.removesuffix("...").strip()


def _embedded(content: Path | bytes) -> str:
    """Encode a PNG file or a JPEG as a data URL."""
    kind, content = ("png", content.read_bytes()) if isinstance(content, Path) else ("jpeg", content)
    return f"data:image/{kind};base64,{b64encode(content).decode()}"
