"""The networks of vision-language-action models: a prefix of images and sentence, and the velocity of actions given it.

Shapes: B batch, C cameras, L tokens of the sentence, S state, P tokens of the prefix, k action chunk, A components of
a padded action, as in the network.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor, nn
from transformers.models.llama.modeling_llama import apply_rotary_pos_emb

from vla.io.errors import UserError
from vla.io.types import Count, Layers, Width

MIN_PERIOD, MAX_PERIOD = 4e-3, 4.0  # of the time embedding

Rotation = tuple[Tensor, Tensor]  # cosines and sines of positions, (B, N, H) each
LayerOutput = tuple[Tensor, Tensor, Tensor]  # tokens after a layer, (B, N, E), and all keys and values they attend to


class Prefix(NamedTuple):
    """What actions attend to: images, sentence and in some models the state, encoded once per plan, never modified."""

    keys: tuple[Tensor, ...]  # of each layer, (B, heads, P, width of a head), positions applied
    values: tuple[Tensor, ...]  # of each layer, (B, heads, P, width of a head)
    present: Tensor  # (B, P) bool, false for padding


class LayerCache:
    """All keys and values that the tokens of a layer attend to: those of preceding tokens, and their own.

    It takes the place of a cache of transformers, but nothing is added to the preceding ones: a prefix never changes.

    Args:
        past: keys and values of preceding tokens, (B, heads, P, width of a head) each; None: there are none.
    """

    keys: Tensor
    values: Tensor

    def __init__(self, past: tuple[Tensor, Tensor] | None) -> None:
        self._past = past

    def update(self, keys: Tensor, values: Tensor, *_: Any, **__: Any) -> tuple[Tensor, Tensor]:
        """Append (B, heads, N, width of a head) keys and values; versions of transformers pass more."""
        if past := self._past:
            keys, values = torch.cat([past[0], keys], 2), torch.cat([past[1], values], 2)
        self.keys, self.values = keys, values
        return keys, values


class KeyValueMixin(nn.Module):
    """Mixin for a layer of transformers, which makes it return keys and values beside its tokens.

    Left in a cache, their gradients would bypass FSDP, which gathers a layer's weights when they reach its outputs.
    """

    def forward(self, hidden: Tensor, past: tuple[Tensor, Tensor] | None = None, **attention: Any) -> LayerOutput:
        """Process (B, N, E) tokens, which attend to preceding tokens too, given the keys and values of these."""
        cache, layer = LayerCache(past), super()
        hidden = layer.forward(hidden, past_key_values=cache, **attention)
        return hidden, cache.keys, cache.values


class _LastLayer(nn.Module):
    """The last layer of a trunk, which computes only keys and values: nothing depends on its other results.

    Args:
        layer: a Llama or Gemma layer of transformers, whose parts it takes.
    """

    def __init__(self, layer: Any) -> None:
        super().__init__()
        self.input_layernorm, self.self_attn = layer.input_layernorm, layer.self_attn
        self.self_attn.q_proj = _UnusedWeights(layer.self_attn.q_proj)
        self.self_attn.o_proj = _UnusedWeights(layer.self_attn.o_proj)
        self.post_attention_layernorm = _UnusedWeights(layer.post_attention_layernorm)
        self.mlp = _UnusedWeights(layer.mlp)

    def forward(self, hidden: Tensor, position_embeddings: Rotation, **_: Any) -> LayerOutput:
        """Return (B, N, E) tokens unchanged, with their keys and values."""
        normed, attention = self.input_layernorm(hidden), self.self_attn
        keys, values = (
            project(normed).unflatten(-1, (-1, attention.head_dim)).transpose(1, 2)
            for project in (attention.k_proj, attention.v_proj)
        )
        return hidden, apply_rotary_pos_emb(keys, keys, *position_embeddings)[1], values


class _UnusedWeights(nn.Module):
    """Weights of a published policy that no action depends on, under their names and without gradients.

    Args:
        module: the module that has the weights.
    """

    def __init__(self, module: nn.Module) -> None:
        super().__init__()
        for name, weight in module.named_parameters(recurse=False):
            self.register_parameter(name, nn.Parameter(weight.data, requires_grad=False))
        for name, child in module.named_children():
            self.add_module(name, _UnusedWeights(child))


def shorten(trunk: Any, kind: type[KeyValueMixin]) -> None:
    """Truncate a Llama or Gemma of transformers, in place, after the keys and values of its last layer.

    All layers return their keys and values; `kind` is the class that does so.
    """
    return_keys(trunk, kind)
    trunk.layers[-1], trunk.norm = _LastLayer(trunk.layers[-1]), _UnusedWeights(trunk.norm)


def return_keys(network: Any, kind: type[KeyValueMixin]) -> None:
    """Make the layers of a Llama or Gemma of transformers instances of `kind`, in place."""
    for layer in network.layers:
        layer.__class__ = kind


class FlowNetwork(nn.Module, ABC):
    """A pretrained trunk with an expert that predicts the velocity of noisy actions.

    The prefix never attends to the actions, so training, too, computes it only once per batch, and the gradients of the
    velocity reach the trunk through the keys and values of the prefix.

    A YAML node is a factory, called as `network()`, of a subclass: all sizes are its arguments.

    Args:
        vocabulary: number of different tokens in sentences.
        width, layers, heads, head_width, feedforward: of the language model.
        vision_width, vision_layers, vision_heads, vision_feedforward: of the image encoder, a vision transformer.
        resolution: height and width of an image [px].
        patch: height and width of a patch [px].
        expert_width, expert_feedforward: of the expert, whose layers and heads are those of the language model.
        action_width: A, padded with zeros.

    Raises:
        UserError: sizes do not divide each other.
    """

    # Names of weights in a whole policy of LeRobot, and in the vision-language model alone: pairs of how they begin
    # there and here. The first match counts.
    published_names: ClassVar[tuple[tuple[str, str], ...]] = ()
    trunk_names: ClassVar[tuple[tuple[str, str], ...]] = ()
    # Beginnings of the published names of a language-model head, which no action depends on; LeRobot's comes first.
    unused_names: ClassVar[tuple[str, ...]] = ()

    kind: ClassVar[str] = ""  # LeRobot's name of the policy
    causal: ClassVar[bool] = False  # whether actions never attend to later ones

    state_width: int  # S, padded with zeros; 0: the state is part of the sentence
    value_width: int  # width of the values of a token in a layer, over all heads
    unused_width: int  # width of the input of the unused language-model head

    def __init__(
        self,
        vocabulary: Count,
        width: Width,
        layers: Layers,
        heads: Layers,
        head_width: Width,
        feedforward: Width,
        vision_width: Width,
        vision_layers: Layers,
        vision_heads: Layers,
        vision_feedforward: Width,
        resolution: Count,
        patch: Count,
        expert_width: Width,
        expert_feedforward: Width,
        action_width: Width,
    ) -> None:
        super().__init__()
        require_multiple("vision_width", vision_width, "vision_heads", vision_heads)
        require_multiple("resolution", resolution, "patch", patch)
        require_multiple("head_width", head_width, "for pairs of a sine and a cosine", 2)
        require_multiple("expert_width", expert_width, "for pairs of a sine and a cosine", 2)
        self.vocabulary, self.resolution, self.action_width = vocabulary, resolution, action_width
        self.width, self.head_width, self.expert_width = width, head_width, expert_width
        # Sizes under their names in transformers: those shared by trunk and expert, and those of each part.
        self.shared = {"num_attention_heads": heads, "head_dim": head_width, "num_hidden_layers": layers}
        self.text = {"vocab_size": vocabulary, **sizes(width, feedforward)}
        self.vision = {"num_hidden_layers": vision_layers, "num_attention_heads": vision_heads, "patch_size": patch}
        self.vision |= {"image_size": resolution, **sizes(vision_width, vision_feedforward)}
        self.expert_sizes = sizes(expert_width, expert_feedforward)

    def options(self) -> dict[str, Any]:
        """Return the options by which LeRobot describes this network, where they differ from its defaults."""
        return {}

    @abstractmethod
    def prefix(self, images: Tensor, cameras: Tensor, tokens: Tensor, sentence: Tensor, state: Tensor | None) -> Prefix:
        """Encode what is known before actions are chosen.

        Args:
            images: (B, C, 3, H, W) float32 in -1 … 1, of `resolution`.
            cameras: (B, C) bool, false where a camera is missing.
            tokens: (B, L) int64.
            sentence: (B, L) bool, false for padding at the end.
            state: (B, S) float32, normalised and padded; None where `state_width` is 0.
        """

    @abstractmethod
    def velocity(self, prefix: Prefix, noisy: Tensor, time: Tensor) -> Tensor:
        """Predict the velocity, (B, k, A) float32, of (B, k, A) noisy actions.

        Time is 1 for noise and 0 for actions: (B,), or (B, k) with one per action.
        """


def rename_weight(name: str, beginnings: Iterable[tuple[str, str]]) -> str:
    """Return a published name as it is here, given pairs of how names begin there and here."""
    for published_prefix, own_prefix in beginnings:
        if name.startswith(published_prefix):
            return own_prefix + name.removeprefix(published_prefix)
    return name


def time_embedding(time: Tensor, width: int, precision: torch.dtype) -> Tensor:
    """Embed times (…) in 0 … 1 as sines and cosines, (…, width), whose angles are computed in a `precision`."""
    steps = torch.linspace(0, 1, width // 2, dtype=precision, device=time.device)
    angles = time.unsqueeze(-1) * (1 / (MIN_PERIOD * (MAX_PERIOD / MIN_PERIOD) ** steps) * 2 * math.pi)
    return torch.cat([angles.sin(), angles.cos()], -1)


def with_time(hidden: Tensor, time: Tensor, mix: tuple[nn.Module, nn.Module], precision: torch.dtype) -> Tensor:
    """Fuse (B, k, F) actions with their times, (B,) or (B, k), by an MLP of two layers; returns (B, k, F)."""
    clock = time_embedding(time, hidden.shape[-1], precision).to(hidden.dtype)
    clock = (clock if time.dim() == 2 else clock.unsqueeze(1)).expand_as(hidden)
    return mix[1](nn.functional.silu(mix[0](torch.cat([hidden, clock], -1))))


def sizes(width: int, feedforward: int) -> dict[str, int]:
    """Return the sizes of the layers of a transformer under their names in the package transformers."""
    return {"hidden_size": width, "intermediate_size": feedforward}


def require_multiple(name: str, value: int, of: str, unit: int) -> None:
    """Raise a UserError unless a size is a multiple of another."""
    if value % unit:
        raise UserError(f"model.network.{name}={value} must be a multiple of {unit}, {of}")
