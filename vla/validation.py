"""The policy at work while it is being trained: its success on fixed seeds decides which weights are kept as best."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from lightning import Callback, LightningModule, Trainer

from vla.evaluate import ClosableEnvironment, play
from vla.intervals import wilson_interval
from vla.models.learner import Learner
from vla.models.model import Model
from vla.spec import Agent

log = logging.getLogger(__name__)

BEST = "best.ckpt"


class ClosedLoop(Callback):
    """In every validation, plays episodes with the weights that would be saved, and logs `val/success`, 0…1.

    The processes of a training share the episodes. The newest weights of those that succeeded most often are kept as
    `best.ckpt`. Where the weights are shared out among processes, which then act in step only, nothing is played.

    Args:
        make_environment: makes the environment, in which every process plays.
        make_policy: makes the policy of a model in training.
        seeds: of the episodes, the same ones every time.
        checkpoints: folder of `best.ckpt`.
    """

    def __init__(
        self,
        make_environment: Callable[[], ClosableEnvironment],
        make_policy: Callable[[Model], Agent],
        seeds: Sequence[int],
        checkpoints: Path,
    ) -> None:
        self._make_environment, self._make_policy, self._seeds = make_environment, make_policy, seeds
        self._path = checkpoints / BEST
        self._environment: ClosableEnvironment | None = None
        self.success, self.best = 0.0, -1.0

    def on_validation_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Play; the averaged weights are in place until callbacks that come later put the others back."""
        assert isinstance(pl_module, Learner)
        if pl_module.device_mesh is not None:
            return
        if self._environment is None:
            self._environment = self._make_environment()
        policy = self._make_policy(pl_module.model)
        mine = self._seeds[trainer.global_rank :: trainer.world_size]
        with torch.compiler.set_stance("force_eager"):  # one window is not the shape that was compiled
            results = [play(self._environment, policy, seed) for seed in mine]
        for result in results:
            if result.error:
                log.warning("seed %d could not be played in validation: %s", result.seed, result.error)
        won = sum(result.outcome == "success" for result in results)
        share = torch.tensor(won / len(self._seeds), device=pl_module.device)
        pl_module.log("val/success", share, sync_dist=True, reduce_fx="sum")

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Keep what is as good as the best so far: of equals, what was trained longer."""
        self.success = float(trainer.callback_metrics.get("val/success", -1.0))
        if self.success >= max(self.best, 0.0):
            self.best = self.success
            trainer.save_checkpoint(self._path, weights_only=False)

    def teardown(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Free the environment."""
        if self._environment is not None:
            self._environment.close()
            self._environment = None

    def chosen(self, last: Path) -> Path:
        """`best.ckpt` where the last validation lies below the 95 % confidence interval of the best one, else `last`:
        among a few episodes, one more or less is chance, while longer trained is better."""
        low, _ = wilson_interval(round(max(self.best, 0.0) * len(self._seeds)), len(self._seeds))
        if self.success >= low or not self._path.exists():
            return last
        log.info("success in validation fell from %.0f to %.0f %%: %s", 100 * self.best, 100 * self.success, self._path)
        return self._path

    def state_dict(self) -> dict[str, Any]:
        """What an interrupted training goes on with."""
        return {"success": self.success, "best": self.best, "seeds": list(self._seeds)}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go on with it."""
        self.success = state_dict["success"]
        # Where it was left in another folder, or judged by other episodes, what comes now is the best here.
        if self._path.exists() and state_dict.get("seeds") == list(self._seeds):
            self.best = state_dict["best"]
