"""Writes a trained policy as a folder, see `vla.models.policy_folder`."""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from vla.io.files import atomic_path, write_json
from vla.io.versions import installed_versions
from vla.models import policy_folder as files
from vla.models.checkpoint import weights_of
from vla.models.lora import without_lora
from vla.models.trunk import Source

TEXT = """---
library_name: vla
pipeline_tag: robotics
tags:
- robotics
- imitation-learning
---

# {model} for {task}

A policy of `vla`: configuration, spaces and weights, as plain data.

| | |
|-|-|
{table}

`python -m vla.run checkpoint=FOLDER` measures its success rate, `job=deploy deploy=server checkpoint=FOLDER` serves it,
and in a program it is `vla.api.load_policy(FOLDER)`.
"""  # of the card


def write_policy(folder: Path, content: Mapping[str, Any]) -> None:
    """Write the content of a Lightning checkpoint as a policy, which replaces the one in `folder`.

    Values in the state of the model that are not tensors must be plain.

    Raises:
        OSError: it cannot be written; an existing one is unchanged.
    """
    from safetensors.torch import save

    config, spec = content["config"], content["spec"]
    names = (*files.REQUIRED_NODES, *files.OPTIONAL_NODES, "seed", "pretrained")
    nodes = {name: config[name] for name in names if name in config}
    nodes["model"] = files.with_absolute_paths(nodes["model"])
    validate = config.get("validate") or {}
    # The data module saves the digest of the demonstrations under a key with the name of its class, unknown here.
    states = [part for part in content.values() if isinstance(part, dict)]
    trunks = {name: Source(**source) for name, source in content["trunks"].items()}
    state = without_lora(weights_of(content), content["lora_scale"], trunks)
    # Contiguous, and without shared memory, as the format demands.
    tensors = {
        name: value.detach().cpu().clone(memory_format=torch.contiguous_format)
        for name, value in state.items()
        if isinstance(value, Tensor)
    }
    # One string, because safetensors writes several in random order, and equal policies must have equal digests.
    further_state = json.dumps({name: value for name, value in state.items() if name not in tensors})
    weights = save(tensors, {files.MODULE_STATE: further_state})
    training = files.Training(
        steps=content["global_step"],
        windows=next((part["windows"] for part in states if isinstance(part.get("windows"), str)), ""),
        seed=config.get("seed"),
        validation=(validate["seed"], validate["episodes"]) if {"seed", "episodes"} <= validate.keys() else None,
        weights=hashlib.sha256(weights).hexdigest(),
        versions=installed_versions(),
        figures={name: value for name, value in content["figures"].items() if math.isfinite(value)},
        trunks=trunks,
    )
    count = sum(tensor.numel() for tensor in tensors.values())
    folder.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(folder) as draft:
        draft.mkdir()
        (draft / files.WEIGHTS).write_bytes(weights)
        for name, part in ((files.CONFIG, nodes), (files.SPEC, spec), (files.TRAINING, asdict(training))):
            write_json(draft / name, part)
        (draft / files.CARD).write_text(_card(nodes, spec, training, count), encoding="utf-8")
        for path in draft.iterdir():
            with path.open("rb") as file:
                os.fsync(file.fileno())


def _card(config: Mapping[str, Any], spec: Mapping[str, Any], training: files.Training, count: int) -> str:
    """Return the model card of a policy, with the metadata header that the hub reads."""
    model, task = (str(config[name].get("_target_", name)).rpartition(".")[2] for name in ("model", "task"))
    parts = dict[Source, list[str]]()
    for name, source in training.trunks.items():
        parts.setdefault(source, []).append(name)
    rows = {
        "weights": f"{count / 1e6:.2f} million numbers",
        "cameras": f"{', '.join(spec['cameras'])} of {' by '.join(map(str, spec['image_size']))} px",
        "state": ", ".join(spec["state"]),
        "actions": f"{', '.join(spec['action'])} at {spec['control_hz']:g} Hz",
        "training": f"{training.steps} steps, seed {training.seed}, demonstrations {training.windows or 'unknown'}",
        **{f"trunk {', '.join(names)}": f"{source}, not in this folder" for source, names in parts.items()},
        **{name: f"{value:.4g}" for name, value in training.figures.items()},
    }
    table = "\n".join(f"| {name} | {text} |" for name, text in rows.items())
    return TEXT.format(model=model, task=task, table=table)
