"""π0 and π0.5 of some ten thousand weights, and what they are compared on.

Shapes: B batch, C cameras, L tokens, k action chunk, A padded action, S padded state.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from defaults import defaults_of, part_of
from fake_batch import as_policy
from tiny_vla import fill, published
from tokenizers import Tokenizer
from tokenizers.models import BPE
from tokenizers.normalizers import Replace
from tokenizers.processors import TemplateProcessing
from torch import Tensor

from vla.models.tokenizers.tokenizer import Uniform
from vla.models.vlm.lerobot_export import LeRobotPolicyExporter
from vla.models.vlm.network import FlowNetwork
from vla.models.vlm.pi0 import PI0
from vla.models.vlm.pi05 import PI05
from vla.models.vlm.policy import VisionLanguageAction
from vla.models.vlm.prompt import WORDS, Prompt
from vla.spec import Spec

# Arguments of the networks; LeRobot's has eight heads at any size.
SIZES: dict[str, Any] = {
    **{"vocabulary": 128, "width": 64, "layers": 2, "heads": 8, "head_width": 8, "feedforward": 96},
    **{"vision_width": 32, "vision_layers": 2, "vision_heads": 4, "vision_feedforward": 48},
    **{"resolution": 28, "patch": 14, "expert_width": 32, "expert_feedforward": 48, "action_width": 8},
}
STATE_WIDTH = 8  # of π0
CHUNK, STEPS = 10, 10
LENGTHS = {"pi0": 16, "pi05": 56}  # of a prompt, for which one of `TASKS` is too long
STATISTICS = {"pi0": ("mean", "std"), "pi05": ("q01", "q99")}
KINDS: dict[str, type[FlowNetwork]] = {"pi0": PI0, "pi05": PI05}

# Of the whole way from an observation to a command: state and action are narrower than what they are padded to.
COMPONENTS = ("x", "y", "z", "yaw", "gripper")
SPEC = Spec(
    cameras=("front", "side"),
    image_size=(36, 48),
    state=COMPONENTS,
    state_units=("m", "m", "m", "rad", "m"),
    action=COMPONENTS,
    units=("m", "m", "m", "rad", "1"),
    low=(-1.0,) * 5,
    high=(1.0,) * 5,
    control_hz=10.0,
)
TASKS = ("  pick_up the red\nblock ", "open the drawer")
CHARACTERS = "\n ,.:;-_0123456789abcdefghijklmnopqrstuvwxyzATS▁"


def inputs() -> dict[str, Tensor]:
    """What a network is given: the second row has a camera less and a shorter sentence."""
    random = np.random.default_rng(0)
    size, width = SIZES["resolution"], SIZES["action_width"]
    sentence, cameras = torch.ones(2, 8, dtype=torch.bool), torch.ones(2, 2, dtype=torch.bool)
    sentence[1, 5:], cameras[1, 1] = False, False
    given = {
        "images": random.uniform(-1, 1, (2, 2, 3, size, size)),
        "state": random.standard_normal((2, STATE_WIDTH)),
        "actions": random.standard_normal((2, CHUNK, width)),
        "noise": random.standard_normal((2, CHUNK, width)),
        "time": np.array([0.3, 0.993]),
    }
    tokens = torch.from_numpy(random.integers(3, SIZES["vocabulary"] - 1, (2, 8)))
    floats = {name: torch.from_numpy(values).float() for name, values in given.items()}
    return {**floats, "tokens": tokens, "sentence": sentence, "cameras": cameras}


def observed() -> dict[str, Tensor]:
    """Raw observations and actions, and the quantiles of their datasets; one component never changes."""
    random = np.random.default_rng(1)
    rows, low, high = len(TASKS), random.uniform(-3, -1, (2, 5)), random.uniform(1, 3, (2, 5))
    high[0, 4] = low[0, 4]
    state = random.uniform(-3.5, 3.5, (rows, 5))
    state[:, 4] = low[0, 4]
    given = {
        "state": state,
        "actions": random.uniform(-3.5, 3.5, (rows, CHUNK, 5)),
        "noise": random.standard_normal((rows, CHUNK, SIZES["action_width"])),
        **{"state.q01": low[0], "state.q99": high[0], "action.q01": low[1], "action.q99": high[1]},
    }
    images = torch.from_numpy(random.integers(0, 256, (2, rows, 36, 48, 3), dtype=np.uint8))
    return {"images": images, **{name: torch.from_numpy(values).float() for name, values in given.items()}}


def tokenizer() -> Tokenizer:
    """A tokenizer of characters, which begins a sentence and writes a space as PaliGemma's does."""
    special = ["<pad>", "<eos>", "<bos>", "<unk>"]
    vocabulary = {token: number for number, token in enumerate([*special, *CHARACTERS, "▁t", "▁th"])}
    made = Tokenizer(BPE(vocabulary, [("▁", "t"), ("▁t", "h")], unk_token="<unk>"))
    made.add_special_tokens(special)
    made.normalizer = Replace(" ", "▁")
    made.post_processor = TemplateProcessing(single="<bos> $A", special_tokens=[("<bos>", 2)])
    return made


def write_tokenizer(folder: Path) -> Path:
    """Write the tokenizer as the hub has it, and return the folder."""
    tokenizer().save(str(folder / "tokenizer.json"))
    return folder


def make_network(name: str, **changes: Any) -> FlowNetwork:
    """A network with the weights of `fill`."""
    network = KINDS[name](**{**SIZES, **changes}, **({"state_width": STATE_WIDTH} if name == "pi0" else {}))
    fill(published(network))
    return network.eval()


def make_policy(name: str, tokenizer: Path | None = None, **options: Any) -> VisionLanguageAction:
    """The policy of an option with a tiny network of the weights of `fill`, unless a trunk gives them."""
    text = part_of(f"model/{name}", "text", name=tokenizer and str(tokenizer), length=LENGTHS[name])
    return VisionLanguageAction(
        partial(make_network, name, **({} if tokenizer else {"vocabulary": WORDS})),
        partial(Prompt, **text),
        **defaults_of(f"model/{name}", chunk=CHUNK, **options),
        spec=SPEC,
        tokenizer=Uniform(spec=SPEC, **defaults_of("tokenizer/uniform")),
    ).eval()


def take_statistics(model: VisionLanguageAction) -> None:
    """Normalise by the quantiles of `observed`, which may take the place of mean and standard deviation."""
    given = observed()
    for normalizer, name in ((model.state_normalizer, "state"), (model.action_normalizer, "action")):
        pair = zip(normalizer.statistics, ("q01", "q99"), strict=True)
        normalizer.take({f"{name}.{own}": given[f"{name}.{quantile}"] for own, quantile in pair}, name, "the dataset")


def batch_of(model: VisionLanguageAction) -> dict[str, Any]:
    """What a policy is given of `observed`."""
    given = observed()
    return {
        "rgb": {camera: images.unsqueeze(1) for camera, images in zip(SPEC.cameras, given["images"], strict=True)},
        "state": given["state"].unsqueeze(1),
        "present": torch.ones(len(TASKS), 1, dtype=torch.bool),
        "text": model.text.tokenize([*TASKS]),
        "noise": given["noise"],
    }


def export(name: str, folder: Path) -> None:
    """Write a policy with the statistics of `observed` as LeRobot has it, in `folder`/exported."""
    model = make_policy(name, write_tokenizer(folder))
    take_statistics(model)
    LeRobotPolicyExporter(folder / "exported").export(as_policy(model, SPEC))
