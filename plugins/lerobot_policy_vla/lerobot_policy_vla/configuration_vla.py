"""Configuration of the policy: its folder, and the features that it reads."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lerobot.configs import FeatureType, PolicyFeature, PreTrainedConfig
from lerobot.utils.constants import ACTION

from vla.envs.lerobot import IMAGE, IMAGES, RATES, STATE
from vla.models.policy_folder import read_policy


@PreTrainedConfig.register_subclass("vla")
@dataclass
class VlaConfig(PreTrainedConfig):
    """A policy of vla.

    Attributes:
        checkpoint: its folder, or that of its run; empty in a folder of `--policy.path`, which has it.
        precision: "fp32" or "bf16".
        compile: compile the model.
        lanes: environments that one pass through the model serves; unused ones are padding.
        scale: factor of each component of an action, for environments with other units; none: as in training.
    """

    checkpoint: str = ""
    precision: str = "fp32"
    compile: bool = False
    lanes: int = 1
    scale: list[float] = field(default_factory=list)
    push_to_hub: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.checkpoint and Path(self.checkpoint).is_dir():
            self.describe(Path(self.checkpoint))

    def describe(self, checkpoint: Path) -> None:
        """Describe what the policy sees, under the names of LeRobot.

        Raises:
            ValueError: there is no policy, or it is damaged.
        """
        spec = read_policy(checkpoint).spec
        vectors = {STATE: len(spec.pose), **({RATES: len(spec.rates)} if spec.rates else {})}
        single = [IMAGE] if spec.parts or len(spec.cameras) == 1 else []  # of an environment with one image
        images = [*(f"{IMAGES}{name}" for name in spec.cameras), *single]
        self.input_features = {
            **{key: PolicyFeature(FeatureType.VISUAL, (3, *spec.image_size)) for key in images},
            **{key: PolicyFeature(FeatureType.STATE, (size,)) for key, size in vectors.items()},
        }
        self.output_features = {ACTION: PolicyFeature(FeatureType.ACTION, (len(spec.action),))}
        if self.scale and len(self.scale) != len(spec.action):
            raise ValueError(
                f"--policy.scale has {len(self.scale)} factors: give one for each of {', '.join(spec.action)}"
            )

    @property
    def observation_delta_indices(self) -> None:
        """None: the policy remembers its history itself."""

    @property
    def action_delta_indices(self) -> None:
        """None: the policy is not trained here."""

    @property
    def reward_delta_indices(self) -> None:
        """None: the policy is not trained here."""

    def get_optimizer_preset(self) -> Any:
        """Raise: the policy is not trained here."""
        raise NotImplementedError("policies of vla are trained with python -m vla.run")

    def get_scheduler_preset(self) -> None:
        """Return None."""

    def validate_features(self) -> None:
        """Accept: the policy itself compares every observation with its spec."""
