"""Closed-loop evaluation: counting, intervals, errors, and the same report whatever the number of workers."""

from __future__ import annotations

import os
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import toy_recordable as toy
from composing import composed
from finished_runs import a_report
from rerun.chunk import RrdReader

from vla.config.experiment import Experiment
from vla.jobs.evaluate import require_possible
from vla.parallel.pool import Cluster, WorkerCrash
from vla.reports.evaluation import summary, write_report
from vla.reports.run_page import write_page
from vla.rollouts import recordings
from vla.rollouts.comparison import compare_conditions
from vla.rollouts.evaluate import _RolloutWorker, evaluate
from vla.rollouts.recordings import choose_results, keep_pictures, merge_recordings
from vla.rollouts.results import Report, Result
from vla.rollouts.statistics import wilson_interval
from vla.runs.folder import read_report
from vla.spec import FIRST_SEED, Array, Environment, Observation

SEEDS = range(FIRST_SEED, FIRST_SEED + 10)


def test_the_last_line_is_the_success_rate() -> None:
    report = a_report("s" * 83 + "d" * 17)
    assert str(report).splitlines() == ["dropped 17", "success 83/100 (83.0 %, 95 % CI 74.5-89.1)"]


def test_several_tasks_are_told_apart() -> None:
    def asked(task: str, *outcomes: str) -> list[Result]:
        return [Result(FIRST_SEED, outcome, task=task) for outcome in outcomes]

    push, lift = asked("push", "success", "dropped", "error"), asked("lift", "success", "success")
    nothing = Result(FIRST_SEED, "error", error="ValueError: no scene")
    report = Report((*push, *lift, nothing))
    assert report.tasks == {"lift": Report(tuple(lift)), "push": Report(tuple(push))}
    assert str(report).splitlines()[-3:] == [
        "lift 2/2 (100.0 %, 95 % CI 34.2-100.0)",
        "push 1/2 (50.0 %, 95 % CI 9.5-90.5)",
        "success 3/4 (75.0 %, 95 % CI 30.1-95.4)",
    ]
    assert {task: (told["count"], told["of"]) for task, told in summary(report)["tasks"].items()} == {
        **{"lift": (2, 2), "push": (1, 2)}
    }
    alone = Report(tuple(push))
    assert "push" not in str(alone) and summary(alone)["tasks"] == {}


def test_a_condition_without_an_episode_is_refused_before_any_is_played() -> None:
    asked = composed("task/randomize=wide", "task.blocks=6", "evaluate=language", "agent=expert")
    with pytest.raises(ValueError, match=r"condition impossible of the evaluation: task\.blocks must be from 2 to 5"):
        require_possible(Experiment.from_config(asked))
    asked = composed("task.blocks=3", "evaluate=paper")  # whose conditions change different axes
    with pytest.raises(ValueError, match=r"condition distractors of the evaluation: .* needs task\.blocks=4 or more"):
        require_possible(Experiment.from_config(asked))


@pytest.mark.parametrize(
    ("policy", "says"),
    [
        (["policy.device=cuda"], r"policy\.device=cuda, but PyTorch finds no GPU"),
        (["policy=onnx", "model=decoder", "tokenizer=fast"], "Decoder with Fast cannot be exported"),
    ],
)
def test_a_policy_that_cannot_run_here_is_refused_before_it_is_trained(
    policy: list[str], says: str, tmp_path: Path
) -> None:
    place = f"output={tmp_path}/run"
    with pytest.raises(ValueError, match=says):
        require_possible(Experiment.from_config(composed(*policy, place)))
    require_possible(Experiment.from_config(composed(*policy, place, "agent=expert")))


def test_the_report_of_rounds_is_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "round_0/checkpoints").mkdir(parents=True)
    with pytest.raises(ValueError, match="has the rounds of a job=improve, whose report this would replace"):
        require_possible(Experiment.from_config(composed(f"output={tmp_path}", "agent=expert")))


@pytest.mark.parametrize("trained", ["policy", "checkpoints/last.ckpt"])
def test_the_report_of_a_training_is_not_replaced_by_that_of_another_agent(tmp_path: Path, trained: str) -> None:
    (tmp_path / trained).mkdir(parents=True)
    with pytest.raises(ValueError, match="has a training of its own, whose report this would replace: add output=DIR"):
        require_possible(Experiment.from_config(composed(f"output={tmp_path}", "agent=expert")))


def of_ten(**won: int) -> tuple[Result, ...]:
    """Ten episodes of each task, of which so many succeed."""
    outcomes = [(task, "success" if n < count else "lost") for task, count in won.items() for n in range(10)]
    return tuple(Result(FIRST_SEED + n, outcome, task=task) for n, (task, outcome) in enumerate(outcomes))


def test_tiers_that_no_report_could_show_are_refused_before_any_work(tmp_path: Path) -> None:
    asked = composed(f"output={tmp_path}", "agent=expert", "+task.tiers=[easy]")
    with pytest.raises(ValueError, match=r"^config\.task\.tiers must be an object, got \['easy'\]"):
        require_possible(Experiment.from_config(asked))


def test_tiers_weigh_the_same_whatever_the_number_of_their_tasks() -> None:
    tiers = {"easy": ["reach", "push"], "very_hard": ["stack"], "unseen": ["fold"]}
    results = of_ten(reach=10, push=8, stack=2)
    report = Report(results, tiers)
    *_, easy, hard, mean, success = str(report).splitlines()
    assert easy.startswith("easy 18/20 (90.0 %, ") and hard.startswith("very hard 2/10 (20.0 %, ")
    assert mean.startswith("mean over tiers (3 of 4 tasks) 55.0 % (95 % CI ") and success.startswith(
        "success 20/30 (66.7 %, "
    )
    # Which task it is explains part of the outcomes: an interval for fixed tasks is narrower than Wilson's.
    low, high = report.interval
    assert low < report.success < high and high - low < 0.9 * np.diff(wilson_interval(20, 30))
    unknown = tuple(replace(result, task="") for result in results[:10])  # as an error leaves them in a condition
    assert Report((*unknown, *results[10:]), tiers).interval == Report(results[10:], tiers).interval
    told = summary(report)
    assert told["mean_over_tiers"]["mean"] == pytest.approx(0.55)
    assert {tier: part["rate"] for tier, part in told["tiers"].items()} == {"easy": 0.9, "very_hard": 0.2}
    assert "mean over tiers" not in str(Report(results[:20], tiers))


def test_a_tier_may_name_its_tasks_by_patterns() -> None:
    tiers = {"goal": ["goal*_0", "goal*_1"], "long": ["long*_0"]}
    played = [Result(n, "success", task=task) for n, task in enumerate(("goal_0", "goal_swap_1", "long_swap_0"))]
    report = Report(tuple(played), tiers)
    assert {tier: part.episodes for tier, part in report.tier_reports.items()} == {"goal": 2, "long": 1}
    assert report.mean_label == "mean over tiers"
    assert Report(tuple(played[1:]), tiers).mean_label == "mean over tiers (2 of 3 tasks)"


def test_a_condition_of_a_benchmark_keeps_its_interval_on_the_page(tmp_path: Path) -> None:
    report = Report(of_ten(reach=10, stack=2), {"easy": ["reach", "push"], "hard": ["stack"]})
    config = {"task": {"tiers": report.tiers}}
    write_report(report, tmp_path / "report.json", None, config, conditions={"dark": report})
    written = read_report(tmp_path)
    assert written and written.reports["dark"].interval == written.reports["seen"].interval == report.interval
    assert written.reports["seen"].mean_label == report.mean_label == "mean over tiers (2 of 3 tasks)"


def test_a_condition_that_changes_nothing_is_the_training_condition_on_the_page_too(tmp_path: Path) -> None:
    report = Report(of_ten(reach=10, stack=2))
    evaluate = {"conditions": {"dark": {"light": 0}, "same": {"light": 1}}}
    config = {"task": {"light": 1}, "evaluate": evaluate}
    conditions = {"dark": report, "same": report}
    write_report(report, tmp_path / "report.json", None, config, {}, conditions, compare_conditions(conditions, 0.02))
    written = read_report(tmp_path)
    assert written and written.reports["same"] is written.reports["seen"] is not written.reports["dark"]
    page = write_page(tmp_path).read_text()
    assert "the same as seen, because they change nothing in the task: same" in page


def test_milestones_have_a_rate_of_their_own() -> None:
    reached = [("grasped",), ("grasped", "lifted"), (), ()]
    report = Report(tuple(Result(FIRST_SEED, "dropped", milestones=names) for names in reached))
    assert report.milestones == {"grasped": 2, "lifted": 1}
    assert "grasped 2/4 (50.0 %, 95 % CI 15.0-85.0)" in str(report).splitlines()
    assert summary(report)["milestones"]["lifted"] == {
        "rate": 0.25,
        "ci_low": pytest.approx(0.0456, abs=1e-4),
        "ci_high": pytest.approx(0.6994, abs=1e-4),
        **{"count": 1, "of": 4},
    }


def test_errors_are_neither_successes_nor_failures() -> None:
    report = a_report("sedde")
    assert (report.episodes, report.successes, len(report.errors)) == (3, 1, 2)
    assert report.success == 1 / 3
    assert report.outcome_counts == {"error": 2, "dropped": 2, "success": 1}


def test_a_report_of_errors_alone_has_the_widest_interval() -> None:
    assert str(a_report("e")).splitlines()[-1] == "success 0/0 (no episode was completed)"
    assert a_report("e").interval == (0, 1)


def test_two_workers_report_what_one_reports_also_if_one_dies_once(tmp_path: Path) -> None:
    alone = evaluate(toy.make_environment, toy.make_agent, None, SEEDS)
    make_environment = partial(toy.OnceDeadlyEnvironment, tmp_path / "died")
    assert evaluate(make_environment, toy.make_agent, None, SEEDS, Cluster(2, "beside")) == alone
    assert (tmp_path / "died").exists()
    assert [result.seed for result in alone.results] == list(SEEDS)
    assert alone.outcome_counts == {"success": 8, "timeout": 2}
    first = alone.results[0]
    assert first.steps > 0
    assert first.draws["limit"] == 40 and len(first.draws["point"]) == 2 and first.draws["colour"] in first.instruction


def test_an_episode_that_raises_is_an_error_and_the_others_go_on() -> None:
    report = evaluate(toy.make_broken_environment, toy.make_agent, None, SEEDS[:3])
    assert [result.outcome for result in report.results] == ["success", "error", "success"]
    assert report.errors[0].seed == toy.BROKEN_SEED
    assert report.errors[0].error.startswith("ValueError: the block fell off the table (toy_recordable.py:")
    assert "errors 1, the first at seed 1000001: ValueError: the block fell" in str(report)


def test_what_no_report_can_hold_is_an_error_of_its_episode(tmp_path: Path) -> None:
    class Odd(toy.ToyEnvironment):
        @property
        def tool(self) -> np.ndarray:
            return np.array([*self._point, np.nan if self._seed == SEEDS[2] else 0.0])

        def reset(self, seed: int) -> Observation:
            seen = super().reset(seed)
            self.draws["wind"] = {SEEDS[0]: float("nan"), SEEDS[1]: object()}.get(seed, 1.0)
            return seen

    report = evaluate(Odd, toy.make_agent, None, SEEDS[:5])
    assert [result.outcome == "error" for result in report.results] == [True, True, True, False, False]
    assert report.results[4].motion and report.results[4].motion.path_m
    write_report(report, tmp_path / "report.json", None, {})


@pytest.mark.parametrize("lanes", [1, 2])
def test_only_the_episode_that_kills_its_process_is_an_error_also_of_those_side_by_side(lanes: int) -> None:
    makers, kept = (toy.make_deadly_environment, toy.make_agent, None), list[Result]()
    report = evaluate(*makers, SEEDS, Cluster(2, "beside"), lanes=lanes, on_result=kept.append)
    assert [error.seed for error in report.errors] == [toy.DEADLY_SEED]
    assert report.errors[0].error == (
        "a worker process crashed twice: it ended with exit status 1; "
        "lower cluster.workers, or set PYTHONFAULTHANDLER=1 to see where"
    )
    assert [result.seed for result in report.results] == [*SEEDS]
    assert sorted(result.seed for result in kept) == [seed for seed in SEEDS if seed != toy.DEADLY_SEED]


def test_the_episodes_of_a_crashed_group_are_played_last(monkeypatch: pytest.MonkeyPatch) -> None:
    attempt, kept = _RolloutWorker.attempt, list[int]()

    def crash(worker: Any, item: Any) -> Any:
        if item[0][0] == SEEDS[0] and len(item[0]) > 1:
            raise WorkerCrash("gone")
        return attempt(worker, item)

    monkeypatch.setattr(_RolloutWorker, "attempt", crash)
    evaluate(toy.make_environment, toy.make_agent, None, SEEDS, lanes=2, on_result=lambda each: kept.append(each.seed))
    assert kept == [*SEEDS[8:], *SEEDS[:8]]


@pytest.mark.parametrize("workers", [1, 2])
def test_an_environment_that_cannot_be_built_ends_the_evaluation(workers: int) -> None:
    with pytest.raises(ValueError, match="no such mesh"):
        evaluate(toy.make_impossible_environment, toy.make_agent, None, SEEDS[:2], Cluster(workers, "beside"))


def test_seeds_of_training_are_refused() -> None:
    for seeds in (range(0), range(FIRST_SEED - 1, FIRST_SEED + 1)):
        with pytest.raises(ValueError, match="seeds from 1000000 on"):
            evaluate(toy.make_environment, toy.make_agent, None, seeds)


def test_libraries_use_one_thread_while_it_lasts(monkeypatch: pytest.MonkeyPatch) -> None:
    import torch

    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    before, seen = torch.get_num_threads(), []
    torch.set_num_threads(2)

    def make_agent(environment: Environment) -> toy.ThinkingAgent:
        seen.append((os.environ["OMP_NUM_THREADS"], torch.get_num_threads()))
        return toy.make_agent(environment)

    evaluate(toy.make_environment, make_agent, None, SEEDS[:1])
    assert seen == [("1", 1)]
    assert (os.environ["OMP_NUM_THREADS"], torch.get_num_threads()) == ("3", 2)
    torch.set_num_threads(before)


def test_recordings_are_kept_in_one_file_failures_first(tmp_path: Path) -> None:
    folder, target = tmp_path / "recordings", tmp_path / "rollouts.rrd"
    played = evaluate(toy.make_environment, toy.make_agent, toy.make_recorder(folder), SEEDS[:6])
    report = replace(played, results=played.results[:5])  # as where workers were ahead when it was decided
    assert merge_recordings(report, folder, target, 3) == [SEEDS[3], SEEDS[0], SEEDS[1]]
    kept = [entry.recording_id.rpartition("-")[0] for entry in RrdReader(target).recordings()]
    assert kept == ["failure-01000003-timeout", "success-01000000", "success-01000001"]
    assert merge_recordings(report, folder, target, 3) == [SEEDS[3], SEEDS[0], SEEDS[1]]  # as after a lost report
    keep_pictures(report, folder, 3, SEEDS)
    assert list(tmp_path.iterdir()) == [target]


def test_only_recordings_that_are_kept_are_made(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    makers = toy.make_environment, toy.make_agent, toy.make_recorder(tmp_path)
    everything = evaluate(*makers, SEEDS[:5])
    assert len([*tmp_path.iterdir()]) == 5
    for file in tmp_path.iterdir():
        file.unlink()
    names = ["failure-01000003-timeout", *(f"success-{seed:08d}" for seed in (*SEEDS[:3], SEEDS[4]))]
    for wanted, made in ((2, names[:2]), ("failures", names), (0, [])):
        capsys.readouterr()
        assert evaluate(*makers, SEEDS[:5], recordings=wanted) == everything
        assert ("recording" in capsys.readouterr().out) == bool(made)  # episodes are played once more, which takes time
        assert sorted(file.stem for file in tmp_path.iterdir()) == made
        for file in tmp_path.iterdir():
            file.unlink()


def test_by_default_the_failures_and_ten_successes_are_kept() -> None:
    outcomes = ["timeout" if seed % 4 == 0 else "error" if seed % 4 == 1 else "success" for seed in range(40)]
    report = Report(tuple(Result(FIRST_SEED + n, outcome) for n, outcome in enumerate(outcomes)))
    failures, successes = ([n for n, each in enumerate(outcomes) if each == which] for which in ("timeout", "success"))
    for wanted, seeds in (
        ("failures", failures + successes[:10]),
        ("all", failures + successes),
        (12, failures + successes[:2]),
        (3, failures[:3]),
        (0, []),
    ):
        assert [result.seed - FIRST_SEED for result in choose_results(report, wanted)] == seeds


def test_a_recording_that_takes_another_course_is_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    class Slower(toy.RecordableEnvironment):
        def step(self, action: Array) -> Observation:
            return super().step(action / 2 if self._resets > 1 else action)

    report = evaluate(Slower, toy.make_agent, toy.make_recorder(tmp_path), SEEDS[:1], recordings=1)
    assert f"steps, not {report.results[0].steps}" in caplog.text


def test_what_ends_differently_when_played_again_has_no_recording(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    class Fickle(toy.RecordableEnvironment):
        def reset(self, seed: int) -> Observation:
            observation = super().reset(seed)
            if self._resets > 2:
                self._seed = 3  # which fails
            return observation

    report = evaluate(Fickle, toy.make_agent, toy.make_recorder(tmp_path), SEEDS[:2], recordings=2)
    assert report.successes == 2 and "seed 1000000 has no recording" in caplog.text
    assert merge_recordings(report, tmp_path, tmp_path / "rollouts.rrd", 2) == []


@pytest.mark.parametrize("limit", ["MAX_RECORDINGS", "MAX_BYTES"])
def test_what_would_be_too_large_in_one_file_stays_in_several(
    limit: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    folder, target = tmp_path / "recordings", tmp_path / "rollouts.rrd"
    report = evaluate(toy.make_environment, toy.make_agent, toy.make_recorder(folder), SEEDS[:5])
    sizes = {file.name: file.stat().st_size for file in folder.iterdir()}
    two = sizes["failure-01000003-timeout.rrd"] + sizes["success-01000000.rrd"]
    monkeypatch.setattr(recordings, limit, 2 if limit == "MAX_RECORDINGS" else two)
    with caplog.at_level("INFO", "vla.rollouts.recordings"):
        merged = merge_recordings(report, folder, target, "all")
    assert merged == [SEEDS[3], SEEDS[0]] and len(RrdReader(target).recordings()) == 2
    assert f"{target} has 2 recordings, the 3 others stay in {folder}" in caplog.text
    keep_pictures(report, folder, "all", merged)
    assert sorted(path.name for path in folder.iterdir()) == [f"success-{SEEDS[n]:08d}.rrd" for n in (1, 2, 4)]
