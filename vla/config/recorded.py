"""The resolver `${recorded:…}`: the spec of a task out of the recording that its expert reads."""

from __future__ import annotations

import json
from functools import lru_cache
from typing import TYPE_CHECKING, Any

from omegaconf import DictConfig, ListConfig, OmegaConf

from vla.config.annotations import locate
from vla.config.build import GROUPS, check_node, makes
from vla.io.documents import resolved
from vla.io.errors import UserError

if TYPE_CHECKING:
    from vla.data.formats.imported_demonstrations import Recording


def recorded(name: str, *, _root_: DictConfig) -> Any:
    """Resolve `${recorded:NAME}`: an attribute of `Recording`, or `low` or `high`, the bounds of the task's actions.

    Raises:
        UserError: the expert reads no recording, or there is none.
    """
    found = _recording(json.dumps(OmegaConf.to_container(_root_.expert, resolve=True)))
    if name not in ("low", "high"):
        value = resolved(getattr(found, name), "the recording")
        return ListConfig(value) if isinstance(value, list) else value
    action = list(_root_.task.action)
    if unknown := [each for each in action if each not in found.bounds]:
        raise UserError(f"task.action names {', '.join(unknown)}, the recording has {', '.join(found.bounds)}")
    return ListConfig([found.bounds[each][name == "high"] for each in action])


@lru_cache(maxsize=8)
def _recording(expert: str) -> Recording:
    """Describe the recording of a node of the group `expert`, which is JSON."""
    from vla.data.formats.imported_demonstrations import ImportedDemonstrations

    options, group = json.loads(expert), GROUPS["expert"]
    check_node("expert", options, makes(group), group.runtime)
    target = locate("expert._target_", options.pop("_target_"))
    if not issubclass(target, ImportedDemonstrations):
        raise UserError(
            "task=recorded needs recorded demonstrations: expert=lerobot expert.folder=DIR, or an expert of your own"
        )
    return target.recording(**options)


OmegaConf.register_new_resolver("recorded", recorded, replace=True)
