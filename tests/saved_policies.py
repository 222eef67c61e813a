"""Policies in folders, as a training writes them or as somebody else made them."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from toy import SPEC

from vla.models.policy_writing import write_policy
from vla.spec import Spec


def save_policy(
    folder: Path, config: Mapping[str, Any], spec: Spec = SPEC, state: Mapping[str, Any] | None = None, **further: Any
) -> Path:
    """Write a policy, with one number as its weights unless they are given, and return its folder."""
    weights = {f"model.{name}": value for name, value in (state or {"count": torch.zeros(1)}).items()}
    content = {"config": config, "spec": spec.to_dict(), "state_dict": weights, "global_step": 0, "figures": {}}
    content |= {"trunks": {}, "lora_scale": 1.0}
    write_policy(folder, content | further)
    return folder


def save_run(run: Path, config: Any, plainly: bool = True) -> Path:
    """Write a run whose checkpoint has a configuration, and, if it is plain, its policy; return its folder."""
    (run / "checkpoints").mkdir(parents=True, exist_ok=True)
    torch.save({"config": config, "global_step": 0, "finished": True, "state_dict": {}}, run / "checkpoints/last.ckpt")
    if plainly:
        save_policy(run / "policy", config)
    return run


def change_json(file: Path, change: Callable[[Any], Any]) -> None:
    """Replace what a JSON file holds by what `change` makes of it."""
    file.write_text(json.dumps(change(json.loads(file.read_text()))))
