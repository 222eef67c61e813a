"""Every option of every group composes into a config that passes the check."""

from __future__ import annotations

from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from hydra.errors import ConfigCompositionException
from omegaconf import DictConfig

from vla.check import JOBS, check

CONF = Path(__file__).parents[1] / "conf"
OPTIONS = [
    (path.parent.relative_to(CONF).as_posix(), path.stem)
    for path in sorted(CONF.rglob("*.yaml"))
    if path.parent != CONF and path.parent.name != "hydra"
]


# Options that are only for some options of another group.
TOGETHER = {("tokenizer", "fast"): ["model=decoder"]}


def composed(*overrides: str) -> DictConfig:
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return compose("config", overrides=["output=outputs/runs/now", *overrides])


def composed_with(group: str, option: str) -> DictConfig:
    """A config in which `option` stands, together with a parent that has such a nested group."""
    parent = group.rpartition("/")[0]
    parents = [f"{parent}={path.stem}" for path in sorted((CONF / parent).glob("*.yaml"))] if parent else []
    chosen = [TOGETHER.get((group, option), []), *[[choice] for choice in parents]]
    attempts = [[*overrides, f"{group}={option}"] for overrides in chosen]
    for attempt in (*attempts, [f"+{group}={option}"]):  # the last where no option is chosen by default
        try:
            return composed(*attempt)
        except ConfigCompositionException as error:
            problem = error
    raise problem


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
    cfg = composed_with(group, option)
    top = group.partition("/")[0]
    cfg.job = next((job for job in ("evaluate", "export", "deploy") if top in JOBS[job] and cfg.get(top)), "evaluate")
    check(cfg)


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
