"""The check of a composed config, the objects built from one, and the digest that names its data."""

from __future__ import annotations

import hashlib
from typing import Any

import pytest
import toy
from omegaconf import DictConfig, OmegaConf
from test_conf import composed

from vla.check import JOBS, PLAIN, build, check, digest, suggestion
from vla.resume import adopt
from vla.run import sentence

GRAMMAR = {
    "_target_": "vla.tasks.language.Grammar",
    "phrasings": ["lift {block}"],
    "words": {},
    "held_out_phrasings": ["{block} up"],
    "held_out_words": {"lift": ["raise"]},
}
MASSES = {"_target_": "vla.tasks.randomize.blocks.Masses", "factor": [0.5, 2.0]}
PERTURBATION = {"_target_": "vla.tasks.expert.Perturbation", "start": 0.5, "steps": [2, 5]}


def config(**changes: Any) -> DictConfig:
    """A config that is right for job=collect, with dotted changes."""
    cfg = OmegaConf.create(
        {
            "job": "collect",
            "seed": 0,
            "checkpoint": None,
            "pretrained": None,
            "resume": False,
            "output": "outputs/runs/now",
            "chosen": {"experiment": None, "model": "bc", "randomize": "default"},
            "collect": {"episodes": 5, "seed": 0, "workers": None, "folder": "outputs/episodes/x"},
            "evaluate": {"episodes": 5, "seed": 1_000_000, "workers": None, "recordings": 2, "conditions": {}},
            "validate": {"episodes": 0, "seed": 2_000_000},
            "preview": {"episodes": 1, "seed": 0},
            "benchmark": {
                "names": ["train"],
                "episodes": 1,
                "batches": 1,
                "steps": 1,
                "rounds": 1,
                "precisions": ["fp32"],
                "compile": [False],
                "robosuite": None,
                "lerobot": None,
            },
            "inspect": dict.fromkeys(("stores", "where", "into", "episode")) | {"folder": "x", "repair": False},
            "report": {"runs": []},
            "task": {
                "_target_": "vla.tasks.tabletop.Tabletop",
                "goal": {"_target_": "vla.tasks.goals.lift.Lift", "language": GRAMMAR, "height": 0.1},
                "randomize": {"mass": MASSES, "size": None},
            },
            "expert": {"_target_": "vla.tasks.expert.Waypoint", "perturb": PERTURBATION},
            "cluster": {"_target_": "vla.cluster.Local", "workers": None},
        }
    )
    for key, value in changes.items():
        OmegaConf.update(cfg, key, value, force_add=True, merge=False)
    return cfg


def problem(**changes: Any) -> str:
    with pytest.raises(ValueError) as caught:
        check(config(**changes))
    return str(caught.value)


def test_a_right_config_passes() -> None:
    check(config())
    check(config(**{"task.time_limit": 10, "task.image_size": [64, 128], "expert.perturb": None}))


def test_an_unknown_key_is_named_with_what_was_probably_meant() -> None:
    assert problem(**{"task.bloks": 2}).startswith("task.bloks is unknown, did you mean blocks? Tabletop takes goal,")
    assert problem(**{"task.goal.hight": 0.2}).startswith("task.goal.hight is unknown, did you mean height?")
    assert problem(**{"task.randomize.mass.faktor": 1}).startswith("task.randomize.mass.faktor is unknown")
    assert problem(**{"collect.episode": 2}).startswith("collect.episode is unknown, did you mean episodes?")
    assert problem(sed=1).startswith("sed is unknown, did you mean seed?")


@pytest.mark.parametrize(
    ("key", "value", "expected"),
    [
        ("task.blocks", "three", "task.blocks must be int, at least 1, got 'three'"),
        ("task.blocks", True, "task.blocks must be int, at least 1, got True"),
        ("task.blocks", 2.5, "task.blocks must be int, at least 1, got 2.5"),
        ("task.shadows", 1, "task.shadows must be bool, got 1"),
        ("task.image_size", [96], "task.image_size must be tuple[int, int], each at least 8, at most 1024, got [96]"),
        ("task.image_size", [96, "x"], "task.image_size must be tuple[int, int], each at least 8"),
        ("task.image_size", [1, 1], "task.image_size must be tuple[int, int], each at least 8"),
        ("task.cameras", ["front", "front"], "task.cameras must be tuple[str, …], each not empty, not empty, without"),
        ("task.time_limit", float("nan"), "task.time_limit must be float, more than 0, got nan"),
        ("task.randomize.mass.factor", [2.0, 1.0], "task.randomize.mass.factor must be tuple[float, float], each more"),
        ("expert.perturb.steps", [5, 2], "expert.perturb.steps must be tuple[int, int], each at least 1, in ascending"),
        ("collect.folder", "", "collect.folder must be str, not empty, got ''"),
        ("task.goal", "lift", "task.goal must be Goal or Mixed, got 'lift'"),
        (
            "task.randomize.mass.factor",
            [0.5, "a"],
            "task.randomize.mass.factor must be tuple[float, float], each more than 0, in",
        ),
        ("expert.perturb.start", None, "expert.perturb.start must be float, at least 0, at most 1, got None"),
        ("collect.workers", "all", "collect.workers must be int, at least 1 or null, got 'all'"),
        ("seed", "first", "seed must be int, at least 0, at most 4294967295, got 'first'"),
        ("task.meshes", "lite", "task.meshes must be one of light, full, got 'lite', did you mean light?"),
        ("evaluate.episodes", 0, "evaluate.episodes must be int, at least 1, got 0"),
        (
            "benchmark.names",
            ["training"],
            "benchmark.names must be list[one of collect, loader, train",
        ),
        (
            "benchmark.precisions",
            ["fp16"],
            "benchmark.precisions must be list[one of fp32, bf16] or null, got ['fp16']",
        ),
    ],
)
def test_a_wrong_value_is_named_with_what_is_allowed(key: str, value: Any, expected: str) -> None:
    assert problem(**{key: value}).startswith(expected)


def test_a_missing_name_is_named_unless_the_program_gives_it() -> None:
    cfg = config()
    del cfg.task.goal
    with pytest.raises(ValueError, match=r"task\.goal is missing: Tabletop needs it"):
        check(cfg)
    check(config(expert={"_target_": "vla.tasks.expert.Waypoint"}))  # spec comes from the task
    assert problem(**{"expert.spec": 1}).startswith("expert.spec is unknown")


def test_a_job_needs_its_groups_and_looks_at_no_others() -> None:
    assert "job=collect needs expert" in problem(expert=None)
    check(config(deploy={"_target_": "vla.nowhere.Nothing"}))
    cfg = composed("job=deploy", "deploy=loop")
    cfg.deploy._target_ = "vla.nowhere.Nothing"
    with pytest.raises(ValueError, match=r"deploy\._target_ is vla\.nowhere\.Nothing, which cannot be imported"):
        check(cfg)


def test_a_misspelt_job_is_answered_with_what_was_probably_meant() -> None:
    assert problem(job="evalute").endswith("got 'evalute', did you mean evaluate?")


def test_the_job_menu_is_the_table_of_jobs() -> None:
    assert set(PLAIN["job"].__args__) == set(JOBS)


@pytest.mark.parametrize(
    "target",
    ["os.system", "subprocess.Popen", "vla.evaluate.os.system", "vla.evaluate.Path", "torch.hub.load", "vla.check:os"],
)
def test_a_target_that_is_no_class_of_the_package_is_refused(target: str) -> None:
    node = {"_target_": "vla.tasks.expert.Waypoint", "perturb": {"_target_": target}}
    with pytest.raises(ValueError, match=r"expert\.perturb\._target_ (must|is)"):
        build(node, "expert", spec=None)
    with pytest.raises(ValueError, match=r"expert\.perturb\._target_ (must|is)"):
        check(config(expert=node))


def test_a_class_stands_only_where_its_kind_is_asked_for() -> None:
    node = {"_target_": "vla.tasks.expert.Waypoint", "perturb": MASSES}
    with pytest.raises(ValueError, match=r"expert\.perturb must be Perturbation or null, got \{'_target_': .*Masses"):
        build(node, "expert", spec=None)
    with pytest.raises(ValueError, match=r"expert\._target_ must name a class of kind Agent or Recorded, got .*Masses"):
        build(MASSES, "expert")
    assert problem(task=MASSES).startswith("task._target_ must name a class of kind Environment")
    assert problem(**{"task.randomize.mass": GRAMMAR}).startswith("task.randomize must be Mapping[str, Axis or")


def test_build_gives_plain_containers_runtime_arguments_and_nested_factories() -> None:
    cluster = build(OmegaConf.create({"_target_": "vla.cluster.Local"}), "cluster", workers=3)
    assert cluster.workers == 3
    image = {"_target_": "vla.models.image_tokenizer.FilmConv", "_partial_": True, "channels": [8]}
    image |= {"kernels": [3], "strides": [2]}
    text = {"_target_": "vla.models.text.NGrams", "_partial_": True}
    node = OmegaConf.create({"_target_": "vla.models.bc.BC", "image": image, "text": text})
    tokenizer = build({"_target_": "vla.models.action_tokenizer.Uniform"}, "tokenizer", spec=toy.SPEC)
    model = build(node, "model", spec=toy.SPEC, tokenizer=tokenizer)
    assert model.tokenizer is tokenizer and model.text.width == 64


def test_build_passes_on_what_a_nested_constructor_complains_about() -> None:
    axis = {"_target_": "vla.tasks.randomize.blocks.Colours", "names": ["pink"]}
    with pytest.raises(ValueError, match="unknown colours"):
        build(config(**{"task.randomize": {"colour": axis}}).task, "task")


def test_what_is_checked_is_what_is_built() -> None:
    """A reference that is left would be looked up again, in another place than where it was checked."""
    hidden = {"_target_": "vla.tasks.expert.Waypoint", "perturb": "${oc.create:{_target_:builtins.print}}"}
    with pytest.raises(ValueError, match=r"expert holds the reference"):
        build(hidden, "expert", spec=None)


def test_conditions_of_an_evaluation_are_checked_with_the_task_that_they_change() -> None:
    wrong = {"heavy": {"goal": MASSES}}
    with pytest.raises(ValueError, match=r"task \(evaluate\.conditions\.heavy\)\.goal must be Goal or Mixed"):
        cfg = composed()
        cfg.evaluate.conditions = wrong
        check(cfg)


def digested(cfg: DictConfig) -> str:
    return digest("task", "expert", "collect.seed", _root_=cfg)


def test_the_digest_is_stable_and_changes_with_the_episodes_only() -> None:
    expected = digested(config())
    same: list[dict[str, Any]] = [
        {"seed": 3},
        {"collect.episodes": 9},
        {"output": "elsewhere"},
        {"task.goal.height": 0.1},
    ]
    assert {digested(config(**change)) for change in same} == {expected}
    assert digested(config(**{"task.time_limit": 10})) == digested(config(**{"task.time_limit": 10.0}))
    different: list[dict[str, Any]] = [
        {"collect.seed": 1},
        {"task.blocks": 2},
        {"expert.perturb": None},
        {"task.randomize.size": 1},
    ]
    assert len({digested(config(**change)) for change in different} | {expected}) == 5
    by_hand = hashlib.sha256(b'[{"a": 1, "b": [2, "x"]}]').hexdigest()[:12]
    assert digest("task", _root_=OmegaConf.create({"task": {"a": 1, "b": [2.0, "x"]}})) == by_hand


def test_the_digest_resolves_references_and_is_a_resolver() -> None:
    cfg = OmegaConf.create({"a": {"x": "${b}"}, "b": 1, "folder": "episodes/${digest:a,b}"})
    assert cfg.folder == "episodes/" + digest("a", "b", _root_=OmegaConf.create({"a": {"x": 1}, "b": 1}))


def test_a_suggestion_is_made_only_where_something_is_close() -> None:
    assert suggestion("precison", ["precision", "devices"]) == ", did you mean precision?"
    assert suggestion("xyz", ["precision", "devices"]) == ""


SAVED = {
    "chosen": {"experiment": "standard", "model": "rt1", "randomize": "wide"},
    "task": {"_target_": "vla.tasks.tabletop.Tabletop", "blocks": 4, "randomize": {"mass": None, "light": {"x": 1}}},
    "tokenizer": {"bins": 64},
    "model": {"history": 6},
}


def test_a_checkpoint_brings_its_task_tokenizer_and_model_and_task_overrides_apply_on_top() -> None:
    cfg = config(**{"task.blocks": 2, "tokenizer": {"bins": 256}, "model": None, "task.randomize": {"mass": {"a": 1}}})
    untouched = adopt(cfg, SAVED, ["collect.episodes=3", "evaluate.seed=5"])
    assert OmegaConf.to_container(untouched.task) == SAVED["task"]
    assert (untouched.tokenizer.bins, untouched.model.history, cfg.tokenizer.bins) == (64, 6, 256)
    assert adopt(cfg, SAVED, ["task.blocks=2"]).task.blocks == 2
    harder = adopt(cfg, SAVED, ["task/randomize=wide", "~task.goal"])
    assert OmegaConf.to_container(harder.task.randomize) == {"mass": {"a": 1}}
    assert harder.task.blocks == 4
    assert untouched.chosen == SAVED["chosen"]
    assert harder.chosen == {"experiment": "standard", "model": "rt1", "randomize": "default"}
    assert "light" not in adopt(cfg, SAVED, ["~task.randomize.light"]).task.randomize


KEPT = ["tokenizer=rt1", "tokenizer.bins=32", "model/image=efficientnet", "+model.x=1", "experiment=few", "variant=rt1"]


@pytest.mark.parametrize("override", KEPT)
def test_a_checkpoint_keeps_its_tokenizer_and_model(override: str) -> None:
    with pytest.raises(ValueError, match="cannot be combined with a checkpoint"):
        adopt(config(), SAVED, [override])


def test_a_report_says_what_the_training_of_its_checkpoint_was() -> None:
    cfg, saved = config(job="evaluate"), {**SAVED, "collect": {"episodes": 50}, "learner": {"lr": 1e-4}}
    assert adopt(cfg, saved, []).collect.episodes == 50
    cfg.job = "export"
    assert adopt(cfg, saved, []).collect.episodes != 50


@pytest.mark.parametrize(
    ("override", "says"),
    [
        ({"evaluate.seed": 0}, r"evaluate\.seed must be .*1000000"),
        ({"validate.seed": 1_000_004, "validate.episodes": 1}, "share episodes"),
        ({"resume": True}, "checkpoint=last"),
    ],
)
def test_what_would_judge_what_it_chose_or_trained_on_is_refused(override: dict[str, Any], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        check(config(**override))


def test_any_error_is_one_line() -> None:
    assert sentence(ValueError("a\n  b")) == "a b"
    assert sentence(OSError(28, "No space left on device", "f")) == "f: No space left on device"
