"""The folder of options, and composition of configs outside of the command line."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from copy import copy
from functools import cache
from typing import Any

import hydra
from hydra._internal.config_repository import ConfigRepository
from hydra.core.config_loader import ConfigLoader
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.version import VersionBase
from omegaconf import DictConfig, OmegaConf, open_dict

import vla.config.resolvers  # noqa: F401  registers them
from vla.config.annotations import is_node, locate, packages
from vla.config.build import check_value
from vla.config.experiment import Node, make_environment, to_plain
from vla.config.packages import CONF, MISSING, offer_options, trusting
from vla.io.documents import read_yaml
from vla.io.errors import UserError, suggestion
from vla.spec import Environment

log = logging.getLogger(__name__)


def copy_less() -> None:
    """Make Hydra copy its config repository shallowly: it copies it for every group that `--help` lists."""
    ConfigRepository.__deepcopy__ = lambda repository, memo: copy(repository)  # type: ignore[attr-defined]


def compose(*overrides: str) -> DictConfig:
    """Compose the config that `python -m vla.run` composes from the same overrides, see `with_variant`.

    Add `output=DIR`: only the command line creates a folder per run.
    """
    own = HydraConfig.get().overrides.hydra if HydraConfig.initialized() else []  # of the command
    folders = [override for override in own if override.lstrip("+").startswith("hydra.searchpath=")]
    with _hydra():
        config = hydra.compose("config", [*folders, *overrides], return_hydra_config=True)
    OmegaConf.resolve(config.chosen)  # needs Hydra's node
    with open_dict(config):
        del config["hydra"]
    return with_variant(config, overrides)


def with_variant(config: DictConfig, overrides: Sequence[str]) -> DictConfig:
    """Return a config without its `variants`, composed again with the overrides of the one that `variant` names.

    `config` was composed from `overrides`. Raises a UserError if there is no such variant, or an override opposes it.
    """
    with open_dict(config):
        name, variants = config.pop("variant"), config.pop("variants")
    if name is None:
        return config
    if name not in variants:
        hint = f"{suggestion(str(name), variants) or ':'} the variants are {', '.join(variants)}" if variants else ""
        raise UserError(f"there is no variant={name}{hint or ': choose an experiment that has it'}")
    changes = to_plain(variants)[name]
    check_value(f"variants.{name}", changes, list[str])
    overrides_by_key = {override.partition("=")[0].lstrip("+"): override for override in overrides}
    for change in changes:
        if contrary := overrides_by_key.get(change.partition("=")[0]):
            raise UserError(f"variant={name} sets {change}: omit {contrary}")
    return compose(*overrides, *changes, "variant=null")


def compose_task(task: str, **overrides: Any) -> Node:
    """Compose the node of a task, as `task=TASK task/GROUP=OPTION task.KEY=VALUE` does on the command line.

    Args:
        task: an option of the group `task`.
        overrides: GROUP=OPTION for a group below it, such as goal="lift" or **{"randomize/light": "wide"}, and
            KEY=VALUE for an argument, such as image_size=(64, 64) or **{"goal.radius": 0.03}. As on the command line, a
            mapping is merged, and an optional argument that the task's files do not list begins with a plus.

    An option or key that does not exist raises an exception of Hydra or OmegaConf.
    """
    with _hydra() as loader:
        groups = {name: option for name, option in overrides.items() if loader.get_group_options(f"task/{name}")}
        choices = [f"task/{name}={json.dumps(option, ensure_ascii=False)}" for name, option in groups.items()]
        config = hydra.compose("config", [f"task={task}", *choices])
        for name, value in overrides.items():
            if name not in groups:
                plain_value = json.loads(json.dumps(value))  # tuples as lists
                key, is_new = name.removeprefix("+"), name.startswith("+")
                OmegaConf.update(config.task, key, plain_value, merge=True, force_add=is_new)
        return to_plain(config.task)


def make_task(task: str, **overrides: Any) -> Environment:
    """Build a task, see `compose_task`. The package that a task of gymnasium names is trusted: the caller chose it."""
    node = compose_task(task, **overrides)
    with trusting([name for name in packages(node) if name != MISSING]):
        return make_environment(node)


@cache
def axes() -> dict[str, dict[str, dict[str, Any]]]:
    """Return group → option → node from `conf/axes.yaml`, such as task/randomize/light → hard → node of a lamp."""
    table = read_yaml(CONF / "axes.yaml", dict[str, dict[str, Any]])
    return {
        f"task/randomize/{axis}": {
            level: {"_target_": levels["_target_"], **values} for level, values in levels.items() if level != "_target_"
        }
        for axis, levels in table.items()
    }


@cache
def offer_axes() -> None:
    """Register the options of `axes` with Hydra, in addition to those that are files."""
    for group, options in axes().items():
        for name, node in options.items():
            ConfigStore.instance().store(name=name, node=node, group=group, provider="vla")


@contextmanager
def _hydra() -> Iterator[ConfigLoader]:
    """Initialise Hydra with `CONF` and restore its global state afterwards, for programs that use Hydra themselves.

    Within a command, its own Hydra is used, which also finds the options in the folder of `--config-dir`.
    """
    if HydraConfig.initialized() and (command := GlobalHydra.instance().hydra):
        main_folders = [each.path for each in command.config_loader.get_sources() if each.provider == "main"]
        if main_folders == [str(CONF)]:
            yield command.config_loader
            return
    state = GlobalHydra.instance().hydra, VersionBase.instance().version_base
    GlobalHydra.instance().clear()
    offer_options()
    offer_axes()
    try:
        with hydra.initialize_config_dir(str(CONF), version_base="1.3"):
            yield GlobalHydra.instance().config_loader()
    finally:
        GlobalHydra.instance().hydra, VersionBase.instance().version_base = state


def substitutes(task: Node, overrides: Sequence[str]) -> list[str]:
    """Return an override for every part of a task that this machine cannot use: the substitute that its class names.

    Logs a warning for each. Options that the command line names are not replaced: building them raises a UserError.
    """
    replacements = []
    for name, node in task.items():
        if not is_node(node) or any(override.startswith(f"task/{name}=") for override in overrides):
            continue
        kind: Any = locate(f"task.{name}._target_", node["_target_"])
        if substitute := getattr(kind, "substitute", lambda: None)():
            reason, option = substitute
            log.warning("%s: task/%s=%s instead", reason, name, option)
            replacements.append(f"task/{name}={option}")
    return replacements
