"""Policies of vla in LeRobot, `lerobot-eval --policy.type=vla`, and policies of LeRobot in vla, `agent=lerobot`."""

from lerobot_policy_vla.configuration_vla import VlaConfig
from lerobot_policy_vla.modeling_vla import VlaPolicy
from lerobot_policy_vla.processor_vla import make_vla_pre_post_processors

__all__ = ["VlaConfig", "VlaPolicy", "make_vla_pre_post_processors"]
