"""Pretrained weights that are stored elsewhere: of a vision-language model, or of a whole policy of LeRobot."""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor, nn

from vla.io.documents import parse_plain, read_json
from vla.io.errors import UserError
from vla.models.trunk import Source
from vla.models.trunk_folder import CONFIG, WEIGHTS, open_safetensors, trunk_folder
from vla.models.vision.image_tokenizer import ImageEncoder
from vla.models.vlm.network import MAX_PERIOD, MIN_PERIOD, FlowNetwork, rename_weight
from vla.models.vlm.normalizer import MODES, Kind
from vla.parallel.limits import free_memory

Part = TypeVar("Part")

PREPROCESSOR = "policy_preprocessor.json"
NORMALIZER = "normalizer_processor"  # its step that normalises
IMAGES = "observation.images."
EMBEDDING = "embed_tokens.weight"  # end of the name of the embedding of words
OLD_STATISTICS = ("normalize_inputs.", "normalize_targets.", "unnormalize_outputs.")  # of LeRobot before 0.4
KINDS = ("smolvla", "pi0", "pi05")  # of policies of LeRobot
# Options of LeRobot's policies that change what is computed → values that are supported here. With 0 layers or less the
# expert has as many as the trunk, and with a length of 0 or less a prefix is not padded: smolvla_base has 0 for both.
OPTIONS: dict[str, tuple[Any, ...]] = {
    **{"adapt_to_pi_aloha": (False,), "add_image_special_tokens": (False,), "attention_mode": ("cross_attn",)},
    **{"num_expert_layers": (-1, 0), "prefix_length": (-1, 0), "use_relative_actions": (False,)},
    **{"min_period": (MIN_PERIOD,), "max_period": (MAX_PERIOD,)},
}


class Trunk:
    """A folder of pretrained weights, which are read when a network is built.

    Args:
        name: a folder, or hub:OWNER/NAME or hub:OWNER/NAME@REVISION.

    Raises:
        UserError: there is none, it cannot be fetched, it has no weights, or its policy has unsupported options.
    """

    def __init__(self, name: str) -> None:
        self.name, self.folder = name, trunk_folder(name)
        self._config = read_json(self.folder / CONFIG, dict[str, Any])
        self.is_policy = "input_features" in self._config  # of LeRobot, and not the vision-language model alone
        kind = self._config.get("type")
        if self.is_policy and kind not in KINDS:
            raise UserError(f"{name} is a policy of LeRobot's type {kind}, and only {', '.join(KINDS)} are supported")
        for option, values in OPTIONS.items():
            if self._config.get(option, values[0]) not in values:
                raise UserError(
                    f"{name} was trained with {option}={self._config[option]}, and only {values[0]} is supported"
                )
        self._files = sorted(self.folder.glob(WEIGHTS))
        if not self._files:
            raise UserError(f"{self.folder} has no weights, {WEIGHTS}: download the model again")

    def __str__(self) -> str:
        return self.name

    @property
    def source(self) -> Source:
        """What identifies the weights."""
        sources = [Source.from_file(path, self.name) for path in self._files]
        digests = b"".join(bytes.fromhex(source.sha256) for source in sources)
        size = sum(source.size for source in sources)
        return Source(self.name, sources[0].revision, hashlib.sha256(digests).hexdigest(), size)

    @property
    def cameras(self) -> list[str]:
        """The cameras that the policy sees, in their order; empty for a vision-language model alone."""
        features = self._mapping("input_features", dict[str, dict[str, Any]])
        return [name.removeprefix(IMAGES) for name, feature in features.items() if feature.get("type") == "VISUAL"]

    def other_normalization(self, kind: Kind) -> str:
        """Describe how the policy normalises state and actions in another way than `kind`; "" if it does not."""
        mapping = self._mapping("normalization_mapping", dict[str, str])
        modes = {mapping[feature] for feature in ("STATE", "ACTION") if feature in mapping} - {MODES[kind]}
        names = ", ".join(sorted(modes))
        return f"{self} normalises by {names}, and model.normalization is {kind}: choose the same" if modes else ""

    def statistics(self, kind: Kind) -> dict[str, Tensor]:
        """Return the statistics by which the policy normalises, such as action.mean; empty if it has no normaliser.

        Raises:
            UserError: it normalises in another way than `kind`.
        """
        if difference := self.other_normalization(kind):
            raise UserError(f"{difference}, or model.statistics=demonstrations")
        path = self.folder / PREPROCESSOR
        raw_steps = read_json(path, dict[str, Any]).get("steps", []) if path.is_file() else []
        steps = parse_plain(raw_steps, list[dict[str, Any]], f"steps of {path}")
        files = [step.get("state_file") for step in steps if step.get("registry_name") == NORMALIZER]
        paths = [self.folder / Path(str(name)).name for name in files if name]
        return {name: tensor for path in paths if path.is_file() for name, tensor in _tensors([path])}

    def _mapping(self, key: str, kind: type[Part]) -> Part:
        """Return a mapping in the config; an empty one if it is missing."""
        return parse_plain(self._config.get(key) or {}, kind, f"{key} of {self.folder / CONFIG}")

    def build(self, network: Callable[[], FlowNetwork]) -> FlowNetwork:
        """Build a network with these weights; parts that a vision-language model lacks are initialised at random.

        Modules all of whose weights were read from here get the attribute `source`.

        Raises:
            UserError: a weight is missing, unknown or of another shape, or they need more memory than is free.
        """
        instance = sketch(network)
        size, own_size = self._config.get("resize_imgs_with_padding"), [instance.resolution] * 2
        if self.is_policy and size not in (None, own_size):
            raise UserError(f"{self} sees images of {size} pixels, and the model of {own_size}: choose another model=")
        if any(isinstance(module, ImageEncoder) for module in instance.modules()):
            instance = network()  # such an encoder is small, and may have weights of its own, which a sketch lacks
        parameters = dict(instance.named_parameters())
        weights = dict[str, Tensor]()
        for key, tensor in _tensors(self._files):
            names = instance.published_names if self.is_policy else instance.trunk_names
            plain_key = key.replace("._orig_mod.", ".")  # of a policy that was compiled
            name = rename_weight(plain_key, names)
            if name in parameters:
                if name.endswith(EMBEDDING) and not self.is_policy:
                    tensor = tensor[: len(parameters[name])]  # the rest pads a vocabulary
                if tensor.shape != parameters[name].shape:
                    shapes = f"{[*tensor.shape]}, and the model has {[*parameters[name].shape]}"
                    raise UserError(f"{key} in {self} has shape {shapes}: choose another model= or model.network")
                weights[name] = tensor.to(torch.float32, copy=True)
            elif self.is_policy and not plain_key.startswith((*instance.unused_names, *OLD_STATISTICS)):
                raise UserError(f"{self} has {key}, which the model lacks: choose another model= or model.network")
        prefixes = ("",) if self.is_policy else tuple(prefix for _, prefix in instance.trunk_names)
        if missing_names := [name for name in parameters if name not in weights and name.startswith(prefixes)]:
            suffix = ", …" if len(missing_names) > 1 else ""
            raise UserError(f"{self} lacks weights of the model: {missing_names[0]}{suffix}")
        instance.load_state_dict(weights, strict=False, assign=True)
        materialize(instance)
        source: Any = self.source
        for part, module in instance.named_modules():
            names = [f"{part}.{name}".removeprefix(".") for name, _ in module.named_parameters()]
            if names and weights.keys() >= {*names}:
                module.source = source
        return instance


def sketch(network: Callable[[], FlowNetwork]) -> FlowNetwork:
    """Build a network without values, on the device "meta"; a UserError if its weights exceed the free memory."""
    # Warnings of an image encoder's own weights, of which a sketch takes the shapes only.
    with torch.device("meta"), warnings.catch_warnings(action="ignore"):
        instance = network()
    size, room = sum(weight.nbytes for weight in instance.parameters()), free_memory()
    if size > room:
        raise UserError(
            f"the weights of {type(instance).__name__} need {size / 1e9:.1f} GB of memory, and {room / 1e9:.1f} GB are "
            "free: use a machine with more, or lower sizes in model.network"
        )
    return instance


def materialize(network: nn.Module) -> None:
    """Allocate all tensors that are on the device "meta", with the values of an untrained network."""
    for weight in network.parameters():
        hf_weight: Any = weight
        hf_weight._is_hf_initialized = not weight.is_meta  # transformers does not initialise marked weights
    for name, module in network.named_modules():
        tensors = [*module.named_parameters(recurse=False), *module.named_buffers(recurse=False)]
        if not any(tensor.is_meta for _, tensor in tensors):
            continue
        values = {key: tensor.data for key, tensor in tensors if not tensor.is_meta}
        module.to_empty(device="cpu", recurse=False)
        _initialize(network, name, module)
        for key, tensor in values.items():
            getattr(module, key).data = tensor


@torch.no_grad()
def _initialize(network: nn.Module, name: str, module: nn.Module) -> None:
    """Initialise a module as the innermost model of transformers that it is part of does, or else as PyTorch does."""
    while name:
        name = name.rpartition(".")[0]
        if callable(initialize := getattr(network.get_submodule(name), "_init_weights", None)):
            return initialize(module)
    reset: Any = module.reset_parameters
    return reset()


def _tensors(paths: list[Path]) -> Iterator[tuple[str, Tensor]]:
    """Yield the name and the tensor of every weight in the files; a UserError if a file is damaged."""
    for path in paths:
        with open_safetensors(path) as file:
            names: list[str] = file.keys()  # it is no mapping
            for name in names:
                yield name, file.get_tensor(name)
