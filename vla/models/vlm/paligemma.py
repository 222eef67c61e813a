"""PaliGemma with an action expert: a narrower Gemma whose layers attend to the keys and values of PaliGemma too.

The trunk of π0 (K. Black et al., "π0: A Vision-Language-Action Flow Model for General Robot Control", arXiv 2410.24164)
and of π0.5 (Physical Intelligence, "π0.5: a Vision-Language-Action Model with Open-World Generalization", arXiv
2504.16054). Attention is block-wise: images and sentence attend to each other, actions to these and to each other.

Shapes: B batch, C cameras, L tokens of the sentence, N tokens of any kind, P tokens of the prefix, k action chunk, A
components of a padded action, E width of a token, H width of a head.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn
from transformers import GemmaConfig, GemmaModel, PaliGemmaConfig, PaliGemmaModel, SiglipVisionConfig
from transformers.models.gemma.modeling_gemma import GemmaDecoderLayer

from vla.io.types import Inherited
from vla.models.vlm.network import FlowNetwork, KeyValueMixin, Prefix, return_keys, shorten

NAMES = (  # of weights, published and here
    ("paligemma_with_expert.paligemma.lm_head.", "paligemma.language_model.embed_tokens."),  # one matrix is both
    ("paligemma_with_expert.paligemma.model.vision_tower.vision_model.", "paligemma.vision_tower."),
    ("paligemma_with_expert.paligemma.model.", "paligemma."),
    ("paligemma_with_expert.gemma_expert.model.", "expert."),
    ("", ""),
)
TRUNK = (  # the same of PaliGemma alone
    ("language_model.model.", "paligemma.language_model."),
    ("vision_tower.vision_model.", "paligemma.vision_tower."),
    ("multi_modal_projector.", "paligemma.multi_modal_projector."),
)
HEADS = ("model.", "")  # of published names: what LeRobot saves begins with the former, what openpi saves does not


class _GemmaLayer(KeyValueMixin, GemmaDecoderLayer):
    """A layer of Gemma."""


class PaliGemmaWithExpert(FlowNetwork):
    """What π0 and π0.5 share: the trunk, the expert, and attention between them.

    All query heads share one key-value head, and every patch becomes a token.
    """

    published_names = tuple((f"{head}{prefix}", own_prefix) for head in HEADS for prefix, own_prefix in NAMES)
    trunk_names = TRUNK
    unused_names = tuple(f"{head}paligemma_with_expert.gemma_expert.lm_head." for head in HEADS)

    def __init__(self, **inherited: Inherited) -> None:
        super().__init__(**inherited)
        self.state_width, self.value_width, self.unused_width = 0, self.head_width, self.expert_width
        shared = {**self.shared, "num_key_value_heads": 1}
        self.paligemma = _trunk({**shared, **self.text}, self.vision)
        self.expert = _expert({**shared, **self.expert_sizes})
        self.action_in_proj = nn.Linear(self.action_width, self.expert_width)
        self.action_out_proj = nn.Linear(self.expert_width, self.action_width)

    def options(self) -> dict[str, Any]:
        """Return LeRobot's options of this network; its other sizes are fixed in LeRobot."""
        return {"image_resolution": [self.resolution] * 2}

    def prefix(self, images: Tensor, cameras: Tensor, tokens: Tensor, sentence: Tensor, state: Tensor | None) -> Prefix:
        """Encode images and sentence; absent tokens are masked, and positions do not count them."""
        patches = self.paligemma.get_image_features(images.flatten(0, 1)).pooler_output.unflatten(0, images.shape[:2])
        words = self.paligemma.language_model.embed_tokens(tokens)  # which scales by the square root of its width
        present = torch.cat([cameras.repeat_interleave(patches.shape[2], 1), sentence], 1)
        hidden = torch.cat([patches.flatten(1, 2), words], 1)
        return self.attend(self.paligemma.language_model, hidden, present, None)[1]

    def attend(
        self, gemma: GemmaModel, hidden: Tensor, present: Tensor, prefix: Prefix | None, **condition: Tensor
    ) -> tuple[Tensor, Prefix]:
        """Pass tokens through the layers of a Gemma, in which they attend to each other and to the prefix.

        Args:
            gemma: with layers like those of the trunk.
            hidden: (B, N, E).
            present: (B, N) bool, false for padding.
            prefix: preceding tokens, to which they attend too; None: there are none.
            condition: further arguments of every layer.

        Returns:
            The tokens, (B, N, E), not normalised, and a prefix of all that they attended to.
        """
        key_mask = present if prefix is None else torch.cat([prefix.present, present], 1)  # (B, P + N)
        positions = key_mask.cumsum(1)[:, -hidden.shape[1] :] - 1
        rotation = self.paligemma.language_model.rotary_emb(hidden, positions)
        mask = key_mask[:, None, None, :].expand(-1, 1, hidden.shape[1], -1)
        keys, values = [], []
        for number, layer in enumerate(gemma.layers):
            pair = None if prefix is None else (prefix.keys[number], prefix.values[number])
            attention = {"attention_mask": mask, "position_embeddings": rotation, "past": pair}
            hidden, layer_keys, layer_values = layer(hidden, **attention, **condition)
            keys.append(layer_keys)
            values.append(layer_values)
        return hidden, Prefix(tuple(keys), tuple(values), key_mask)


def _trunk(text: dict[str, Any], vision: dict[str, Any]) -> PaliGemmaModel:
    """Build vision_tower, multi_modal_projector and language_model."""
    encoder = SiglipVisionConfig(**vision, vision_use_head=False)
    width = text["hidden_size"]
    trunk = PaliGemmaModel(
        PaliGemmaConfig(vision_config=encoder, text_config=GemmaConfig(**text), projection_dim=width)
    )
    shorten(trunk.language_model, _GemmaLayer)
    return trunk


def _expert(sizes: dict[str, int]) -> GemmaModel:
    """Build the expert, whose input is not text."""
    # The ids of special tokens must be within the vocabulary even so.
    expert = GemmaModel(GemmaConfig(**sizes, vocab_size=1, pad_token_id=0, bos_token_id=0, eos_token_id=0))
    del expert.embed_tokens
    return_keys(expert, _GemmaLayer)
    return expert
