"""The page that compares rows, `comparison.html` of runs and `sweep.html` of a sweep, and a sweep's other files."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from functools import partial
from itertools import cycle
from pathlib import Path
from urllib.parse import quote

from markupsafe import Markup
from matplotlib.axes import Axes

from vla.config.differences import ABSENT, differences, value_at
from vla.io.files import warn_on_error, write_text
from vla.reports.comparison import Comparisons, compare, difference_tables, remarks
from vla.reports.page import Section, render
from vla.reports.pictures import COLOURS, Panels, error_bars, plot_rates, save, svgs
from vla.reports.tables import Table, config_value, duration, links, percent, rate
from vla.reports.training_curves import training_sections
from vla.rollouts.recordings import moving_pictures
from vla.runs.folder import PAGE, RECORDING, RECORDINGS, Run
from vla.runs.sweep import DEMONSTRATIONS, SweepRow, conditions_of, failures, read_rows

COMPARISON, SWEEP = "comparison.html", "sweep.html"
CONDITIONS = 4  # maximum number of conditions on a terminal
FAILURES = 3  # moving pictures per run


def write_comparison(
    page: Path, title: str, rows: Sequence[SweepRow], comparisons: Comparisons, facts: Mapping[str, str]
) -> Path:
    """Write a page on rows and their comparisons; return its path. Raises a UserError if a moving picture is damaged.

    With more runs than colours it shows neither their moving pictures nor the differences in their configurations.
    """
    legend, cells = _legend(rows), list[tuple[str, str, Run]]()
    for row in rows:
        single = len(row.runs) == 1
        cells += [(row.name if single else run.folder.name, legend[row.name], run) for run in row.runs]
    if len({name for name, _, _ in cells}) < len(cells):  # a row's name may be the number of another row's cell
        cells = [(run.folder.name, colour, run) for _, colour, run in cells]
    shown_runs = {name: run for name, _, run in cells} if len(cells) <= len(COLOURS) else {}
    parts = [
        results_table(rows, page.parent),
        Section("Remarks", facts=facts),
        Section("Success", panels=svgs(success_panels(rows)), lines=legend),
        *difference_tables(comparisons),
        *training_sections([(colour, run.metrics) for _, colour, run in cells]),
        _config_differences(shown_runs),
        *(_failures(name, run) for name, run in shown_runs.items()),
    ]
    return render(page, title, parts, any(report.anytime for _, _, run in cells for report in run.reports.values()))


def tabulate(folder: Path) -> list[SweepRow]:
    """Write the table of a sweep's folder and return its rows; without any report, write nothing."""
    rows = read_rows(folder)
    if rows:
        margin = value_at(rows[0].runs[0].config, "evaluate.margin", 0.0)
        compared = compare(((rows[0], other) for other in rows[1:]), margin)
        failure_lines = failures(folder)
        tables = [results_table(rows), *(difference_tables(compared)[:1] if compared else [])]
        texts = [*(table.markdown() for table in tables), "".join(f"- failed: {line}\n" for line in failure_lines)]
        write_text(folder / "sweep.md", "\n".join(filter(None, texts)))
        size = 4, max(2.5, 0.5 + 0.25 * len(rows))
        if panels := success_panels(rows):
            save(folder / "sweep.png", panels, 4, size, "success, 95 % CI")
        with warn_on_error(folder / SWEEP):
            facts = {f"failed cell {number}": line for number, line in enumerate(failure_lines, 1)}
            facts |= remarks({run.folder.name: run for row in rows for run in row.runs})
            write_comparison(folder / SWEEP, f"Sweep {folder.resolve().name}", rows, compared, facts)
    return rows


def results_table(rows: Sequence[SweepRow], folder: Path | None = None) -> Table:
    """Tabulate success under every condition, errors on recordings, and costs; for a page in `folder` also link to the
    pages of the runs."""
    conditions, seeds = conditions_of(list(rows)), any(len(row.runs) > 1 for row in rows)
    errors = ["error / constant"] if any(row.relative_error is not None for row in rows) else []
    costs = [*(["each seed [%]"] if seeds else []), "parameters [M]", "action [ms]", "steps", "training"]
    lines = []
    for row in rows:
        rates = [rate(row.interval(condition)) if condition in row.successes else ABSENT for condition in conditions]
        rates += [ABSENT if (error := row.relative_error) is None else f"{error:.3f}"] if errors else []
        lines.append([*row.choices.values(), *rates, *_costs(row, seeds), *([_links(row, folder)] if folder else [])])
    heads = [*rows[0].choices, *(f"{name} [%]" for name in conditions), *errors, *costs, *(["pages"] if folder else [])]
    details = [f"{name} [%]" for name in conditions[1:]] if len(conditions) > CONDITIONS else []
    return Table(heads, lines, "Success and cost", details=[*details, *costs])


def _costs(row: SweepRow, seeds: bool) -> list[str]:
    run, training = row.runs[0], row.runs[0].training
    files = [file for cell in row.runs for file in (cell.report, cell.errors) if file]
    latencies = [file.latency_ms for file in files if file.latency_ms]
    last_step = max((steps[-1] + 1 for steps, _ in run.metrics.values()), default=ABSENT)
    return [
        *([", ".join(map(percent, row.rates))] if seeds else []),
        f"{run.parameters / 1e6:.2f}" if run.parameters else ABSENT,
        f"{min(latencies):.1f}" if latencies else ABSENT,  # because other load on the machine only increases it
        str(training.steps if training else last_step),
        duration(training.seconds) if training else ABSENT,
    ]


def _links(row: SweepRow, folder: Path) -> Markup:
    files = [run.folder / name for run in row.runs for name in (PAGE, RECORDING) if (run.folder / name).is_file()]
    return links({f"{file.parent.name}/{file.name}": quote(os.path.relpath(file, folder)) for file in files})


def success_panels(rows: Sequence[SweepRow]) -> Panels:
    """Return a panel per condition: success of every row, or over the number of demonstrations if that varies."""
    if DEMONSTRATIONS in rows[0].choices:
        return {name: partial(_plot_demonstrations, rows=rows, condition=name) for name in conditions_of(list(rows))}
    panels: Panels = {}
    for condition in conditions_of(list(rows)):
        rates = {row.name: row.interval(condition) for row in rows if condition in row.successes}
        panels[condition] = partial(plot_rates, rates=rates, colours=_legend(rows))
    return panels


def _legend(rows: Sequence[SweepRow]) -> dict[str, str]:
    """Return name of a row → colour."""
    return dict(zip((row.name for row in rows), cycle(COLOURS), strict=False))


def _plot_demonstrations(axes: Axes, rows: Sequence[SweepRow], condition: str) -> None:
    """Plot success under one condition over the number of demonstrations, a line per other choice."""
    lines: dict[str, list[SweepRow]] = {}
    for row in sorted(rows, key=_demonstrations):
        if condition in row.successes:
            choices = [value for key, value in row.choices.items() if key != DEMONSTRATIONS]
            lines.setdefault(" ".join(choices), []).append(row)
    for (name, line), colour in zip(lines.items(), cycle(COLOURS), strict=False):
        rates, reach = error_bars(row.interval(condition) for row in line)
        axes.errorbar([*map(_demonstrations, line)], rates, reach, fmt="o-", color=colour, capsize=3, label=name)
    axes.set(xscale="log", ylim=(0, 1), xticks=sorted({*map(_demonstrations, rows)}))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_formatter("")
    axes.grid(alpha=0.2)
    if len(lines) > 1:
        axes.legend(frameon=False)


def _demonstrations(row: SweepRow) -> int:
    choice = row.choices[DEMONSTRATIONS]  # "default" in a cell of another sweep in the folder
    return int(choice) if choice.isdecimal() else int(value_at(row.runs[0].config, DEMONSTRATIONS, 0))


def _config_differences(runs: Mapping[str, Run]) -> Table:
    """Tabulate the dotted keys that differ, with their value in each run."""
    config, *configs = [run.config for run in runs.values()] or [{}]
    keys = dict.fromkeys(key for other in configs for key, _, _ in differences(config, other))
    rows = [[key, *(config_value(value_at(run.config, key)) for run in runs.values())] for key in keys]
    return Table(["key", *runs], rows, "Differences in configuration")


def _failures(name: str, run: Run) -> Section:
    failed = [result for result in run.report.per_episode if not result.success] if run.report else []
    pictures = moving_pictures(failed, run.folder / RECORDINGS)
    return Section(f"Failures of {name}", rollouts=pictures[:FAILURES])
