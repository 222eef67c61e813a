"""Action tokenizers: a chunk of actions as a sequence of tokens from a vocabulary of K.

Shapes: D action components, k actions of a chunk, L tokens of a batch's longest sequence, K bins, … leading axes.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from vla.io.errors import UserError
from vla.io.types import Bins, Natural, NonNegative
from vla.spec import ActionStatistics, Spec

# Fixed bounds of RT-1: 1 m, a right angle, and a gripper command of one (arXiv 2212.06817).
RT1_BOUNDS = {"m": 1.0, "rad": math.pi / 2, "1": 1.0}

# Smallest range of the bins of a component, as a fraction of its allowed range.
MIN_SPAN = 0.05


class ActionTokenizer(nn.Module, ABC):
    """Base class of action tokenizers; bounds and other fitted values are saved in checkpoints.

    What a constructor computes from `statistics` must be in buffers, or in the extra state of a module: a training and
    a policy load it into a tokenizer that was built without them.

    Args:
        spec: names the components.
        low, high: (D,) bounds of the encoded actions, in the units of the action.
        bins: K, the size of the vocabulary, at least 2.
    """

    low: Tensor  # (D,)
    high: Tensor  # (D,)
    end = -1  # end and padding token; -1 if all sequences have the same length

    def __init__(self, spec: Spec, low: np.ndarray, high: np.ndarray, bins: Bins) -> None:
        super().__init__()
        ranges = zip(spec.action, spec.low, spec.high, strict=True)
        names = [name for name, lower, upper in ranges if not (lower < upper and math.isfinite(upper - lower))]
        if names:
            raise UserError(f"the spec must give {', '.join(names)} finite bounds, with low below high")
        self.bins, self.components = bins, len(spec.action)
        self.register_buffer("low", torch.as_tensor(low, dtype=torch.float32))
        self.register_buffer("high", torch.as_tensor(high, dtype=torch.float32))

    @abstractmethod
    def length(self, chunk: int) -> int:
        """Return the maximum number of tokens of a chunk of `chunk` actions."""

    @abstractmethod
    def tokenize(self, actions: Tensor) -> Tensor:
        """Encode (…, k, D) float chunks, clipped to the bounds, as (…, L) int64 tokens."""

    @abstractmethod
    def detokenize(self, tokens: Tensor) -> Tensor:
        """Decode any (…, L) tokens as (…, k, D) float actions."""

    @abstractmethod
    def loss_mask(self, tokens: Tensor, perturbations: Tensor) -> Tensor:
        """Return the (…, L) bool loss mask, given (…, k) perturbed steps before each action, -1 beyond the episode."""

    def token_losses(self, logits: Tensor, tokens: Tensor, actions: Tensor) -> Tensor:
        """Return the (…, L) losses of (…, L, K) logits against the (…, L) tokens of (…, k, D) actions."""
        return _hard_cross_entropy(logits, tokens)

    def sample_inputs(self, tokens: Tensor, actions: Tensor) -> Tensor:
        """Sample (…, L) decoder inputs near the (…, L) tokens of (…, k, D) actions, by default the tokens themselves.

        Such noise makes the decoder robust to errors in its own prefix.
        """
        return tokens

    def actions(self, logits: Tensor, tokens: Tensor) -> Tensor:
        """Decode (…, L, K) logits and the (…, L) tokens chosen from them as (…, k, D) actions."""
        return self.detokenize(tokens)


class ComponentTokenizer(ActionTokenizer):
    """Tokenizers with one token per component of every action, in order, so that L is k·D."""

    @abstractmethod
    def encode(self, action: Tensor) -> Tensor:
        """Encode (…, D) float actions, clipped to the bounds, as (…, D) int64 tokens."""

    @abstractmethod
    def decode(self, token: Tensor) -> Tensor:
        """Decode (…, D) tokens as (…, D) float actions."""

    def decode_logits(self, logits: Tensor) -> Tensor:
        """Decode (…, D, K) logits as (…, D) float actions, by default those of the most likely tokens."""
        return self.decode(logits.argmax(-1))

    def cross_entropy(self, logits: Tensor, action: Tensor) -> Tensor:
        """Return the (…, D) cross-entropy of (…, D, K) logits against (…, D) actions."""
        return _hard_cross_entropy(logits, self.encode(action))

    def length(self, chunk: int) -> int:
        """Return k·D."""
        return chunk * self.components

    def tokenize(self, actions: Tensor) -> Tensor:
        """Encode (…, k, D) float chunks as (…, k·D) int64 tokens."""
        return self.encode(actions).flatten(-2)

    def detokenize(self, tokens: Tensor) -> Tensor:
        """Decode (…, k·D) tokens as (…, k, D) float actions."""
        return self.decode(self._split(tokens, -1))

    def loss_mask(self, tokens: Tensor, perturbations: Tensor) -> Tensor:
        """Return the (…, k·D) bool loss mask: the tokens of actions that no perturbed step precedes."""
        return (perturbations == 0).repeat_interleave(self.components, -1)

    def token_losses(self, logits: Tensor, tokens: Tensor, actions: Tensor) -> Tensor:
        """Return the (…, k·D) losses of (…, k·D, K) logits against (…, k, D) actions."""
        return self.cross_entropy(self._split(logits, -2), actions).flatten(-2)

    def actions(self, logits: Tensor, tokens: Tensor) -> Tensor:
        """Decode (…, k·D, K) logits as (…, k, D) actions."""
        return self.decode_logits(self._split(logits, -2))

    def _split(self, values: Tensor, dim: int) -> Tensor:
        return values.unflatten(dim, (-1, self.components))


class EvenBins(ComponentTokenizer):
    """Uniform grid of K bins; the outermost are centred on the bounds."""

    def decode(self, token: Tensor) -> Tensor:
        """Decode (…, D) tokens, integer or fractional, as (…, D) float actions."""
        return token.to(self.low.dtype) / (self.bins - 1) * (self.high - self.low) + self.low

    def _position(self, action: Tensor) -> Tensor:
        """Return the fractional token, 0 … K - 1, of (…, D) actions clipped to the bounds."""
        clipped_action = action.clamp(self.low, self.high)
        return (clipped_action - self.low) / (self.high - self.low) * (self.bins - 1)


class Uniform(EvenBins):
    """Uniform bins over the range of the data, with Gaussian targets around the correct bin.

    An action is decoded as the expectation over the most likely window of bins. The result is finer than a bin, and
    modes further apart than the window are not averaged. Decoding the most likely bin instead would prefer a sharp peak
    of little weight, such as standing still, over a broad mode of more weight.

    Args:
        bins: K.
        margin: distance of the bounds from the data, as a fraction of its range.
        smoothing: standard deviation of the Gaussian target [bins]; 0 gives one-hot targets.
        reach: half the length of the decoding window [bins]; 0 decodes the most likely bin.
        spec: gives the allowed range of actions.
        statistics: bounds of the data; None if a checkpoint is loaded next, the allowed range until then.
    """

    def __init__(
        self,
        bins: Bins,
        margin: NonNegative,
        smoothing: NonNegative,
        reach: Natural,
        *,
        spec: Spec,
        statistics: ActionStatistics | None = None,
    ) -> None:
        super().__init__(spec, *data_bounds(spec, statistics, margin), bins)
        self.smoothing, self.reach = smoothing, reach

    def encode(self, action: Tensor) -> Tensor:
        """Encode (…, D) float actions as the nearest tokens, (…, D) int64."""
        return self._position(action).round().long()

    def cross_entropy(self, logits: Tensor, action: Tensor) -> Tensor:
        """Return the (…, D) cross-entropy against a Gaussian around the fractional token of the action."""
        if self.smoothing == 0:
            return _hard_cross_entropy(logits, self.encode(action))
        distance = (self._bins(logits) - self._position(action).unsqueeze(-1)) / self.smoothing  # (…, D, K)
        target = (-0.5 * distance.square()).softmax(-1)
        return -(target * logits.log_softmax(-1)).sum(-1)

    def sample_inputs(self, tokens: Tensor, actions: Tensor) -> Tensor:
        """Sample (…, k·D) tokens from the Gaussian target of each component."""
        position = self._position(actions).flatten(-2)
        return (position + self.smoothing * torch.randn_like(position)).round().clamp(0, self.bins - 1).long()

    def decode_logits(self, logits: Tensor) -> Tensor:
        """Decode (…, D, K) logits as the expectation over the most likely window of bins, (…, D)."""
        probabilities = logits.float().softmax(-1)  # (…, D, K)
        window = 2 * self.reach + 1
        weight = F.avg_pool1d(probabilities.flatten(0, -2), window, stride=1, padding=self.reach).view_as(logits)
        bins = self._bins(logits)
        peak = probabilities * ((bins - weight.argmax(-1, keepdim=True)).abs() <= self.reach)
        return self.decode((peak * bins).sum(-1) / peak.sum(-1))

    def _bins(self, logits: Tensor) -> Tensor:
        return torch.arange(self.bins, device=logits.device, dtype=torch.float32)


class RT1Bins(EvenBins):
    """The tokenizer of RT-1: fixed bounds per unit (1 m, π/2 rad, 1), rounding down, one-hot targets, most likely bin.

    It exists for faithful reproduction: small motions use few bins, and rounding down biases every action.

    Args:
        bins: K.
        spec: gives the units of the components.
        statistics: unused; part of the signature of every tokenizer.
    """

    def __init__(self, bins: Bins, *, spec: Spec, statistics: ActionStatistics | None = None) -> None:
        other_units = sorted(set(spec.units) - set(RT1_BOUNDS))
        if other_units:
            raise UserError(f"tokenizer=rt1 takes actions in {', '.join(RT1_BOUNDS)}, not in {', '.join(other_units)}")
        bound = np.array([RT1_BOUNDS[unit] for unit in spec.units])
        super().__init__(spec, -bound, bound, bins)

    def encode(self, action: Tensor) -> Tensor:
        """Encode (…, D) float actions, rounded down, as (…, D) int64 tokens."""
        # The offset keeps a decoded token, which may have a rounding error, at its own index.
        return (self._position(action) + 1e-3).floor().long()


def data_bounds(spec: Spec, statistics: ActionStatistics | None, margin: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Return (D,) bounds: the data extended by `margin` times its range, or without data the allowed range.

    Raises:
        UserError: the statistics have another number of components.
    """
    allowed_low, allowed_high = np.array(spec.low), np.array(spec.high)
    low = allowed_low if statistics is None else np.asarray(statistics.low, dtype=np.float64)
    high = allowed_high if statistics is None else np.asarray(statistics.high, dtype=np.float64)
    if low.shape != allowed_low.shape:
        raise UserError(
            f"the statistics describe actions of {low.size} components, the spec has {len(spec.action)}: "
            f"{', '.join(spec.action)}"
        )
    span = np.maximum(high - low, MIN_SPAN * (allowed_high - allowed_low))
    half_span = (0.5 + margin) * span
    return (low + high) / 2 - half_span, (low + high) / 2 + half_span


def out_of_bounds(tokenizer: ActionTokenizer, chunks: np.ndarray) -> float:
    """Return the share of (N, k, D) actions outside the bounds of a tokenizer by more than a rounding error."""
    actions, slack = torch.from_numpy(np.array(chunks, np.float32)), 1e-4 * (tokenizer.high - tokenizer.low)
    return float(((actions < tokenizer.low - slack) | (actions > tokenizer.high + slack)).any(-1).float().mean())


def rounding(tokenizer: ActionTokenizer, chunks: np.ndarray, spec: Spec) -> tuple[str, float]:
    """Return the component of (N, k, D) chunks that tokens round most, and its mean error as a share of its range."""
    actions = torch.from_numpy(np.array(chunks, np.float32))
    error = (tokenizer.detokenize(tokenizer.tokenize(actions)) - actions).abs().mean((0, 1)).numpy()  # (D,)
    span = np.maximum(chunks.max((0, 1)) - chunks.min((0, 1)), MIN_SPAN * (np.array(spec.high) - np.array(spec.low)))
    worst_index = int((error / span).argmax())
    return spec.action[worst_index], float(error[worst_index] / span[worst_index])


def _hard_cross_entropy(logits: Tensor, token: Tensor) -> Tensor:
    return F.cross_entropy(logits.flatten(0, -2), token.flatten(), reduction="none").view(token.shape)
