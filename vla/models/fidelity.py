"""What is lost when actions become tokens."""

# N chunks, k actions of a chunk, D action components, L tokens of a sequence

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch

from vla.models.action_tokenizer import ActionTokenizer

READABLE = {"m": ("mm", 1000.0), "rad": ("°", 180 / math.pi), "1": ("of the gripper", 1.0)}  # unit → name and factor


def beyond(tokenizer: ActionTokenizer, chunks: np.ndarray) -> float:
    """Share of the (N, k, D) numbers that lie beyond the bounds of the tokenizer, by more than rounding."""
    actions, slack = torch.from_numpy(np.array(chunks, np.float32)), 1e-4 * (tokenizer.high - tokenizer.low)
    return float(((actions < tokenizer.low - slack) | (actions > tokenizer.high + slack)).float().mean())


def fidelity(tokenizer: ActionTokenizer, chunks: np.ndarray, units: Sequence[str]) -> str:
    """What is lost between (N, k, D) chunks and their tokens, in one line: mean error, bias and largest error, in the
    units of people. Of each unit, and for each of the three, the worst component counts.
    """
    actions = torch.from_numpy(np.array(chunks, np.float32))
    tokens = tokenizer.tokenize(actions)  # (N, L)
    error = (tokenizer.detokenize(tokens) - actions).flatten(0, 1)  # (N·k, D)
    told = []
    for unit, (name, scale) in READABLE.items():
        of_unit = [index for index, other in enumerate(units) if other == unit]
        if of_unit:
            part = scale * error[:, of_unit]
            bias, most = part.mean(0).abs().max(), part.abs().max()
            told.append(f"{part.abs().mean(0).max():.3f} {name} (bias {bias:.3f}, at most {most:.3f})")
    written = tokenizer.learned(tokens, torch.ones(actions.shape[:2], dtype=torch.bool)).sum()
    per_action = f"{written / (len(chunks) * chunks.shape[1]):.3g} tokens per action"
    return f"{', '.join(told)} lost; {tokenizer.used(tokens)}; {per_action}"
