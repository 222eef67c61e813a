"""The levels of every axis of randomisation as options of the command line, out of one table."""

from __future__ import annotations

from functools import cache
from typing import Any

from hydra.core.config_store import ConfigStore

from vla.config.packages import CONF
from vla.io.documents import read_yaml


@cache
def axes() -> dict[str, dict[str, dict[str, Any]]]:
    """Return group → option → node out of `conf/axes.yaml`, such as task/randomize/light → hard → node of a lamp."""
    table = read_yaml(CONF / "axes.yaml", dict[str, dict[str, Any]])
    return {
        f"task/randomize/{axis}": {
            level: {"_target_": levels["_target_"], **values} for level, values in levels.items() if level != "_target_"
        }
        for axis, levels in table.items()
    }


@cache
def offer_axes() -> None:
    """Register these options with Hydra, beside those that are files."""
    for group, options in axes().items():
        for name, node in options.items():
            ConfigStore.instance().store(name=name, node=node, group=group, provider="vla")
