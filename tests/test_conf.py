"""Every option of every group composes into a config that passes the check."""

from __future__ import annotations

import re
from collections.abc import Iterator
from functools import cache
from inspect import Parameter, signature
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from composing import CONF, check, composed
from defaults import defaults_of
from hydra import compose, initialize_config_dir
from hydra.utils import get_class
from omegaconf import OmegaConf

from vla.config.compose import axes
from vla.config.compose import compose as compose_whole
from vla.config.differences import differences
from vla.config.experiment import Experiment, to_plain
from vla.robots.cartesian import LIMIT_MARGIN
from vla.robots.panda import FINGER_TRAVEL, JOINT_HIGH, JOINT_LOW, JOINT_SPEED, MAX_OPENING
from vla.spec import FIRST_SEED
from vla.tasks.tabletop.environment import Tabletop
from vla.tasks.tabletop.goals.skills import REST_STEPS
from vla.tasks.tabletop.simulation import WORKSPACE

LEVELS = sorted({level for levels in axes().values() for level in levels} - {"swapped"})
OPTIONS = [
    (path.parent.relative_to(CONF).as_posix(), path.stem)
    for path in sorted(CONF.rglob("*.yaml"))
    if path.parent != CONF and path.parent.name != "hydra"
]
MODELS = sorted(path.stem for path in (CONF / "model").glob("*.yaml"))


pytestmark = pytest.mark.usefixtures("recording")

# Options that are only for some options of another group.
TOGETHER = {
    ("evaluate", "lerobot"): ["task=metaworld"],
    **{(group, option): ["task=libero"] for group, option in (("validate", "libero"), ("evaluate", "libero_pro"))},
    ("tokenizer", "fast"): ["model=decoder"],
    **{
        ("policy/chunking", option): ["model=flow", "model.prefix=4"]
        for option in ("guided", "guided_lerobot", "trained")
    },
    ("job", "deploy"): ["deploy=ros2"],
    ("task/robot", "file"): [
        *("task.robot.file=arm.xml", "task.robot.joints=[a]", "task.robot.home=[0.0]", "task.robot.tool=tcp"),
        *("task.robot.open={a: 1.0}", "task.robot.closed={a: 0.0}", "task.robot.fingertips=[[a],[b]]"),
    ],
    ("task", "gymnasium"): [
        *("task.package=gymnasium_robotics", "task.id=Any-v0", "task.images={top: render}"),
        *("task.state={observation: null}", "task.instruction=go"),
    ],
}


@cache
def groups(*overrides: str) -> set[str]:
    """Those of which an option is chosen, if only by default."""
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return {*compose("config", overrides=[*overrides], return_hydra_config=True).hydra.runtime.choices}


@cache
def brought_by(group: str) -> list[str]:
    """What to choose so that there is such a group: nothing, or an option of the group around it."""
    around = group.rpartition("/")[0]
    parents = [[f"{around}={path.stem}"] for path in sorted((CONF / around).glob("*.yaml"))] if around else []
    return next(overrides for overrides in ([], *parents) if group in groups(*overrides))


@pytest.mark.parametrize(("group", "option"), OPTIONS, ids=[f"{group}={option}" for group, option in OPTIONS])
def test_option(group: str, option: str) -> None:
    top = group.partition("/")[0]
    job = [f"job={top}"] if top in ("export", "deploy") else []
    plus = "+" if group == "policy/chunking" else ""
    together = TOGETHER[group, option] if (group, option) in TOGETHER else brought_by(group)
    check(composed(*together, f"{plus}{group}={option}", *job))


def test_every_encoder_can_be_chosen_with_every_model() -> None:
    check(composed("model=rt1_small", "model/image=film_efficientnet_lite0"))
    for path in (CONF / "model").glob("*.yaml"):  # values of an encoder in there would be set in any other one too
        file = yaml.safe_load(path.read_text())
        chosen = {group for entry in file.get("defaults", []) if isinstance(entry, dict) for group in entry}
        assert not chosen & set(file), path.name


def variants(experiment: str) -> dict[str, list[str]]:
    """What a grid compares: name → what the command line would say."""
    file = yaml.safe_load((CONF / f"experiment/{experiment}.yaml").read_text())
    named = [name.strip() for name in file["hydra"]["sweeper"]["params"]["variant"].split(",")]
    assert named == [*file["variants"]] and named[0] == "none"
    return file["variants"]


GRIDS = [(name, variant) for name in ("ablation", "images_alone", "recipe") for variant in variants(name)]


@pytest.mark.parametrize(("experiment", "variant"), GRIDS, ids=map("=".join, GRIDS))
def test_every_variant_of_a_grid_is_a_model(experiment: str, variant: str, tabletop: Tabletop) -> None:
    config = composed(f"experiment={experiment}", *variants(experiment)[variant])
    learner = Experiment.from_config(config).learner(tabletop.spec)
    assert sum(weight.numel() for weight in learner.model.parameters()) > 10_000
    first = to_plain(composed(f"experiment={experiment}"))
    changed = [key for key, *_ in differences(first, to_plain(config)) if not key.startswith("chosen")]
    assert (variant == "none") == (not changed)


@pytest.mark.parametrize(("experiment", "variant"), [GRIDS[-1], ("ablation", "no_transformer")])
def test_a_variant_is_what_one_would_type(experiment: str, variant: str) -> None:
    typed = composed(f"experiment={experiment}", *variants(experiment)[variant])
    assert to_plain(composed(f"experiment={experiment}", f"variant={variant}")) == to_plain(typed)


@pytest.mark.parametrize(
    ("overrides", "sentence"),
    [
        (
            ("experiment=recipe", "variant=no_shft"),
            "there is no variant=no_shft, did you mean no_shift? the variants are none",
        ),
        (("variant=no_shift",), "there is no variant=no_shift: choose an experiment that has it"),
        (("experiment=recipe", "variant=chunked", "model.chunk=2"), "sets model.chunk=4: omit model.chunk=2"),
        (("+variants.mine=3", "variant=mine"), "variants.mine must be a valid array"),
    ],
)
def test_a_variant_that_cannot_be_is_refused(overrides: tuple[str, ...], sentence: str) -> None:
    with pytest.raises(ValueError, match=re.escape(sentence)):
        compose_whole("output=there", *overrides)


def test_success_is_what_the_documentation_says() -> None:
    page = " ".join((CONF.parent / "docs/worlds.md").read_text(encoding="utf-8").split())
    place, lift, push = (composed(f"task/goal={goal}").task.goal for goal in ("pick_place", "lift", "push"))
    assert {goal.hold_steps for goal in (place, lift, push, composed("task/goal=stack").task.goal)} == {3}
    for said in (
        "must hold in three consecutive steps",
        f"its centre less than {100 * place.radius:g} cm from that of the pad",
        f"more than {100 * lift.height:g} cm above where it started",
        f"rests less than {100 * push.radius:g} cm from the pad, and was never lifted by {100 * push.highest:g} cm",
        "the arm rests for fifteen steps",
    ):
        assert said in page, said
    assert REST_STEPS == 15


@pytest.mark.parametrize("level", LEVELS)
def test_every_axis_of_randomisation_at_a_level(level: str) -> None:
    check(composed(*(f"{axis}={level}" for axis, levels in axes().items() if level in levels)))


def test_an_axis_is_applied_at_its_place_however_it_was_switched_on() -> None:
    one = composed("task/randomize/shape=wide", "task.randomize.light=null").task.randomize
    assert list(one) == list(composed("task/randomize=wide").task.randomize) == list(composed().task.randomize)
    default = {axis for axis, level in composed().task.randomize.items() if level}
    assert {axis for axis, level in one.items() if level} == default - {"light"} | {"shape"}


@pytest.mark.parametrize("level", ["none", "wide"])
def test_intensity_and_colour_of_the_light_are_changed_one_at_a_time(level: str) -> None:
    cfg = composed("evaluate=suite", f"task/randomize={level}")
    check(cfg)
    suite = Experiment.from_config(cfg).evaluate.changes
    hard, intensity, colour = (
        suite[f"light{name}_hard"]["randomize"]["light"] for name in ("", "_intensity", "_colour")
    )
    unchanged = {"_target_": hard["_target_"], "brightness": None, "tint": 0.0, "tilt": 0.0}  # as in the scene
    own = {**unchanged, **(cfg.task.randomize.get("light") or {})}
    assert intensity == {**own, "brightness": hard["brightness"]}
    assert colour == {**own, "tint": hard["tint"]}


def test_the_suite_has_every_axis_by_itself_at_each_level() -> None:
    suite = Experiment.from_config(composed("evaluate=suite")).evaluate.changes
    levels = {level: composed(f"task/randomize={level}").task.randomize for level in ("wide", "hard")}
    for level in levels:  # no level of all axes has it
        assert levels[level]["disturbance"] is None
        levels[level]["disturbance"] = composed(f"task/randomize/disturbance={level}").task.randomize["disturbance"]
    # The levels of phrasing are the same, and naming has none.
    axes = [axis for axis in levels["wide"] if axis not in ("phrasing", "naming")]
    assert {"swapped", "impossible", "empty", "phrasing"} < set(suite)
    assert composed("evaluate=suite").evaluate.without == ["images", "instruction"]
    for axis, level in product(axes, levels):
        assert suite[f"{axis}_{level}"] == {"randomize": {axis: levels[level][axis]}}
    assert len(suite) == 4 + 2 * len(axes) + 4  # intensity and colour of the light


@pytest.mark.parametrize(
    ("experiment", "model"), [*(("standard", model) for model in MODELS), ("few", "act"), ("multitask", "bc")]
)
def test_an_experiment_shifts_the_images_of_any_model(experiment: str, model: str) -> None:
    assert composed(f"experiment={experiment}", f"model={model}").model.shift == [4, 4]


def test_a_model_stands_in_one_file() -> None:
    for model in MODELS:
        file = yaml.safe_load((CONF / f"model/{model}.yaml").read_text())
        assert [each for each in file.get("defaults", ["_self_"]) if isinstance(each, str)] == ["_self_"], model


def test_a_model_changes_nothing_but_itself() -> None:
    default = to_plain(composed())
    for model in MODELS:
        other = to_plain(composed(f"model={model}"))
        assert {name for name in default if other[name] != default[name]} <= {"model", "chosen"}, model


def test_options_are_named_as_the_command_line_names_them() -> None:
    chosen = composed("experiment=few", "model=act").chosen
    assert chosen == {"experiment": "few", "model": "act", "agent": None}


def test_a_file_comes_after_the_options_that_it_extends_and_before_those_that_it_chooses() -> None:
    for path in CONF.rglob("*.yaml"):
        order = OmegaConf.select(OmegaConf.load(path), "defaults", default=["_self_"])
        extends = any(isinstance(entry, str) and entry != "_self_" for entry in order)
        assert order[-1 if extends else 0] == "_self_", path


def test_a_model_of_one_token_per_component_takes_no_other_tokens() -> None:
    for model in ("bc", "rt1", "rt1_tiny"):
        with pytest.raises(ValueError, match=r"Fast does not make one per component: .* model=decoder"):
            check(composed(f"model={model}", "tokenizer=fast"))
    together = composed("model=decoder", "tokenizer=fast", "model.chunk=5")
    assert together.tokenizer.chunk == 5


def test_an_axis_that_is_off_is_as_one_that_is_not_there() -> None:
    off, without = composed("task.randomize.light=null"), composed("~task.randomize.light")
    assert off.task != without.task and off.collect.folder == without.collect.folder != composed().collect.folder


def nodes(value: Any) -> Iterator[dict[str, Any]]:
    """Every mapping with a `_target_` in a plain value."""
    if isinstance(value, dict):
        yield from [value] if "_target_" in value else []
    for part in value.values() if isinstance(value, dict) else value if isinstance(value, list) else ():
        yield from nodes(part)


def test_numbers_that_the_simulator_and_a_file_need_are_equal() -> None:
    robot = defaults_of("deploy/robot/panda")
    np.testing.assert_array_equal([robot["low"], robot["high"], robot["speed"]], [JOINT_LOW, JOINT_HIGH, JOINT_SPEED])
    assert (robot["margin"], robot["finger_open"]) == (LIMIT_MARGIN, [FINGER_TRAVEL] * 2)
    assert (robot["widest"], robot["finger_closed"]) == (MAX_OPENING, [0, 0])
    node = composed("job=deploy", "deploy=ros2").deploy
    np.testing.assert_array_equal(node.safety.workspace, WORKSPACE)
    assert composed().evaluate.seed == FIRST_SEED == composed("job=deploy", "deploy=simulator").deploy.seed


@pytest.mark.parametrize("path", sorted(CONF.rglob("*.yaml")), ids=lambda path: path.relative_to(CONF).as_posix())
def test_what_stands_in_a_file_has_no_default_in_the_code(path: Path) -> None:
    for node in nodes(axes() if path.name == "axes.yaml" else OmegaConf.to_container(OmegaConf.load(path))):
        if node["_target_"].startswith("vla."):
            parameters = signature(get_class(node["_target_"])).parameters.values()
            defaults = {each.name for each in parameters if each.default is not Parameter.empty}
            assert defaults.isdisjoint(node), node["_target_"]
