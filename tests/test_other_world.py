"""Everything works in a world without a robot, depth, a scene to draw, or any axis of the tabletop."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import toy
from command_line import here
from composing import composed
from defaults import defaults_of
from exporting import exporter
from fake_batch import as_policy
from rerun.chunk import RrdReader
from small_training import make_trainer

from vla.config.experiment import Experiment
from vla.config.nodes import with_changes
from vla.data.episodes import EpisodeStore
from vla.data.formats.lerobot_import import LeRobotDemonstrations
from vla.data.verification import require_whole, verify_store
from vla.policy import Policy
from vla.reports.comparison_page import tabulate
from vla.reports.dataset_card import store_table, write_card
from vla.reports.evaluation import plot_report, write_report
from vla.reports.run_page import write_page
from vla.rollouts.evaluate import evaluate
from vla.rollouts.recorder import RerunRecorder
from vla.rollouts.recordings import merge_recordings
from vla.rollouts.rollout import rollout
from vla.runs.folder import save_config
from vla.spec import FIRST_SEED

SMALL = (
    *("model=bc", "model.width=16", "model.text_width=8", "model.keypoints=4", "learner.warmup_steps=0"),
    *("collect.episodes=30", "data.batch_size=4", "data.validation_fraction=0"),
)
OWN = {"expert": "clean", "evaluate": "generalisation"}


def policy_of(store: Path, environment: Any = None, overrides: tuple[str, ...] = SMALL) -> Policy:
    """A policy after two steps of training."""
    experiment, opened = Experiment.from_config(composed(*overrides)), EpisodeStore(store)
    learner = experiment.fitted_learner(opened)
    network = learner.model
    data = experiment.data(opened, network.history, network.chunk, network)
    make_trainer(2).fit(learner, datamodule=data)
    return as_policy(network, opened.spec)


def test_a_policy_is_evaluated_recorded_and_reported(folder: Path, tmp_path: Path) -> None:
    cell = tmp_path / "0"
    (cell / ".hydra").mkdir(parents=True)
    (cell / ".hydra/overrides.yaml").write_text("- model=bc\n")
    seeds, recorder = range(FIRST_SEED, FIRST_SEED + 3), partial(RerunRecorder, cell / "recordings", 1)
    report = evaluate(toy.make_environment, partial(policy_of, folder), recorder, seeds)
    assert report.episodes == 3 and {*report.tasks} == {
        toy.make_environment().reset(seed).instruction.split()[3] for seed in seeds
    }
    recorded = merge_recordings(report, cell / "recordings", cell / "rollouts.rrd", "all")
    assert sorted(recorded) == [*seeds]
    entities = {chunk.entity_path for chunk in RrdReader(cell / "rollouts.rrd").stream()}
    assert {"/camera/eye/rgb", "/state/m", "/action/1/executed"} <= entities
    assert not any(entity.startswith("/world") or "depth" in entity for entity in entities)
    plot_report(report, cell / "report.png")
    save_config(cell, {"task": {"_target_": "somewhere.World"}}, [])
    write_report(report, cell / "report.json", None, {}, {"parameters": 1, "latency_ms": 1.0}, {"dim": report})
    page = write_page(cell).read_text()
    assert "dim" in page and json.loads((cell / "report.json").read_text())["tasks"].keys() == report.tasks.keys()
    tabulate(tmp_path)
    assert (tmp_path / "sweep.html").is_file()


@pytest.mark.parametrize("model", ["act", "flow"])
def test_models_of_actions_that_are_no_tokens_are_trained_and_act(model: str, folder: Path) -> None:
    few = ("collect.episodes=30", "data.batch_size=4", "data.validation_fraction=0")
    policy = policy_of(folder, overrides=(f"model={model}", "model.width=32", *few))
    actions = rollout(toy.make_environment(), policy, FIRST_SEED).actions
    assert actions.any() and np.isfinite(actions).all()


@pytest.mark.parametrize("kind", ["files", "lerobot"])
def test_episodes_are_exported(folder: Path, tmp_path: Path, kind: str) -> None:
    store = EpisodeStore(folder, episodes=3)
    exporter(kind, tmp_path / "export").export(store)
    if kind == "files":
        state = json.loads((tmp_path / "export/episode_00000/step_0000/robot_state.json").read_text())
        assert np.array([state["east"], state["north"]], np.float32).tolist() == store.rows("state")[:1][0].tolist()
        assert not list((tmp_path / "export").rglob("depth*"))
    else:
        expert = LeRobotDemonstrations(**defaults_of("expert/lerobot", folder=tmp_path / "export"), spec=toy.SPEC)
        episode = expert.episode(0)
        assert episode.draws["recorded"]["lacks"] == []
        state = np.stack([seen.state for seen in episode.observations])
        np.testing.assert_array_equal(state, store.rows("state")[: len(state)])


def test_a_store_is_verified_and_described(folder: Path) -> None:
    findings = verify_store(EpisodeStore(folder))
    require_whole(findings)
    assert len(store_table(findings).rows) > 10
    assert "east | m" in write_card(findings).read_text()


def test_changes_are_merged_and_a_class_replaces_a_class() -> None:
    node: dict[str, Any] = {
        "size": 1,
        "wind": {"force": [0, 1], "gusts": True},
        "goal": {"_target_": "a.Goal", "radius": 2},
    }
    changes = {"wind": {"gusts": None}, "goal": {"_target_": "b.Goal"}, "rain": {"rate": 1}}
    assert with_changes(node, changes) == {
        "size": 1,
        "wind": {"force": [0, 1], "gusts": None},
        "goal": {"_target_": "b.Goal"},
        "rain": {"rate": 1},
    }
    assert node["wind"]["gusts"] is True
    assert with_changes(node, {"goal": {"radius": 3}})["goal"] == {"_target_": "a.Goal", "radius": 3}


def test_a_world_chooses_its_expert_and_evaluations_and_the_command_line_has_the_last_word(tmp_path: Path) -> None:
    (tmp_path / "task").mkdir()
    chosen = "".join(f"  - override /{group}@_global_.{group}: {name}\n" for group, name in OWN.items())
    (tmp_path / "task/other.yaml").write_text(f"defaults:\n  - _self_\n{chosen}\n_target_: somewhere.World\n")
    there = (f"hydra.searchpath=[file://{tmp_path}]", "task=other")
    own, said = composed(*there), composed(*there, "expert=waypoint")
    assert own.task == {"_target_": "somewhere.World"} and own.validate.changes == {}
    assert "perturb" not in own.expert and [*own.evaluate.conditions] == ["wide"]
    assert "perturb" in said.expert and [*said.evaluate.conditions] == ["wide"]


def test_a_variant_is_composed_with_the_folders_of_options_of_the_command(tmp_path: Path) -> None:
    (tmp_path / "experiment").mkdir()
    text = "# @package _global_\nvariants: {two: ['plan.rates=[0.6,0.6]']}\n"
    (tmp_path / "experiment/own.yaml").write_text(text)
    there = f"hydra.searchpath=[file://{tmp_path}]"
    refused = here(tmp_path, "job=plan", there, "experiment=own", "variant=two", ok=False)
    assert "plan.rates=[0.6, 0.6] are equal" in refused.stderr
