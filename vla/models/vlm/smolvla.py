"""SmolVLA: a small vision-language model, and an action expert that attends to it layer by layer.

M. Shukor et al., "SmolVLA: A Vision-Language-Action Model for Affordable and Efficient Robotics", arXiv 2506.01844.

Shapes: B batch, C cameras, L tokens of the sentence, N tokens of any kind, P tokens of the prefix, k action chunk, A
components of a padded action, E width of the trunk, F width of the expert, H width of a head, S padded state.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from transformers import LlamaConfig, LlamaModel, SmolVLMConfig, SmolVLMModel
from transformers.models.llama.modeling_llama import LlamaAttention, LlamaDecoderLayer, apply_rotary_pos_emb

from vla.io.errors import UserError
from vla.io.types import Count, Inherited, Layers, Natural, Width
from vla.models.vision.image_tokenizer import ImageEncoder, Keypoints
from vla.models.vlm.network import (
    FlowNetwork,
    KeyValueMixin,
    Prefix,
    Rotation,
    require_multiple,
    shorten,
    sizes,
    with_time,
)

ROPE_BASE = 10_000.0  # of the policy, whatever that of the language model was
EPSILON = 1e-5  # of RMS norms
NO_TOKENS: dict[str, None] = {"bos_token_id": None, "eos_token_id": None}  # nothing is generated


class SmolVLA(FlowNetwork):
    """The first layers of SmolVLM2 and an action expert of equally many layers, which read their keys and values.

    In every layer whose number is a multiple of `joint_every`, actions attend to the prefix and causally to themselves;
    in the others to the prefix alone, through projections of its keys and values that are computed once per plan. In
    the prefix, images and sentence see each other, and the state, which comes last, sees all.

    Args:
        key_heads: number of key-value heads of the language model, each shared by several query heads.
        shuffle: this many by this many neighbouring patches become one token.
        image: factory of an image encoder, conditioned on the sum of the word embeddings, for `keypoints`.
        keypoints: number of keypoint tokens per image, in place of those of the vision transformer, which from random
            weights needs many more images until it locates objects; 0: none, as in published weights.
        joint_every: 1: no layer attends to the prefix alone.
        state_width: S.

    Raises:
        UserError: sizes do not divide each other, or keypoints have no image encoder.
    """

    kind = "smolvla"
    causal = True
    published_names = (
        ("model.vlm_with_expert.vlm.model.", "vlm."),
        ("model.vlm_with_expert.lm_expert.", "expert."),
        ("model.", ""),
    )
    trunk_names = (("model.", "vlm."),)
    unused_names = ("model.vlm_with_expert.vlm.lm_head.",)

    def __init__(
        self,
        key_heads: Layers,
        shuffle: Count,
        image: Callable[..., ImageEncoder] | None,
        keypoints: Natural,
        joint_every: Layers,
        state_width: Width,
        **inherited: Inherited,
    ) -> None:
        super().__init__(**inherited)
        require_multiple("heads", self.shared["num_attention_heads"], "key_heads", key_heads)
        require_multiple("resolution", self.resolution, "patch times shuffle", self.vision["patch_size"] * shuffle)
        self.state_width, self.joint_every, self.value_width = state_width, joint_every, key_heads * self.head_width
        self.unused_width = self.width
        shared = {**self.shared, "num_key_value_heads": key_heads, "rms_norm_eps": EPSILON, **NO_TOKENS}
        self.vlm = _trunk({**shared, **self.text}, self.vision, shuffle)
        self.keypoints: _KeypointTokens | None = None
        if keypoints:
            if image is None:
                raise UserError(f"model.network.keypoints={keypoints} needs an image encoder in model.network.image")
            self.keypoints = _KeypointTokens(image, keypoints, self.width)
            nn.init.normal_(self.vlm.text_model.embed_tokens.weight, std=self.width**-0.5)  # scale of keypoint tokens
            del self.vlm.vision_model, self.vlm.connector
        self.expert = _expert(shared, joint_every, **self.expert_sizes)
        self.state_proj = nn.Linear(state_width, self.width)
        self.action_in_proj = nn.Linear(self.action_width, self.expert_width)
        self.action_out_proj = nn.Linear(self.expert_width, self.action_width)
        self.action_time_mlp_in = nn.Linear(2 * self.expert_width, self.expert_width)
        self.action_time_mlp_out = nn.Linear(self.expert_width, self.expert_width)

    def options(self) -> dict[str, Any]:
        """Return LeRobot's options of this network, with the width of the expert as a multiple of the trunk's.

        Raises:
            UserError: the network has keypoint tokens, which LeRobot's lacks.
        """
        if self.keypoints is not None:
            raise UserError("LeRobot's SmolVLA sees no keypoints: train with model.network.keypoints=0")
        ratio = self.action_in_proj.out_features / self.state_proj.out_features
        layers = {"num_vlm_layers": len(self.expert.layers), "self_attn_every_n_layers": self.joint_every}
        return {**layers, "expert_width_multiplier": ratio, "resize_imgs_with_padding": [self.resolution] * 2}

    def prefix(self, images: Tensor, cameras: Tensor, tokens: Tensor, sentence: Tensor, state: Tensor | None) -> Prefix:
        """Encode images, sentence and state; every layer of the expert gets keys and values as it uses them."""
        assert state is not None
        words = self.vlm.text_model.embed_tokens(tokens)
        words = words * math.sqrt(words.shape[-1])
        image_tokens = self._encode_images(images, words, sentence)  # (B, C, N, E)
        present = cameras.repeat_interleave(image_tokens.shape[2], 1)
        hidden = torch.cat([image_tokens.flatten(1, 2), words, self.state_proj(state).unsqueeze(1)], 1)
        present = torch.cat([present, sentence, sentence.new_ones(len(sentence), 1)], 1)  # (B, P)
        mask = present[:, None, None, :].repeat(1, 1, present.shape[1], 1)  # (B, 1, P, P)
        mask[:, :, :-1, -1] = False  # only the state sees the state
        rotation, pairs = rotation_of(present.cumsum(1) - 1, self.head_width), []
        for layer, expert in zip(self.vlm.text_model.layers, self.expert.layers, strict=True):
            hidden, *pair = layer(hidden, attention_mask=mask, position_embeddings=rotation)
            pairs.append(pair if expert.self_attn.joint else expert(None, prefix=pair))
        return Prefix(tuple(keys for keys, _ in pairs), tuple(values for _, values in pairs), present)

    def _encode_images(self, images: Tensor, words: Tensor, sentence: Tensor) -> Tensor:
        """Return tokens of (B, C, 3, H, W) images, (B, C, N, E); keypoints depend on the (B, L, E) words, too."""
        flat_images = images.flatten(0, 1)
        if self.keypoints is not None:
            word_sum = (words * sentence.unsqueeze(-1)).sum(1)
            image_tokens = self.keypoints(flat_images, word_sum.repeat_interleave(images.shape[1], 0))
        else:
            patches = self.resolution // self.vision["patch_size"]
            mask = sentence.new_ones(len(flat_images), patches, patches)  # by default it is made on the CPU and copied
            features = self.vlm.vision_model(pixel_values=flat_images, patch_attention_mask=mask)
            image_tokens = self.vlm.connector(features.last_hidden_state)
            image_tokens = image_tokens * math.sqrt(image_tokens.shape[-1])
        return image_tokens.unflatten(0, images.shape[:2])

    def velocity(self, prefix: Prefix, noisy: Tensor, time: Tensor) -> Tensor:
        """Predict the velocity of (B, k, A) noisy actions at times (B,) or (B, k)."""
        hidden, count = self.action_in_proj(noisy), noisy.shape[1]
        hidden = with_time(hidden, time, (self.action_time_mlp_in, self.action_time_mlp_out), torch.float64)
        places = torch.arange(count, device=noisy.device)
        joint_rotation = rotation_of(prefix.present.sum(1, keepdim=True) + places, self.head_width)
        cross_rotation = rotation_of(places.unsqueeze(0), self.head_width)
        prefix_mask = prefix.present[:, None, None, :].expand(-1, 1, count, -1)
        causal_mask = (places[:, None] >= places).expand(len(noisy), 1, count, count)
        joint_mask = torch.cat([prefix_mask, causal_mask], -1)  # (B, 1, k, P + k)
        for layer, keys, values in zip(self.expert.layers, prefix.keys, prefix.values, strict=True):
            mask, rotation = (joint_mask, joint_rotation) if layer.self_attn.joint else (prefix_mask, cross_rotation)
            hidden = layer(hidden, attention_mask=mask, position_embeddings=rotation, prefix=(keys, values))
        return self.action_out_proj(self.expert.norm(hidden).float())


class _KeypointTokens(nn.Module):
    """Keypoints of an image as tokens, each with an embedding of its number.

    Args:
        image: factory of the image encoder, which is conditioned on the sentence.
        keypoints: M.
        width: E.
    """

    def __init__(self, image: Callable[..., ImageEncoder], keypoints: int, width: int) -> None:
        super().__init__()
        self.sentence = nn.LayerNorm(width)
        self.encoder = image(text_width=width)
        self.keypoints = Keypoints(self.encoder.channels, keypoints)
        self.tokens = nn.Linear(self.keypoints.width, width)
        self.number = nn.Parameter(torch.randn(keypoints, width))

    def forward(self, images: Tensor, words: Tensor) -> Tensor:
        """Map (B, 3, H, W) images in -1 … 1 to (B, M, E), given the (B, E) sum of the words of a sentence."""
        features = self.encoder((images + 1) / 2, self.sentence(words))
        return self.tokens(self.keypoints(features)) + self.number


class _TrunkLayer(KeyValueMixin, LlamaDecoderLayer):
    """A layer of the trunk."""


class _ExpertLayer(LlamaDecoderLayer):
    """A layer of the expert."""

    def forward(self, hidden_states: Tensor | None, prefix: tuple[Tensor, Tensor], **attention: Any) -> Any:
        """Process (B, k, F) tokens; without tokens, return the keys and values of the prefix that they will attend to,
        here because FSDP gathers the weights of a layer for its `forward` only."""
        if hidden_states is None:
            return self.self_attn.read(*prefix)
        return super().forward(hidden_states, prefix=prefix, **attention)


class _ExpertAttention(LlamaAttention):
    """Attention of actions to the prefix and, if `joint`, to each other, by keys and values of their own."""

    def __init__(self, config: LlamaConfig, layer: int, *, joint: bool) -> None:
        super().__init__(config, layer)
        self.joint = joint
        if not joint:
            width = config.num_key_value_heads * self.head_dim
            self.k_proj, self.v_proj = (nn.Linear(width, width, bias=False) for _ in range(2))

    def read(self, keys: Tensor, values: Tensor) -> tuple[Tensor, Tensor]:
        """Return keys and values of the prefix, (B, heads, P, H) each, as `forward` takes them if it is not joint."""
        return self._split_heads(self.k_proj(_join_heads(keys))), self._split_heads(self.v_proj(_join_heads(values)))

    def forward(
        self,
        hidden_states: Tensor,
        position_embeddings: Rotation,
        attention_mask: Tensor,
        prefix: tuple[Tensor, Tensor],
        **_: Any,
    ) -> tuple[Tensor, None]:
        """Attend from (B, k, F) with a (B, 1, k, P) mask, or (B, 1, k, P + k) if it is joint."""
        query, (keys, values) = self._split_heads(self.q_proj(hidden_states)), prefix
        own_keys = self._split_heads(self.k_proj(hidden_states)) if self.joint else query
        query, own_keys = apply_rotary_pos_emb(query, own_keys, *position_embeddings)
        if self.joint:
            keys = torch.cat([keys, own_keys], 2)
            values = torch.cat([values, self._split_heads(self.v_proj(hidden_states))], 2)
        output = F.scaled_dot_product_attention(query, keys, values, attention_mask, enable_gqa=True)
        return self.o_proj(_join_heads(output)), None

    def _split_heads(self, features: Tensor) -> Tensor:
        return features.unflatten(-1, (-1, self.head_dim)).transpose(1, 2)


def _trunk(text: dict[str, Any], vision: dict[str, Any], shuffle: int) -> SmolVLMModel:
    """Build vision_model, connector and text_model."""
    config = SmolVLMConfig(text_config={"model_type": "llama", **text}, vision_config=vision, scale_factor=shuffle)
    trunk = SmolVLMModel(config)
    shorten(trunk.text_model, _TrunkLayer)
    return trunk


def _expert(shared: dict[str, Any], joint_every: int, hidden_size: int, intermediate_size: int) -> LlamaModel:
    """Build the expert, whose input is not text."""
    # The heads need not add up to its width, though the validation of `LlamaConfig` demands it.
    config = LlamaConfig(**shared, vocab_size=1, **sizes(shared["num_attention_heads"], intermediate_size))
    config.hidden_size = hidden_size
    expert = LlamaModel(config)
    del expert.embed_tokens
    for number, layer in enumerate(expert.layers):
        layer.self_attn = _ExpertAttention(config, number, joint=number % joint_every == 0)
        layer.__class__ = _ExpertLayer
    return expert


def rotation_of(positions: Tensor, width: int) -> Rotation:
    """Return the rotary embedding of (B, N) positions for heads of `width`."""
    exponents = 2.0 / width * torch.arange(width // 2, dtype=torch.float32, device=positions.device)
    angles = (positions.unsqueeze(-1).float() / ROPE_BASE**exponents).repeat(1, 1, 2)
    return angles.cos(), angles.sin()


def _join_heads(by_head: Tensor) -> Tensor:
    """Join the heads of (B, heads, N, H)."""
    return by_head.transpose(1, 2).flatten(2)
