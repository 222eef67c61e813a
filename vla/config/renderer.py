"""The renderers of the config, and which of them a machine can use."""

from __future__ import annotations

import copy
import logging
from collections.abc import Sequence
from typing import cast

from omegaconf import DictConfig, OmegaConf

from vla.config.compose import CONF
from vla.config.experiment import Node, plain
from vla.tasks.gl import has_egl

log = logging.getLogger(__name__)
FAST = "vla.tasks.rendering.fast.Fast"


def renderers() -> dict[str, Node]:
    """Return option of `task/renderer` → its node, of those that work on this machine."""
    files = sorted((CONF / "task/renderer").glob("*.yaml"))
    nodes = {file.stem: plain(cast(DictConfig, OmegaConf.load(file))) for file in files}
    return {name: node for name, node in nodes.items() if node["_target_"] != FAST or has_egl()}


def with_usable_renderer(cfg: DictConfig, overrides: Sequence[str]) -> DictConfig:
    """Return `cfg` with MuJoCo's own renderer in place of the fast one on a machine without EGL, and log a warning.

    What follows, such as the folder of the demonstrations, names the renderer that draws. A renderer that the command
    line names stays, and so does that of a resumed run: its demonstrations have been drawn.
    """
    asked = cfg.resume is not None or any(override.startswith("task/renderer=") for override in overrides)
    if asked or OmegaConf.select(cfg, "task.renderer._target_") != FAST or has_egl():
        return cfg
    log.warning(
        "this machine has no EGL, which the fast renderer needs: MuJoCo's own draws instead, task/renderer=mujoco. The "
        "packages libegl1, libgl1 and libgl1-mesa-dri bring EGL"
    )
    usable = copy.deepcopy(cfg)
    usable.task.renderer = renderers()["mujoco"]
    return usable
