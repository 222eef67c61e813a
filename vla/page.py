"""Pages that show what came out of a run, of several, or of a sweep: one file each, with everything in it."""

from __future__ import annotations

import logging
import os
from base64 import b64encode
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import datetime
from itertools import combinations
from pathlib import Path
from typing import Any
from urllib.parse import quote

import yaml
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from vla.curves import colours, draw_run, draw_runs
from vla.evaluate import ERROR, SEEN, Report, Result
from vla.files import write_text
from vla.report import BLUE, GREEN, GREY, RED
from vla.results import ABSENT, Run, at, differences, read_run, require_run
from vla.suite import mcnemar

log = logging.getLogger(__name__)

PAGE, COMPARISON, SWEEP = "report.html", "comparison.html", "sweep.html"
RECORDING, SAMPLES, PLOTS, SUITE = "rollouts.rrd", "samples.png", "report.png", "suite.png"
FAILURES, SUCCESSES = 6, 3  # episodes of a run that are shown
COMPARED = 3  # failures of each run that is compared


@dataclass(frozen=True)
class Line:
    """A row of a table of results."""

    words: Sequence[str]  # what it is about
    intervals: Mapping[str, tuple[float, float, float]]  # condition → success rate and its 95 % confidence interval
    costs: Sequence[str]
    links: Mapping[str, str] = field(default_factory=dict)  # what is written → where it leads
    colour: str = ""  # of its curves


@contextmanager
def optional(path: Path) -> Iterator[None]:
    """What is done within only shows results, so where it fails a warning says so and the results stay."""
    try:
        yield
    except Exception as error:
        log.warning("%s could not be made, all else is there: %s: %s", path, type(error).__name__, error)


def write_page(folder: Path) -> Path:
    """Show what lies in a run's folder, and return the path of the page; what is not there is left out.

    Raises:
        ValueError: a file is damaged.
    """
    run = read_run(folder)
    pictures = {name: folder / name for name in (SAMPLES, PLOTS, SUITE) if (folder / name).is_file()}
    return _write(
        folder / PAGE,
        "run.html",
        title=_title(run),
        run=run,
        facts=_facts(run),
        all_steps=at(run.config, "trainer.max_steps", None),
        conditions=_conditions(run),
        curves=draw_run(run.metrics),
        strips=_strips(run, FAILURES, SUCCESSES),
        pictures=pictures,
    )


def write_comparison(folders: Sequence[Path], target: Path) -> Path:
    """Show several runs beside each other in a page in the folder `target`, and return its path.

    Raises:
        ValueError: there is nothing to compare, a folder is no run, or a file in it is damaged.
    """
    if not folders:
        raise ValueError("name the runs to compare, as in report.runs=[RUN,RUN]")
    read = [require_run(folder) for folder in folders]
    runs = dict(zip(_names(folders), read, strict=True))
    lines = [
        Line([name], _intervals(run), _costs(run), _links(run.folder, target), colour)
        for (name, run), colour in zip(runs.items(), colours(len(runs)), strict=True)
    ]
    return _write(
        target / COMPARISON,
        "comparison.html",
        title=f"{len(runs)} runs" if len(runs) > 1 else next(iter(runs)),
        lines=lines,
        heads=(["run"], ["model", "parameters [M]", "action [ms]", "steps", "time"], ""),
        curves=draw_runs({name: run.metrics for name, run in runs.items()}),
        pairs=_pairs(runs),
        differences=_between(runs),
        strips={name: strips for name, run in runs.items() if (strips := _strips(run, COMPARED, 0))},
        links={name: _links(run.folder, target) for name, run in runs.items()},
    )


def write_sweep(folder: Path, choices: Sequence[str], lines: Sequence[Line], cells: Sequence[Path]) -> Path:
    """Show the table of a sweep, its picture and the curves of its cells, and return the path of the page.

    Args:
        folder: of the sweep.
        choices: what distinguishes its lines.
        lines: of the table.
        cells: their folders, whose names a line's links bear.
    """
    runs = {cell.name: read_run(cell) for cell in cells}
    told = {cell: f"{cell}: {' '.join(line.words)}" for line in lines for cell in line.links}
    overview = folder / "sweep.png"
    return _write(
        folder / SWEEP,
        "sweep.html",
        title=f"Sweep {folder.resolve().name}",
        lines=lines,
        heads=(choices, ["each seed [%]", "parameters [M]", "action [ms]"], "cells"),
        curves=draw_runs({name: run.metrics for name, run in runs.items()}),
        cells=dict(zip(map(told.get, runs), colours(len(runs)), strict=True)),
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
    environment.globals.update(green=GREEN, red=RED, blue=BLUE, grey=GREY)
    page = environment.get_template(template).render(written=f"{datetime.now():%Y-%m-%d %H:%M}", **content)
    write_text(path, page)
    return path


def _title(run: Run) -> str:
    return " · ".join(part for part in (run.model, run.goal) if part) or run.folder.resolve().name


def _facts(run: Run) -> dict[str, str]:
    """What the page begins with, beside the success rate."""
    training, report = run.training, run.report
    facts = {}
    if run.parameters is not None:
        facts["parameters"] = f"{run.parameters / 1e6:.2f} M"
    if report and report.latency_ms:
        facts["time per action"] = f"{report.latency_ms:.1f} ms"
    if training:
        facts["training"] = f"{training.steps} steps in {_duration(training.seconds)}"
    if report and report.budget_s:
        facts["collection, training, evaluation"] = _duration(report.budget_s)
    if run.metrics and (demonstrations := at(run.config, "collect.episodes")) != ABSENT:
        facts["demonstrations"] = str(demonstrations)
    if report and report.seeds:
        facts["evaluated on"] = f"seeds {min(report.seeds)} to {max(report.seeds)}"
    if report and report.checkpoint:
        folder, checkpoint = (Path(os.path.realpath(path)) for path in (run.folder, report.checkpoint))
        inside = checkpoint.is_relative_to(folder)
        facts["checkpoint"] = str(checkpoint.relative_to(folder) if inside else report.checkpoint)
    return facts


def _conditions(run: Run) -> list[dict[str, Any]]:
    """Of each condition its name, interval, counts, and how surely it differs from the first."""
    reports = run.reports
    first = next(iter(reports.values()), None)
    return [
        {
            "name": name,
            "interval": (report.success, *report.interval),
            "report": report,
            "p": None if report is first or first is None else mcnemar(first, report),
        }
        for name, report in reports.items()
    ]


def _intervals(run: Run) -> dict[str, tuple[float, float, float]]:
    return {name: (report.success, *report.interval) for name, report in run.reports.items()}


def _costs(run: Run) -> list[str]:
    logged = max((steps[-1] + 1 for steps, _ in run.metrics.values()), default=ABSENT)
    return [
        run.model or ABSENT,
        ABSENT if run.parameters is None else f"{run.parameters / 1e6:.2f}",
        f"{run.report.latency_ms:.1f}" if run.report and run.report.latency_ms else ABSENT,
        str(run.training.steps if run.training else logged),
        _duration(run.training.seconds) if run.training else ABSENT,
    ]


def _links(run: Path, page: Path) -> dict[str, str]:
    """What a run's folder has to be opened, and where that lies, seen from the folder of the page."""
    return {
        name: quote(os.path.relpath(run / name, page).replace(os.sep, "/"))
        for name in (PAGE, RECORDING)
        if (run / name).is_file()
    }


def _pairs(runs: Mapping[str, Run]) -> list[dict[str, Any]]:
    """Every two runs that played the same episodes: who won where the other lost, and how surely they differ."""
    found = []
    for one, other in combinations(runs, 2):
        for condition in runs[one].reports:
            mine, yours = (_by_seed(runs[name], condition) for name in (one, other))
            # Under the same seed another goal or another level of randomisation is another episode.
            seeds = [seed for seed, (_, scene) in mine.items() if seed in yours and scene == yours[seed][1]]
            if seeds:
                a, b = (Report(tuple(results[seed][0] for seed in seeds)) for results in (mine, yours))
                won = [
                    (x.outcome == "success", y.outcome == "success") for x, y in zip(a.results, b.results, strict=True)
                ]
                counts = {"first": won.count((True, False)), "second": won.count((False, True)), "seeds": len(seeds)}
                found.append({"one": one, "other": other, "condition": condition, **counts, "p": mcnemar(a, b)})
    return found


def _by_seed(run: Run, condition: str) -> dict[int, tuple[Result, Any]]:
    """Seed → how the policy did under a condition, and what tells whether there was the same to see and to hear."""
    results = [result for result in run.reports.get(condition, Report(())).results if result.outcome != ERROR]
    if condition == SEEN:
        return {result.seed: (result, (result.instruction, result.draws)) for result in results}
    told = run.report.config if run.report else {}
    scene = at(told, "task"), at(at(told, "evaluate.conditions"), condition)
    return {result.seed: (result, scene) for result in results}


def _between(runs: Mapping[str, Run]) -> dict[str, list[Any]]:
    """Dotted key → its value in each run, of everything in which their configurations differ."""
    first, *others = (run.config for run in runs.values())
    keys = dict.fromkeys(key for other in others for key, _, _ in differences(first, other))
    return {key: [at(run.config, key) for run in runs.values()] for key in keys}


def _strips(run: Run, failures: int, successes: int) -> list[Any]:
    if not (run.folder / RECORDING).is_file():
        return []
    from vla.film import read_strips  # the viewer's library is needed only here

    return read_strips(run.folder / RECORDING, failures, successes)


def _names(folders: Sequence[Path]) -> list[str]:
    """What tells the folders apart: the ends of their paths, no longer than they must be."""
    paths = [folder.resolve().parts for folder in folders]
    for length in range(1, max(map(len, paths)) + 1):
        names = ["/".join(path[-length:]) for path in paths]
        if len(set(names)) == len(names):
            return names
    raise ValueError("report.runs names a folder twice")


def _percent(share: float) -> str:
    return f"{100 * share:.1f}"


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    if minutes >= 60:
        return f"{minutes // 60} h {minutes % 60:02d} min"
    return f"{minutes} min {rest:02d} s" if minutes else f"{rest} s"


def _brief(value: Any) -> str:
    """A value of a configuration on one line, as it would be typed; nothing for one that is not there."""
    if value == ABSENT:
        return ""
    text = yaml.safe_dump(value, default_flow_style=True, width=10**6, allow_unicode=True, sort_keys=False).strip()
    return text.removesuffix("...").strip()


def _embedded(content: Path | bytes) -> str:
    """A picture as an address that holds it: a PNG file, or a JPEG."""
    kind, content = ("png", content.read_bytes()) if isinstance(content, Path) else ("jpeg", content)
    return f"data:image/{kind};base64,{b64encode(content).decode()}"
