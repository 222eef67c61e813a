"""Pretrained parts of a model, whose weights a policy does not copy: it names their source and saves only the rest."""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import nn

from vla.io.documents import SHA256, STRICT
from vla.io.errors import UserError
from vla.io.types import Natural, Text


@dataclass(frozen=True)
class Source:
    """Where the weights of a part come from; the code that loads them sets the attribute `source` of the module."""

    __pydantic_config__ = STRICT

    name: Text  # package, file or folder, or repository of the hub
    revision: str | None  # commit of the hub
    sha256: SHA256  # of the file
    size: Natural  # of the file [bytes]

    @classmethod
    def from_file(cls, path: Path, name: str) -> Source:
        """Return the source of weights that were read from a file, which may lie in the hub's cache."""
        folder = path.absolute().parent
        revision = folder.name if folder.parent.name == "snapshots" else None
        with path.open("rb") as file:
            return cls(name, revision, hashlib.file_digest(file, "sha256").hexdigest(), path.stat().st_size)

    def __str__(self) -> str:
        return f"{self.name}{f' at {self.revision}' if self.revision else ''}, SHA-256 {self.sha256[:8]}…"


def is_within(name: str, parts: Collection[str]) -> bool:
    """Return whether the dotted name of a weight is in one of the parts."""
    return any(f"{name}.".startswith(f"{part}.") for part in parts)


def is_factor(name: str) -> bool:
    """Return whether a weight is a LoRA factor, which is trained even in a frozen part."""
    return ".lora_" in name


def trunks(model: nn.Module) -> dict[str, Source]:
    """Return name → source of the parts whose weights were loaded from elsewhere and are not trained."""
    sources = dict[str, Source]()
    for name, module in model.named_modules():
        part = name.removesuffix(".base_layer")  # a linear map with LoRA factors is called as without them
        source = getattr(module, "source", None)
        if not isinstance(source, Source) or is_within(part, sources):
            continue
        if not any(weight.requires_grad and not is_factor(key) for key, weight in module.named_parameters()):
            sources[part] = source
    return sources


def evaluate_frozen(module: nn.Module) -> None:
    """Put a frozen part into evaluation mode, so that its buffers do not change; LoRA's dropout stays active."""
    module.eval()
    for name, part in module.named_modules():
        part.train(is_factor(f".{name}."))


def require_trunks(model: nn.Module, sources: Mapping[str, Source], policy: object) -> None:
    """Require the trunks that a policy names.

    Raises:
        UserError: a trunk is missing, or differs from the one in training.
    """
    modules: dict[str, Any] = dict(model.named_modules())
    for part, source in sources.items():
        if (model_source := getattr(modules.get(part), "source", None)) is None or model_source.sha256 != source.sha256:
            text = f"here it is {model_source}" if model_source else "that is not here"
            raise UserError(f"{policy} was trained with {part} from {source}, and {text}: get the one of the training")


def whole_state(model: nn.Module, state: Mapping[str, Any], parts: Collection[str]) -> dict[str, Any]:
    """Return the state of a policy with that of the trunks `parts`, into which their LoRA factors are merged.

    The attribute `source` becomes None on every module whose weights in this state differ from those of its source.
    """
    result = {name: value for name, value in state.items() if not (is_factor(name) and is_within(name, parts))}
    changed_layers = set[str]()  # linear maps
    for part in parts:
        for name, value in model.get_submodule(part).state_dict(prefix=f"{part}.").items():
            layer = name.removesuffix(".weight")
            if f"{layer}.lora_A" in state:
                value = value + state[f"{layer}.lora_B"] @ state[f"{layer}.lora_A"]
                changed_layers.add(layer)
            result[name] = value
    for name, module in model.named_modules():
        unchanged = is_within(name, parts) and not any(is_within(layer, [name]) for layer in changed_layers)
        if isinstance(getattr(module, "source", None), Source) and not unchanged:
            module.source = None  # type: ignore[assignment]
    return result
