"""Pages of a run, of several runs and of a sweep, from small files as real parts write them."""

from __future__ import annotations

import base64
import io
import json
import logging
import re
import shutil
from collections.abc import Callable
from dataclasses import asdict, replace
from html import unescape
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from finished_runs import CONFIG, CURVES, SAID, a_run, compared
from PIL import Image
from toy_recordable import ThinkingAgent, make_environment

from vla.config.differences import differences
from vla.config.origin import Origin
from vla.data.index import Entry, index_line
from vla.io.files import warn_on_error
from vla.reports.comparison import compare, read_runs, rows_of
from vla.reports.comparison_page import tabulate
from vla.reports.evaluation import write_report
from vla.reports.observations import draw_samples
from vla.reports.run_page import write_page
from vla.reports.training_curves import training_sections
from vla.rollouts.moving_picture import FRAMES, save_moving_picture
from vla.rollouts.recorder import RerunRecorder
from vla.rollouts.recordings import keep_pictures, merge_recordings, moving_pictures
from vla.rollouts.results import Report, Result, recording_name
from vla.rollouts.rollout import rollout
from vla.rollouts.statistics import pooled_interval
from vla.runs.files import Training
from vla.runs.folder import read_run, save_config, save_training
from vla.spec import FIRST_SEED, Episode

SEEN = [FIRST_SEED, FIRST_SEED + 1, FIRST_SEED + 3]  # the toy world fails at the last


def text(page: Path) -> str:
    """What a reader sees, on one line."""
    body = re.sub(r"<style>.*?</style>|<title>.*?</title>", "", page.read_text(), flags=re.DOTALL)
    return " ".join(unescape(re.sub(r"<[^>]*>", " ", body)).split())


def pictures(page: Path) -> list[Image.Image]:
    found = re.findall(r'src="data:image/\w+;base64,([^"]+)"', page.read_text())
    return [Image.open(io.BytesIO(base64.b64decode(content))) for content in found]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that left everything, of the toy world."""
    folder = a_run(tmp_path_factory.mktemp("runs") / "whole", "ssstsd")
    save_training(folder, Training(1_500_000, 40, 400.0, "done"))
    environment, recorder = make_environment(), RerunRecorder(folder / "recordings", pictures=6)
    episodes = [rollout(environment, ThinkingAgent(), seed, recorder) for seed in SEEN]
    report = Report(tuple(Result(each.seed, each.outcome, each.instruction) for each in episodes))
    recorded = merge_recordings(report, folder / "recordings", folder / "rollouts.rrd", "all")
    keep_pictures(report, folder / "recordings", "all", recorded)
    first = [episode.observations[0] for episode in episodes]
    batch: dict[str, Any] = {
        "rgb": {name: np.stack([seen.rgb[name] for seen in first])[:, None] for name in first[0].rgb},
        "action": np.stack([episode.actions[0] for episode in episodes])[:, None, None],
        "instruction": [SAID] * len(first),
    }
    draw_samples(batch, environment.spec, folder / "samples.png")
    write_page(folder)
    return folder


def test_the_page_tells_everything_that_lies_in_the_folder(whole: Path) -> None:
    told = text(whole / "report.html")
    for words in (
        "66.7 % success 4/6 (66.7 %, 95 % CI 30.0-90.3)",
        "parameters 1.50 M",
        "time per action 2.5 ms",
        "40 steps in 6 min 40 s",
        "checkpoint policy",
        "dark 0.0 (0.0-39.0) 0/6 -66.7 (-90.3 to -13.1) 0.12 0.12 open",  # four lost, none won: 2 / 2^4
        "timeout",
        "seed 1000003, 20 steps",
        "model.width 16 32",
    ):
        assert words in told, words
    assert not list(whole.glob(".*"))
    markup = (whole / "report.html").read_text()
    for table in re.findall(r"<table>(.*?)</table>", markup, re.DOTALL):  # every cell has its head for narrow windows
        heads, *rows = re.findall(r"<tr.*?</tr>", table, re.DOTALL)
        names = re.findall(r"<th[^>]*>(.*?)</th>", heads)
        assert all(re.findall(r'data-head="(.*?)"', row) == names[1:] for row in rows)


def test_failures_move_first_and_every_camera_is_shown(whole: Path) -> None:
    page, shown = (whole / "report.html").read_text(), pictures(whole / "report.html")
    assert page.index(">timeout<") < page.index(f"seed {SEEN[0]}") < page.index(f"seed {SEEN[1]}")
    assert [each.format for each in shown] == ["WEBP", "WEBP", "WEBP", "PNG"]  # and the first training batch
    failure, first = shown[0], make_environment().reset(SEEN[2])
    assert getattr(failure, "n_frames", 1) > 1 and failure.info["loop"] == 0  # equal frames are one
    sides = np.concatenate([*first.rgb.values()], axis=1)
    assert np.abs(np.array(failure.convert("RGB"), dtype=int) - sides).mean() < 20  # lossy
    assert 'href="rollouts.rrd"' in page
    assert sorted(path.suffix for path in (whole / "recordings").iterdir()) == [".webp"] * 3


def test_long_episodes_move_faster(tmp_path: Path) -> None:
    seen, actions = make_environment().reset(0), np.zeros((200, 3), np.float32)
    steps = [
        replace(seen, rgb={name: np.full_like(image, 37 * number % 256) for name, image in seen.rgb.items()})
        for number in range(200)
    ]
    episode = Episode(7, "a", seen.instruction, "dropped", frozenset(), {}, steps, actions, actions)
    save_moving_picture(episode, tmp_path / "one.webp")
    picture = Image.open(tmp_path / "one.webp")
    assert (picture.format, getattr(picture, "n_frames", 1)) == ("WEBP", FRAMES)


def test_outcomes_take_turns_in_what_is_shown(tmp_path: Path) -> None:
    outcomes = ["success", "dropped", "dropped", "dropped", "timeout", "success", "dropped", "success", "success"]
    results = [Result(seed, outcome) for seed, outcome in enumerate(outcomes)]
    for each in results:
        (tmp_path / f"{recording_name(each.seed, each.outcome)}.webp").touch()
    assert [each.seed for each, _ in moving_pictures(results, tmp_path)] == [1, 4, 2, 3, 6, 0, 5, 7]


def test_the_page_says_what_was_recorded_and_how_to_play_an_episode_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = a_run(tmp_path / "run", "sssdsde", more={"recorded": [FIRST_SEED + n for n in (3, 5, 0, 1)]})
    (folder / "rollouts.rrd").touch()
    told = text(write_page(folder))
    assert "rollouts.rrd has 2 of 2 failures and 2 of 4 successes" in told
    monkeypatch.chdir(tmp_path)
    again = "checkpoint=run/policy evaluate.seed=SEED evaluate.episodes=1 evaluate.recordings=all"
    assert again not in told and again in text(write_page(folder))  # relative to the working directory


def test_recordings_of_single_episodes_are_linked(tmp_path: Path) -> None:
    folder = a_run(tmp_path / "run")
    (folder / "recordings").mkdir()
    for number in range(23):
        (folder / f"recordings/success-{number:08d}.rrd").touch()
    page = write_page(folder)
    links = re.findall(r'href="(recordings/[^"]*)"', page.read_text())
    assert links == [f"recordings/success-{number:08d}.rrd" for number in range(20)]
    assert "success-00000019.rrd and 3 more in recordings" in text(page)


def test_an_agent_without_a_checkpoint_is_named_to_play_an_episode_again(tmp_path: Path) -> None:
    folder = a_run(tmp_path / "run")
    change(folder, lambda content: content.update(checkpoint=None))
    save_config(folder, {**CONFIG, "chosen": {"agent": "expert"}}, [])
    (folder / "rollouts.rrd").touch()
    again = (
        "python -m vla.run agent=expert evaluate.seed=SEED evaluate.episodes=1 evaluate.recordings=all, and the task"
    )
    assert again in text(write_page(folder))


def test_rounds_are_linked_with_success_from_one_to_the_next(tmp_path: Path) -> None:
    run = a_run(tmp_path / "run", "sssd")
    for number, outcomes in enumerate(["", "sd", "sss"]):
        folder = a_run(run / f"round_{number}", curves=f"step,val/success\n9,0.1\n19,0.{number}5\n")
        (folder / "episodes").mkdir()
        entries = [
            Entry(seed, "", "success" if each == "s" else "dropped", (), "", 3 * seed, 3, {}, {})
            for seed, each in enumerate(outcomes)
        ]
        (folder / "episodes/index.jsonl").write_bytes(b"".join(map(index_line, entries)))
        save_training(folder, Training(1, 20, 30.0, "done"))
        write_page(folder)
    told, markup = text(write_page(run)), (run / "report.html").read_text()
    assert "round 0 5.0 20 30 s round 1 50.0 (9.5-90.5) 1/2 15.0 20 30 s round 2 100.0 (43.9-100.0) 3/3 25.0" in told
    assert "evaluation 75.0 (30.1-95.4) 3/4" in told
    assert [f"round_{number}/report.html" for number in range(3)] == re.findall(r'href="(round_[^"]*)"', markup)
    assert "Rounds with the expert" not in text(run / "round_1/report.html")


def test_what_a_round_was_trained_on_is_told(tmp_path: Path) -> None:
    config = {"collect": {"episodes": 1, "more": ["round_1/episodes"]}, "pretrained": "round_0/policy"}
    save_config(tmp_path, config | {"task": {"goal": {"_target_": "vla.tasks.goals.PickPlace"}}}, [])
    save_training(tmp_path, Training(1, 1, 3.0, "done"))
    told = text(write_page(tmp_path))
    assert told.startswith("pick place ") and "training 1 step in 3 s" in told
    assert "demonstrations 1 and those in [round_1/episodes] from weights of round_0/policy" in told


def test_the_page_tells_the_command_the_commit_and_the_machine(tmp_path: Path) -> None:
    trained = Origin("python -m vla.run model=bc", {"vla": "0123456789ab"}, "ada", "EPYC, 2 cores")
    folder = a_run(tmp_path / "run", more={"origin": asdict(trained)})
    save_training(folder, Training(1, 1, 1.0, "done", origins=[trained]))
    told = text(write_page(folder))
    where = "git commit 0123456789ab (vla) host ada processor EPYC, 2 cores"
    assert f"Origin command python -m vla.run model=bc {where}" in told
    later = replace(trained, command="python -m vla.run", commits={"vla": "0123456789ab with uncommitted changes"})
    save_training(folder, Training(1, 1, 1.0, "done", origins=[later]))
    told = text(write_page(folder))
    assert "Origin of the training command python -m vla.run git commit 0123456789ab with uncommitted changes" in told
    assert f"Origin of the evaluation command python -m vla.run model=bc {where}" in told
    save_training(folder, Training(1, 1, 1.0, "done", origins=[trained, later]))
    told = text(write_page(folder))
    assert told.index("Origin of the training") < told.index("Origin of the training, part 2") < told.index("of the e")


def test_a_page_refers_to_nothing_outside_and_runs_nothing(whole: Path, tmp_path: Path) -> None:
    other = a_run(tmp_path / "a <b>", "ssssds")
    for page in (whole / "report.html", compared([whole, other], tmp_path)):
        markup = page.read_text()
        assert "http" not in markup and "<script" not in markup and "<link" not in markup and "@import" not in markup
        for address in re.findall(r'(?:src|href)="([^"]*)"', markup):
            assert address.startswith(("#", "data:image/")) or not re.match(r"\w+:|/", address), address
        assert "a <b>" not in markup


def test_words_of_others_are_escaped(tmp_path: Path) -> None:
    folder = a_run(tmp_path / "run")
    save_config(folder, CONFIG, [{"key": "task.said", "here": SAID, "default": "<b>"}])
    save_training(folder, Training(1, 1, 1.0, "the loss is <nan>"))
    page = write_page(folder)
    assert SAID in text(page) and "Training failed: the loss is <nan>" in text(page)
    assert "<script" not in page.read_text() and "<nan>" not in page.read_text()


def test_tasks_and_tiers_have_their_rates_and_their_mean(tmp_path: Path) -> None:
    tasks = ["push", "lift", "lift", "stack"]
    results = [Result(FIRST_SEED + n, "success", SAID, 20, task=task) for n, task in enumerate(tasks)]
    tiers = {"easy": ["push", "lift"], "very_hard": ["stack"]}
    write_report(Report(tuple(results), tiers), tmp_path / "report.json", None, {**CONFIG, "task": {"tiers": tiers}})
    assert read_run(tmp_path).reports["seen"].tiers == tiers
    told = text(write_page(tmp_path))
    assert re.search(r"easy 100\.0 \(\d.* 3/3 very_hard 100\.0 \(.* 1/1 mean over tiers 100\.0", told)
    assert "task rate [%] episodes lift 100.0 (34.2-100.0) 2/2 push 100.0 (20.7-100.0) 1/1" in told
    write_report(Report(tuple(results[1:3])), tmp_path / "report.json", None, CONFIG)
    assert "Success by task" not in text(write_page(tmp_path))


def test_what_is_missing_is_left_out(tmp_path: Path) -> None:
    told = text(write_page(tmp_path))
    assert told.startswith(tmp_path.name)
    for section in ("success", "Training", "Rollouts", "conditions", "differs"):
        assert section not in told
    (tmp_path / "metrics.csv").write_text(CURVES)
    save_training(tmp_path, Training(1, 39, 3.0, "interrupted"))
    told = text(write_page(tmp_path))
    assert "p Holm" not in told
    assert f"Training was interrupted after 39 steps; resume={tmp_path} output={tmp_path} continues it." in told
    assert "Rollouts" not in told


def test_a_training_without_curves_has_its_demonstrations(tmp_path: Path) -> None:
    save_config(tmp_path, {"collect": {"episodes": 7}}, [])
    assert "demonstrations" not in text(write_page(tmp_path))  # an evaluation of a policy from elsewhere
    save_training(tmp_path, Training(1, 20, 3.0, "done"))
    assert "demonstrations 7" in text(write_page(tmp_path))


def test_conditions_over_other_networks_are_not_compared(tmp_path: Path) -> None:
    report = Report((Result(FIRST_SEED, "success"),))
    for name, latency in (("one", 20), ("other", 200)):
        (tmp_path / name).mkdir()
        config = {"task": {}, "evaluate": {"networks": {"radio": {"latency": latency}}}}
        write_report(report, tmp_path / name / "report.json", None, config, {}, {"radio": report})
    found = compare(combinations(rows_of(read_runs([tmp_path / "one", tmp_path / "other"])), 2), 0.02)
    assert [condition for _, _, condition in found] == ["seen"]


def test_curves_have_axes_that_tell_most() -> None:
    steps = np.array([9, 19])
    metrics = {
        "train/loss": (np.array([9, 19, 29]), np.array([4.5, 2.5, 0.1])),
        "val/loss": (steps, np.array([2.5, 0.125])),
        "val/success": (steps, np.array([0.5, 1.0])),
        "train/truth_loss": (steps, np.array([1.0, 1.0])),
        "val/error_dx_mm": (steps, np.array([1.001, 1.003])),
        "pace/waiting": (steps, np.array([5e-5, 7e-5])),
    }
    training, speed = training_sections([("#112233", metrics), ("#445566", {"val/loss": metrics["val/loss"]})])
    assert list(training.panels) == ["loss", "success", "error dx [mm]", "truth loss"] and list(speed.panels) == [
        "waiting"
    ]
    labels = {title: re.findall(r">([\d.e\N{MINUS SIGN}]+)</text>", panel) for title, panel in training.panels.items()}
    assert {"0.2", "0.5", "1"} <= {*labels["loss"]}  # from 0.1 to 4.5 the axis is logarithmic
    assert "#112233" in training.panels["loss"] and "#445566" in training.panels["loss"]
    assert "1" in labels["success"] and "0" in labels["error dx [mm]"]
    assert "5e\N{MINUS SIGN}05" in speed.panels["waiting"]
    assert all(title == "loss" or "0" in each for title, each in labels.items())  # though the first step is 9


def test_of_odd_metrics_what_can_be_drawn_is_drawn(tmp_path: Path) -> None:
    run = a_run(tmp_path / "run", curves="step,train/loss,lr\n9,1e308,1\n19,-1e308,2\n29,2.5,3\n29,2.0,3\n")
    steps, values = read_run(run).metrics["train/loss"]
    assert (steps.tolist(), values.tolist()) == ([29], [2.0])  # a step that was logged twice counts as it was last
    assert "<svg" in write_page(run).read_text()
    names = ",".join(f"loss{number}" for number in range(3000))
    (run / "metrics.csv").write_text(f"step,{names}\n9{',1' * 3000}\n")
    with pytest.raises(ValueError, match=r"metrics\.csv is damaged in line 1: .*more than 300"):
        write_page(run)


def test_configurations_differ_leaf_by_leaf() -> None:
    one = {"output": "a", "model": {"width": 1, "image": {"name": "x", "size": 2}}, "seed": 0}
    other = {"output": "b", "model": {"width": 2, "layers": [1]}, "seed": 0}
    assert differences(one, other) == [
        ("model.width", 1, 2),
        ("model.image", {"name": "x", "size": 2}, "-"),
        ("model.layers", "-", [1]),
    ]


def test_runs_are_compared_on_the_seeds_they_share(tmp_path: Path) -> None:
    good = a_run(tmp_path / "good/run", "ssssssss", dark="ssssssdd")
    bad = a_run(tmp_path / "bad/run", "ddddddsd", width=8)
    short = a_run(tmp_path / "short/run", "ds")
    write_page(good)
    page = compared([good, bad, short], tmp_path / "new")
    told, markup = text(page), page.read_text()
    assert page == tmp_path / "new/comparison.html" and told.startswith("3 runs")
    assert "good/run 100.0 (67.6-100.0)" in told
    assert "bad/run good/run seen 8 7 0 -87.5 (" in told
    # seven lost, none won: 2 / 2^7; the clearest of five
    assert ") 0.016 0.078 open bad/run good/run dark 8 6 0 -75.0 (" in told
    assert "short/run good/run seen 2 1 0 -50.0 (" in told and "model.width 16 8 16" in told
    assert 'href="../good/run/report.html"' in markup and "bad/run/report.html" not in markup
    assert markup.count("<svg") == 8


def test_what_makes_runs_differ_is_told(tmp_path: Path) -> None:
    plain, dark = a_run(tmp_path / "plain", "ssssssss"), a_run(tmp_path / "dark", "dddddddd", light=0.1)
    told = text(compared([plain, dark], tmp_path / "new"))
    assert "plain 100.0" in told and "Differences in success" not in told  # equal seeds, other scenes
    assert "not compared, because no episode is the same in both plain and dark" in told
    brighter = a_run(tmp_path / "brighter", "ssssssss")
    change(brighter, lambda content: content["config"]["evaluate"]["conditions"].update(dark={"light": 0.5}))
    told = text(compared([plain, brighter], tmp_path / "some"))
    assert "not compared under a condition, because its worlds differ plain and brighter (dark)" in told
    crashing = a_run(tmp_path / "crashing", "sseeeeee")
    for folder, mujoco in ((plain, "3.3.0"), (crashing, "3.17.0")):
        change(folder, lambda content, mujoco=mujoco: content.update(versions={"mujoco": mujoco, "torch": "2.13"}))
    told = text(compared([plain, crashing], tmp_path / "page"))
    assert "evaluated with different versions mujoco 3.3.0 and 3.17.0" in told
    assert "episodes that ended in errors, which count nowhere 6 of 8 in crashing (seen)" in told


def change(run: Path, edit: Callable[[dict[str, Any]], object]) -> None:
    content = json.loads((run / "report.json").read_text())
    edit(content)
    (run / "report.json").write_text(json.dumps(content))


def test_episodes_without_draws_are_the_same_only_in_the_same_task(tmp_path: Path) -> None:
    runs = [a_run(tmp_path / name, "s" * 8, light=None) for name in ("one", "same", "other")]
    for run in runs:
        task = {"id": run.name.replace("same", "one")}
        change(run, lambda content, task=task: content["config"].update(task=task))
        change(run, lambda content: [result.update(draws={}) for result in content["per_episode"]])
    found = compare(combinations(rows_of(read_runs(runs)), 2), 0.02)
    assert {case[:2] for case in found if case[2] == "seen"} == {("same", "one")}


def test_other_seeds_of_the_same_world_are_compared_as_they_are(tmp_path: Path) -> None:
    one, other = a_run(tmp_path / "one", "sssssssd"), a_run(tmp_path / "other", "sddddddd")

    def move(content: dict[str, Any]) -> None:
        content["seeds"] = [seed + 100 for seed in content["seeds"]]
        for result in content["per_episode"]:
            result["seed"] += 100

    change(other, move)
    told = text(compared([one, other], tmp_path / "new"))
    assert "other one seen 16 -75.0 (-89.5 to -26.1) 0.01 0.02 worse" in told


def test_runs_with_nothing_to_compare_are_refused(tmp_path: Path) -> None:
    run = a_run(tmp_path / "run")
    (tmp_path / "empty").mkdir()
    for folders, says in (
        ([], r"report\.runs=\[RUN,RUN\]"),
        ([run, tmp_path / "empty"], "empty is no run: it has none of report.json, errors.json and metrics.csv"),
        ([run, tmp_path / "run/../run"], "a run is named twice"),
    ):
        with pytest.raises(ValueError, match=says):
            compared(folders, tmp_path / "new")
    loop = tmp_path / "loop"
    loop.symlink_to(loop)
    with pytest.raises(ValueError, match="loop is no run"):
        compared([loop], tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_a_page_that_cannot_be_made_is_a_warning(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "report.json").write_text("{")
    with caplog.at_level(logging.WARNING), warn_on_error(tmp_path / "report.html"):
        write_page(tmp_path)
    assert "could not write" in caplog.text and "report.html" in caplog.text and "report.json is damaged" in caplog.text
    assert [file.name for file in tmp_path.iterdir()] == ["report.json"]


def test_the_page_of_a_sweep_leads_to_every_cell(tmp_path: Path) -> None:
    for number, (model, outcomes) in enumerate([("bc", "ssss"), ("bc", "sssd"), ("rt1", "sddd")]):
        cell = a_run(tmp_path / str(number), outcomes)
        write_page(cell)
        (cell / ".hydra").mkdir()
        (cell / ".hydra/overrides.yaml").write_text(f"- model={model}\n- seed={number}\n")
    tabulate(tmp_path)
    markup, told = (tmp_path / "sweep.html").read_text(), text(tmp_path / "sweep.html")
    assert re.findall(r'href="([^"#]*)"', markup) == [f"{n}/report.html" for n in range(3)]
    trainings = [dict(enumerate(won)) for won in ((True, True, True, True), (True, True, True, False))]
    low, high = (100 * bound for bound in pooled_interval(trainings))
    assert f"bc 87.5 ({low:.1f}-{high:.1f})" in told and markup.count("<svg") == 8


def test_a_page_holds_no_file_that_is_no_picture(whole: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(whole, tmp_path / "run"))
    (tmp_path / "key").write_text("secret")
    picture = next((folder / "recordings").glob("failure*.webp"))
    picture.unlink()
    picture.symlink_to(tmp_path / "key")
    with pytest.raises(ValueError, match=r"webp is no picture: remove it"):
        compared([folder], tmp_path / "new")
