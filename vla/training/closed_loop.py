"""Closed-loop validation: success rate on fixed seeds during training, which selects the best checkpoint."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import torch
from annotated_types import Ge, Le
from lightning import Callback, LightningModule, Trainer

from vla.io.documents import STRICT, parse_plain
from vla.models.learner import Learner
from vla.models.model import Model
from vla.rollouts.evaluate import play
from vla.rollouts.statistics import wilson_interval
from vla.spec import Agent, Environment

log = logging.getLogger(__name__)

BEST = "best.ckpt"

Success = Annotated[float, Ge(-1), Le(1)]  # success rate; -1: not measured


@dataclass(frozen=True)
class ClosedLoopState:
    """State of `ClosedLoop` in a checkpoint."""

    __pydantic_config__ = STRICT

    success: Success
    best: Success
    seeds: list[int] | None = None


class ClosedLoop(Callback):
    """Plays episodes with the EMA weights in every validation, and logs `val/success`, 0…1.

    The processes of a training split the episodes. The weights with the highest success rate are saved as `best.ckpt`;
    ties go to the newest. With sharded weights nothing is played, because all processes would have to act in step.

    Args:
        make_environment: factory of the environment, called for every validation, after which it is closed.
        make_policy: factory of a policy from the model in training.
        seeds: of the episodes, the same in every validation.
        checkpoints: folder of `best.ckpt`.
    """

    def __init__(
        self,
        make_environment: Callable[[], Environment],
        make_policy: Callable[[Model], Agent],
        seeds: Sequence[int],
        checkpoints: Path,
    ) -> None:
        self._make_environment, self._make_policy, self._seeds = make_environment, make_policy, seeds
        self._path = checkpoints / BEST
        self._plays = self._played = False
        self.success, self.best = 0.0, -1.0

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Build the environment before training, in case this machine cannot."""
        assert isinstance(pl_module, Learner)
        self._plays = pl_module.device_mesh is None and trainer.enable_validation
        if self._plays:
            environment, spec = self._make_environment(), pl_module.model.spec.without_truth
            environment.close()
            spec.require(environment.spec.without_truth, "the demonstrations", "the task")

    def on_validation_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Play the episodes; later callbacks restore the weights in training."""
        assert isinstance(pl_module, Learner)
        if not self._plays:
            return
        policy, environment = self._make_policy(pl_module.model), self._make_environment()
        mine = self._seeds[trainer.global_rank :: trainer.world_size]
        with closing(environment), torch.compiler.set_stance("force_eager"):  # a window's shape is not the compiled one
            results = [play(environment, policy, seed) for seed in mine]
        for result in results:
            if result.error:
                log.warning("validation: seed %d could not be played: %s", result.seed, result.error)
        counts = [sum(result.success for result in results), sum(not result.error for result in results)]
        gathered = pl_module.all_gather(torch.tensor(counts, device=pl_module.device))
        assert isinstance(gathered, torch.Tensor)
        won, completed = gathered.view(-1, 2).sum(0).tolist()  # of all processes
        self._played = completed > 0
        if self._played:
            self.success = won / completed
            pl_module.log("val/success", self.success, sync_dist=True)

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Save `best.ckpt` if episodes were played, and their success rate is at least the best so far."""
        if self._played and self.success >= self.best:
            self.best = self.success
            trainer.save_checkpoint(self._path, weights_only=False)

    def selected_checkpoint(self, last: Path) -> Path:
        """Return `best.ckpt` if the last success rate is below the 95 % confidence interval of the best, else `last`.

        Smaller differences between a few episodes are chance, and longer training is better.
        """
        low, _ = wilson_interval(round(max(self.best, 0.0) * len(self._seeds)), len(self._seeds))
        if self.success >= low or not self._path.exists():
            return last
        log.info("success in validation fell from %.0f to %.0f %%: %s", 100 * self.best, 100 * self.success, self._path)
        return self._path

    def state_dict(self) -> dict[str, Any]:
        """Return the state to save in a checkpoint."""
        return {"success": self.success, "best": self.best, "seeds": list(self._seeds)}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore the state; a ValueError if it is of another kind."""
        state = parse_plain(state_dict, ClosedLoopState, "the state of the validation")
        self.success = state.success
        # The best is void in another folder or with other episodes.
        if self._path.exists() and state.seeds == list(self._seeds):
            self.best = state.best
