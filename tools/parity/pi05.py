"""Compares π0 and π0.5 with LeRobot's own, of equal weights, noise and times, and writes what the tests compare with.

Of π0.5 the network, and of both the way around it: images, prompts, normalised states and actions, and commands made of
raw observations. LeRobot 0.6 with transformers 5.5 are in a folder of their own:

    PYTHONPATH=FOLDER:.:tests python tools/parity/pi05.py
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any

import lerobot_modules  # first: it makes the imports of LeRobot possible
import newer_python  # noqa: F401
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies.pi0 import modeling_pi0
from lerobot.policies.pi0.configuration_pi0 import PI0Config
from lerobot.policies.pi0.processor_pi0 import make_pi0_pre_post_processors
from lerobot.policies.pi05 import modeling_pi05
from lerobot.policies.pi05.configuration_pi05 import PI05Config
from lerobot.policies.pi05.processor_pi05 import make_pi05_pre_post_processors
from lerobot.processor import tokenizer_processor
from references import TOLERANCE, lerobot_results, write
from safetensors.torch import load_file
from tiny_pi import CHUNK, LENGTHS, SIZES, STATE_WIDTH, STATISTICS, STEPS, TASKS, inputs, observed, tokenizer
from tiny_vla import deviation, fill
from torch import Tensor
from transformers import GemmaConfig, PaliGemmaConfig, PreTrainedTokenizerFast

CAMERAS = ("front", "side", "wrist")  # nobody has the last one
GRADIENTS = {  # of the network, by its names here → LeRobot's
    "paligemma.vision_tower.encoder.layers.0.mlp.fc1.weight": "paligemma.model.vision_tower.vision_model.",
    "paligemma.language_model.layers.0.self_attn.v_proj.weight": "paligemma.model.",
    "expert.layers.1.input_layernorm.dense.weight": "gemma_expert.model.",
}
LEROBOT: dict[str, tuple[Any, Any, Any, Any]] = {  # module, policy, its configuration and its processors
    "pi0": (modeling_pi0, modeling_pi0.PI0Policy, PI0Config, make_pi0_pre_post_processors),
    "pi05": (modeling_pi05, modeling_pi05.PI05Policy, PI05Config, make_pi05_pre_post_processors),
}


def their_policy(name: str) -> Any:
    """LeRobot's policy with a network of other sizes."""
    module, kind, config_class, _ = LEROBOT[name]
    original = module.PaliGemmaForConditionalGenerationWithPiGemma

    def trunk(config: Any) -> Any:
        """Without the sizes that it sets in any case."""
        config.vision_config.projection_dim = config.text_config.hidden_size
        config.vision_config.intermediate_size = SIZES["vision_feedforward"]
        config.text_config.vocab_size = SIZES["vocabulary"]
        return original(config=config)

    vision = {
        **{"hidden_size": SIZES["vision_width"], "num_hidden_layers": SIZES["vision_layers"]},
        **{"num_attention_heads": SIZES["vision_heads"], "patch_size": SIZES["patch"], "vision_use_head": False},
    }
    gemma = module.GemmaConfig
    heads = (SIZES["layers"], SIZES["heads"], SIZES["head_width"])
    module.PaliGemmaForConditionalGenerationWithPiGemma = trunk
    module.CONFIG_MAPPING = {
        "paligemma": lambda: PaliGemmaConfig(vision_config={"model_type": "siglip_vision_model", **vision}),
        "gemma": lambda **options: GemmaConfig(**{**options, "vocab_size": SIZES["vocabulary"]}),
    }
    module.get_gemma_config = lambda variant: gemma(
        **{"depth": heads[0], "num_heads": heads[1], "num_kv_heads": 1, "head_dim": heads[2]},
        width=SIZES["width" if variant == "gemma_2b" else "expert_width"],
        mlp_dim=SIZES["feedforward" if variant == "gemma_2b" else "expert_feedforward"],
    )
    size = SIZES["resolution"]
    images = {f"observation.images.{name}": PolicyFeature(FeatureType.VISUAL, (3, size, size)) for name in CAMERAS}
    state = {"observation.state": PolicyFeature(FeatureType.STATE, (5,))}
    config = config_class(
        **{"chunk_size": CHUNK, "n_action_steps": CHUNK, "max_action_dim": SIZES["action_width"], "device": "cpu"},
        **{"num_inference_steps": STEPS, "image_resolution": (size, size), "tokenizer_max_length": LENGTHS[name]},
        max_state_dim=STATE_WIDTH,
        input_features={**images, **state},
        output_features={"action": PolicyFeature(FeatureType.ACTION, (5,))},
    )
    policy = kind(config).eval()
    fill((name.removeprefix("model."), weight) for name, weight in policy.state_dict().items())
    trunk = policy.model.paligemma_with_expert.paligemma
    trunk.model.language_model.embed_tokens.weight.data.copy_(trunk.lm_head.weight)  # one matrix is published as both
    return policy


def network_results(theirs: Any) -> dict[str, Tensor]:
    """Return what the network computes, see `lerobot_results`."""
    gradients = {
        name: f"paligemma_with_expert.{prefix}{name.partition('.')[2].removeprefix('vision_tower.')}"
        for name, prefix in GRADIENTS.items()
    }
    return lerobot_results(theirs, ("tokens", "sentence"), inputs(), gradients)


def without_hub() -> None:
    """Give LeRobot's processors our tokenizer in place of the hub's."""
    reader = PreTrainedTokenizerFast(tokenizer_object=tokenizer(), pad_token="<pad>")
    tokenizer_processor.AutoTokenizer = SimpleNamespace(from_pretrained=lambda name: reader)


def raw() -> dict[str, Any]:
    """Return the observations as LeRobot's processors take them."""
    batch = observed()
    images = {
        f"observation.images.{camera}": values.permute(0, 3, 1, 2).float() / 255
        for camera, values in zip(CAMERAS, batch["images"], strict=False)
    }
    return {**images, "observation.state": batch["state"], "action": batch["actions"], "task": [*TASKS]}


def way_results(name: str, policy: Any) -> dict[str, Tensor]:
    """Return what LeRobot makes of raw observations, and the commands it makes of what the network answers."""
    raw_batch = observed()
    statistics = {
        feature: {
            statistic: raw_batch[f"{feature.rpartition('.')[2]}.{quantile}"]
            for statistic, quantile in zip(STATISTICS[name], ("q01", "q99"), strict=True)
        }
        for feature in ("observation.state", "action")
    }
    preprocess, postprocess = LEROBOT[name][-1](policy.config, statistics)
    batch = preprocess(raw())
    pictures, masks = policy._preprocess_images(batch)
    return {
        "way.image": pictures[0],
        "way.present": torch.stack(masks, 1),
        "way.tokens": batch["observation.language.tokens"],
        "way.sentence": batch["observation.language.attention_mask"],
        "way.state": batch["observation.state"],
        "way.actions": policy.prepare_action(batch),
        "way.commands": postprocess(policy.predict_action_chunk(batch, noise=raw_batch["noise"])),
    }


def exported_results(name: str, folder: Path) -> Tensor:
    """Return the commands of LeRobot's policy and processors that are loaded from what is exported here."""
    # With the newer transformers of this project, in which modules of the image encoder have other names.
    code = f"from tiny_pi import *; export({name!r}, Path({str(folder)!r}))"
    path = os.environ["PYTHONPATH"].partition(os.pathsep)[2]
    subprocess.run([sys.executable, "-c", code], env={**os.environ, "PYTHONPATH": path}, check=True)
    policy = LEROBOT[name][1].from_pretrained(folder / "exported")
    state, tensors = policy.state_dict(), load_file(folder / "exported/model.safetensors")
    assert all(torch.equal(state[weight], tensor.float()) for weight, tensor in tensors.items())
    # That is the same matrix as that of the head.
    missing_weights = {"model.paligemma_with_expert.paligemma.model.language_model.embed_tokens.weight"}
    assert state.keys() - tensors.keys() == missing_weights
    preprocess, postprocess = lerobot_modules.processors_of(folder / "exported")
    return postprocess(policy.predict_action_chunk(preprocess(raw()), noise=observed()["noise"]))


def main() -> None:
    """Write what LeRobot computes, and print how far it is from what was written before."""
    without_hub()
    for name in LEROBOT:
        policy = their_policy(name)
        network_part = network_results(policy.model) if name == "pi05" else {}
        results = {**network_part, **way_results(name, policy)}
        write("pi05" if network_part else "pi0_policy", results)
        with TemporaryDirectory() as folder:
            error = deviation(exported_results(name, Path(folder)), results["way.commands"])
            print(f"{name}: commands of our export {error:.1e}")
            assert error <= TOLERANCE


if __name__ == "__main__":
    main()
