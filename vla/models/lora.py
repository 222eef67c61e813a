"""LoRA: linear maps learn an update that is a product of two small matrices (E. Hu et al., arXiv 2106.09685).

Shapes: r rank, I inputs and O outputs of a linear map.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Any

from torch import nn

from vla.io.errors import UserError
from vla.io.types import Count, Names, Positive, Rate
from vla.models.trunk import is_factor, is_within
from vla.models.vision.image_tokenizer import Keypoints

ADAPTER = "default"  # peft's name for the only adapter


@dataclass(frozen=True)
class LoRA:
    """Frozen (O, I) weights W of linear maps become W + alpha / r · B A, where B (O, r) and A (r, I) are trained.

    Args:
        modules: dotted names of linear maps, or of parts that contain some; `*` matches anything, and the beginning of
            a name can be left out: `q_proj`, `context`, `expert.*.v_proj`.
        rank: r.
        alpha: scale of the product times r.
        dropout: rate of dropout of the inputs of A.
    """

    modules: Names
    rank: Count
    alpha: Positive
    dropout: Rate

    def inject(self, model: nn.Module) -> None:
        """Add the factors to a model, in place; its other trained parameters stay trained.

        Raises:
            UserError: a name matches no linear map, or peft is not installed.
        """
        try:
            from peft import LoraConfig, inject_adapter_in_model
        except ImportError as error:
            raise UserError("learner.lora needs peft: pip install -e '.[vlm]'") from error
        targets = self._target_modules(model)
        trained_ids = {id(weight) for weight in model.parameters() if weight.requires_grad}
        options: dict[str, Any] = {"r": self.rank, "lora_alpha": self.alpha, "lora_dropout": self.dropout}
        inject_adapter_in_model(LoraConfig(target_modules=targets, **options), model)  # freezes all but the factors
        for name, weight in model.named_parameters():
            weight.requires_grad_(is_factor(name) or (id(weight) in trained_ids and ".base_layer." not in name))
        for module in model.modules():
            if isinstance(module, nn.TransformerEncoderLayer) and any(map(is_factor, module.state_dict())):
                module.activation_relu_or_gelu = 0  # else the fast path of evaluation would ignore the factors

    def _target_modules(self, model: nn.Module) -> list[str]:
        modules, targets = dict(model.named_modules()), dict[str, None]()
        # The linear maps in these are not called as modules, so factors in them would have no effect.
        others = [name for name, module in modules.items() if isinstance(module, nn.MultiheadAttention | Keypoints)]
        linear = [name for name in modules if isinstance(modules[name], nn.Linear) and not is_within(name, others)]
        for pattern in self.modules:
            matches = [name for name in linear if fnmatchcase(f".{name}.", f"*.{pattern}.*")]
            if not matches:
                names = sorted({name.rpartition(".")[2] for name in linear})
                parts = sorted({name.partition(".")[0] for name in linear})
                raise UserError(
                    f"learner.lora.modules names {pattern}, which matches no linear map of the model: there are "
                    f"{', '.join(names[:20])} in {', '.join(parts)}"
                )
            targets |= dict.fromkeys(matches)
        return list(targets)


def without_lora(state: Mapping[str, Any], scale: float, parts: Collection[str]) -> dict[str, Any]:
    """Return the state of a model with its LoRA factors merged into the weights, and without the trunks `parts`.

    The factors in a trunk are not merged: they remain, as lora_A and the scaled lora_B.
    """
    result = dict[str, Any]()
    for name, value in state.items():
        layer, _, kind = name.partition(".base_layer.")
        factor = f"{layer}.lora_%s.{ADAPTER}.weight"
        if is_factor(name):
            if is_within(name, parts):
                result[name.removesuffix(f".{ADAPTER}.weight")] = scale * value if ".lora_B." in name else value
        elif is_within(name, parts):
            continue
        elif kind == "weight":
            result[f"{layer}.weight"] = value + scale * (state[factor % "B"] @ state[factor % "A"])
        else:
            result[name.replace(".base_layer.", ".")] = value
    return result
