"""Actions as tokens: every component of an action becomes one of K bins, and a network predicts which.

Shapes: D action components, K bins, … any leading dimensions.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Protocol

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from vla.spec import Spec

# Fixed bounds of RT-1: 1 m, a right angle, and a gripper command of one (arXiv 2212.06817).
RT1_BOUNDS = {"m": 1.0, "rad": math.pi / 2, "1": 1.0}

# A component that varies less than this part of its allowed range in the data still gets bins over this part.
LEAST_SPAN = 0.05


class Statistics(Protocol):
    """The smallest and largest action of a data set."""

    @property
    def low(self) -> np.ndarray:
        """(D,) smallest action."""
        ...

    @property
    def high(self) -> np.ndarray:
        """(D,) largest action."""
        ...


class ActionTokenizer(nn.Module, ABC):
    """K bins per component between two bounds, which are buffers and so travel with a checkpoint.

    Args:
        low, high: (D,) bounds of the bins in the units of the action.
        bins: K, at least 2.
    """

    low: Tensor  # (D,)
    high: Tensor  # (D,)

    def __init__(self, low: np.ndarray, high: np.ndarray, bins: int) -> None:
        super().__init__()
        if bins < 2:
            raise ValueError(f"a tokenizer needs at least 2 bins, got bins={bins}")
        self.bins = bins
        self.register_buffer("low", torch.as_tensor(low, dtype=torch.float32))
        self.register_buffer("high", torch.as_tensor(high, dtype=torch.float32))

    @abstractmethod
    def encode(self, action: Tensor) -> Tensor:
        """(…, D) float actions, clipped to the bounds, as (…, D) int64 tokens."""

    @abstractmethod
    def read(self, logits: Tensor) -> Tensor:
        """The (…, D) float action to execute for (…, D, K) logits."""

    @abstractmethod
    def cross_entropy(self, logits: Tensor, action: Tensor) -> Tensor:
        """The (…, D) loss of (…, D, K) logits against (…, D) actions."""

    def decode(self, token: Tensor) -> Tensor:
        """(…, D) tokens, whole or fractional, as (…, D) float actions."""
        return token.to(self.low.dtype) / (self.bins - 1) * (self.high - self.low) + self.low

    def loss(self, logits: Tensor, action: Tensor, valid: Tensor) -> Tensor:
        """Mean cross-entropy of (…, D, K) logits against (…, D) actions where the (…) bool `valid` is true."""
        losses = self.cross_entropy(logits.float(), action).mean(-1)  # (…)
        return (losses * valid).sum() / valid.sum().clamp(min=1)

    def _position(self, action: Tensor) -> Tensor:
        """(…, D) actions, clipped to the bounds, as positions on the scale of the tokens, 0 … K - 1."""
        inside = torch.minimum(torch.maximum(action, self.low), self.high)
        return (inside - self.low) / (self.high - self.low) * (self.bins - 1)


class Uniform(ActionTokenizer):
    """Bins over the range of the data, nearest bin, and targets that also credit the neighbours of the right bin.

    The action is read as the expectation over the most likely stretch of bins, so it is finer than a bin and two
    separate ways to act are never averaged. A stretch and not a bin, because a sharp peak of little weight, such as
    standing still, would otherwise beat a broad one of more weight, and a robot that stands still goes on doing so.

    Args:
        bins: K.
        margin: how far the bounds lie beyond the data, as a part of its range.
        smoothing: standard deviation of the Gaussian target [bins]; 0 trains on the single best bin.
        reach: half the length of the stretch of bins that an action is read from [bins]; 0 reads the single best bin.
        spec: gives the range of allowed actions.
        statistics: bounds of the data; None before a checkpoint's bounds are loaded, the allowed range stands in.
    """

    def __init__(
        self,
        bins: int = 256,
        margin: float = 0.05,
        smoothing: float = 3.0,
        reach: int = 50,
        *,
        spec: Spec,
        statistics: Statistics | None = None,
    ) -> None:
        allowed_low, allowed_high = np.array(spec.low), np.array(spec.high)
        low = allowed_low if statistics is None else np.asarray(statistics.low, dtype=np.float64)
        high = allowed_high if statistics is None else np.asarray(statistics.high, dtype=np.float64)
        if low.shape != allowed_low.shape:
            raise ValueError(
                f"the statistics describe actions of {low.size} components, the spec has {len(spec.action)}: "
                f"{', '.join(spec.action)}"
            )
        span = np.maximum(high - low, LEAST_SPAN * (allowed_high - allowed_low))
        half = (0.5 + margin) * span
        super().__init__((low + high) / 2 - half, (low + high) / 2 + half, bins)
        self.smoothing, self.reach = smoothing, reach

    def encode(self, action: Tensor) -> Tensor:
        """(…, D) float actions as the nearest of the K tokens, (…, D) int64."""
        return self._position(action).round().long()

    def cross_entropy(self, logits: Tensor, action: Tensor) -> Tensor:
        """The (…, D) loss against a Gaussian around the exact position of the action, which need not be a bin."""
        if self.smoothing == 0:
            return _hard_cross_entropy(logits, self.encode(action))
        distance = (self._bins(logits) - self._position(action).unsqueeze(-1)) / self.smoothing  # (…, D, K)
        target = (-0.5 * distance.square()).softmax(-1)
        return -(target * logits.log_softmax(-1)).sum(-1)

    def read(self, logits: Tensor) -> Tensor:
        """The (…, D) expectation over the most likely stretch of bins."""
        probabilities = logits.float().softmax(-1)  # (…, D, K)
        window = 2 * self.reach + 1
        weight = F.avg_pool1d(probabilities.flatten(0, -2), window, stride=1, padding=self.reach).view_as(logits)
        bins = self._bins(logits)
        near = probabilities * ((bins - weight.argmax(-1, keepdim=True)).abs() <= self.reach)
        return self.decode((near * bins).sum(-1) / near.sum(-1))

    def _bins(self, logits: Tensor) -> Tensor:
        return torch.arange(self.bins, device=logits.device, dtype=torch.float32)


class RT1(ActionTokenizer):
    """The rule of RT-1: fixed bounds by unit (1 m, π/2 rad, 1), rounding down, one right bin, most likely bin.

    Kept for fidelity: with small motions it uses few bins, and rounding down biases every action.

    Args:
        bins: K.
        spec: gives the units of the components.
        statistics: accepted like in every tokenizer, and not needed.
    """

    def __init__(self, bins: int = 256, *, spec: Spec, statistics: Statistics | None = None) -> None:
        unknown = sorted(set(spec.units) - set(RT1_BOUNDS))
        if unknown:
            raise ValueError(f"tokenizer=rt1 knows the units {sorted(RT1_BOUNDS)}, the spec has {unknown}")
        bound = np.array([RT1_BOUNDS[unit] for unit in spec.units])
        super().__init__(-bound, bound, bins)

    def encode(self, action: Tensor) -> Tensor:
        """(…, D) float actions rounded down to a token, (…, D) int64."""
        # A decoded token lies within a rounding error of its own position and must not fall to the one below.
        return (self._position(action) + 1e-3).floor().long()

    def cross_entropy(self, logits: Tensor, action: Tensor) -> Tensor:
        """The (…, D) loss against the one right token."""
        return _hard_cross_entropy(logits, self.encode(action))

    def read(self, logits: Tensor) -> Tensor:
        """The (…, D) action of the most likely token."""
        return self.decode(logits.argmax(-1))


def _hard_cross_entropy(logits: Tensor, token: Tensor) -> Tensor:
    return F.cross_entropy(logits.flatten(0, -2), token.flatten(), reduction="none").view(token.shape)


def fidelity(tokenizer: ActionTokenizer, actions: np.ndarray, units: Sequence[str]) -> str:
    """What is lost between (N, D) actions and their tokens, in one line: errors and bias in the units of people.

    The largest component of each unit counts; bins are used that at least one action falls into.
    """
    action = torch.from_numpy(np.array(actions, np.float32))  # a copy: those of a store cannot be written to
    tokens = tokenizer.encode(action)
    error = tokenizer.decode(tokens) - action  # (N, D)
    told = []
    for unit, (name, scale) in {"m": ("mm", 1000.0), "rad": ("°", 180 / math.pi), "1": ("of the gripper", 1.0)}.items():
        of_unit = [index for index, other in enumerate(units) if other == unit]
        if of_unit:
            part = error[:, of_unit]
            told.append(f"{scale * part.abs().mean(0).max():.3f} {name} (bias {scale * part.mean(0).abs().max():.3f})")
    used = [len(tokens[:, index].unique()) for index in range(tokens.shape[1])]
    spread = f"{min(used)} to {max(used)} of {tokenizer.bins} bins used"
    return f"{', '.join(told)} lost; {spread}; {len(units)} tokens per action"
