"""The command line as a user types it: small, but every part is the real one; in processes of their own where these
are started, killed or interrupted."""

from __future__ import annotations

import gc
import json
import os
import re
import shutil
import signal
import socket
from html import unescape
from pathlib import Path
from socket import create_connection, create_server
from typing import Any
from unittest.mock import Mock

import mujoco
import numpy as np
import pytest
import torch
import warm
import yaml
from collecting import until
from command_line import SMALL, here, vla
from PIL import Image
from rerun.chunk import RrdReader
from saved_policies import change_json
from websockets.sync.client import connect

from vla import jobs
from vla.data.episodes import EpisodeStore
from vla.io.array_messages import pack
from vla.jobs import evaluate
from vla.models.learner import Learner
from vla.models.policy_folder import read_policy
from vla.rollouts.results import recording_name
from vla.tasks.rendering.fast import Fast
from vla.tasks.rendering.reference import Reference


def test_the_key_of_a_server_is_in_no_file_of_a_training(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("VLA_API_KEY", "s3cret")
    gc.collect()
    before = sum(isinstance(each, Learner) for each in gc.get_objects())
    here(home, *SMALL, "job=train", "deploy=server", "trainer.max_steps=1", "output=keyed")
    assert sum(isinstance(each, Learner) for each in gc.get_objects()) == before  # there is room for what follows
    files = [path for path in (home / "keyed").rglob("*") if path.is_file()]
    assert home / "keyed/checkpoints/last.ckpt" in files
    assert not [path for path in files if b"s3cret" in path.read_bytes()]


def test_the_main_job_collects_trains_evaluates_and_records(home: Path) -> None:
    report = json.loads((home / "run/report.json").read_text())
    assert {"success", "episodes", "ci_low", "ci_high", "seeds", "outcome_counts", "checkpoint", "config"} <= {*report}
    assert (report["experiment"], report["model"]) == (None, "bc")
    assert {result["task"] for result in report["per_episode"]} == {"pick_place"}
    training = json.loads((home / "run/training.json").read_text())
    assert report["episodes"] == 2 and report["errors"] == 0
    assert report["versions"]["mujoco"] == mujoco.__version__
    assert report["config"]["collect"]["episodes"] == 12
    names = ("report.html", "report.png", "rollouts.rrd", "samples.png", "metrics.csv", "checkpoints/last.ckpt")
    for name in (*names, *(f"{policy}/model.safetensors" for policy in ("policy", "policy_best"))):
        assert (home / "run" / name).stat().st_size > 0
    assert list((home / "run/tensorboard").glob("events.out.tfevents.*"))
    header, *rows = (home / "run/metrics.csv").read_text().splitlines()
    success = header.split(",").index("val/success")
    assert [row.split(",")[success] for row in rows if row.split(",")[success]] == ["0.0", "0.0"]  # hardly trained
    page = (home / "run/report.html").read_text()
    for words in ("4 steps", "collect.episodes", ">500</td>", "First training batch", 'href="rollouts.rrd"'):
        assert words in page and "${" not in page, words
    command = report["origin"]["command"]
    assert training["origins"] == [report["origin"]] and command.startswith("python -m vla.run ")
    assert command in unescape(page)
    assert report["origin"]["host"] == socket.gethostname() in page
    moving = sorted(path.name for path in (home / "run/recordings").iterdir())
    named = {each["seed"]: recording_name(each["seed"], each["outcome"]) for each in report["per_episode"]}
    assert moving == sorted(f"{name}.webp" for name in named.values()) and "data:image/webp" in page
    assert sorted(report["recorded"]) == sorted(report["seeds"])  # both failures, or successes of at most ten
    assert yaml.safe_load((home / "run/config.yaml").read_text()) == report["config"]
    printed = (home / "printed.txt").read_text()
    assert "\ntraining ━" in printed and "Epoch" not in printed
    last = printed.strip().splitlines()[-1]
    assert last.startswith(f"success {report['successes']}/2 (")


def test_a_checkpoint_brings_its_task_and_model_and_takes_harder_scenes_once(home: Path) -> None:
    arguments = ("checkpoint=run", "evaluate.episodes=1", "cluster.workers=1", "output=again", "recorder=none")
    harder = (*arguments, "task/randomize=wide", "task.time_limit=1.0")
    assert "wrote again/report.html" in here(home, *harder).stdout
    report, page = json.loads((home / "again/report.json").read_text()), home / "again/report.html"
    assert report["config"]["task"]["image_size"] == [32, 32]
    assert "purple" in report["config"]["task"]["randomize"]["colour"]["names"]
    assert report["model"] == "bc" and "${" not in (home / "again/changes.yaml").read_text()
    for spoil in (lambda: os.utime(page, (0, 0)), page.unlink):  # the process was killed before it was written
        spoil()
        assert "evaluation is already finished" in here(home, *harder).stdout
        assert page.stat().st_mtime > 0 and "95 % confidence intervals" in page.read_text()


def test_a_policy_sees_the_pictures_of_its_training_and_those_of_the_other_renderer(
    home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[str] = []
    for kind in (Fast, Reference):

        def noted(self: Any, model: Any, view: Any, name: str = kind.__name__, really: Any = kind.open) -> Any:
            opened.append(name)
            return really(self, model, view)

        monkeypatch.setattr(kind, "open", noted)
    arguments = ("checkpoint=run", "evaluate=renderer", "evaluate.episodes=2", "output=renderers")
    network = "{_target_: vla.rollouts.realtime.Network, latency: 0.3, jitter: 0, loss: 0, ensemble: null}"
    arguments += ("cluster.workers=1", "task.time_limit=1.0")
    clash = here(home, *arguments, f"+evaluate.networks.renderer_fast={network}", ok=False)
    assert "evaluate has 2 conditions with the name renderer_fast: rename one" in clash.stderr
    done = here(home, *arguments, f"+evaluate.networks.slow={network}")
    report = json.loads((home / "renderers/report.json").read_text())
    assert opened == ["Fast", "Reference", "Fast"]
    conditions = report["conditions"]
    assert conditions.keys() == {"renderer_fast", "renderer_mujoco", "slow"}
    assert conditions["renderer_fast"]["outcomes"] == [result["outcome"] for result in report["per_episode"]]
    assert conditions["renderer_mujoco"]["episodes"] == 2
    assert "renderer_mujoco" in done.stdout


@pytest.mark.parametrize(
    "overrides",
    [
        ("job=train", "trainer.devices=999", "trainer.accelerator=cpu"),  # refused with the folder locked
        ("job=train", "collect.seed=2000000", "trainer.accelerator=cpu"),
        ("job=deploy", "deploy=server"),
    ],
)
def test_a_refused_run_leaves_no_folder(tmp_path: Path, overrides: tuple[str, ...]) -> None:
    (tmp_path / "mine").mkdir()
    for folder in ("named", "mine"):
        here(tmp_path, *overrides, f"output={folder}", ok=False)
    assert not (tmp_path / "named").exists() and not [*tmp_path.glob("outputs/*/*")]
    assert (tmp_path / "mine").exists() and not [*(tmp_path / "mine").iterdir()]


def test_a_policy_behind_a_server_acts_as_it_does_from_its_checkpoint(home: Path) -> None:
    with create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    serve = ("job=deploy", "deploy=server", f"deploy.port={port}", "checkpoint=run")
    server = warm.Started(home, "vla.run", *serve, "output=served", environment={})
    try:
        until(lambda: _listens(port))
        here(home, *SMALL, "agent=remote", f"agent.url=ws://127.0.0.1:{port}", "recorder=none", "output=remote")
        asked = (*SMALL, "agent=remote", f"agent.url=ws://127.0.0.1:{port}", "recorder=none", "output=again")
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("vla.jobs.evaluate.write_report", Mock(side_effect=KeyboardInterrupt))
            here(home, *asked, ok=False)
        done = here(home, *asked)
        assert f"they are of what ws://127.0.0.1:{port} served then: if that is another" in done.stdout + done.stderr
        with connect(f"ws://127.0.0.1:{port}", proxy=None) as hostile:
            hostile.recv()
            hostile.send(pack({"\x1b]0;evil\x07\r\nerror: forged": 1}))
            hostile.recv()
    finally:
        server.send_signal(signal.SIGTERM)
    assert server.wait(60) == 0, server.printed()
    printed = server.printed()
    assert "prompt: it has \\x1b]0;evil\\x07 error: forged\n" in printed and not {"\x1b", "\x07"} & {*printed}
    played = [json.loads((home / run / "report.json").read_text())["per_episode"] for run in ("run", "remote")]
    first, second = ([(each["outcome"], each["motion"]) for each in episodes] for episodes in played)
    assert len(first) == 2 and first == second


def test_one_policy_for_all_workers_acts_as_one_beside_each(home: Path) -> None:
    policy = ("checkpoint=run", "evaluate.episodes=2", "cluster.workers=1", "cluster.policy=here", "recorder=none")
    here(home, *policy, "output=shared")
    first, second = (json.loads((home / run / "report.json").read_text())["per_episode"] for run in ("run", "shared"))
    assert len(first) == 2 and first == second


def _listens(port: int) -> bool:
    try:
        create_connection(("127.0.0.1", port), 1).close()
    except ConnectionRefusedError:
        return False
    return True


def test_the_nearest_demonstration_is_evaluated_like_a_policy_and_beside_one(home: Path) -> None:
    here(home, *SMALL, "agent=nearest", "collect.folder=nowhere", "hydra.run.dir=late", ok=False)
    assert not (home / "late").exists()
    done = here(home, *SMALL, "agent=nearest", "recorder=none", "output=nearest")
    report = json.loads((home / "nearest/report.json").read_text())
    assert (report["model"], report["checkpoint"], report["episodes"], report["errors"]) == ("nearest", None, 2, 0)
    assert done.stdout.strip().splitlines()[-1].startswith(f"success {report['successes']}/2 (")
    policy = ("checkpoint=run", "task.time_limit=1.0", "evaluate.episodes=2", "cluster.workers=1")
    (folder,) = (home / "outputs/episodes").iterdir()
    done = here(home, *policy, f"evaluate.nearest={folder}", "recorder=none", "output=beside_nearest")
    beside = json.loads((home / "beside_nearest/report.json").read_text())["conditions"]
    assert beside.keys() == {"nearest"} and "nearest" in done.stdout
    assert beside["nearest"]["outcomes"] == [each["outcome"] for each in report["per_episode"]]
    refused = here(home, *policy, "evaluate.nearest=nowhere", "output=refused_nearest", ok=False)
    assert refused.stderr.count("\n") == 1 and "no episode store in nowhere" in refused.stderr


def test_an_evaluation_ends_when_what_it_is_asked_is_decided(home: Path) -> None:
    policy = ("checkpoint=run", "cluster.workers=1", "task.time_limit=0.2", "recorder=none")
    asked = (*policy, "evaluate.episodes=40", "evaluate.until=decided", "evaluate.margin=0.9")
    done = here(home, *asked, "evaluate.bar=0.5", "evaluate.without=[images,instruction]", "output=beside")
    report = json.loads((home / "beside/report.json").read_text())
    assert report["conditions"].keys() == {"without_images", "without_instruction"}
    blind = report["conditions"]["without_images"]
    assert report["anytime"] and blind["anytime"] and 1 < blind["episodes"] < report["episodes"] < 40
    assert report["successes"] == 0 and report["ci_high"] < 0.5  # hardly trained
    assert report["statements"] == ["success is below the bar of 50 %"]
    assert blind["compared"]["success"]["verdict"] == "not worse by 90 points"
    assert report["statements"][0] in done.stdout and "anytime-valid 95 % CI" in done.stdout.strip().splitlines()[-1]
    page = (home / "beside/report.html").read_text()
    assert report["statements"][0] in page and "anytime-valid" in page
    here(home, *asked, "evaluate.against=beside", "output=against")
    again = json.loads((home / "against/report.json").read_text())
    assert again["statements"][0].startswith(f"compared with beside on {blind['episodes']} common episodes: not worse")


def test_what_an_evaluation_cannot_decide_is_refused_before_any_work(home: Path) -> None:
    arguments = ("checkpoint=run", "cluster.workers=1", "output=refused")
    for asked, says in (
        ("evaluate.until=decided", "needs something to decide: evaluate.bar=0.95"),
        ("evaluate.against=nowhere", "nowhere is no run"),
        ("evaluate.bar=1.0", "evaluate.bar must be less than 1, got 1.0"),
    ):
        refused = here(home, *arguments, asked, ok=False)
        assert says in refused.stderr and not (home / "refused/report.json").exists(), refused.stderr


def test_the_same_command_in_the_same_folder_does_nothing_twice(home: Path) -> None:
    arguments = (*SMALL, "validate.episodes=1", "hydra.run.dir=run")
    made = {home / "run" / name: (home / "run" / name).stat().st_mtime_ns for name in ("report.json", "metrics.csv")}
    done = here(home, *arguments, "output=run")
    assert "training is already finished" in done.stdout and "evaluation is already finished" in done.stdout
    refused = here(home, *arguments, "output=run", "learner.lr=1e-4", "trainer.max_steps=5", ok=False)
    assert "run holds a training that differs in learner.lr: choose" in refused.stderr
    refused = here(home, "resume=run", "output=run", "learner.lr=1e-4", ok=False)
    assert "run holds a training that differs in learner.lr: omit that to continue it" in refused.stderr
    done = here(home, "resume=run", "output=run")
    assert "training is already finished" in done.stdout and "evaluation is already finished" in done.stdout
    assert made == {path: path.stat().st_mtime_ns for path in made}
    shutil.copytree(home / "run", home / "copy")
    done = here(home, *arguments, "output=copy", "evaluate.episodes=1")  # its evaluation is another
    assert "training is already finished" in done.stdout and "training BC" not in done.stdout
    assert json.loads((home / "copy/report.json").read_text())["episodes"] == 1


def test_a_policy_that_is_replaced_while_it_is_evaluated_gets_no_report(
    home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(home / "run/policy", home / "replaced")
    play = evaluate._play

    def replaced(*arguments: Any) -> dict[str, Any]:
        reports = play(*arguments)
        change_json(home / "replaced/training.json", lambda training: {**training, "weights": "0" * 64})
        return reports

    monkeypatch.setattr(evaluate, "_play", replaced)
    asked = ("checkpoint=replaced", "evaluate.episodes=1", "recorder=none", "cluster.workers=1", "output=of_both")
    refused = here(home, *asked, ok=False)
    assert "replaced was replaced while it was evaluated: run the evaluation again" in refused.stderr
    assert not (home / "of_both/report.json").exists()


def test_a_training_that_cannot_be_resumed_stays_as_it_was(home: Path) -> None:
    run = Path(shutil.copytree(home / "run", home / "refused_run"))
    last = run / "checkpoints/last.ckpt"
    saved = torch.load(last)
    torch.save({**saved, "WindowDataModule": {**saved["WindowDataModule"], "windows": "others"}}, last)
    names = ("report.json", "report.html", "training.json", "config.yaml", "metrics.csv")
    before = {name: (run / name).read_bytes() for name in names}
    refused = here(home, "resume=refused_run", "output=refused_run", "trainer.max_steps=50", ok=False)
    assert "was started with other demonstrations" in refused.stderr
    assert before == {name: (run / name).read_bytes() for name in names}


def test_runs_are_compared_in_one_page(home: Path) -> None:
    before = {*home.glob("outputs/runs/*")}
    here(home, "job=report", "report.runs=[run]", "output=compared")
    assert 'href="../run/report.html"' in (home / "compared/comparison.html").read_text()
    assert {*home.glob("outputs/runs/*")} == before  # not the folder of a command that writes elsewhere


def test_cells_run_at_the_same_time_and_one_that_fails_leaves_the_others_alone(home: Path) -> None:
    launcher = ("-m", "hydra/launcher=joblib", "hydra.launcher.n_jobs=2", "hydra.sweep.dir=grid")
    small = ("job=collect", "cluster.workers=1", "task.image_size=[32,32]", "collect.folder=grid/store")
    done = vla(home, *launcher, *small, "collect.episodes=0,1,-2", ok=False)
    errors = done.stderr[done.stderr.index("error: ") :].splitlines()
    assert errors[0].startswith("error: 2 of 3 cells failed") and "Traceback" not in done.stderr
    assert errors[1].startswith("  0 collect.episodes=0: collect.episodes must be") and "=-2: " in errors[2]
    assert len(EpisodeStore(home / "grid/store").episodes) == 1 and not (home / "grid/1/error.txt").exists()
    assert "greater than or equal to 1" in (home / "grid/2/error.txt").read_text()


def test_preview_shows_resets_and_like_a_replay_needs_no_viewer(home: Path) -> None:
    (store,) = (home / "outputs/episodes").iterdir()
    look = here(home, "job=preview", "preview.episodes=2", "output=look").stdout
    sheet = np.asarray(Image.open(home / "look/preview.png").convert("RGB"))
    assert (np.ptp(sheet.astype(int), axis=-1) > 60).sum() > 500  # pixels of coloured blocks, of which text has none
    recorded = {chunk.entity_path for chunk in RrdReader(home / "look/preview.rrd").stream().to_chunks()}
    assert "/camera/front/rgb" in recorded and "placement" in look
    code = f"""
import sys
sys.modules.update(dict.fromkeys(["rerun", "rerun_cli", "av", "rclpy"]))  # as if they were not installed
from vla.run import main
for job in ["job=preview", "preview.episodes=1"], ["job=inspect", "inspect.folder={store}", "inspect.episode=2"]:
    sys.argv[1:] = [*job, "recorder=none", "output=plain"]
    main()
"""
    (home / "no_viewer.py").write_text(code)
    done = warm.run(home, program="no_viewer")
    assert "plain/preview.png" in done.stdout and "bit for bit" in done.stdout, done.stderr
    assert sorted(path.name for path in (home / "plain").iterdir() if path.suffix != "") == ["preview.png"]


def test_a_success_rate_is_printed_even_where_the_report_cannot_be_written(home: Path) -> None:
    for name in ("report.json", "report.png"):
        (home / "blocked" / name).mkdir(parents=True)  # where a file is to go
    arguments = ("checkpoint=run", "evaluate.episodes=1", "cluster.workers=1", "recorder=none")
    done = here(home, *arguments, "output=blocked", ok=False)
    assert done.stdout.strip().splitlines()[-1].startswith("success ")
    errors = [line for line in done.stderr.splitlines() if line.startswith("error: ")]
    assert len(errors) == 1 and "blocked/report.json cannot be written (" in errors[0]
    assert "could not write blocked/report.png" in done.stdout + done.stderr  # which alone costs no report
    names = ["changes.yaml", "config.yaml", "played.jsonl", "report.json", "report.png"]
    assert sorted(path.name for path in (home / "blocked").iterdir()) == names


def test_an_episode_is_replayed_into_a_recording(home: Path) -> None:
    (store,) = (home / "outputs/episodes").iterdir()
    replay = ("job=inspect", f"inspect.folder={store}", "output=replay")
    assert "bit for bit" in here(home, *replay, "inspect.episode=2").stdout
    recorded = {chunk.entity_path for chunk in RrdReader(home / "replay/episode-2.rrd").stream().to_chunks()}
    assert {"/camera/front/rgb", "/camera/wrist/depth", "/state/rad", "/action/m/executed"} <= recorded
    assert any(path.startswith("/world/panda") for path in recorded)


def test_a_bug_gives_a_traceback_and_so_does_a_mistake_where_asked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patched:
        patched.setattr(jobs, "run", lambda experiment: int("x"))
        with pytest.raises(ValueError, match="invalid literal for int"):
            here(tmp_path, "job=plan", "plan.rates=[0.9,0.95]")
    monkeypatch.setenv("HYDRA_FULL_ERROR", "1")
    with pytest.raises(ValueError, match="name the runs to compare"):
        here(tmp_path, "job=report")


def test_an_option_without_its_value_may_be_last(tmp_path: Path) -> None:
    assert "job: plan" in here(tmp_path, "job=plan", "--info").stdout


def test_variants_are_found_in_a_folder_of_options_of_the_user(tmp_path: Path) -> None:
    (tmp_path / "mine/experiment").mkdir(parents=True)
    text = "# @package _global_\nvariant: equal\nvariants:\n  equal: ['plan.rates=[0.5,0.5]']\n"
    (tmp_path / "mine/experiment/mine.yaml").write_text(text)
    refused = here(tmp_path, "job=plan", "--config-dir", "mine", "experiment=mine", ok=False)
    assert "are equal: no number of episodes tells them apart" in refused.stderr, refused.stderr


def test_a_training_that_goes_on_archives_its_evaluation(home: Path) -> None:
    shutil.copytree(home / "run", home / "longer")
    done = here(home, "job=train", "resume=longer", "output=longer", "trainer.max_steps=6")
    assert "trained 6 steps" in done.stdout
    # Its evaluation was of the policy before: nothing of it is said of this one.
    assert (home / "longer/report_4.json").read_bytes() == (home / "run/report.json").read_bytes()
    assert not any((home / "longer" / name).exists() for name in ("report.json", "report.png", "rollouts.rrd"))
    page = (home / "longer/report.html").read_text()
    assert "6 steps" in page and "95 % CI" not in page


def test_a_policy_is_trained_further_for_another_goal(home: Path, tmp_path: Path) -> None:
    shutil.copytree(home / "run/policy", tmp_path / "theirs")
    arguments = (*SMALL, f"pretrained={tmp_path}/theirs", "task/goal=push", "job=train", "collect.folder=pushed")
    arguments += ("collect.episodes=5",)
    done = here(home, *arguments, "learner.lr=1e-12", "trainer.max_steps=1", "output=tuned")
    assert f"starting from {tmp_path}/theirs" in done.stdout
    before, after = map(read_policy, (tmp_path / "theirs", home / "tuned"))
    assert after.config["task"]["goal"] != before.config["task"]["goal"]
    for name, weight in before.state.items():
        # Statistics are of all that was ever seen.
        gathered = name.startswith(("features.proprioception.", "truth_scale."))
        assert gathered or torch.allclose(after.state[name], weight, atol=1e-9), name
    for other in ("model=rt1_tiny", "tokenizer.bins=64", "model.shift=[0,0]"):
        refused = here(home, *arguments, other, ok=False)
        assert f"error: {other} cannot be combined with saved weights" in refused.stderr
    refused = here(home, *arguments, "checkpoint=tuned", ok=False)
    assert "initialises a new training" in refused.stderr and refused.stderr.count("\n") == 1
    shutil.rmtree(tmp_path / "theirs")  # which going on does not need
    done = here(home, "resume=tuned", "output=tuned", "trainer.max_steps=2")
    assert "trained 2 steps" in done.stdout


def test_a_checkpoint_of_other_cameras_is_refused(home: Path) -> None:
    done = here(home, "checkpoint=run", "task.cameras=[front]", "cluster.workers=1", ok=False)
    assert "cameras" in done.stderr and "Traceback" not in done.stderr


def test_a_model_that_memory_cannot_hold_is_refused_in_one_sentence(home: Path) -> None:
    huge = ("model.width=2048", "model.chunk=1024", "tokenizer.bins=65536")  # 4 TB in the last layer
    done = here(home, *SMALL, "job=train", *huge, "output=huge", ok=False)
    assert done.stderr.startswith("error: training needs more memory than available: lower data.batch_size (now 8)")
    assert "model.width (now 2048)" in done.stderr and len(done.stderr.splitlines()) == 1


def test_training_that_fails_says_so_in_its_page(home: Path) -> None:
    done = here(home, *SMALL, "job=train", "learner.lr=1e30", "learner.warmup_steps=0", "output=failed", ok=False)
    assert "error: the loss is not a finite number at step 1" in done.stderr and "Traceback" not in done.stderr
    assert "Training failed: the loss is not a finite number" in (home / "failed/report.html").read_text()


def test_training_that_is_interrupted_saves_and_goes_on(home: Path) -> None:
    """By both signals, one after the other; that it then is, bit for bit, the same training is for `test_trainer`."""
    run = home / "outputs/runs/stopped"
    metrics, page = run / "metrics.csv", run / "report.html"

    def interrupted(number: signal.Signals, *arguments: str) -> int:
        """After how many steps a training was."""

        def interrupt(process: int) -> None:
            before = metrics.stat().st_size if metrics.exists() else 0
            until(lambda: metrics.exists() and metrics.stat().st_size > before)
            os.kill(process, number)

        done = warm.run(home, *arguments, meanwhile=interrupt)
        assert done.returncode == 130, done.stdout + done.stderr
        said = re.search(r"interrupted after (\d+) steps", done.stdout + done.stderr)
        assert said and f"{run.relative_to(home)}/checkpoints/last.ckpt" in done.stdout + done.stderr
        assert "interrupted: the same command continues" in done.stdout + done.stderr
        assert f"Training was interrupted after {said[1]} steps" in page.read_text()
        return int(said[1])

    endless = ("trainer.max_steps=100000", "trainer.limit_val_batches=0", "trainer.val_check_interval=1000")
    rest = ("learner.schedule=constant", "recorder=none", f"output={run.relative_to(home)}")
    soon = ("trainer.log_every_n_steps=1", "+logger.csv.flush_logs_every_n_steps=1")
    steps = interrupted(signal.SIGTERM, *SMALL, *endless, *rest, *soon)
    more = interrupted(signal.SIGINT, "resume=last")
    assert more > steps
    done = here(home, "resume=last", f"trainer.max_steps={more}")  # nothing is left to train
    assert json.loads((run / "training.json").read_text())["ended"] == "done" and (run / "report.json").exists()
    assert done.stdout.strip().splitlines()[-1].startswith("success ")
    done = here(home, "job=train", f"resume={run.relative_to(home)}", f"trainer.max_steps={more + 2}")
    assert f"trained {more + 2} steps" in done.stdout
