"""A policy of LeRobot as an agent of vla."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.policies import get_policy_class, make_pre_post_processors
from lerobot.utils.constants import ACTION
from lerobot.utils.import_utils import register_third_party_plugins

from vla.envs.lerobot import TASK, arrays
from vla.io.errors import UserError
from vla.io.types import Text
from vla.spec import Array, Observation, Spec


class LeRobotPolicy:
    """A policy of LeRobot, with the processors beside it.

    Args:
        folder: with the policy, as `lerobot-train` writes it.
        device: to run on.
        spec: of the environment.

    Raises:
        ValueError: there is no policy, or it needs what the environment does not give.
    """

    def __init__(self, folder: Text, device: Literal["cpu", "cuda"], *, spec: Spec) -> None:
        register_third_party_plugins()
        try:
            config = PreTrainedConfig.from_pretrained(folder, local_files_only=True)
        except Exception as error:  # of the hub, of draccus, of the file system
            raise UserError(f"agent.folder={folder} holds no policy of LeRobot: {str(error)[:200]}") from error
        config.device, config.pretrained_path = device, folder  # type: ignore[assignment]
        _require(config, spec, folder)
        self._policy = get_policy_class(config.type).from_pretrained(folder, config=config).eval()
        overrides = {"device_processor": {"device": device}}
        self._before, self._after = make_pre_post_processors(config, folder, preprocessor_overrides=overrides)
        self._spec, self._low, self._high = spec, np.array(spec.low), np.array(spec.high)
        self.info: dict[str, Any] = {}

    def reset(self, instruction: str, seed: int) -> None:
        """Forget the history, and seed PyTorch, from which policies of LeRobot draw their noise."""
        torch.manual_seed(seed)
        for part in (self._policy, self._before, self._after):
            part.reset()

    @torch.inference_mode()
    def act(self, observation: Observation) -> Array:
        """Return the (D,) action to execute, clipped to the spec."""
        batch = {key: torch.from_numpy(value[None]) for key, value in arrays(observation, self._spec).items()}
        action = self._after(self._policy.select_action(self._before({**batch, TASK: [observation.instruction]})))
        return np.clip(action[0].float().cpu().numpy(), self._low, self._high).astype(np.float32)


def _require(config: PreTrainedConfig, spec: Spec, folder: str) -> None:
    """Raise a ValueError unless the environment gives all that the policy sees, and takes its actions."""
    inputs = arrays(spec.random_observation(np.random.default_rng(0)), spec)
    sizes = {key: (*value.shape,) for key, value in inputs.items()} | {ACTION: (len(spec.action),)}
    layout = {key: (*part.shape,) for key, part in {**config.input_features, **config.output_features}.items()}
    if misfits := [
        f"{key} {shape}, the task {sizes.get(key, 'none')}" for key, shape in layout.items() if shape != sizes.get(key)
    ]:
        raise UserError(f"the policy in {folder} does not fit the task: it has {'; '.join(misfits)}")
