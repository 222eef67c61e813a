"""Samples per second of training, from the loader to the averaged weights, against what takes part in it alone."""

from __future__ import annotations

import copy
import logging
import os
import shutil
import time
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import lightning
import torch
from lightning.pytorch.profilers import SimpleProfiler
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from vla.benchmark.measure import Measure, measure
from vla.benchmark.memory import forget_peak, peak
from vla.data.episodes import EpisodeStore
from vla.models.flops import matmul_flops, peak_flops, training_flops
from vla.parts import collected, make_data, make_learner
from vla.processor import computes_on_processor, has_bfloat16
from vla.trainer import enough_memory, make_trainer, quiet_lightning

log = logging.getLogger(__name__)

PRECISIONS = {"fp32": "32-true", "bf16": "bf16-mixed"}  # the trainer's names
WARM_UP = 3  # steps of a round before the clock starts: the first ones allocate and compile
WAITING = "[_TrainingEpochLoop].train_dataloader_next"  # what Lightning's profiler calls it
PEAK_SECONDS = 0.5  # per round, for the peak of a device that none is known of


def measures(config: DictConfig) -> dict[str, Measure]:
    """Training in every precision that is fast here, or that is asked for, compiled and not, five measures of each;
    and the loader alone.

    - samples per second through the real trainer and loader, against forward, backward and optimiser step alone on one
      batch that is there, of the same precision, compiled alike;
    - how long a step waits for its batch, against how long it takes;
    - the arithmetic of the model, against the peak of the device: the ratio is the model FLOPs utilisation. Where no
      data sheet gives the peak, it is the best rate that this run measured in the same precision, of matrix products
      of several sizes (in mixed precision also of 32 bits) or of the model;
    - the memory at its fullest, on a CPU what training adds to the process, against gradients and the optimiser's two
      moments;
    - the mean loss of the later half of the steps, against that of the first kind: start and batches are the same.

    Rounds go in turns and the best one counts, so that a busy moment of the machine falls on none of them alone.

    Raises:
        ValueError: nothing is asked for, there is no compiler, or not enough memory.
    """
    on_processor = computes_on_processor(config.trainer.accelerator)
    precisions = _precisions(config.benchmark.precisions, on_processor)
    if not precisions or not config.benchmark.compile:
        raise ValueError("training is timed in each of benchmark.precisions and benchmark.compile: both need an entry")
    if any(config.benchmark.compile) and on_processor and not shutil.which(os.environ.get("CXX", "g++")):
        raise ValueError("to compile for a CPU takes a C++ compiler: install g++, or set benchmark.compile=[false]")
    quiet_lightning()
    logging.getLogger("lightning.pytorch.profilers").setLevel(logging.WARNING)
    store = collected(config)
    kinds = product(precisions, sorted(set(config.benchmark.compile)))
    trials = [Trial(config, store, precision, compiled) for precision, compiled in kinds]
    loading = []
    for _ in range(config.benchmark.rounds):
        for trial in trials:
            with enough_memory(config):
                trial.play()
        loading.append(trials[0].load())
    found: dict[str, Measure] = {}
    for trial in trials:
        peak = max(max(other.peak, other.rate) for other in trials if other.precision == trial.precision)
        found |= trial.measures(peak, trials[0].loss)
    fastest = max(trial.samples / trial.best.seconds for trial in trials)
    found["train: loader alone"] = measure(trials[0].samples / min(loading), "samples/s", trials[0].samples, fastest)
    return found


def _precisions(asked: Sequence[str] | None, on_processor: bool) -> Sequence[str]:
    if asked is not None:
        return asked
    if on_processor and not has_bfloat16():
        log.info("bf16 is left out: this processor has no instructions for it; benchmark.precisions=[bf16] times it")
        return ["fp32"]
    return list(PRECISIONS)


class Round(NamedTuple):
    """How long the timed steps of a round took [s]."""

    seconds: float
    waiting: float  # for batches, in it
    alone: float  # without trainer and loader
    memory: float  # at its fullest [B]


class Trial(lightning.Callback):
    """A short training that is done again and again from the same start, and watched.

    Args:
        config: of the training.
        store: the demonstrations.
        precision: "fp32" or "bf16".
        compiled: whether the model is.
    """

    def __init__(self, config: DictConfig, store: EpisodeStore, precision: str, compiled: bool) -> None:
        self.precision, self.name = precision, f"{precision} compile" if compiled else precision
        self.steps = config.benchmark.steps
        self.samples = self.steps * config.data.batch_size
        self.loss = self.peak = self._flops = 0.0
        self._store, self._config = store, config.copy()
        changes = {
            "learner.compile": compiled,
            "trainer.precision": PRECISIONS[precision],
            "trainer.max_steps": WARM_UP + self.steps,
            "trainer.accumulate_grad_batches": 1,
            "trainer.limit_val_batches": 0,
            "trainer.profiler": "simple",
        }
        for key, value in changes.items():
            OmegaConf.update(self._config, key, value, force_add=True)
        lightning.seed_everything(config.seed, verbose=False)
        self._learner = make_learner(self._config, store)
        self._start = copy.deepcopy(self._learner.state_dict())
        self._rounds: list[Round] = []

    @property
    def rate(self) -> float:
        """The best rate of the model [FLOP/s], within the training or without it."""
        return self._flops * self.steps / min(min(each.seconds, each.alone) for each in self._rounds)

    @property
    def best(self) -> Round:
        """The fastest round."""
        return min(self._rounds, key=lambda each: each.seconds)

    def play(self) -> None:
        """One round: the training, then as many steps of the model alone."""
        self._marks: list[float] = []
        self._losses: list[Tensor] = []
        lightning.seed_everything(self._config.seed, verbose=False)
        self._learner.load_state_dict(self._start)
        data = make_data(self._config, self._store, self._learner.model)
        with TemporaryDirectory() as folder:
            trainer = make_trainer(self._config, Path(folder), self)
            trainer.fit(self._learner, datamodule=data)
            if trainer.received_sigterm:  # in the last hook, after which Lightning would go on as if nothing were
                raise KeyboardInterrupt
        profiler: SimpleProfiler = trainer.profiler  # type: ignore[attr-defined]
        waiting = sum(profiler.recorded_durations[WAITING][WARM_UP : WARM_UP + self.steps])
        self._rounds.append(Round(self._marks[1] - self._marks[0], waiting, self._alone, self._memory))
        self.loss = torch.stack(self._losses[WARM_UP + self.steps // 2 :]).mean().item()
        self._learner.zero_grad()

    def load(self) -> float:
        """How long the loader takes for the batches of a round [s], with nobody at work beside it."""
        data = make_data(self._config, self._store, self._learner.model)
        data.setup("fit")
        stream = iter(data.train_dataloader())
        next(stream)
        started = time.perf_counter()
        for _ in range(self.steps):
            next(stream)
        return time.perf_counter() - started

    def on_train_start(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """What was before does not count."""
        self._held = forget_peak(pl_module.device)

    def on_train_batch_end(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Start the clock after some steps, and stop it."""
        self._losses.append(outputs["loss"].detach())
        if batch_idx + 1 in (WARM_UP, WARM_UP + self.steps):
            self._marks.append(_now(pl_module.device))
            self._batch = batch

    def on_train_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """While model and batch are where they were trained: the floors."""
        device, model = self._learner.device, self._learner.model
        self._memory = peak(device) - self._held
        optimizer = torch.optim.AdamW(model.parameters(), fused=True)
        for step in range(WARM_UP + self.steps):
            if step == WARM_UP:
                started = _now(device)
            optimizer.zero_grad()
            with trainer.precision_plugin.train_step_context():
                loss = model.loss(self._batch)["loss"]
            loss.backward()
            optimizer.step()
        self._alone = _now(device) - started
        self._flops = self._flops or training_flops(model, self._batch)
        precision = PRECISIONS[self.precision]
        known = peak_flops(device, precision)
        self.peak = max(self.peak, known or matmul_flops(device, precision, PEAK_SECONDS))
        self._whose = "the data sheet" if known else "measured rates"
        del self._batch

    def measures(self, peak: float, loss: float) -> dict[str, Measure]:
        """Of the best round, by name, given the peak of the device [FLOP/s] and the loss to compare with."""
        best, alone = self.best, min(each.alone for each in self._rounds)
        weights = sum(each.nbytes for each in self._learner.parameters() if each.requires_grad)
        rate, megabytes = self.samples / best.seconds, min(each.memory for each in self._rounds) / 1e6
        flops = self._flops * self.steps / best.seconds
        found = {
            "": measure(rate, "samples/s", self.samples, self.samples / alone),
            ": data-wait": measure(
                1000 * best.waiting / self.steps, "ms/step", self.steps, 1000 * best.seconds / self.steps
            ),
            ": MFU": measure(flops / 1e9, f"GFLOP/s, peak of {self._whose}", self.steps, peak / 1e9),
            ": memory": measure(megabytes, "MB", self.steps, 3 * weights / 1e6),
            ": loss": measure(self.loss, "mean", self.steps, loss),
        }
        return {f"train: {self.name}{what}": value for what, value in found.items()}


def _now(device: torch.device) -> float:
    """The time [s] at which a device has done what it was given."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()
