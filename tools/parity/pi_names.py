"""Writes the names and shapes of the published weights of π0 and π0.5, as LeRobot's own classes have them.

Runs in the environment of pi05.py. The published files lack the embeddings of words, which are the matrix of the head.
"""

from __future__ import annotations

import json
import re
from types import SimpleNamespace
from typing import Any

import lerobot_modules  # first: it makes the imports of LeRobot possible  # noqa: F401
import newer_python  # noqa: F401
import torch
from lerobot.policies.pi0 import modeling_pi0
from lerobot.policies.pi05 import modeling_pi05
from tiny_vla import REFERENCE
from torch import nn

EMBEDDINGS = "paligemma_with_expert.paligemma.model.language_model.embed_tokens.weight"
SOURCE = (
    "state_dict() of {name} in LeRobot 0.6.1 at its published sizes, without the embeddings of words: {count} names. "
    "LeRobot's issues {issues} quote their beginnings, the missing embeddings, and as many names in {repository}."
)
PUBLISHED = {"pi0": ("PI0Pytorch", "pi0_base", "#2291 and #3109"), "pi05": ("PI05Pytorch", "pi05_base", "#2307")}


def listed(network: nn.Module) -> dict[str, list[int]]:
    """Return name → shape; layers of one kind are one name, with their number in braces."""
    shapes = {name: [*weight.shape] for name, weight in network.state_dict().items() if name != EMBEDDINGS}
    layers = dict[str, set[int]]()
    for name in shapes:
        if found := re.search(r"\.layers\.(\d+)\.", name):
            layers.setdefault(name.replace(found[0], ".layers.{}."), set()).add(int(found[1]))
    assert all(numbers == {*range(len(numbers))} for numbers in layers.values())
    named = {name.replace("{}", f"{{{len(numbers)}}}"): name.replace("{}", "0") for name, numbers in layers.items()}
    single = {name: name for name in shapes if ".layers." not in name}
    return {name: shapes[first] for name, first in sorted({**single, **named}.items())}


def main() -> None:
    """Write a file for each of the two."""
    options: dict[str, Any] = {"dtype": "float32", "image_resolution": (224, 224), "max_action_dim": 32}
    options |= {"paligemma_variant": "gemma_2b", "action_expert_variant": "gemma_300m", "max_state_dim": 32}
    options |= {"freeze_vision_encoder": False, "train_expert_only": False, "compile_model": False}
    for module, (key, (name, repository, issues)) in zip((modeling_pi0, modeling_pi05), PUBLISHED.items(), strict=True):
        with torch.device("meta"):
            network = getattr(module, name)(SimpleNamespace(**options))
        count = sum(weight != EMBEDDINGS for weight in network.state_dict())
        source = SOURCE.format(name=name, count=count, repository=f"lerobot/{repository}", issues=issues)
        text = json.dumps({"source": source, "shapes": listed(network)}, indent=0).replace("\n]", "]")
        (REFERENCE / f"{key}_names.json").write_text(re.sub(r"\[\n([\d,\n]+)\]", _in_line, text) + "\n")
        print(key, count)


def _in_line(match: re.Match[str]) -> str:
    return f"[{match[1].strip().replace(',', ', ').replace(chr(10), '')}]"


if __name__ == "__main__":
    main()
