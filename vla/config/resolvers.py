"""Custom resolvers for `conf/`: `${digest:…}`, `${chosen:…}`, `${recorded:…}` and `${jobs:}`."""

from __future__ import annotations

import hashlib
import json
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, ListConfig, OmegaConf

from vla.config.annotations import locate
from vla.config.build import GROUPS, check_node, product_type
from vla.config.packages import config_folders
from vla.io.documents import canonicalize, resolve_config
from vla.io.errors import UserError

if TYPE_CHECKING:
    from vla.data.formats.imported_demonstrations import Recording


def digest(*keys: str, _root_: DictConfig) -> str:
    """Resolve `${digest:task,expert,collect.seed}`: twelve hexadecimal digits of the values at dotted `keys`.

    The order of keys matters, because randomisation axes are applied in it. Null equals an absent key, 10 equals 10.0.
    """
    values = [OmegaConf.select(_root_, key, throw_on_missing=True) for key in keys]
    plain = [OmegaConf.to_container(value, resolve=True) if OmegaConf.is_config(value) else value for value in values]
    return hashlib.sha256(json.dumps(canonicalize(plain)).encode()).hexdigest()[:12]


def chosen(group: str, *, _root_: DictConfig) -> str | None:
    """Resolve `${chosen:task/randomize}`: the chosen option of a group, or None outside of Hydra."""
    if "hydra" in _root_:
        return _root_.hydra.runtime.choices.get(group)
    return HydraConfig.get().runtime.choices.get(group) if HydraConfig.initialized() else None


def recorded(name: str, *, _root_: DictConfig) -> Any:
    """Resolve `${recorded:NAME}`: an attribute of the expert's `Recording`, or `low` or `high`, the bounds of actions.

    Raises a UserError if the expert reads no recording, or the recording does not exist.
    """
    recording = _recording(json.dumps(OmegaConf.to_container(_root_.expert, resolve=True)))
    if name not in ("low", "high"):
        value = resolve_config(getattr(recording, name), "the recording")
        return ListConfig(value) if isinstance(value, list) else value
    action = list(_root_.task.action)
    if unknown := [component for component in action if component not in recording.bounds]:
        raise UserError(f"task.action names {', '.join(unknown)}: the recording has only {', '.join(recording.bounds)}")
    return ListConfig([recording.bounds[component][name == "high"] for component in action])


@lru_cache(maxsize=8)  # every value of a task asks for it
def _recording(expert: str) -> Recording:
    """Describe the recording that a node of the group `expert` reads; the node is given as JSON."""
    from vla.data.formats.imported_demonstrations import ImportedDemonstrations

    options, group = json.loads(expert), GROUPS["expert"]
    check_node("expert", options, product_type(group), group.runtime)
    target = locate("expert._target_", options.pop("_target_"))
    if not issubclass(target, ImportedDemonstrations):
        raise UserError(
            "task=recorded needs recorded demonstrations: expert=lerobot expert.folder=DIR, or an expert of your own"
        )
    return target.recording(**options)


def jobs() -> str:
    """Resolve `${jobs:}`: a line per option of the group `job`, with the first comment of its file."""
    files = {file.stem: file for folder in reversed(config_folders()) for file in (folder / "job").glob("*.yaml")}
    return "\n".join(f"  {name:11} {_comment(file)}" for name, file in sorted(files.items()))


def _comment(file: Path) -> str:
    lines = (line.removeprefix("# ") for line in file.read_text(encoding="utf-8").splitlines() if line.startswith("# "))
    return next((line for line in lines if not line.startswith("@")), "")


for resolver in (digest, chosen, recorded, jobs):
    OmegaConf.register_new_resolver(resolver.__name__, resolver, replace=True)
