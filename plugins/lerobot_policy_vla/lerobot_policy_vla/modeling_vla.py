"""A policy of vla as one of LeRobot."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.policies.pretrained import PreTrainedPolicy
from torch import Tensor

from lerobot_policy_vla.configuration_vla import VlaConfig
from vla.config.experiment import make_policy
from vla.envs.lerobot import TASK, observations
from vla.models.policy_folder import POLICY, policy_folder
from vla.policy import Policy
from vla.spec import Array


class VlaPolicy(PreTrainedPolicy):
    """A policy of vla as one of LeRobot, with one history per environment.

    Raises:
        ValueError: there is no policy, or it is damaged.
    """

    config_class = VlaConfig
    name = "vla"

    def __init__(self, config: VlaConfig, **_: Any) -> None:
        super().__init__(config)
        if not config.checkpoint:
            raise ValueError("--policy.type=vla needs a policy: add --policy.checkpoint=RUN")
        device = "cuda" if str(config.device).startswith("cuda") else "cpu"
        options = {"device": device, "precision": config.precision, "compile": config.compile, "lanes": config.lanes}
        self._policy: Policy = make_policy(
            {"_target_": "vla.policy.Policy", **options}, policy_folder(config.checkpoint)
        )
        self._policy.device = torch.device(str(config.device) if device == "cuda" else "cpu")  # such as cuda:1
        self.model = self._policy.model  # a module, so that it moves with this one
        self._lanes = 0  # environments that have a history

    @classmethod
    def from_pretrained(
        cls, pretrained_name_or_path: str | Path, *, config: PreTrainedConfig | None = None, **_: Any
    ) -> Self:
        """Load a folder that `save_pretrained` wrote.

        Raises:
            ValueError: it holds no policy, or a damaged one.
        """
        folder = Path(pretrained_name_or_path)
        config = config or PreTrainedConfig.from_pretrained(folder)
        assert isinstance(config, VlaConfig)
        config.checkpoint = str(folder / POLICY)
        config.describe(folder / POLICY)
        return cls(config)

    def _save_pretrained(self, save_directory: Path, state_dict: dict[str, Tensor] | None = None) -> None:
        """Write the policy, which holds its whole configuration, beside the configuration of LeRobot."""
        shutil.copytree(policy_folder(self.config.checkpoint), save_directory / POLICY, dirs_exist_ok=True)
        self.config.checkpoint = ""  # `from_pretrained` knows the place; a name would be looked for where it is run
        self.config._save_pretrained(save_directory)
        self.config.checkpoint = str(save_directory / POLICY)

    def reset(self) -> None:
        """Forget the histories of all environments."""
        self._lanes = 0

    def select_action(self, batch: dict[str, Any], **_: Any) -> Tensor:
        """Return the action to execute in each environment, (B, D)."""
        return self._ask(batch, self._policy.act)

    def predict_action_chunk(self, batch: dict[str, Any], **_: Any) -> Tensor:
        """Return a chunk of actions for each environment, (B, k, D)."""
        return self._ask(batch, self._policy.plan)

    def forward(self, batch: dict[str, Tensor]) -> tuple[Tensor, dict[str, Any] | None]:
        """Raise: the policy is not trained here."""
        raise NotImplementedError("policies of vla are trained with python -m vla.run")

    def get_optim_params(self) -> dict[str, Any]:
        """Raise: the policy is not trained here."""
        raise NotImplementedError("policies of vla are trained with python -m vla.run")

    def _ask(self, batch: dict[str, Any], method: Any) -> Tensor:
        arrays: dict[str, Any] = {
            key: value.float().cpu().numpy() for key, value in batch.items() if isinstance(value, Tensor)
        }
        task = {TASK: batch[TASK]} if TASK in batch else {}
        inputs = observations({**arrays, **task}, self._policy.spec)
        lanes = range(len(inputs))
        if self._lanes != len(inputs):
            self._lanes = len(inputs)
            for lane in lanes:
                self._policy.reset(inputs[lane].instruction, lane, lane)
        answers: Array = method(inputs, lanes)
        answers *= np.array(self.config.scale or 1, np.float32)
        return torch.from_numpy(answers).to(self._policy.device)
