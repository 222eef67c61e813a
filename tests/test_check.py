"""The check of a composed config, the objects built from one, and the digest that names its data."""

from __future__ import annotations

import hashlib
import re
from pathlib import Path
from typing import Any

import pytest
import toy
from composing import CONF, check, composed
from omegaconf import DictConfig, OmegaConf
from saved_policies import save_policy

from vla import jobs
from vla.config import packages
from vla.config.adopt import adopt
from vla.config.build import build
from vla.config.experiment import Experiment, _without_weights, to_plain
from vla.config.resolvers import digest
from vla.io.types import Inherited
from vla.models.model import TokenModel
from vla.models.policy_folder import require_unseen

GRAMMAR = {
    "_target_": "vla.tasks.tabletop.language.Grammar",
    "phrasings": ["lift {block}"],
    "words": {},
    "held_out_phrasings": ["{block} up"],
    "held_out_words": {"lift": ["raise"]},
    "held_out_colours": [],
}
SHAPES = {"_target_": "vla.tasks.tabletop.randomize.blocks.Shapes"}
MASSES = {"_target_": "vla.tasks.tabletop.randomize.blocks.Masses", "factor": [0.5, 2.0]}
STAY = {"_target_": "vla.tasks.tabletop.goals.skills.Stay", "language": GRAMMAR}
WAYPOINT = {"_target_": "vla.tasks.tabletop.expert.Waypoint", "_partial_": True}
PERTURBED = {"_target_": "vla.tasks.perturb.Perturbed", "expert": WAYPOINT}


class Own(TokenModel):
    """A model of a package, whose weights are in a file, if there is one."""

    def __init__(self, pretrained: str | None, backbone: object, **inherited: Inherited) -> None: ...


def config(**changes: Any) -> DictConfig:
    """The configuration of job=collect with a goal of one block, and dotted changes."""
    cfg = composed("job=collect", "task/goal=lift")
    OmegaConf.set_struct(cfg, False)
    for key, value in changes.items():
        OmegaConf.update(cfg, key, value, force_add=True, merge=False)
    return cfg


def problem(**changes: Any) -> str:
    with pytest.raises(ValueError) as caught:
        check(config(**changes))
    return str(caught.value)


def test_fields_that_a_dataclass_inherits_from_another_module_are_checked() -> None:
    with pytest.raises(ValueError, match=r"must be 'joint_state', .* or 'follow_joint_trajectory', got 'fly'"):
        check(composed("job=deploy", "deploy=ros2", "deploy.command=fly"))


def test_an_unknown_key_is_named_with_what_was_probably_meant() -> None:
    assert problem(**{"task.bloks": 2}) == "task.bloks is unknown, did you mean blocks?"
    assert problem(**{"task.goal.hight": 0.2}) == "task.goal.hight is unknown, did you mean height?"
    assert problem(**{"task.randomize.mass.xyz": 1}) == "task.randomize.mass.xyz is unknown: Masses takes factor"
    assert problem(**{"collect.episode": 2}) == "collect.episode is unknown, did you mean episodes?"
    assert problem(sed=1) == "sed is unknown, did you mean seed?"
    assert problem(**{"expert.spec": 1}).startswith("expert.spec is unknown")  # which comes from the program


def test_a_missing_key_is_named_unless_the_program_gives_it() -> None:
    cfg = config(expert={"_target_": "vla.tasks.tabletop.expert.Waypoint"})
    check(cfg)
    del cfg.task.goal
    with pytest.raises(ValueError, match=r"task\.goal is missing: Tabletop needs it"):
        check(cfg)


def test_a_list_of_what_there_is_names_nothing_twice() -> None:
    for job in ("collect", "train", "evaluate", "improve", "deploy", "benchmark"):
        cfg = composed(f"job={job}", *(["deploy=server"] if job == "deploy" else []))
        OmegaConf.update(cfg, "bogus", 3, force_add=True)
        with pytest.raises(ValueError, match="bogus is unknown: the config takes ") as caught:
            check(cfg)
        names = str(caught.value).partition(" takes ")[2].split(", ")
        assert {"job", "task", "cluster", "trainer"} <= {*names} and len(names) == len({*names})


@pytest.mark.parametrize(
    ("key", "value", "expected"),
    [
        ("task.blocks", "three", "task.blocks must be a valid integer, got 'three'"),
        ("task.blocks", True, "task.blocks must be a valid integer, got true"),
        ("task.shadows", 1, "task.shadows must be a valid boolean, got 1"),
        ("task.image_size", [96], "task.image_size must be"),
        ("task.image_size", [96, "x"], "task.image_size[1] must be a valid integer, got 'x'"),
        ("task.image_size", [96, 1], "task.image_size[1] must be greater than or equal to 8, got 1"),
        ("task.cameras", ["front", "front"], "task.cameras must be without repetitions, got ['front', 'front']"),
        ("task.time_limit", float("nan"), "task.time_limit must be a finite number, got nan"),
        ("task.randomize.mass.factor", [2.0, 1.0], "task.randomize.mass.factor must be in ascending order, got [2"),
        ("collect.folder", "", "collect.folder must have at least 1 character, got ''"),
        ("collect.images", "gif", "collect.images must be 'raw', 'lossless' or 'jpeg', got 'gif'"),
        ("task.goal", "lift", "task.goal must be Goal or Mixed or Chain, got 'lift'"),
        ("task.goal", MASSES, "task.goal must be Goal or Mixed or Chain, got {'_target_': 'vla.tasks.tabletop.random"),
        ("task.randomize.mass", GRAMMAR, "task.randomize.mass must be Randomizer, got {'_target_': 'vla"),
        ("expert.perturb.start", None, "expert.perturb.start must be a valid number, got null"),
        ("task.cameras", ["front", "side"], "task.cameras[1] must be 'front' or 'wrist', got 'side'"),
        ("task.randomize.colour.names", ["mauve"], "task.randomize.colour.names[0] must be 'red', 'green', 'blue', "),
        ("task.randomize.shape", {**SHAPES, "names": ["ball"]}, "task.randomize.shape.names[0] must be 'cube', 'cyl"),
        ("task.goal.language.held_out_colours", ["grean"], "task.goal.language.held_out_colours[0] must be 'red', "),
        ("task.meshes", "lite", "task.meshes must be 'light' or 'full', got 'lite', did you mean light?"),
        ("task.goal", {**STAY, "pads": 3}, "task.goal.pads must be less than or equal to 2, got 3"),
        ("evaluate.recordings", "x", "evaluate.recordings must be 'all' or 'failures' or a valid integer, got 'x'"),
    ],
)
def test_a_wrong_value_is_named_with_what_is_allowed(key: str, value: Any, expected: str) -> None:
    assert problem(**{key: value}).startswith(expected)


def test_a_digest_that_is_none_is_named_with_its_pattern() -> None:
    chosen = ("model/image=film_efficientnet_lite0", "model.image.pretrained.sha256=abc")
    with pytest.raises(ValueError, match=r"^model\.image\.pretrained\.sha256 must match pattern .*, got 'abc'$"):
        check(composed("job=train", *chosen))


@pytest.mark.parametrize("policy", ["checkpoint", "pretrained", "resume"])
def test_an_agent_and_a_policy_are_not_both_taken(policy: str) -> None:
    with pytest.raises(ValueError, match=rf"^agent=OPTION and {policy}=RUN are two policies: omit one of them"):
        check(composed("agent=expert", f"{policy}=run"))


def test_a_job_needs_its_groups_and_looks_at_no_others() -> None:
    assert "job=collect needs expert" in problem(expert=None)
    check(config(deploy={"_target_": "vla.nowhere.Nothing"}))
    cfg = composed("job=deploy", "deploy=loop")
    cfg.deploy._target_ = "vla.nowhere.Nothing"
    with pytest.raises(ValueError, match=r"deploy\._target_ is vla\.nowhere\.Nothing, which cannot be imported"):
        check(cfg)


@pytest.mark.parametrize(
    "target",
    [
        "os.system",
        "subprocess.Popen",
        "vla.rollouts.evaluate.os.system",
        "vla.rollouts.evaluate.Path",
        "torch.hub.load",
        "vla.config.check:os",
    ],
)
def test_a_target_that_is_no_class_of_the_package_is_refused(target: str) -> None:
    node = {**PERTURBED, "perturb": {"_target_": target}}
    with pytest.raises(ValueError, match=r"expert\.perturb\._target_ (must|is)"):
        build(node, "expert", spec=None)
    with pytest.raises(ValueError, match=r"expert\.perturb\._target_ (must|is)"):
        check(config(expert=node))


def test_a_class_stands_only_where_its_kind_is_asked_for() -> None:
    node = {**PERTURBED, "perturb": MASSES}
    with pytest.raises(ValueError, match=r"expert\.perturb must be Perturbation, got \{'_target_': .*Masses"):
        build(node, "expert", spec=None)
    kind = "a class of kind Agent or ImportedDemonstrations"
    with pytest.raises(ValueError, match=rf"expert\._target_ must name {kind}, got .*Masses"):
        build(MASSES, "expert")
    assert problem(task=MASSES).startswith("task._target_ must name a class of kind Environment")


def test_a_class_takes_the_arguments_of_its_base_classes_too() -> None:
    node = to_plain(composed("model=act").model)
    for changes, message in (
        ({"width_": 3}, "model.width_ is unknown, did you mean width?"),
        ({"chunk": 0}, "model.chunk must be greater than or equal to 1, got 0"),
        ({"inherited": 3}, "model.inherited is unknown"),
    ):
        with pytest.raises(ValueError, match=re.escape(message)):
            build({**node, **changes}, "model", spec=toy.SPEC, tokenizer=None)
    del node["text_width"]
    with pytest.raises(ValueError, match=r"model\.text_width is missing: ACT needs it"):
        build(node, "model", spec=toy.SPEC, tokenizer=None)


def test_build_passes_on_what_a_nested_constructor_complains_about() -> None:
    with pytest.raises(ValueError, match="so it replaces no word"):
        build(to_plain(config(**{"task.goal.language.phrasings": ["{block}"]}).task), "task")


def test_what_is_checked_is_what_is_built() -> None:
    """A reference that is left would be looked up again, in another place than where it was checked."""
    hidden = {**PERTURBED, "perturb": "${oc.create:{_target_:builtins.print}}"}
    with pytest.raises(ValueError, match=r"expert holds the reference"):
        build(hidden, "expert", spec=None)


def test_conditions_of_an_evaluation_are_checked_with_the_task_that_they_change() -> None:
    wrong = {"heavy": {"goal": MASSES}}
    with pytest.raises(ValueError, match=r"task \(evaluate\.conditions\.heavy\)\.goal must be Goal or Mixed or Chain"):
        cfg = composed()
        cfg.evaluate.conditions = wrong
        check(cfg)
    with pytest.raises(ValueError, match=r"task \(validate\.changes\)\.bloks is unknown, did you mean blocks"):
        check(composed("+validate.changes.bloks=3"))


@pytest.mark.parametrize(
    ("override", "says"), [("policy.lanes=0", r"policy\.lanes must be"), ("~policy", "policy must be")]
)
def test_the_policy_that_validation_plays_is_checked_before_training(override: str, says: str) -> None:
    check(composed("job=train", override, "validate.episodes=0"))
    with pytest.raises(ValueError, match=says):
        check(composed("job=train", override))


def test_published_statistics_need_a_policy_that_has_some() -> None:
    asked = ("job=train", "model=smolvla", "model.statistics=pretrained")
    with pytest.raises(ValueError, match=r"^model\.statistics=pretrained needs a published policy: add pretrained="):
        check(composed(*asked))
    for has_some in ("model.trunk=published", "pretrained=run"):
        check(composed(*asked, has_some))


@pytest.mark.parametrize("wrong", [["seen"], ["without_images", "+evaluate.without=[images]"], ["light_hard"]])
def test_conditions_have_names_of_their_own(wrong: list[str]) -> None:
    name, *also = wrong
    axis = "+evaluate.one_by_one={hard: {randomize: {light: null, colour: null}}}"
    cfg = composed(axis, *also)
    cfg.evaluate.conditions = {name: {"blocks": [3, 3]}}
    cfg.evaluate.one_by_one.hard.randomize.light = cfg.task.randomize.light
    with pytest.raises(ValueError, match=f"evaluate has 2 conditions with the name {name}: rename one"):
        check(cfg)


def test_data_is_shared_by_everything_that_does_not_change_the_episodes() -> None:
    folder = config().collect.folder
    assert folder.startswith("outputs/episodes/")
    same = {"seed": 3, "collect.episodes": 9, "output": "elsewhere", "task.goal.height": 0.1, "cluster.workers": 3}
    different = {"collect.seed": 1, "task.blocks": 2, "expert.perturb.rate": 0.2, "task.randomize.size": 1}
    assert {config(**{key: value}).collect.folder for key, value in same.items()} == {folder}
    assert len({config(**{"task.time_limit": limit}).collect.folder for limit in (10, 10.0)}) == 1
    goals = {composed(goal, "expert=waypoint").collect.folder for goal in ("task/goal=push", "task/goal=lift")}
    others = {config(**{key: value}).collect.folder for key, value in different.items()}
    assert folder in goals and len(goals | others) == 6
    by_hand = hashlib.sha256(b'[{"a": 1, "b": [2, "x"]}]').hexdigest()[:12]
    assert digest("task", _root_=OmegaConf.create({"task": {"a": 1, "b": [2.0, "x"]}})) == by_hand


SAVED = {
    "chosen": {"experiment": "standard", "model": "rt1"},
    "task": {
        "_target_": "vla.tasks.tabletop.environment.Tabletop",
        "blocks": 4,
        "randomize": {"mass": None, "light": {"x": 1}},
    },
    "tokenizer": {"bins": 64},
    "model": {"history": 6},
}


@pytest.fixture
def checkpoint(tmp_path: Path) -> Path:
    return save_policy(tmp_path / "theirs", {**SAVED, "collect": {"episodes": 50}, "learner": {"lr": 1e-4}})


def test_a_checkpoint_brings_its_task_tokenizer_and_model_and_task_overrides_apply_on_top(checkpoint: Path) -> None:
    cfg = config(
        **{
            "job": "export",
            "checkpoint": str(checkpoint),
            "chosen": {"experiment": None, "model": "bc", "randomize": "default"},  # which Hydra fills in
            "task.blocks": 2,
            "tokenizer": {"bins": 256},
            "model": None,
            "task.randomize": {"mass": {"a": 1}},
        }
    )
    untouched = adopt(cfg, ["collect.episodes=3", "evaluate.seed=5"])
    assert OmegaConf.to_container(untouched.task) == SAVED["task"]
    assert (untouched.tokenizer.bins, untouched.model.history, cfg.tokenizer.bins) == (64, 6, 256)
    assert adopt(cfg, ["task.blocks=2"]).task.blocks == 2
    harder = adopt(cfg, ["task/randomize=wide", "~task.goal"])
    assert OmegaConf.to_container(harder.task.randomize) == {"mass": {"a": 1}}
    assert harder.task.blocks == 4 and harder.collect.episodes != 50  # which only a report on the policy shows
    assert untouched.chosen == {**SAVED["chosen"], "randomize": "default"}
    assert "light" not in adopt(cfg, ["~task.randomize.light"]).task.randomize
    with pytest.raises(ValueError, match=r"names a path or an address in task\.robot\.file: .*; task/robot=OPTION"):
        adopt(config(job="export", checkpoint=str(_with_a_file(checkpoint))), ["task.robot={yaw: 0.1}"])
    merged = adopt(cfg, ["task.randomize={size: {b: 2}}"])
    assert OmegaConf.to_container(merged.task.randomize) == {**SAVED["task"]["randomize"], "size": {"b": 2}}
    with pytest.raises(ValueError, match=r"removes nothing, the saved config has no task\.nothing: omit it"):
        adopt(cfg, ["~task.nothing.light"])
    elsewhere = adopt(cfg, ["+task/randomize@evaluate.conditions.wide.randomize=wide"])
    assert OmegaConf.to_container(elsewhere.task) == SAVED["task"]


def _with_a_file(checkpoint: Path) -> Path:
    """A policy whose task names a file."""
    task = {**SAVED["task"], "robot": {"_target_": "vla.tasks.tabletop.robot_file.RobotFile", "file": "/theirs"}}
    return save_policy(checkpoint.parent / "with_a_file", {**SAVED, "task": task})


def test_what_is_removed_from_the_command_line_is_told_before_any_work() -> None:
    cfg = composed("job=train")
    OmegaConf.set_struct(cfg, False)
    del cfg.logger, cfg.recorder
    check(cfg)
    assert Experiment.from_config(cfg)["logger"] is None and Experiment.from_config(cfg).make_recorder(Path()) is None
    del cfg.trainer.max_steps
    with pytest.raises(ValueError, match=r"trainer\.max_steps is missing: trainings need it"):
        check(cfg)


@pytest.mark.parametrize("renderer", ["mujoco", "detailed", "fast", "smooth", "whole"])
def test_an_experiment_goes_with_every_renderer(renderer: str) -> None:
    check(composed("job=collect", "experiment=libero", f"task/renderer={renderer}"))


KEPT = [
    "tokenizer=rt1",
    "tokenizer.bins=32",
    "model/image=efficientnet",
    "+model.x=1",
    "experiment=few",
    "model.shift=[0,0]",
]


@pytest.mark.parametrize("override", KEPT)
def test_a_checkpoint_keeps_its_tokenizer_and_model(override: str, checkpoint: Path) -> None:
    with pytest.raises(ValueError, match="cannot be combined with saved weights"):
        adopt(config(job="evaluate", checkpoint=str(checkpoint)), [override])


def test_what_can_no_longer_change_a_policy_is_said_and_its_report_does_not_show_it(
    checkpoint: Path, caplog: pytest.LogCaptureFixture
) -> None:
    given = [f"checkpoint={checkpoint}", "learner.lr=1.0", "seed=5", "evaluate.episodes=3"]
    adopted = adopt(composed(*given), given)
    assert (adopted.learner.lr, adopted.evaluate.episodes) == (1e-4, 3)
    assert "ignored: learner.lr=1.0, seed=5, because checkpoint= evaluates a policy as it is" in caplog.text


@pytest.mark.parametrize(
    ("overrides", "end"),
    [
        (("experiment=libero", "tokenizer=rt1"), "; experiment=libero sets it: ~tokenizer.smoothing removes it"),
        (
            ("experiment=libero_varied", "model/image=efficientnet_lite0"),
            "; experiment=libero_varied sets it: model.image.channels=VALUE replaces it",
        ),
        (("experiment=few", "model/text=minilm"), "; experiment=few sets it: ~model.text.dropout removes it"),
        (("experiment=libero", "tokenizer.bins=1"), "tokenizer.bins must be greater than or equal to 2, got 1"),
    ],
)
def test_what_an_experiment_sets_for_other_options_is_told_from_what_was_typed(
    overrides: tuple[str, ...], end: str
) -> None:
    with pytest.raises(ValueError, match=f"{re.escape(end)}$"):
        check(composed(*overrides))


def test_an_experiment_that_only_hydra_reads_hides_no_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "experiment").mkdir()
    (tmp_path / "experiment/mine.yaml").write_text("one: &all [1]\nother: *all\n")
    monkeypatch.setattr("vla.config.check.config_folders", lambda: (CONF, tmp_path))
    said = problem(**{"chosen.experiment": "mine", "task.bloks": 2})
    assert said == "task.bloks is unknown, did you mean blocks?"


@pytest.mark.parametrize("partial", [True, "false", 1, None, [False]])
def test_a_factory_is_refused_where_an_object_belongs(partial: Any) -> None:
    """As a group it passed the check, without all of its arguments, and ended in a traceback when it was built."""
    assert problem(**{"task._partial_": partial}).startswith("task._partial_ must be omitted here")
    assert problem(**{"expert": {**WAYPOINT, "_partial_": partial}}).startswith("expert._partial_ must be omitted")
    axis = problem(**{"task.randomize.mass": {**MASSES, "_partial_": partial}})
    wrong = " must be Randomizer, got" if partial is True else "._partial_ must be "
    assert axis.startswith(f"task.randomize.mass{wrong}")


def test_an_object_is_refused_where_a_factory_belongs() -> None:
    for wrong in (False, "true"):
        assert "expert.expert" in problem(**{"expert": {**PERTURBED, "expert": {**WAYPOINT, "_partial_": wrong}}})


def test_a_factory_has_all_arguments_but_its_callers() -> None:
    cfg = composed("job=train")
    OmegaConf.set_struct(cfg, False)
    del cfg.model.text.vocabulary
    with pytest.raises(ValueError, match=r"model\.text\.vocabulary is missing: NGrams needs it"):
        check(cfg)


def test_evaluation_seeds_used_for_training_or_selection_are_refused() -> None:
    assert problem(**{"evaluate.seed": 0}) == "evaluate.seed must be greater than or equal to 1000000, got 0"
    shared = ("validate.seed=1000004", "validate.episodes=1")
    with pytest.raises(ValueError, match="share episodes"):
        check(composed(*shared))
    check(composed("agent=expert", *shared))  # no weights are selected


@pytest.mark.parametrize(
    ("overrides", "key", "shared"),
    [
        (("checkpoint=RUN", "evaluate.seed=2000010"), "evaluate.seed", "2000010 to 2000019"),
        (("checkpoint=RUN", "evaluate.seed=1999000", "evaluate.episodes=1001"), "evaluate.seed", "2000000 to 2000000"),
        (("pretrained=RUN", "evaluate.seed=2000000"), "evaluate.seed", "2000000 to 2000019"),
        (("job=improve", "pretrained=RUN", "evaluate.seed=2000000"), "evaluate.seed", "2000000 to 2000019"),
        (
            ("job=deploy", "deploy=loop", "checkpoint=RUN", "deploy.simulator.seed=2000019"),
            "deploy.simulator.seed",
            "2000019 to 2000019",
        ),
    ],
)
def test_a_checkpoint_is_not_evaluated_on_what_selected_it_whatever_is_validated_now(
    overrides: tuple[str, ...], key: str, shared: str, tmp_path: Path
) -> None:
    """The episodes of its own training count, not `validate` of the command."""
    selected = {"validate": {"episodes": 20, "seed": 2_000_000, "changes": {}}}
    path = save_policy(tmp_path / "theirs", {**SAVED, **selected})
    for validated in ("validate.seed=3000000", "validate.episodes=0"):
        cfg = composed(*(each.replace("RUN", str(path)) for each in overrides), validated, f"output={tmp_path}/out")
        check(cfg)
        with pytest.raises(ValueError, match=rf"^{key}=\d+: episodes {shared} selected the weights in .*theirs"):
            jobs.run(Experiment.from_config(cfg))


def test_a_checkpoint_is_measured_in_its_own_world_whatever_would_be_validated_in_the_default_one() -> None:
    asked = ("job=benchmark", "task=metaworld", "validate=tabletop")
    with pytest.raises(ValueError, match=r"^task \(validate\.changes\)\.randomize is unknown"):
        check(composed(*asked))
    check(composed(*asked, "checkpoint=RUN"))


def test_a_checkpoint_may_be_evaluated_on_all_that_did_not_select_it(tmp_path: Path) -> None:
    for validate in ({"episodes": 20, "seed": 2_000_000}, {"episodes": 0, "seed": 1_000_000}, {}):
        path = save_policy(tmp_path / "theirs", {**SAVED, "validate": validate})
        require_unseen(path, "evaluate.seed", range(1_000_000, 2_000_000))
        require_unseen(path, "evaluate.seed", range(2_000_020, 2_000_040))
    check(config(job="evaluate", checkpoint=str(path), **{"validate.seed": 1_000_000}))  # nothing is validated


def test_the_classes_of_a_saved_policy_are_built_without_pretrained_weights(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(packages.TRUSTED, __name__)
    backbone = {"_target_": "vla.models.vision.timm_encoders.FilmBackbone", "pretrained": "auto"}
    node = {"_target_": f"{__name__}.Own", "pretrained": "weights.pt", "backbone": backbone}
    assert _without_weights(node) == {**node, "pretrained": None, "backbone": {**backbone, "pretrained": False}}
    vla = {"_target_": "vla.models.vlm.policy.VisionLanguageAction", "trunk": "hub:owner/name"}
    assert _without_weights(vla) == {**vla, "trunk": None}
