"""Writes the names and shapes of the published weights of π0 and π0.5, as LeRobot's own classes have them.

Runs in the environment of pi05.py. The published files lack the embeddings of words, which are the matrix of the head.
"""

from __future__ import annotations

import json
import math
import re
from types import SimpleNamespace
from typing import Any

import lerobot_modules  # first: it makes the imports of LeRobot possible  # noqa: F401
import newer_python  # noqa: F401
import torch
from lerobot.policies.pi0.modeling_pi0 import PI0Pytorch
from lerobot.policies.pi05.modeling_pi05 import PI05Pytorch
from tiny_vla import REFERENCE

EMBEDDINGS = "paligemma_with_expert.paligemma.model.language_model.embed_tokens.weight"
SOURCE = "{name} of LeRobot 0.6.1 at its published sizes, without the embeddings of words; not its file itself. {known}"
PUBLISHED = {  # class → repository, and what is known of its file
    PI0Pytorch: ("pi0_base", "LeRobot's threads 2291 and 3109 quote names, 777 tensors, no embeddings."),
    PI05Pytorch: ("pi05_base", "LeRobot's thread 2307 tells of the embeddings; a descendant has 812 tensors."),
}


def rows(shapes: dict[str, list[int]]) -> list[list[Any]]:
    """Return name, layers and shape; layers of one kind are one row, with a star in place of their numbers."""
    layers = dict[str, set[int]]()
    for name in shapes:
        match = re.search(r"\.layers\.(\d+)\.", name)
        pattern = name.replace(match[0], ".layers.*.") if match else name
        layers.setdefault(pattern, set()).update({int(match[1])} if match else set())
    assert all(numbers == {*range(len(numbers))} for numbers in layers.values())
    return [
        [name, f"0:{len(numbers)}" if numbers else "", shapes[name.replace("*", "0")]]
        for name, numbers in sorted(layers.items())
    ]


def main() -> None:
    """Write a file for each of the two."""
    options: dict[str, Any] = {"dtype": "float32", "image_resolution": (224, 224), "max_action_dim": 32}
    options |= {"paligemma_variant": "gemma_2b", "action_expert_variant": "gemma_300m", "max_state_dim": 32}
    options |= {"freeze_vision_encoder": False, "train_expert_only": False, "compile_model": False}
    for kind, (repository, remark) in PUBLISHED.items():
        with torch.device("meta"):
            network = kind(SimpleNamespace(**options))
        shapes = {name: [*weight.shape] for name, weight in network.state_dict().items() if name != EMBEDDINGS}
        values = {
            "source": SOURCE.format(name=kind.__name__, known=remark),
            "tensors": len(shapes),
            "numbers": sum(math.prod(shape) for shape in shapes.values()),
        }
        head = [f"  {json.dumps(name)}: {json.dumps(value)}," for name, value in values.items()]
        body = ",\n".join(f"    {json.dumps(row)}" for row in rows(shapes))
        text = "\n".join(["{", *head, '  "weights": [', body, "  ]", "}", ""])
        (REFERENCE / f"{repository}.json").write_text(text, encoding="utf-8")
        print(repository, values)


if __name__ == "__main__":
    main()
