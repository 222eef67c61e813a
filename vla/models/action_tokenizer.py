"""Actions as tokens: a chunk of actions becomes a sequence of tokens out of K, and a network predicts which.

Shapes: D action components, k actions of a chunk, L tokens of the longest sequence at hand, K bins, … any leading
dimensions.
"""

from __future__ import annotations

import logging
import math
from abc import ABC, abstractmethod
from typing import Protocol

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from vla.spec import Spec
from vla.types import Bins, Count, NonNegative

log = logging.getLogger(__name__)

# Fixed bounds of RT-1: 1 m, a right angle, and a gripper command of one (arXiv 2212.06817).
RT1_BOUNDS = {"m": 1.0, "rad": math.pi / 2, "1": 1.0}

# A component that varies less than this part of its allowed range in the data still gets bins over this part.
LEAST_SPAN = 0.05


class Statistics(Protocol):
    """What a tokenizer is fitted on: the smallest and largest action of a data set, and a sample of its chunks."""

    @property
    def low(self) -> np.ndarray:
        """(D,) smallest action."""
        ...

    @property
    def high(self) -> np.ndarray:
        """(D,) largest action."""
        ...

    def chunks(self, length: int) -> np.ndarray:
        """(N, length, D) float32 actions that follow each other."""
        ...


class ActionTokenizer(nn.Module, ABC):
    """Chunks of actions as sequences of tokens; bounds and whatever else is fitted travel with a checkpoint.

    Args:
        spec: names the components.
        low, high: (D,) bounds of the actions that tokens stand for, in the units of the action.
        bins: K, the size of the vocabulary, at least 2.
    """

    low: Tensor  # (D,)
    high: Tensor  # (D,)
    end = -1  # the token that ends a sequence and fills it up; none where all are of one length

    def __init__(self, spec: Spec, low: np.ndarray, high: np.ndarray, bins: Bins) -> None:
        super().__init__()
        if bins < 2:
            raise ValueError(f"a tokenizer needs at least 2 bins, got bins={bins}")
        ranges = zip(spec.action, spec.low, spec.high, strict=True)
        empty = [name for name, least, most in ranges if not (least < most and math.isfinite(most - least))]
        if empty:
            raise ValueError(f"the spec must give {', '.join(empty)} a range: a low and a higher high, both finite")
        self.bins, self.components = bins, len(spec.action)
        self.register_buffer("low", torch.as_tensor(low, dtype=torch.float32))
        self.register_buffer("high", torch.as_tensor(high, dtype=torch.float32))

    @abstractmethod
    def length(self, chunk: int) -> int:
        """The largest L: the most tokens that a chunk of so many actions takes."""

    @abstractmethod
    def tokenize(self, actions: Tensor) -> Tensor:
        """(…, k, D) float chunks, clipped to the bounds, as (…, L) int64 tokens."""

    @abstractmethod
    def detokenize(self, tokens: Tensor) -> Tensor:
        """(…, L) tokens, whichever they are, as (…, k, D) float actions."""

    @abstractmethod
    def learned(self, tokens: Tensor, valid: Tensor) -> Tensor:
        """(…, L) bool: which of the tokens of a chunk count, given which of its actions do, (…, k) bool."""

    @abstractmethod
    def used(self, tokens: Tensor) -> str:
        """How much of the vocabulary appears in (N, L) tokens, for people."""

    def token_losses(self, logits: Tensor, tokens: Tensor, actions: Tensor) -> Tensor:
        """The (…, L) losses of (…, L, K) logits against the (…, L) tokens of the (…, k, D) actions."""
        return _hard_cross_entropy(logits, tokens)

    def drawn(self, tokens: Tensor, actions: Tensor) -> Tensor:
        """(…, L) tokens that a model which has learned these (…, L) tokens of (…, k, D) actions may choose instead.

        What is trained to go on from them goes on from its own as well.
        """
        return tokens

    def actions(self, logits: Tensor, tokens: Tensor) -> Tensor:
        """The (…, k, D) actions to execute after (…, L) tokens were chosen by (…, L, K) logits."""
        return self.detokenize(tokens)


class PerComponent(ActionTokenizer):
    """One token per component of every action, in order, so that L is k·D and a token is one of D kinds of bins."""

    @abstractmethod
    def encode(self, action: Tensor) -> Tensor:
        """(…, D) float actions, clipped to the bounds, as (…, D) int64 tokens."""

    @abstractmethod
    def decode(self, token: Tensor) -> Tensor:
        """(…, D) tokens as (…, D) float actions."""

    def read(self, logits: Tensor) -> Tensor:
        """The (…, D) float action to execute for (…, D, K) logits: that of the most likely tokens."""
        return self.decode(logits.argmax(-1))

    def cross_entropy(self, logits: Tensor, action: Tensor) -> Tensor:
        """The (…, D) loss of (…, D, K) logits against (…, D) actions, of which one token each is right."""
        return _hard_cross_entropy(logits, self.encode(action))

    def loss(self, logits: Tensor, action: Tensor, valid: Tensor) -> Tensor:
        """Mean cross-entropy of (…, D, K) logits against (…, D) actions where the (…) bool `valid` is true."""
        losses = self.cross_entropy(logits.float(), action).mean(-1)  # (…)
        return (losses * valid).sum() / valid.sum().clamp(min=1)

    def length(self, chunk: int) -> int:
        """k·D."""
        return chunk * self.components

    def tokenize(self, actions: Tensor) -> Tensor:
        """(…, k, D) float chunks as (…, k·D) int64 tokens."""
        return self.encode(actions).flatten(-2)

    def detokenize(self, tokens: Tensor) -> Tensor:
        """(…, k·D) tokens as (…, k, D) float actions."""
        return self.decode(self._split(tokens, -1))

    def learned(self, tokens: Tensor, valid: Tensor) -> Tensor:
        """(…, k·D) bool: the tokens of the actions that count."""
        return valid.repeat_interleave(self.components, -1)

    def token_losses(self, logits: Tensor, tokens: Tensor, actions: Tensor) -> Tensor:
        """The (…, k·D) losses of (…, k·D, K) logits against (…, k, D) actions."""
        return self.cross_entropy(self._split(logits, -2), actions).flatten(-2)

    def actions(self, logits: Tensor, tokens: Tensor) -> Tensor:
        """The (…, k, D) actions that are read from (…, k·D, K) logits."""
        return self.read(self._split(logits, -2))

    def used(self, tokens: Tensor) -> str:
        """Over the components, the fewest and the most bins that at least one action falls into."""
        counts = [len(of_one.unique()) for of_one in self._split(tokens, -1).unbind(-1)]
        return f"{min(counts)} to {max(counts)} of {self.bins} bins used"

    def _split(self, values: Tensor, dim: int) -> Tensor:
        return values.unflatten(dim, (-1, self.components))


class EvenBins(PerComponent):
    """K bins at even distances, the outermost on the bounds."""

    def decode(self, token: Tensor) -> Tensor:
        """(…, D) tokens, whole or fractional, as (…, D) float actions."""
        return token.to(self.low.dtype) / (self.bins - 1) * (self.high - self.low) + self.low

    def _position(self, action: Tensor) -> Tensor:
        """(…, D) actions, clipped to the bounds, as positions on the scale of the tokens, 0 … K - 1."""
        inside = torch.minimum(torch.maximum(action, self.low), self.high)
        return (inside - self.low) / (self.high - self.low) * (self.bins - 1)


class Uniform(EvenBins):
    """Bins over the range of the data, nearest bin, and targets that also credit the neighbours of the right bin.

    The action is read as the expectation over the most likely stretch of bins, so it is finer than a bin, and ways to
    act that lie further apart than the stretch is long are not averaged. A stretch and not a bin, because a sharp peak
    of little weight, such as standing still, would otherwise beat a broad one of more weight, and a robot that stands
    still goes on doing so.

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
        bins: Bins = 256,
        margin: NonNegative = 0.05,
        smoothing: NonNegative = 3.0,
        reach: Count = 50,
        *,
        spec: Spec,
        statistics: Statistics | None = None,
    ) -> None:
        super().__init__(spec, *data_bounds(spec, statistics, margin), bins)
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

    def drawn(self, tokens: Tensor, actions: Tensor) -> Tensor:
        """(…, k·D) tokens from the Gaussian that is the target of each component."""
        position = self._position(actions).flatten(-2)
        return (position + self.smoothing * torch.randn_like(position)).round().clamp(0, self.bins - 1).long()

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


class RT1(EvenBins):
    """The rule of RT-1: fixed bounds by unit (1 m, π/2 rad, 1), rounding down, one right bin, most likely bin.

    Kept for fidelity: with small motions it uses few bins, and rounding down biases every action.

    Args:
        bins: K.
        spec: gives the units of the components.
        statistics: accepted like in every tokenizer, and not needed.
    """

    def __init__(self, bins: Bins = 256, *, spec: Spec, statistics: Statistics | None = None) -> None:
        unknown = sorted(set(spec.units) - set(RT1_BOUNDS))
        if unknown:
            raise ValueError(f"tokenizer=rt1 knows the units {sorted(RT1_BOUNDS)}, the spec has {unknown}")
        bound = np.array([RT1_BOUNDS[unit] for unit in spec.units])
        super().__init__(spec, -bound, bound, bins)

    def encode(self, action: Tensor) -> Tensor:
        """(…, D) float actions rounded down to a token, (…, D) int64."""
        # A decoded token lies within a rounding error of its own position and must not fall to the one below.
        return (self._position(action) + 1e-3).floor().long()


def data_bounds(spec: Spec, statistics: Statistics | None, margin: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """(D,) bounds of the data, `margin` times its range beyond it; without data, of the allowed actions.

    Raises:
        ValueError: the statistics are those of other actions.
    """
    allowed_low, allowed_high = np.array(spec.low), np.array(spec.high)
    low = allowed_low if statistics is None else np.asarray(statistics.low, dtype=np.float64)
    high = allowed_high if statistics is None else np.asarray(statistics.high, dtype=np.float64)
    if low.shape != allowed_low.shape:
        raise ValueError(
            f"the statistics describe actions of {low.size} components, the spec has {len(spec.action)}: "
            f"{', '.join(spec.action)}"
        )
    least = LEAST_SPAN * (allowed_high - allowed_low)
    still = [name for name, narrow in zip(spec.action, high - low < least, strict=True) if narrow]
    if still:
        log.info("%s hardly differs in the demonstrations, and gets %g of its range", ", ".join(still), LEAST_SPAN)
    span = np.maximum(high - low, least)
    half = (0.5 + margin) * span
    return (low + high) / 2 - half, (low + high) / 2 + half


def _hard_cross_entropy(logits: Tensor, token: Tensor) -> Tensor:
    return F.cross_entropy(logits.flatten(0, -2), token.flatten(), reduction="none").view(token.shape)
