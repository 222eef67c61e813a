"""Export of vision-language-action models as folders that LeRobot's own classes load."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from vla.io.errors import UserError
from vla.io.files import atomic_path, write_json
from vla.io.types import Text
from vla.models.trunk_folder import CONFIG
from vla.models.vlm.network import rename_weight
from vla.models.vlm.normalizer import EPSILON, MODES, Normalizer
from vla.models.vlm.policy import VisionLanguageAction
from vla.models.vlm.trunk import IMAGES, NORMALIZER, PREPROCESSOR

POSTPROCESSOR = "policy_postprocessor.json"
STATE, ACTION = "observation.state", "action"


class LeRobotPolicyExporter:
    """Writes a trained policy in LeRobot's layout: config.json, model.safetensors, and its processors with statistics.

    The state has only the components that the model uses: no rates of change. The folder is written atomically.

    Args:
        folder: output folder, which must not exist.
    """

    of_policies = True

    def __init__(self, folder: Text | Path) -> None:
        self._folder = Path(folder).resolve()

    def export(self, policy: Any) -> Path:
        """Write a policy; returns the folder.

        Raises:
            UserError: the folder exists, LeRobot has no such policy, or there is no room for the weights.
        """
        from safetensors import SafetensorError
        from safetensors.torch import save_file

        if self._folder.exists():
            raise UserError(f"{self._folder} exists already: choose another export.folder")
        model = policy.model
        if not isinstance(model, VisionLanguageAction):
            raise UserError(f"LeRobot has no {type(model).__name__}: this export is for model=smolvla, pi0 and pi05")
        if model.text.name is None:
            raise UserError("LeRobot needs a tokenizer, and this policy has none: train with model.text.name=FOLDER")
        beginnings = [(own_prefix, published_prefix) for published_prefix, own_prefix in model.network.published_names]
        state = model.network.state_dict()
        weights = {
            rename_weight(name, beginnings): tensor.detach().cpu().contiguous() for name, tensor in state.items()
        }
        # No action depends on these, but LeRobot's π0 and π0.5 report a failure to load if one is missing.
        shape = model.network.vocabulary, model.network.unused_width
        weights[f"{model.network.unused_names[0]}weight"] = torch.zeros(shape, dtype=torch.bfloat16)
        config, steps = _config(model), (_preprocessing(model), _postprocessing(model))
        with atomic_path(self._folder) as draft:
            draft.mkdir(parents=True)
            try:
                save_file(weights, draft / "model.safetensors")
            except SafetensorError as error:
                remedy = "make room there, or choose another export.folder"
                raise UserError(f"{self._folder} cannot be written ({error}): {remedy}") from error
            write_json(draft / CONFIG, config)
            for file, pipeline in zip((PREPROCESSOR, POSTPROCESSOR), steps, strict=True):
                for step in pipeline:
                    if "state_file" in step:
                        save_file(_statistics(model), draft / step["state_file"])
                write_json(draft / file, {"name": file.removesuffix(".json"), "steps": pipeline})
        return self._folder


def _config(model: VisionLanguageAction) -> dict[str, Any]:
    inputs, outputs = _features(model)
    network, mode = model.network, MODES[model.action_normalizer.kind]
    is_smolvla = network.kind == "smolvla"
    if model.place != ("corner" if is_smolvla else "centre"):
        raise UserError(f"LeRobot's {network.kind} places non-square images differently: train without model.place")
    if model.text.state != (in_sentence := not network.state_width):
        raise UserError(
            f"LeRobot's {network.kind} has {'the' if in_sentence else 'no'} state in the sentence: train with "
            f"model.text.state={str(in_sentence).lower()}"
        )
    smolvla_options = {"vlm_model_name": _tokenizer(model), "num_steps": model.steps}
    return {
        "type": network.kind,
        "input_features": inputs,
        "output_features": outputs,
        "chunk_size": model.chunk,
        "n_action_steps": model.execute,
        "normalization_mapping": {"VISUAL": "IDENTITY", "STATE": mode, "ACTION": mode},
        "max_state_dim": network.state_width or network.action_width,
        "max_action_dim": network.action_width,
        "tokenizer_max_length": model.text.length,
        **network.options(),
        **(smolvla_options if is_smolvla else {"num_inference_steps": model.steps}),
    }


def _tokenizer(model: VisionLanguageAction) -> str:
    """Return the name of the tokenizer without a revision, which LeRobot does not take."""
    name = str(model.text.name)
    return name if Path(name).is_dir() else name.partition("@")[0]


def _features(model: VisionLanguageAction) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return LeRobot's descriptions of inputs and outputs."""
    image = {"type": "VISUAL", "shape": [3, *model.spec.image_size]}
    state = {STATE: {"type": "STATE", "shape": [len(model.spec.pose)]}}
    images = {f"{IMAGES}{camera}": image for camera in model.cameras}
    return {**state, **images}, {ACTION: {"type": "ACTION", "shape": [len(model.spec.action)]}}


def _preprocessing(model: VisionLanguageAction) -> list[dict[str, Any]]:
    prompt = model.text
    tokens = {"max_length": prompt.length, "task_key": "task", "padding_side": "right", "padding": "max_length"}
    reader = "prepare_state_tokenizer_processor_step" if prompt.state else "new_line_processor"
    inputs, outputs = _features(model)
    normalizer = _step(NORMALIZER, model, {**inputs, **outputs}, "policy_preprocessor_step_5_normalizer_processor")
    return [
        {"registry_name": "rename_observations_processor", "config": {"rename_map": {}}},
        {"registry_name": "to_batch_processor", "config": {}},
        normalizer,  # before the state becomes text
        {"registry_name": f"{model.network.kind}_{reader}", "config": {}},
        {
            "registry_name": "tokenizer_processor",
            "config": {**tokens, "truncation": True, "tokenizer_name": _tokenizer(model)},
        },
        {"registry_name": "device_processor", "config": {"device": "cpu", "float_dtype": None}},
    ]


def _postprocessing(model: VisionLanguageAction) -> list[dict[str, Any]]:
    file = "policy_postprocessor_step_0_unnormalizer_processor"
    step = _step("unnormalizer_processor", model, _features(model)[1], file)
    return [step, {"registry_name": "device_processor", "config": {"device": "cpu", "float_dtype": None}}]


def _step(name: str, model: VisionLanguageAction, features: dict[str, Any], file: str) -> dict[str, Any]:
    mode = MODES[model.action_normalizer.kind]
    config = {"eps": EPSILON, "features": features, "norm_map": {"VISUAL": "IDENTITY", "STATE": mode, "ACTION": mode}}
    return {"registry_name": name, "config": config, "state_file": f"{file}.safetensors"}


def _statistics(model: VisionLanguageAction) -> dict[str, Tensor]:
    parts: dict[str, Normalizer] = {STATE: model.state_normalizer, ACTION: model.action_normalizer}
    return {
        f"{feature}.{name}": value.detach().cpu().clone()
        for feature, normalizer in parts.items()
        for name, value in normalizer.state_dict().items()
    }
