"""The table of a sweep."""

from __future__ import annotations

import io
import json
import re
import weakref
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from figures import panels, points, spans, texts
from hydra.core.utils import JobReturn, JobStatus
from hydra.types import RunMode
from matplotlib.figure import Figure
from omegaconf import OmegaConf
from rich.console import Console

from vla.io.errors import UserError
from vla.jobs.sweep import SweepTable
from vla.reports.comparison import Comparisons, common_episodes, compare
from vla.reports.comparison_page import results_table, tabulate
from vla.reports.evaluation import write_report
from vla.reports.tables import Table
from vla.rollouts.comparison import SUCCESS, compare_samples
from vla.rollouts.results import Report, Result
from vla.rollouts.sequential import anytime_interval
from vla.rollouts.statistics import pooled_interval
from vla.run import SWEEP, _end, _fail
from vla.runs.folder import read_run
from vla.runs.sweep import SweepRow, describe_failures, read_rows, save_failure
from vla.spec import FIRST_SEED


def cell(
    sweep: Path,
    number: int,
    overrides: list[str],
    successes: int,
    latency: float = 2.0,
    dark: int = 1,
    anytime: bool = False,
    conditions: tuple[str, ...] = ("dark",),
    config: dict[str, Any] | None = None,
    draws: Callable[[int], dict[str, Any]] = lambda seed: {},
) -> None:
    """A cell as a run leaves it: 10 episodes, whose draws follow from their seeds, and 5 in the dark."""
    folder = sweep / str(number)
    (folder / ".hydra").mkdir(parents=True, exist_ok=True)
    (folder / ".hydra/overrides.yaml").write_text("".join(f"- {one}\n" for one in overrides))
    seen = ["success"] * successes + ["timeout"] * (10 - successes)
    in_the_dark = ["success"] * dark + ["dropped"] * (5 - dark) + ["error"] * 5
    plain = Report(tuple(Result(n, seen[n], draws=draws(n)) for n in range(10)), anytime=anytime)
    other = Report(tuple(map(Result, range(10), in_the_dark)), anytime=anytime)
    size = {"parameters": 2_000_000, "latency_ms": latency}
    write_report(plain, folder / "report.json", None, config or {}, size, dict.fromkeys(conditions, other))


def test_worlds_are_the_same_whether_a_condition_makes_them_or_the_task_is_so(tmp_path: Path) -> None:
    report, levels = Report(tuple(Result(FIRST_SEED + n, "success") for n in range(3))), {}
    for level in ("default", "wide"):
        config = {"task": {"randomize": level}, "evaluate": {"conditions": {"wide": {"randomize": "wide"}}}}
        (tmp_path / level).mkdir()
        write_report(report, tmp_path / level / "report.json", None, config, {}, {"wide": report})
        levels[level] = read_run(tmp_path / level)
    assert len(common_episodes(levels["default"], levels["wide"], "wide")) == 3
    assert not common_episodes(levels["default"], levels["wide"], "seen")


def printed(table: Table) -> str:
    console = Console(file=io.StringIO(), width=120, record=True)
    console.print(table)
    return console.export_text()


def compare_rows(rows: list[SweepRow]) -> Comparisons:
    """Every row with the first one."""
    return compare(((rows[0], other) for other in rows[1:]), 0.02)


def test_seeds_are_put_together_and_the_rest_is_told_apart(tmp_path: Path, figures: list[Figure]) -> None:
    for number, (model, seed, successes) in enumerate([("bc", 0, 9), ("bc", 1, 7), ("rt1", 0, 10), ("rt1", 1, 8)]):
        cell(tmp_path, number, ["trainer.max_steps=5", f"model={model}", f"seed={seed}"], successes, 9.0 - 7 * seed)
    bc, rt1 = tabulate(tmp_path)
    assert (bc.choices, rt1.choices) == ({"model": "bc"}, {"model": "rt1"})
    assert bc.episodes == {"seen": 20, "dark": 10}
    assert bc.rates == [0.9, 0.7]
    lines = (tmp_path / "sweep.md").read_text().splitlines()
    assert (
        lines[0] == "| model | seen [%] | dark [%] | each seed [%] | parameters [M] | action [ms] | steps | training |"
    )
    low, high = (100 * bound for bound in pooled_interval(bc.successes["seen"]))
    assert f"| bc | 80.0 ({low:.1f}-{high:.1f}) |" in lines[2] and lines[2].endswith(
        "| 90.0, 70.0 | 2.00 | 2.0 | - | - |"
    )
    (seen,), (dark,) = (panels(figures[0], title) for title in ("seen", "dark"))
    assert points(seen) == [(0.8, 0.0), (0.9, 1.0)] and points(dark) == [(0.2, 0.0), (0.2, 1.0)]
    assert spans(seen)[0] == (round(low / 100, 3), round(high / 100, 3))
    assert {"bc", "rt1"} <= texts(seen)
    assert not list(tmp_path.glob(".*"))


def test_no_run_is_lost_where_the_choices_are_numbers_like_those_of_cells(tmp_path: Path) -> None:
    for number, (seed, history) in enumerate([(0, 1), (0, 2), (1, 1)]):  # a fourth cell failed
        cell(tmp_path, number, [f"seed={seed}", f"model.context.history={history}"], 5, config={"seed": seed})
    assert [row.name for row in tabulate(tmp_path)] == ["1", "2"]
    page = (tmp_path / "sweep.html").read_text()
    differences = re.sub(r"<[^>]*>", " ", page[page.index("Differences in configuration") :])
    assert "key 0 2 1 seed 0 1 0" in " ".join(differences.split())


def test_the_console_has_a_row_per_choice_and_of_many_conditions_the_first(tmp_path: Path) -> None:
    cell(tmp_path, 0, ["model=bc"], 9)
    cell(tmp_path, 1, ["model=[rt1]"], 7, dark=0)
    rows = read_rows(tmp_path)
    shown = printed(results_table(rows))
    assert "90.0 (59.6-98.2)" in shown and "0.0 (0.0-43.4)" in shown and "[rt1]" in shown and "dark" in shown
    cell(tmp_path, 2, ["model=act"], 7, conditions=tuple(f"dark_{number}" for number in range(4)))
    assert "seen [%]" in (shown := printed(results_table(read_rows(tmp_path)))) and "dark" not in shown


def test_cells_that_failed_are_left_out_and_a_sweep_without_any_writes_nothing(tmp_path: Path) -> None:
    (tmp_path / "0/.hydra").mkdir(parents=True)
    assert tabulate(tmp_path) == []
    assert not list(tmp_path.glob("sweep.*"))
    cell(tmp_path, 1, ["model=bc", "seed=0"], 9)
    cell(tmp_path, 2, ["model=rt1", "seed=0"], 9)
    (tmp_path / "2/error.txt").write_text("holds a training that differs in model")  # the report is of another sweep
    cell(tmp_path, 3, [], 9)
    (tmp_path / "3/.hydra/overrides.yaml").unlink()  # a run that somebody put into the folder
    (row,) = tabulate(tmp_path)
    assert row.choices == {} and row.name == "all"
    failed = "2 model=rt1: holds a training that differs in model"
    assert (tmp_path / "sweep.md").read_text().endswith(f"\n\n- failed: {failed}\n")
    assert f"<dd>{failed}</dd>" in (tmp_path / "sweep.html").read_text()


def test_of_many_cells_the_table_is_written_after_some_and_at_the_end(tmp_path: Path) -> None:
    written, page = [], tmp_path / "sweep.html"
    for number in range(13):
        cell(tmp_path, number, [f"seed={number}"], 9)
        hydra = {
            "mode": RunMode.MULTIRUN,
            "runtime": {"output_dir": str(tmp_path / str(number))},
            "sweep": {"dir": str(tmp_path)},
        }
        config = OmegaConf.create({"hydra": hydra})
        SweepTable().on_job_end(config, JobReturn(status=JobStatus.COMPLETED))
        written.append(page.exists())
        page.unlink(missing_ok=True)
    assert written == [True] * 10 + [False] * 3
    SweepTable().on_multirun_end(config)
    assert page.exists()


def test_where_a_cell_fails_the_table_has_the_others_too(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for number in range(13):
        cell(tmp_path, number, [f"data.seed={number}"], 9)
    save_failure(tmp_path / "2", "no room")
    (error := UserError("no room")).add_note(f"{SWEEP}{tmp_path}")  # of the first cell that failed, when all have ended
    with pytest.raises(SystemExit):
        _end(error)
    assert capsys.readouterr().err == (
        f"error: 1 of 13 cells failed, see error.txt of each in {tmp_path}\n  2 data.seed=2: no room\n"
    )
    told = (tmp_path / "sweep.md").read_text()
    assert "| 12 | 90.0 (" in told and "- failed: 2 data.seed=2: no room" in told
    (tmp_path / "13").mkdir()
    save_failure(tmp_path / "13", "hydra.output_subdir=None")  # so that its overrides are not known
    assert describe_failures(tmp_path).endswith("\n  13: hydra.output_subdir=None")


def test_agents_without_a_model_are_rows_too(tmp_path: Path) -> None:
    cell(tmp_path, 0, ["model=bc"], 9)
    (tmp_path / "1/.hydra").mkdir(parents=True)
    (tmp_path / "1/.hydra/overrides.yaml").write_text("- agent=expert\n")
    write_report(Report((Result(0, "success"),)), tmp_path / "1/report.json", None, {})
    tabulate(tmp_path)
    assert "| expert | 100.0 (20.7-100.0) | - | - | - | - | - |\n" in (tmp_path / "sweep.md").read_text()


def test_a_condition_that_not_every_cell_played_is_left_open(tmp_path: Path) -> None:
    cell(tmp_path, 0, ["evaluate=paper"], 7)
    cell(tmp_path, 1, ["evaluate=default"], 7, conditions=())
    tabulate(tmp_path)
    assert "| default | 70.0 (39.7-89.2) | - |" in (tmp_path / "sweep.md").read_text()
    assert (tmp_path / "sweep.html").exists()


def test_rows_are_compared_with_the_first_on_the_same_scenes(tmp_path: Path) -> None:
    for number, (model, successes) in enumerate([("bc", 10), ("rt1", 3), ("act", 10)]):
        cell(tmp_path, number, [f"model={model}"], successes)
    rows = tabulate(tmp_path)
    compared = {(name, condition): each[SUCCESS] for (name, _, condition), each in compare_rows(rows).items()}
    assert {*compared} == {(model, condition) for model in ("rt1", "act") for condition in ("seen", "dark")}
    worse = compared["rt1", "seen"]
    assert (worse.only_first, worse.only_second, worse.episodes, worse.verdict) == (7, 0, 10, "worse")
    assert worse.p == worse.p_holm == 2 / 2**7  # the other three never differ
    _, text = (tmp_path / "sweep.md").read_text().split("\n\n")
    assert text.startswith("| second | minus first | condition | episodes | only the first succeeds |")
    assert re.search(r"\| rt1 \| bc \| seen \| 10 \| 7 \| 0 \| -70\.0 \(.*\) \| 0\.016 \| 0\.016 \| worse \|", text)
    page = (tmp_path / "sweep.html").read_text()
    assert "Differences in success" in page and page.count("<td>rt1</td>") == 3 and "McNemar" in page


def test_a_condition_that_repeats_the_training_condition_is_no_further_comparison(tmp_path: Path) -> None:
    for light, expected in ((1, ["seen", "dark"]), (0, ["seen"])):
        config = {"task": {"light": light}, "evaluate": {"conditions": {"dark": {"light": 0}}}}
        for number, (model, successes) in enumerate([("bc", 10), ("rt1", 3)]):
            cell(tmp_path, number, [f"model={model}"], successes, config=config)
        assert [condition for _, _, condition in compare_rows(tabulate(tmp_path))] == expected


def test_single_trainings_are_compared_in_the_course_of_episodes(tmp_path: Path) -> None:
    for number, milestones in enumerate((["grasped"], [])):
        folder = tmp_path / str(number)
        (folder / ".hydra").mkdir(parents=True)
        (folder / ".hydra/overrides.yaml").write_text(f"- model={['bc', 'act'][number]}\n")
        results = (Result(seed, "success", "lift", milestones=tuple(milestones)) for seed in range(8))
        write_report(Report(tuple(results)), folder / "report.json", None, {})
    (compared,) = compare_rows(tabulate(tmp_path)).values()
    assert compared[SUCCESS].verdict == "open" and compared["grasped"].difference == -1
    page = (tmp_path / "sweep.html").read_text()
    assert "Differences in secondary metrics" in page and "-100.0 * (" in page


def test_rows_of_the_same_scenes_in_other_pictures_are_compared_under_conditions_too(tmp_path: Path) -> None:
    for number, size in enumerate((96, 48)):
        config = {"task": {"image_size": [size, size]}, "evaluate": {"conditions": {"dark": {"light": 0}}}}
        drawn = [f"task.image_size=[{size},{size}]"]
        cell(tmp_path, number, drawn, 5, config=config, draws=lambda n: {"blocks": n})
    assert [condition for _, _, condition in compare_rows(tabulate(tmp_path))] == ["seen", "dark"]


def test_cells_on_recordings_are_compared_by_their_errors(tmp_path: Path) -> None:
    for number, (model, seed, relative) in enumerate([("act", 0, 0.5), ("act", 1, 0.7), ("bc", 0, 0.8)]):
        (folder := tmp_path / str(number) / ".hydra").mkdir(parents=True)
        (folder / "overrides.yaml").write_text(f"- model={model}\n- seed={seed}\n")
        part = {"name": "x", "unit": "1", "error": 1.0, "ci_low": 1.0, "ci_high": None, "constant": 2.0}
        errors = {"seeds": [3, 8], "components": [part], "relative": relative, "checkpoint": None, "config": {}}
        (folder.parent / "errors.json").write_text(json.dumps({**errors, "latency_ms": 3.0 + number}))
    assert len(tabulate(tmp_path)) == 2
    table = (tmp_path / "sweep.md").read_text()
    assert "| act | 0.600 |" in table and "| bc | 0.800 |" in table and "| 5.0 |" in table
    page = (tmp_path / "sweep.html").read_text()
    assert "0.600" in page and "not compared" not in page and not (tmp_path / "sweep.png").exists()


def test_a_condition_that_some_trainings_of_a_row_lack_is_no_error(tmp_path: Path) -> None:
    for number, conditions in enumerate([("dark",), (), ("dark",), ("dark",)]):
        config = {"task": {"light": 1}, "evaluate": {"conditions": {name: {"light": 0} for name in conditions}}}
        drawn = [f"model={'bc' if number < 2 else 'rt1'}", f"seed={number % 2}"]
        cell(tmp_path, number, drawn, 5, conditions=conditions, config=config)
    assert ("rt1", "bc", "seen") in compare_rows(tabulate(tmp_path))


def test_several_trainings_count_as_fewer_episodes_in_a_comparison(tmp_path: Path) -> None:
    for number, (model, successes) in enumerate([("bc", 9), ("bc", 9), ("rt1", 1), ("rt1", 9)]):
        cell(tmp_path, number, [f"model={model}", f"seed={number % 2}"], successes)
    seen, _ = (each[SUCCESS] for each in compare_rows(tabulate(tmp_path)).values())
    assert seen.difference == pytest.approx(-0.4) and (seen.episodes, seen.only_first) == (40, None)
    independent = compare_samples(18, 20, 10, 20)
    assert independent.p < 0.05 < seen.p and seen.ci_low < independent.ci_low  # the trainings of rt1 differ
    assert seen.verdict == "open"


def test_several_trainings_are_compared_only_if_all_their_scenes_are_the_same(tmp_path: Path) -> None:
    for number, (level, seed) in enumerate([("default", 0), ("default", 1), ("wide", 0), ("wide", 1)]):
        most = 2 if level == "default" else 3
        drawn = [f"task/randomize={level}", f"seed={seed}"]
        cell(tmp_path, number, drawn, 5, draws=lambda n, most=most: {"blocks": 2 if n < 3 else most})
    assert [condition for _, _, condition in compare_rows(tabulate(tmp_path))] == ["dark"]


def test_a_row_that_stopped_when_it_was_clear_has_its_anytime_valid_interval(tmp_path: Path) -> None:
    cell(tmp_path, 0, ["model=bc"], 9, anytime=True)
    low, high = (100 * bound for bound in anytime_interval(9, 1))
    tabulate(tmp_path)
    assert f"| 90.0 ({low:.1f}-{high:.1f}) |" in (tmp_path / "sweep.md").read_text()
    assert "by betting, valid at any time, where playing stopped" in (tmp_path / "sweep.html").read_text()


def test_over_the_number_of_demonstrations_success_is_a_curve_under_each_condition(
    tmp_path: Path, figures: list[Figure]
) -> None:
    numbers = [("default", 1000, 9), ("default", 50, 8), ("wide", 50, 3), ("wide", 1000, 4)]
    for number, (level, count, successes) in enumerate(numbers):
        cell(tmp_path, number, [f"task/randomize={level}", f"collect.episodes={count}"], successes)
    tabulate(tmp_path)
    (seen,), (dark,) = (panels(figures[0], title) for title in ("seen", "dark"))
    assert points(seen) == [(50, 0.8), (1000, 0.9), (50, 0.3), (1000, 0.4)]
    assert points(dark) == [(50, 0.2), (1000, 0.2)] * 2
    assert {"default", "wide"} <= texts(seen) and {"50", "1000"} <= texts(dark)


def test_a_cell_that_does_not_name_its_demonstrations_has_those_of_its_config(tmp_path: Path) -> None:
    cell(tmp_path, 0, ["collect.episodes=10"], 5)
    cell(tmp_path, 1, ["model=bc"], 5)
    (tmp_path / "1/config.yaml").write_text("collect: {episodes: 500}")
    tabulate(tmp_path)
    assert (tmp_path / "sweep.html").exists() and (tmp_path / "sweep.png").exists()


def test_the_error_of_a_cell_holds_neither_its_model_nor_its_data(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Model:
        def __init__(self) -> None:
            self.trainer = self  # as in a training, a cycle

    def train() -> None:
        model = Model()
        models.append(weakref.ref(model))
        try:
            raise KeyError(model)
        except KeyError as error:
            raise UserError("the loss is not finite") from error

    models = list[Any]()
    config = OmegaConf.create({"runtime": {"output_dir": str(tmp_path / "0")}})
    monkeypatch.setattr("vla.run.HydraConfig.get", lambda: config)
    with pytest.raises(UserError, match="not finite") as kept:
        try:
            train()
        except UserError as error:
            _fail(error)
    assert models[0]() is None and kept.value.__notes__ == [f"{SWEEP}{tmp_path}"]
    assert (tmp_path / "0/error.txt").read_text() == "the loss is not finite\n"
