"""Fallbacks for options of a task that this machine cannot run."""

from __future__ import annotations

import copy
import logging
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any, cast

from omegaconf import DictConfig, OmegaConf

from vla.config.annotations import MissingLibrary, locate
from vla.config.experiment import Node, plain
from vla.config.packages import CONF
from vla.data.header import is_store

log = logging.getLogger(__name__)


def builds_world(cfg: DictConfig, groups: Collection[str]) -> bool:
    """Return whether a job that builds `groups` of `cfg` builds the environment of its task."""
    if "deploy" not in groups or cfg.deploy is None:
        return "task" in groups
    return getattr(locate("deploy._target_", cfg.deploy._target_), "needs_environment", False)


def with_substitutes(cfg: DictConfig, overrides: Sequence[str]) -> DictConfig:
    """Return `cfg` with the substitute of every part of the task that cannot be used here, and log a warning.

    Everything derived from the config, such as the folder of the demonstrations, uses the substitute. An option that
    the command line names is kept. Nothing is substituted in a resumed run, or in job=train if the store exists.
    """
    stored = cfg.job == "train" and is_store(Path(cfg.collect.folder))
    if cfg.resume is not None or cfg.task is None or stored:
        return cfg
    for name, node in cfg.task.items():
        asked = any(override.startswith(f"task/{name}=") for override in overrides)
        if asked or (found := substitute(f"task.{name!s}", node)) is None:
            continue
        reason, option = found
        log.warning("%s: task/%s=%s instead", reason, name, option)
        cfg = copy.deepcopy(cfg)
        cfg.task[name] = options(f"task/{name!s}")[option]
    return cfg


def options(group: str) -> dict[str, Node]:
    """Return the options of a group without those that this machine has a substitute for, with their nodes."""
    files = sorted((CONF / group).glob("*.yaml"))
    nodes = {file.stem: plain(cast(DictConfig, OmegaConf.load(file))) for file in files}
    return {name: node for name, node in nodes.items() if substitute(f"{group}={name}", node) is None}


def substitute(key: str, node: Any) -> tuple[str, str] | None:
    """Return why a node's class cannot be used here, and the option that its `substitute` names; None if it can be."""
    if not isinstance(node, DictConfig | dict) or "_target_" not in node:
        return None
    try:
        kind: Any = locate(f"{key}._target_", node["_target_"])
    except MissingLibrary:
        return None
    return getattr(kind, "substitute", lambda: None)()
