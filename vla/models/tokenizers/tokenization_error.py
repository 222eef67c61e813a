"""Tokenisation error of actions."""

# N chunks, k actions of a chunk, D action components, L tokens of a sequence

from __future__ import annotations

import numpy as np
import torch

from vla.models.tokenizers.tokenizer import ActionTokenizer
from vla.spec import Spec, readable


def out_of_bounds(tokenizer: ActionTokenizer, chunks: np.ndarray) -> float:
    """Return the share of the (N, k, D) values outside the bounds of the tokenizer by more than a rounding error."""
    actions, slack = torch.from_numpy(np.array(chunks, np.float32)), 1e-4 * (tokenizer.high - tokenizer.low)
    return float(((actions < tokenizer.low - slack) | (actions > tokenizer.high + slack)).float().mean())


def describe_tokenization_error(tokenizer: ActionTokenizer, chunks: np.ndarray, spec: Spec) -> str:
    """Describe the error of (N, k, D) chunks after tokenisation in one line: mean error, bias and maximum error.

    For each unit and each of the three, it is the worst component, in readable units.
    """
    actions = torch.from_numpy(np.array(chunks, np.float32))
    tokens = tokenizer.tokenize(actions)  # (N, L)
    error = (tokenizer.detokenize(tokens) - actions).flatten(0, 1)  # (N·k, D)
    errors = []
    for unit in dict.fromkeys(spec.units):
        of_unit = [index for index, other in enumerate(spec.units) if other == unit]
        scale, name = readable(unit)
        part = scale * error[:, of_unit]
        bias, largest = part.mean(0).abs().max(), part.abs().max()
        named = name or f"of {', '.join(spec.action[index] for index in of_unit)}"
        errors.append(f"{part.abs().mean(0).max():.3f} {named} (bias {bias:.3f}, at most {largest:.3f})")
    valid = torch.ones(actions.shape[:2], dtype=torch.bool)
    length = tokenizer.loss_mask(tokens, valid, valid[:, 0]).sum()
    per_action = f"{length / (len(chunks) * chunks.shape[1]):.3g} tokens per action"
    return f"{', '.join(errors)}; {tokenizer.vocabulary_usage(tokens)}; {per_action}"
