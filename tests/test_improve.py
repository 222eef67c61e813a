"""Rounds of an expert's labels for what a policy sees."""

from __future__ import annotations

import json
import shutil
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import toy
from collecting import content
from command_line import SMALL, here
from composing import check, composed
from reading import windows

from vla.config.adopt import resume
from vla.config.experiment import Experiment, to_plain
from vla.data.derivation import derive_store
from vla.data.episodes import EpisodeStore
from vla.data.header import Codec
from vla.data.verification import episode_of, verify_store
from vla.data.window_batches import WindowBatcher
from vla.jobs import improve
from vla.models.policy_folder import read_policy
from vla.parallel.pool import Cluster
from vla.rollouts.collect import collect
from vla.rollouts.rollout import replay, rollout
from vla.rollouts.supervised import SupervisedAgent, require_memoryless
from vla.runs.folder import save_config
from vla.tasks.perturb import Perturbed
from vla.tasks.tabletop.expert import Waypoint

ROUNDS = ("job=improve", "pretrained=run", *SMALL, "task.time_limit=2", "evaluate.episodes=1")
FEW = ("improve.episodes=2", "improve.steps=2", "collect.folder=few", "collect.episodes=3", "recorder=none")
FEW += ("task.image_size=[40,48]", "cluster.policy=here")  # sharper cameras than in training, and one policy for all


def label(folder: Path, workers: int, episodes: int = 12) -> EpisodeStore:
    store = EpisodeStore.create_or_open(folder, toy.SPEC, {})
    agent = partial(SupervisedAgent, toy.make_wanderer, toy.make_expert)
    collect(store, toy.make_environment, agent, episodes, Cluster(workers, "beside"), 100, keep_failures=True)
    return EpisodeStore(folder)


@pytest.fixture(scope="module")
def labelled(tmp_path_factory: pytest.TempPathFactory) -> EpisodeStore:
    """Twelve labelled episodes of the toy world."""
    return label(tmp_path_factory.mktemp("labelled"), workers=1)


def test_the_policy_acts_and_the_expert_labels() -> None:
    environment = toy.make_environment()
    episode = rollout(environment, SupervisedAgent(toy.make_wanderer, toy.make_expert, environment), 7)
    alone = rollout(toy.make_environment(), toy.Wanderer(), 7)
    np.testing.assert_array_equal(episode.executed, alone.executed)
    assert not episode.success
    for observation, action in zip(episode.observations, episode.actions, strict=True):
        assert observation.truth is not None
        way = observation.truth["target"] - observation.truth["point"]
        np.testing.assert_array_equal(action, [*np.clip(way, -0.05, 0.05), 1.0])


def test_failures_are_kept_with_their_labels(labelled: EpisodeStore, tmp_path: Path) -> None:
    assert [entry.seed for entry in labelled.episodes] == [*range(100, 112)]
    failures = [entry for entry in labelled.episodes if not entry.success]
    assert failures and all(entry.steps == 40 for entry in failures)
    assert replay(toy.make_environment(), episode_of(labelled, failures[0]))[1] is None
    outcomes = {"success": 12 - len(failures), "timeout": len(failures)}
    assert verify_store(labelled).outcomes == outcomes
    derive_store([labelled], tmp_path / "some", {"seed": [104, None]})
    assert len(EpisodeStore(tmp_path / "some").episodes) == 8


def test_labelled_episodes_do_not_depend_on_workers_or_interruptions(labelled: EpisodeStore, tmp_path: Path) -> None:
    label(tmp_path / "two", workers=1, episodes=5)
    label(tmp_path / "two", workers=2)
    assert content(tmp_path / "two") == content(labelled.folder)


def test_windows_of_several_stores_are_those_of_each(labelled: EpisodeStore, folder: Path) -> None:
    first = EpisodeStore(folder, 4)
    module = windows(folder, episodes=4, more=[labelled.folder])
    start, rows = first.episodes[-1].end, labelled.episodes[-1].end
    both = np.concatenate([module.training_windows, module.held_out_windows])
    assert sorted(both.tolist()) == [*range(start + rows)]
    batch = module.make_batch(np.array([start + 3, 5, start + rows - 1, 0]))
    for store, chosen, part in ((first, [5, 0], slice(0, 2)), (labelled, [3, rows - 1], slice(2, 4))):
        alone = WindowBatcher(store, 3, 2)(np.array(chosen))
        for name in ("state", "action", "truth", "valid", "present"):
            np.testing.assert_array_equal(batch[name][part], alone[name])
        np.testing.assert_array_equal(batch["rgb"]["eye"][part], alone["rgb"]["eye"])
        assert batch["instruction"][part] == alone["instruction"]
    with pytest.raises(ValueError, match="other demonstrations"):
        windows(folder, episodes=4).load_state_dict(module.state_dict())


def test_only_a_memoryless_expert_labels() -> None:
    class Counting(toy.ToyExpert):
        memoryless = False

    class Silent(toy.Wanderer):
        """Says nothing about its memory."""

    unused: Any = None  # the perturbation
    for other in (Counting(), Silent(), Perturbed(toy.SPEC, lambda spec: Counting(), unused)):
        with pytest.raises(ValueError, match="cannot label the states of another agent"):
            require_memoryless(other)
    require_memoryless(Perturbed(toy.SPEC, lambda spec: toy.ToyExpert(), unused))


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        ("improve.seed=999999", "its rounds reach 1000000, where evaluation begins: lower it"),
        ("trainer.devices=2", "trains on one device"),
        ("expert=clean", "Waypoint cannot label the states of another agent"),
        ("evaluate.against=nowhere", "nowhere"),
        ("evaluate.until=decided", "needs something to decide"),
        ("+improve.changes.blocks=50", "task.blocks"),
        ("+improve.changes.image_size=[64,64]", "the task has image_size = .* with improve.changes has"),
    ],
)
def test_what_cannot_be_improved_is_refused_before_any_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, wrong: str, sentence: str
) -> None:
    monkeypatch.setattr(Waypoint, "memoryless", wrong != "expert=clean")
    nowhere = (f"output={tmp_path}/run", f"collect.folder={tmp_path}/episodes")
    with pytest.raises(ValueError, match=sentence):
        improve.run(Experiment.from_config(composed("job=improve", *nowhere, wrong)))
    assert not list(tmp_path.iterdir())


def test_the_episodes_of_a_round_may_have_another_task() -> None:
    check(composed("job=improve", "+improve.changes.time_limit=5.0"))
    with pytest.raises(ValueError, match=r"task \(improve.changes\).time is unknown"):
        check(composed("job=improve", "+improve.changes.time=5.0"))


def test_a_round_validates_once_at_its_end(tmp_path: Path) -> None:
    asked = composed("job=improve", "improve.steps=50", "trainer.accumulate_grad_batches=3")
    trainer = improve._round(Experiment.from_config(asked), tmp_path / "policy", tmp_path, [])["trainer"]
    assert (trainer["max_steps"], trainer["val_check_interval"]) == (50, 150)  # steps, and batches


def test_rounds_resume_with_their_own_config(tmp_path: Path) -> None:
    run = tmp_path / "run"
    saved = composed("job=improve", f"output={run}", "pretrained=policy", "improve.steps=7", "trainer.max_steps=9")
    save_config(run, to_plain(saved), [])
    more = ["job=improve", "improve.rounds=5"]
    resumed = resume(composed(f"output={tmp_path}/now", *more), run, more)
    assert (resumed.job, resumed.output, resumed.pretrained) == ("improve", str(run), "policy")
    assert (resumed.improve.rounds, resumed.improve.steps, resumed.trainer.max_steps) == (5, 7, 9)


def test_the_folder_of_a_training_without_rounds_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "checkpoints/last.ckpt").touch()
    with pytest.raises(ValueError, match=rf"{tmp_path} has a training without rounds: choose another output=DIR"):
        improve.run(Experiment.from_config(composed(f"output={tmp_path}", "job=improve")))
    assert [path.name for path in tmp_path.iterdir()] == ["checkpoints"]


@pytest.mark.parametrize(
    "change",
    [
        *("seed=1", "trainer.max_steps=5", "+trainer.max_time={hours: 1}", "policy.lanes=2"),
        *("improve.steps=5", "improve.episodes=3", "improve.seed=700000"),
    ],
)
def test_a_folder_with_other_rounds_or_longer_trainings_is_left_alone(tmp_path: Path, change: str) -> None:
    there = (f"output={tmp_path}", "job=improve")
    save_config(tmp_path, to_plain(composed(*there)), [])
    (tmp_path / "round_1/episodes").mkdir(parents=True)
    (tmp_path / "round_1/episodes/store.json").write_text("{}")
    before = (tmp_path / "config.yaml").read_bytes()
    key = "data.seed, seed" if change == "seed=1" else change.lstrip("+").partition("=")[0]
    with pytest.raises(ValueError, match=rf"{tmp_path} holds a training that differs in {key}"):
        improve.run(Experiment.from_config(composed(*there, change)))
    assert (tmp_path / "config.yaml").read_bytes() == before


def result(folder: Path) -> tuple[dict[str, bytes], dict[str, float]]:
    """What a round leaves that must not depend on interruptions: its episodes and weights."""
    state = read_policy(folder).state
    return content(folder / "episodes"), {name: values.double().sum().item() for name, values in state.items()}


def test_rounds_that_were_killed_go_on_to_the_same_result(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    here(home, *ROUNDS, *FEW, "output=rounds", "improve.rounds=1", "collect.images=lossless")
    changes = (home / "rounds/changes.yaml").read_text()
    assert "key: improve.steps" in changes and "improve.changes" not in changes
    first, second = (home / "rounds" / name for name in ("round_1", "round_2"))
    whole = result(first)
    assert json.loads((home / "rounds/report.json").read_text())["config"]["improve"]["rounds"] == 1

    # What a process leaves that is killed within the second episode: rows without a line in the index.
    shutil.rmtree(first / "checkpoints")
    index = first / "episodes/index.jsonl"
    index.write_bytes(index.read_bytes().splitlines(keepends=True)[0] + b'{"seed": 500')
    here(home, "resume=rounds", "output=rounds", "job=improve", "improve.rounds=2")
    assert result(first) == whole
    labelled = EpisodeStore(second / "episodes")
    assert [entry.seed for entry in labelled.attempts] == [500002, 500003]
    assert labelled.codec == EpisodeStore(home / "few").codec == Codec("lossless")
    assert (home / "rounds/report_1.json").exists()  # of the policy after one round
    trained = read_policy(second).config
    stores = ["rounds/round_1/episodes", "rounds/round_2/episodes"]
    assert trained["collect"]["more"] == stores
    assert trained["pretrained"] == "rounds/round_1/policy"
    monkeypatch.chdir(home)
    further = composed(*ROUNDS, *FEW, "output=further", "pretrained=rounds/round_2")
    with pytest.raises(ValueError, match=rf"collect\.more=\[{','.join(stores)}\] to train on these episodes again"):
        improve.run(Experiment.from_config(further))
    further.collect.more = stores
    with pytest.raises(ValueError, match=r"have 500000, 500001: set improve\.seed=500002, or higher"):
        improve.run(Experiment.from_config(further))
