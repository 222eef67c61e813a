"""Every option of every group composes into a config that passes the check."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from omegaconf import DictConfig, OmegaConf

from vla.check import JOBS, check

CONF = Path(__file__).parents[1] / "conf"
AXES = CONF / "task/randomize"  # a group for each, with levels of the same names
LEVELS = sorted({path.stem for path in AXES.glob("*/*.yaml")})
OPTIONS = [
    (path.parent.relative_to(CONF).as_posix(), path.stem)
    for path in sorted(CONF.rglob("*.yaml"))
    if path.parent != CONF and path.parent.name != "hydra" and path.parents[1] != AXES
]


# Options that are only for some options of another group.
TOGETHER = {("tokenizer", "fast"): ["model=decoder"]}


def composed(*overrides: str, whole: bool = False) -> DictConfig:
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return compose("config", overrides=["output=outputs/runs/now", *overrides], return_hydra_config=whole)


@cache
def groups(*overrides: str) -> set[str]:
    """Those of which an option is chosen, if only by default."""
    return {*composed(*overrides, whole=True).hydra.runtime.choices}


@cache
def brought_by(group: str) -> list[str]:
    """What to choose so that there is such a group: nothing, or an option of the group around it."""
    around = group.rpartition("/")[0]
    parents = [[f"{around}={path.stem}"] for path in sorted((CONF / around).glob("*.yaml"))] if around else []
    return next(overrides for overrides in ([], *parents) if group in groups(*overrides))


def test_the_default_passes_for_every_job_but_deploy() -> None:
    cfg = composed()
    for cfg.job in sorted({*JOBS} - {"deploy"}):
        check(cfg)


def test_deploying_nothing_is_refused() -> None:
    with pytest.raises(ValueError, match="job=deploy needs deploy"):
        check(composed("job=deploy"))


def test_empty_batches_are_refused() -> None:
    with pytest.raises(ValueError, match=r"data\.batch_size must be int, at least 1, got 0"):
        check(composed("data.batch_size=0"))


@pytest.mark.parametrize(("group", "option"), OPTIONS, ids=[f"{group}={option}" for group, option in OPTIONS])
def test_option(group: str, option: str) -> None:
    cfg = composed(*TOGETHER.get((group, option), brought_by(group)), f"{group}={option}")
    top = group.partition("/")[0]
    cfg.job = next((job for job in ("evaluate", "export", "deploy") if top in JOBS[job] and cfg.get(top)), "evaluate")
    check(cfg)


@pytest.mark.parametrize("level", LEVELS)
def test_every_axis_of_randomisation_at_a_level(level: str) -> None:
    axes = [f"task/randomize/{path.parent.name}" for path in sorted(AXES.glob(f"*/{level}.yaml"))]
    check(composed(*(f"{'' if axis in groups() else '+'}{axis}={level}" for axis in axes)))


@pytest.mark.parametrize("level", ["none", "default", "wide"])
def test_intensity_and_colour_of_the_light_are_changed_one_at_a_time(level: str) -> None:
    cfg = composed("evaluate=suite", f"task/randomize={level}")
    check(cfg)
    conditions = OmegaConf.to_container(cfg.evaluate.conditions, resolve=True)
    assert isinstance(conditions, dict)
    hard, intensity, colour = (
        conditions[f"light{name}_hard"]["randomize"]["light"] for name in ("", "_intensity", "_colour")
    )
    unchanged = {"_target_": hard["_target_"], "brightness": [0.55, 0.55], "tint": 0.0, "tilt": 0.0}  # as in the scene
    own = {**unchanged, **(cfg.task.randomize.get("light") or {})}
    assert intensity == {**own, "brightness": hard["brightness"]}
    assert colour == {**own, "tint": hard["tint"]}


def test_a_model_of_one_token_per_component_takes_no_other_tokens() -> None:
    for model in ("bc", "rt1", "rt1_tiny"):
        with pytest.raises(ValueError, match=r"one token per component, which Fast does not have: .* model=decoder"):
            check(composed(f"model={model}", "tokenizer=fast"))
    together = composed("model=decoder", "tokenizer=fast", "model.chunk=5")
    assert together.tokenizer.chunk == 5


def test_data_is_shared_by_everything_that_does_not_change_the_episodes() -> None:
    folder = composed().collect.folder
    assert folder.startswith("outputs/episodes/")
    assert composed("seed=3", "collect.episodes=7", "expert=waypoint", "cluster=dask").collect.folder == folder
    assert composed("task/goal=lift").collect.folder != folder
    assert composed("collect.seed=1").collect.folder != folder
