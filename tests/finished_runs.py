"""Run folders as an evaluation leaves them, without their pictures."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any

from vla.reports.comparison import compare, read_runs, remarks, rows_of
from vla.reports.comparison_page import write_comparison
from vla.reports.evaluation import write_report
from vla.rollouts.comparison import compare_conditions
from vla.rollouts.results import Report, Result
from vla.runs.folder import save_config
from vla.spec import FIRST_SEED

SAID = "lift the <script>alert('red')</script> block"

CONFIG = {
    "task": {"blocks": 3},
    "model": {"_target_": "vla.models.bc.BC", "width": 16},
    "trainer": {"max_steps": 400},
    "output": "there",
}

CURVES = """\
epoch,step,lr,train/loss,train/truth_loss,val/error_dx_mm,val/error_dy_mm,val/error_gripper,val/loss
0,9,0.001,4.5,1.0,,,,
0,19,0.0005,1.5,0.5,,,,
0,19,,,,3.0,4.0,0.1,2.5
0,29,0.0001,0.1,0.1,,,,
0,39,,,,1.0,2.0,0.05,0.125
"""


OUTCOMES = {"1": "success", "s": "success", "0": "dropped", "d": "dropped", "t": "timeout", "e": "error"}


def a_report(outcomes: str, anytime: bool = False) -> Report:
    """An episode for every letter: 1 or s is a success, 0 or d a drop, t a timeout, e an error."""
    results = (Result(FIRST_SEED + n, OUTCOMES[each], SAID, 20, {"n": n}) for n, each in enumerate(outcomes))
    return Report(tuple(results), anytime=anytime)


def a_run(
    folder: Path,
    outcomes: str = "ssss",
    width: int = 16,
    curves: str = CURVES,
    light: float | None = None,
    dark: str = "",
    more: dict[str, Any] | None = None,
) -> Path:
    """A folder as an evaluation leaves it, without pictures and recordings.

    In the dark all are drops unless told. The report has `more` entries.
    """
    folder.mkdir(parents=True)
    report, in_the_dark = map(a_report, (outcomes, dark or "d" * len(outcomes)))
    if light is not None:
        report = Report(tuple(replace(result, draws={**result.draws, "light": light}) for result in report.results))
    told = {"evaluate": {"conditions": {"dark": {"light": light}}}}
    config = {**CONFIG, **told, "model": {"_target_": "vla.models.bc.BC", "width": width}}
    size = {"parameters": 1_500_000, "latency_ms": 2.5, **(more or {})}
    compared = compare_conditions({"seen": report, "dark": in_the_dark}, 0.02)
    used = f"{folder}/policy"
    write_report(report, folder / "report.json", used, config, size, {"dark": in_the_dark}, compared)
    (folder / "metrics.csv").write_text(curves)
    save_config(folder, config, [{"key": "model.width", "here": width, "default": 32}])
    return folder


def compared(folders: list[Path], target: Path) -> Path:
    """The page of `job=report`."""
    runs = read_runs(folders)
    found, page = compare(combinations(rows_of(runs), 2), 0.02), target / "comparison.html"
    return write_comparison(page, f"{len(runs)} runs", rows_of(runs), found, remarks(runs, found))
