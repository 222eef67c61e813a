"""DAgger (arXiv 1011.0686): a policy acts, and an expert labels every state that it reaches."""

from __future__ import annotations

from typing import Any

import numpy as np

from vla.io.errors import UserError
from vla.rollouts.rollout import AgentFactory, close_agent
from vla.spec import Agent, Array, Environment, Observation


class Supervised:
    """A policy that acts while an expert labels: `info["clean"]` is the expert's action, the label to imitate.

    In some segments of an episode, drawn from its seed, the expert's own action is executed instead, without any
    perturbation; `info["draws"]` names their steps.
    """

    def __init__(self, policy: Agent, expert: Agent, beta: float, segment: int) -> None:
        """Let an expert, see `require_memoryless`, act with the probability `beta` in every `segment` [steps]."""
        require_memoryless(expert)
        self._policy, self._expert, self._beta, self._segment = policy, expert, beta, segment
        self.info: dict[str, Any] = {}

    def reset(self, instruction: str, seed: int) -> None:
        """Start an episode; `seed` seeds policy, expert and the draw of segments."""
        self._policy.reset(instruction, seed)
        self._expert.reset(instruction, seed)
        self._random, self._step = np.random.default_rng([seed, 0xDA66E4]), 0
        self._acts: list[tuple[int, int]] = []  # first and last step of every segment in which the expert acts

    def act(self, observation: Observation) -> Array:
        """Return the (D,) action to execute; the policy also observes the steps in which the expert acts."""
        if self._step % self._segment == 0:
            self._expert_acts = bool(self._random.uniform() < self._beta)
            if self._expert_acts:
                self._acts.append((self._step, self._step + self._segment - 1))
        self._step += 1
        action = self._policy.act(observation)
        executed = self._expert.act(observation)
        label = self._expert.info.get("clean", executed)
        self.info = {**self._policy.info, "clean": label, "draws": {"expert_acts": self._acts}}
        return label if self._expert_acts else action

    def close(self) -> None:
        """Close the policy and the expert."""
        close_agent(self._policy)
        close_agent(self._expert)


def require_memoryless(expert: Agent) -> None:
    """Raise a UserError unless the expert's labels depend on the observation alone, as its `memoryless` says."""
    if not getattr(expert, "memoryless", False):
        raise UserError(
            f"{type(expert).__name__} cannot label the states of another agent: without memoryless = True its actions "
            "may depend on its earlier actions; choose another expert"
        )


def make_supervised(
    make_policy: AgentFactory, make_expert: AgentFactory, beta: float, segment: int, environment: Environment
) -> Supervised:
    """Build the policy and its expert for an environment."""
    return Supervised(make_policy(environment), make_expert(environment), beta, segment)
