"""Imports LeRobot's own policies and processors without most of what LeRobot depends on.

LeRobot is installed with `--no-deps` in a folder of its own, which is in PYTHONPATH. After this import its policies can
be imported: libraries that they do not need, such as those of datasets and robots, are replaced by placeholders.
"""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType
from typing import Any

# What LeRobot imports, and nothing compared here calls.
LIBRARIES = (
    *("accelerate", "av", "cv2", "datasets", "deepdiff", "einops", "gymnasium", "imageio", "jsonlines", "peft"),
    "serial",
)
PARTS = ("lerobot.configs.train", "lerobot.datasets", "lerobot.envs", "lerobot.robots", "lerobot.teleoperators")


class Placeholder(type):
    """A class whose attributes are further placeholders."""

    def __getattr__(cls, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return Placeholder(name, (), {})


class _Module(ModuleType):
    __path__: Sequence[str] = []
    __getattr__ = Placeholder.__getattr__


class _Finder(MetaPathFinder, Loader):
    def find_spec(self, fullname: str, path: Any, target: Any = None) -> ModuleSpec | None:
        if any(f"{fullname}.".startswith(f"{name}.") for name in (*LIBRARIES, *PARTS)):
            return ModuleSpec(fullname, self, is_package=True)
        return None

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        return _Module(spec.name)

    def exec_module(self, module: ModuleType) -> None:
        pass


def processors_of(folder: Path) -> tuple[Any, ...]:
    """Return LeRobot's processors before and after an exported policy."""
    from lerobot.processor import PolicyProcessorPipeline
    from lerobot.processor.converters import policy_action_to_transition, transition_to_policy_action

    converters = {"to_transition": policy_action_to_transition, "to_output": transition_to_policy_action}
    return tuple(
        PolicyProcessorPipeline.from_pretrained(folder, config_filename=f"policy_{part}.json", **options)
        for part, options in (("preprocessor", {}), ("postprocessor", converters))
    )


def _prepare() -> None:
    root = importlib.util.find_spec("lerobot")
    assert root is not None and root.submodule_search_locations, "LeRobot is not in PYTHONPATH: make parity"
    sys.meta_path.insert(0, _Finder())
    policies = ModuleType("lerobot.policies")  # without its __init__, which imports every policy
    policies.__path__ = [str(Path(root.submodule_search_locations[0]) / "policies")]
    sys.modules["lerobot.policies"] = policies


_prepare()
