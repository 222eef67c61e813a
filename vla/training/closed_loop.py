"""Closed-loop validation: success rate on fixed seeds during training, which selects the best checkpoint."""

from __future__ import annotations

import logging
import pickle
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch
from lightning import Callback, LightningModule, Trainer

from vla.models.learner import Learner
from vla.models.model import Model
from vla.models.policy_folder import BEST
from vla.parallel.limits import free_memory
from vla.parallel.pool import Future, ProcessPool, WorkerCrash
from vla.parallel.processes import one_thread_each
from vla.rollouts.results import ERROR, Result
from vla.rollouts.statistics import wilson_interval
from vla.spec import Agent, Environment
from vla.training.device import memory_of
from vla.training.player import Player

log = logging.getLogger(__name__)

ROOM = 3  # memory of a process with a model, as a multiple of its weights: they arrive pickled, and the model acts
GPU_PROCESS_MEMORY = 1e9  # of the GPU, and of the machine, that a process takes without its model [bytes]
PER_WORKER = 5  # smallest number of episodes per process; fewer would take less time than its start


class ClosedLoop(Callback):
    """Plays episodes with the EMA weights in every validation, and logs `val/success`, 0…1.

    The processes of a training split the episodes, and each has workers that share its part; a result does not depend
    on their number. The policy with the highest success rate is saved as `policy_best`; ties go to the newest. No
    episodes are played with sharded weights, as all processes would have to act in lockstep. Workers end on exit.

    Args:
        make_environment: factory of the environment, called for every validation, after which it is closed.
        make_policy: factory of a policy from the model in training, on its device.
        seeds: of the episodes, the same in every validation.
        run: folder of `policy_best`.
        workers: largest number of worker processes on this machine.
    """

    def __init__(
        self,
        make_environment: Callable[[], Environment],
        make_policy: Callable[[Model], Agent],
        seeds: Sequence[int],
        run: Path,
        workers: int = 1,
    ) -> None:
        self._make_environment, self._seeds, self._workers = make_environment, seeds, workers
        self._make_player = partial(Player, make_environment, make_policy)
        self._pool: ProcessPool | None = None
        self._path = run / BEST
        self._enabled = self._played = False
        self.success, self.best = 0.0, -1.0

    def __enter__(self) -> ClosedLoop:
        """Enter the context; workers start in the first validation and wait for the next ones."""
        return self

    def __exit__(self, *error: Any) -> None:
        """End the workers."""
        if self._pool is not None:
            self._pool.__exit__(*error)
            self._pool = None

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Build the environment and pickle the model, as for every validation, before training, in case that fails."""
        assert isinstance(pl_module, Learner)
        self._enabled = pl_module.device_mesh is None and trainer.enable_validation
        if self._enabled:
            environment = self._make_environment()
            environment.close()
            pl_module.model.spec.require_input(environment.spec, "the demonstrations", "the task")
            if self._worker_count(pl_module, min(self._workers, len(self._seeds) // PER_WORKER)) > 1:
                pickle.dumps(pl_module.model)

    def on_validation_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Play the episodes; later callbacks restore the weights in training."""
        assert isinstance(pl_module, Learner)
        if not self._enabled:
            return
        seeds = self._seeds[trainer.global_rank :: trainer.world_size]
        workers = self._workers * trainer.num_nodes // trainer.world_size
        results = self.play(pl_module, seeds, min(workers, len(seeds) // PER_WORKER))
        for result in results:
            if result.error:
                log.warning("validation: seed %d could not be played: %s", result.seed, result.error)
        counts = [sum(result.success for result in results), sum(not result.error for result in results)]
        process_counts = pl_module.all_gather(torch.tensor(counts, device=pl_module.device))
        assert isinstance(process_counts, torch.Tensor)
        successes, episodes = process_counts.view(-1, 2).sum(0).tolist()  # of all processes
        self._played = episodes > 0
        if self._played:
            self.success = successes / episodes
            pl_module.log("val/success", self.success, sync_dist=True)

    def play(self, learner: Learner, seeds: Sequence[int], workers: int) -> list[Result]:
        """Return the results of episodes with the given seeds and the present weights.

        At most as many worker processes play as have memory for a model each; if only one has, this process plays.
        """
        workers = self._worker_count(learner, workers)
        with one_thread_each():
            if workers <= 1:
                with learner.evaluating():
                    return self._make_player().play(learner.model, seeds)
            if self._pool is None:
                self._pool = ProcessPool(self._make_player, workers).__enter__()
            model = pickle.dumps(learner.model)
            parts = [seeds[worker::workers] for worker in range(workers)]
            futures = [self._pool.submit((model, part)) for part in parts]
            return [result for future, part in zip(futures, parts, strict=True) for result in _results(future, part)]

    @staticmethod
    def _worker_count(learner: Learner, most: int) -> int:
        """Return how many workers, at most `most`, have memory for a model each."""
        size = sum(weight.nbytes for weight in learner.model.parameters())
        return min(most, processes_that_fit(learner.device, size))

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Save `policy_best` if episodes were played, and their success rate is at least the best so far."""
        if self._played and self.success >= self.best:
            self.best = self.success
            trainer.save_checkpoint(self._path, weights_only=False)

    def clearly_better_policy(self) -> Path | None:
        """Return `policy_best` if the last success rate is below the 95 % confidence interval of the best, else None.

        Smaller differences in a few episodes are mostly chance, and then longer training is better.
        """
        low, _ = wilson_interval(round(max(self.best, 0.0) * len(self._seeds)), len(self._seeds))
        if self.success >= low or not self._path.exists():
            return None
        text = "success in validation fell from %.0f to %.0f %%: the policy is a copy of %s"
        log.info(text, 100 * self.best, 100 * self.success, self._path)
        return self._path

    def state_dict(self) -> dict[str, Any]:
        """Return the state to save in a checkpoint."""
        return {"success": self.success, "best": self.best, "seeds": list(self._seeds)}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore the state, but not the best success rate in another folder or with other episodes."""
        self.success = state_dict["success"]
        if self._path.exists() and state_dict["seeds"] == list(self._seeds):
            self.best = state_dict["best"]


def processes_that_fit(device: torch.device, size: float) -> int:
    """Return how many processes have memory for a model of `size` [bytes] on a device, each with a copy of its own."""
    overhead = GPU_PROCESS_MEMORY if device.type == "cuda" else 0
    return int(min(memory_of(device)[1], free_memory()) / (ROOM * size + overhead))


def _results(future: Future, seeds: Sequence[int]) -> list[Result]:
    try:
        return future.result()
    except WorkerCrash as crash:
        return [Result(seed, ERROR, error=str(crash)) for seed in seeds]
