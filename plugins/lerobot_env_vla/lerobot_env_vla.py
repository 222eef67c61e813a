"""The worlds of vla as environments of LeRobot: `lerobot-eval --env.type=vla`."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import Any

from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorEnv
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.envs.utils import freeze_after_episode_end
from lerobot.utils.constants import ACTION, OBS_STATE

from vla.envs.lerobot import IMAGES, LeRobotEnvironment


@EnvConfig.register_subclass("vla")
@dataclass
class VlaEnv(EnvConfig):
    """A task of vla.

    Attributes:
        task: an option of the group `task`.
        options: options and values of the task, such as {goal: lift, image_size: [64, 64]}.
        longest: number of steps after which an episode that has not ended itself is over.
    """

    task: str | None = "tabletop"
    options: dict[str, Any] = field(default_factory=dict)
    longest: int = 1000

    def __post_init__(self) -> None:
        """Describe what a policy sees, under the names of LeRobot."""
        world = LeRobotEnvironment(*self._arguments)
        spec = world.vla_spec
        world.close()
        self.fps = round(spec.control_hz)
        self.features = {
            ACTION: PolicyFeature(FeatureType.ACTION, (len(spec.action),)),
            "agent_pos": PolicyFeature(FeatureType.STATE, (len(spec.pose),)),
            **{f"{IMAGES}{name}": PolicyFeature(FeatureType.VISUAL, (*spec.image_size, 3)) for name in spec.cameras},
        }
        self.features_map = {**{key: key for key in self.features}, "agent_pos": OBS_STATE}

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Nothing: `create_envs` makes the environments."""
        return {}

    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> dict[str, dict[int, VectorEnv]]:
        """Make `n_envs` environments, in a process each if `use_async_envs`."""
        # Environments whose episode has ended wait for the others.
        make = [freeze_after_episode_end(partial(LeRobotEnvironment, *self._arguments))] * n_envs
        if use_async_envs and n_envs > 1:
            # Forked after the renderer or PyTorch have started threads, processes would hang.
            environments: VectorEnv = AsyncVectorEnv(make, context="forkserver", autoreset_mode=AutoresetMode.NEXT_STEP)
        else:
            environments = SyncVectorEnv(make, autoreset_mode=AutoresetMode.NEXT_STEP)
        return {self.type: {0: environments}}

    @property
    def _arguments(self) -> tuple[str, int, dict[str, Any]]:
        return self.task or "tabletop", self.longest, self.options
