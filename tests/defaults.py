"""The arguments that stand in `conf/`, for tests that build a class by hand."""

from __future__ import annotations

from functools import cache
from typing import Any, cast

from composing import CONF
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf


@cache
def _arguments(option: str) -> dict[str, Any]:
    with initialize_config_dir(str(CONF), version_base="1.3"):
        # Options refer to the model and to what config.yaml says.
        nodes = OmegaConf.load(CONF / "config.yaml"), compose("model/bc"), compose(option)
    whole: dict[Any, Any] = {}
    for node in nodes:
        whole |= cast("dict[Any, Any]", OmegaConf.to_container(node))
    group = OmegaConf.select(OmegaConf.create(whole), option.rpartition("/")[0].replace("/", "."))
    found = cast("dict[Any, Any]", OmegaConf.to_container(group, resolve=True))
    return {str(name): value for name, value in found.items() if not str(name).startswith("_")}


def defaults_of(option: str, **changes: Any) -> dict[str, Any]:
    """The plain arguments in an option such as "model/bc", without the objects among them, and with some changes."""
    plain = {name: value for name, value in _arguments(option).items() if not _is_object(value)}
    return {**plain, **changes}


def part_of(option: str, part: str, **changes: Any) -> dict[str, Any]:
    """The plain arguments of an object in an option, such as the context of "model/rt1", with some changes."""
    named = _arguments(option)[part].items()
    return {**{name: value for name, value in named if not name.startswith("_")}, **changes}


def _is_object(value: Any) -> bool:
    return isinstance(value, dict) and "_target_" in value
