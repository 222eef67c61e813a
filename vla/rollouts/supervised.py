"""DAgger (arXiv 1011.0686): a policy acts, and an expert labels every state that it reaches."""

from __future__ import annotations

from contextlib import ExitStack
from typing import Any

from vla.io.errors import UserError
from vla.rollouts.rollout import AgentFactory, close_agent
from vla.spec import Agent, Array, Environment, Observation


class SupervisedAgent:
    """A policy that acts while an expert labels: `info["clean"]` is the expert's action, the label to imitate."""

    def __init__(self, make_policy: AgentFactory, make_expert: AgentFactory, environment: Environment) -> None:
        """Let the expert of the environment, see `require_memoryless`, label what the policy sees."""
        with ExitStack() as stack:  # closes the policy if the expert fails
            self._policy = make_policy(environment)
            stack.callback(close_agent, self._policy)
            self._expert = make_expert(environment)
            stack.callback(close_agent, self._expert)
            require_memoryless(self._expert)
            self.close = stack.pop_all().close
        self.info: dict[str, Any] = {}

    def reset(self, instruction: str, seed: int) -> None:
        """Start an episode; `seed` seeds policy and expert."""
        self._policy.reset(instruction, seed)
        self._expert.reset(instruction, seed)

    def act(self, observation: Observation) -> Array:
        """Return the policy's (D,) action."""
        action = self._policy.act(observation)
        label = self._expert.act(observation)
        self.info = {**self._policy.info, "clean": self._expert.info.get("clean", label)}
        return action


def require_memoryless(expert: Agent) -> None:
    """Raise a UserError unless the expert's labels depend on the observation alone, as its `memoryless` says."""
    if not getattr(expert, "memoryless", False):
        raise UserError(
            f"{type(expert).__name__} cannot label the states of another agent: without memoryless = True its actions "
            "may depend on its earlier actions; choose another expert"
        )
