"""Real-time chunking: the plan of a flow model continues the one that is executed while it is computed.

Guidance follows K. Black, M. Galliker, S. Levine, arXiv 2506.07339; training with a given prefix, arXiv 2512.05964.

Shapes: B batch, k action chunk, D action components.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from vla.io.errors import UserError, counted
from vla.io.types import Positive

# Noisy actions (B, k, D) and their times, (B,) or (B, k), from 0 for noise to 1 for actions → velocity (B, k, D).
Velocity = Callable[[Tensor, Tensor], Tensor]


class RunningPlans(NamedTuple):
    """The plans being executed, from the times of the observations on."""

    actions: Tensor  # (B, k, D) scaled as in the model; only the first `remaining` count
    remaining: Tensor  # (B,) 0: there is no plan
    delay: Tensor  # (B,) number of actions, at most `remaining`, that are executed before the next plan arrives


class Chunking(ABC):
    """How the velocity of a plan's actions is changed so that the plan continues a running one."""

    @abstractmethod
    def continuing_velocity(self, velocity: Velocity, running: RunningPlans) -> Velocity:
        """Return the changed velocity; rows without a running plan keep the original one."""


class Guided(Chunking):
    """Guidance towards the running plan, for policies that were not trained for it.

    At time t, with v the velocity, the estimated actions are A = a + (1 - t) v, and the velocity becomes
    v + min(limit, (t² + (1 - t)²) / (t (1 - t))) (∂A/∂a)ᵀ W (running - A). W is 1 for actions that are executed before
    the plan arrives, and then decays to 0 where the running plan ends.

    Args:
        jacobian: compute ∂A/∂a by backpropagation through the network, as published; else the identity, as in LeRobot.
        decay: how W decays: "linear", c from 1 to 0, or "exponential", c (exp(c) - 1) / (e - 1).
        limit: largest factor of the guidance, β.
    """

    def __init__(self, jacobian: bool, decay: Literal["exponential", "linear"], limit: Positive) -> None:
        self._jacobian, self._decay, self._limit = jacobian, decay, limit

    def continuing_velocity(self, velocity: Velocity, running: RunningPlans) -> Velocity:
        """Return the guided velocity."""
        place = torch.arange(running.actions.shape[1], device=running.actions.device)
        start, end = running.delay.unsqueeze(1), running.remaining.unsqueeze(1)
        ramp = (1 - (place - start + 1) / (end - start + 1)).clamp(0, 1).unsqueeze(-1)  # (B, k, 1)
        weights = ramp if self._decay == "linear" else ramp * ramp.expm1() / (math.e - 1)

        def guided_velocity(noisy: Tensor, time: Tensor) -> Tensor:
            t = time[:, None, None]
            vjp = torch.func.vjp(lambda noisy: velocity(noisy, time), noisy) if self._jacobian else None
            free_velocity = vjp[0] if vjp else velocity(noisy, time)
            error = weights * (running.actions - (noisy + (1 - t) * free_velocity))
            correction = error + (1 - t) * vjp[1](error)[0] if vjp else error  # ∂A/∂a is 1 + (1 - t) ∂v/∂a
            factor = ((t**2 + (1 - t) ** 2) / (t * (1 - t))).clamp(max=self._limit)
            return free_velocity + factor * correction

        return guided_velocity


class TrainedPrefix(Chunking):
    """The network is given the actions that are executed before the plan arrives, as in training."""

    def continuing_velocity(self, velocity: Velocity, running: RunningPlans) -> Velocity:
        """Return the velocity given the prefix."""
        return lambda noisy, time: velocity(*with_prefix(noisy, time, running.actions, running.delay))


def with_prefix(noisy: Tensor, time: Tensor, clean: Tensor, length: Tensor) -> tuple[Tensor, Tensor]:
    """Replace the first (B,) `length` of (B, k, D) noisy actions by clean ones, and return them with (B, k) times."""
    mask = torch.arange(noisy.shape[1], device=noisy.device) < length.unsqueeze(1)
    return torch.where(mask.unsqueeze(-1), clean, noisy), time.unsqueeze(1).masked_fill(mask, 1.0)


def after_prefix(perturbations: Tensor, length: Tensor) -> Tensor:
    """Return the loss mask (B, k) of chunks that begin with (B,) `length` executed actions.

    Reactions to executed actions are predictable even if these were perturbed, so a label counts unless a step between
    the prefix and the label was. `perturbations` (B, k): perturbed steps before each label, -1 beyond the episode.
    """
    place = torch.arange(perturbations.shape[1], device=length.device)
    prefix_perturbations = perturbations.gather(1, length.unsqueeze(1))
    return (place >= length.unsqueeze(1)) & (perturbations == prefix_perturbations) & (perturbations >= 0)


def require_chunking(method: type, model: type, prefix: int) -> None:
    """Raise a UserError unless models of a class, trained with prefixes up to a length, can continue plans."""
    if not getattr(model, "continues", False):
        reason = (
            f"continues the plans of flow models, and {model.__name__} is none: omit it, or choose model=flow or a VLA"
        )
    elif issubclass(method, TrainedPrefix) and not prefix:
        reason = "needs a model trained with prefixes: train with model.prefix=4, or choose +policy/chunking=guided"
    else:
        return
    raise UserError(f"+policy/chunking ({method.__name__}) {reason}")


def require_prefix(prefix: int, execute: int, chunk: int) -> None:
    """Raise a UserError if a chunk has fewer actions after its prefix than are executed."""
    if prefix + execute > chunk:
        raise UserError(
            f"model.chunk={chunk} has no room for model.prefix={prefix} and model.execute={execute} after it: "
            "lower one of these, or raise model.chunk"
        )


def require_fit(method: type, model: Mapping[str, Any], delay: int) -> None:
    """Raise a UserError if chunks or trained prefixes of a model, given by its node, are too short for a delay."""
    chunk = model["chunk"]
    interval = max(delay, model.get("execute") or chunk)  # between one plan and the next
    if delay + interval > chunk:
        raise UserError(
            f"plans begin {counted(interval, 'action')} apart and arrive {delay} late, when the one before, of "
            f"model.chunk={chunk}, is over: train with a larger one, or lower model.execute or the delay of the network"
        )
    if issubclass(method, TrainedPrefix) and delay > (prefix := model["prefix"]):
        raise UserError(f"plans arrive {delay} actions late, more than model.prefix={prefix}: train with a larger one")
