"""LeRobot's SmolVLA as the floor of a plan of ours, with equal weights, images, noise and number of threads.

    make .venv/parity/lerobot-0.4.4
    OMP_NUM_THREADS=1 PYTHONPATH=.venv/parity/lerobot-0.4.4:tools/parity:tests:. python -m vla.run job=benchmark \\
      benchmark.names=[policy] +benchmark.peer._target_=smolvla_peer.Peer +benchmark.peer._partial_=true \\
      trust=[smolvla_peer] model=smolvla model.text.name=null
"""

from __future__ import annotations

from copy import deepcopy
from types import SimpleNamespace
from typing import Any

import lerobot_modules  # first: it makes the imports of LeRobot possible  # noqa: F401
import torch
import torch.nn.functional as F
from lerobot.policies.smolvla import smolvlm_with_expert
from lerobot.policies.smolvla.configuration_smolvla import SmolVLAConfig
from lerobot.policies.smolvla.modeling_smolvla import VLAFlowMatching
from tiny_vla import published
from torch import Tensor
from transformers import SmolVLMConfig

from vla.models.layers import Batch
from vla.models.vlm.policy import VisionLanguageAction
from vla.models.vlm.prompt import PADDING

LENGTH = 48  # to which LeRobot pads prompts


def without_hub(trunk: SmolVLMConfig) -> None:
    """Give LeRobot's class the trunk's configuration in place of the hub's."""
    smolvlm_with_expert.AutoConfig = SimpleNamespace(from_pretrained=lambda *_: deepcopy(trunk))
    tokens = SimpleNamespace(fake_image_token_id=3, global_image_token_id=4)
    smolvlm_with_expert.AutoProcessor = SimpleNamespace(from_pretrained=lambda *_: SimpleNamespace(tokenizer=tokens))


def their_network(trunk: SmolVLMConfig, chunk: int) -> VLAFlowMatching:
    """LeRobot's network with random weights, of which nothing is frozen."""
    without_hub(trunk)
    frozen = {"freeze_vision_encoder": False, "train_expert_only": False}
    length = {"chunk_size": chunk, "n_action_steps": chunk, "num_vlm_layers": trunk.text_config.num_hidden_layers}
    return VLAFlowMatching(SmolVLAConfig(**length, **frozen, device="cpu")).eval()


class Peer:
    """`VLAFlowMatching.sample_actions` in place of the network; the way there and back is ours."""

    def __init__(self, model: VisionLanguageAction) -> None:
        vlm: Any = model.network.vlm
        self.model, self.network = model, their_network(vlm.config, model.chunk)
        parameters = dict(self.network.named_parameters())
        with torch.no_grad():
            for name, weight in published(model.network):
                parameters[name].copy_(weight)

    def __call__(self, window: Batch) -> Tensor:
        """Return the actions of a window, (1, k, D)."""
        model = self.model
        images = [model.image(window["rgb"][camera][:, -1]) for camera in model.cameras]
        state = model.state_normalizer(window["state"][:, -1].index_select(-1, model.robot_state.pose))
        tokens = F.pad(window["text"], (0, LENGTH - window["text"].shape[1]), value=PADDING)
        padded_state = F.pad(state, (0, model.network.state_width - state.shape[-1]))
        masks = [image.new_ones(len(image), dtype=torch.bool) for image in images]
        inputs = images, masks, tokens.clamp(min=0), tokens != PADDING, padded_state
        actions = self.network.sample_actions(*inputs, noise=model.noise[None])
        return model.action_normalizer.inverse(actions[..., : len(model.spec.action)])
