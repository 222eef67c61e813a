"""What actions lose as tokens.

Shapes: N chunks, k actions of a chunk, D action components.
"""

from __future__ import annotations

import numpy as np
import torch

from vla.models.tokenizers.tokenizer import MIN_SPAN, ActionTokenizer
from vla.spec import Spec


def out_of_bounds(tokenizer: ActionTokenizer, chunks: np.ndarray) -> float:
    """Return the share of the (N, k, D) values outside the bounds of the tokenizer by more than a rounding error."""
    actions, slack = torch.from_numpy(np.array(chunks, np.float32)), 1e-4 * (tokenizer.high - tokenizer.low)
    return float(((actions < tokenizer.low - slack) | (actions > tokenizer.high + slack)).float().mean())


def rounding(tokenizer: ActionTokenizer, chunks: np.ndarray, spec: Spec) -> tuple[str, float]:
    """Return the component of (N, k, D) chunks that loses most as tokens, and its mean error, a share of its range."""
    actions = torch.from_numpy(np.array(chunks, np.float32))
    error = (tokenizer.detokenize(tokenizer.tokenize(actions)) - actions).abs().mean((0, 1)).numpy()  # (D,)
    span = np.maximum(chunks.max((0, 1)) - chunks.min((0, 1)), MIN_SPAN * (np.array(spec.high) - np.array(spec.low)))
    worst = int((error / span).argmax())
    return spec.action[worst], float(error[worst] / span[worst])
