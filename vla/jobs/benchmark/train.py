"""Throughput, memory and loss of training, from the loader to the EMA weights."""

from __future__ import annotations

import copy
import logging
import time
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import lightning
import torch
from lightning.pytorch.profilers import SimpleProfiler
from torch import Tensor

from vla.config.experiment import Experiment
from vla.config.nodes import Benchmark
from vla.data.datamodule import WindowDataModule
from vla.data.episodes import EpisodeStore
from vla.io.errors import UserError
from vla.jobs.benchmark.measure import Measure, measure
from vla.jobs.benchmark.memory import peak, reset_peak
from vla.jobs.collect import demonstrations
from vla.jobs.machine import computes_on_cpu, has_bfloat16
from vla.models.flops import matmul_flops, peak_flops, training_flops
from vla.runs.folder import CHECKPOINTS
from vla.training.trainer import PRECISIONS, explain_memory_errors, make_trainer, quiet_lightning

log = logging.getLogger(__name__)

WARM_UP = 3  # steps of a round that are not timed: they allocate and compile
WAITING = "[_TrainingEpochLoop].train_dataloader_next"  # what Lightning's profiler calls it
PEAK_SECONDS = 0.5  # duration of the measurement of an unknown peak, per round


def measures(experiment: Experiment) -> dict[str, Measure]:
    """Measure training in each precision, compiled and not, and the loader alone.

    - Throughput of trainer and loader; the floor is forward pass, backward pass and optimiser step alone, on one batch.
    - data-wait: time that a step waits for its batch; the floor is the duration of the step.
    - MFU: FLOP/s of the model; the floor is the peak of the device, so the ratio is the model FLOPs utilisation. If no
      data sheet gives the peak, it is the best rate of this run in the same precision: of matrix products of several
      sizes (for mixed precision also in float32) or of the model.
    - memory: peak, on a CPU the increase by training; the floor is gradients and the optimiser's two moments.
    - loss: mean of the second half of the steps; the floor is that of the first combination, which starts from the same
      weights and trains on the same batches.

    Rounds of the combinations alternate and the fastest counts, so that other load on the machine affects all alike.

    Raises:
        UserError: there is nothing to measure, or not enough memory.
    """
    asked = experiment.options(Benchmark)
    on_processor = computes_on_cpu(experiment.trainer["accelerator"])
    precisions = _precisions(asked.precisions, on_processor)
    if not precisions or not asked.compile:
        raise UserError("training is timed in each of benchmark.precisions and benchmark.compile: both need an entry")
    quiet_lightning()
    logging.getLogger("lightning.pytorch.profilers").setLevel(logging.WARNING)
    store = demonstrations(experiment)
    kinds = product(precisions, sorted(set(asked.compile)))
    trials = [Trial(experiment, store, precision, compiled) for precision, compiled in kinds]
    loading = []
    for _ in range(asked.rounds):
        for trial in trials:
            with explain_memory_errors(experiment.config):
                trial.play()
        loading.append(trials[0].load())
    found: dict[str, Measure] = {}
    for trial in trials:
        fastest_rate = max(max(other.peak, other.rate) for other in trials if other.precision == trial.precision)
        found |= trial.measures(fastest_rate, trials[0].loss)
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


class Timing(NamedTuple):
    """Durations of the timed steps of a round [s], and its memory."""

    seconds: float
    waiting: float  # of these, for batches
    alone: float  # without trainer and loader
    memory: float  # peak [B]


class Trial(lightning.Callback):
    """Callback that repeats a short training from the same initial weights and measures it.

    Args:
        experiment: describes the training.
        store: the demonstrations.
        precision: "fp32" or "bf16".
        compiled: compile the model.
    """

    def __init__(self, experiment: Experiment, store: EpisodeStore, precision: str, compiled: bool) -> None:
        self.precision, self.name = precision, f"{precision} compile" if compiled else precision
        self.steps = experiment.options(Benchmark).steps
        self.samples = self.steps * experiment["data"]["batch_size"]
        self.loss = self.peak = self._flops = 0.0
        self._store = store
        changes = {
            "learner.compile": compiled,
            "trainer.precision": precision,
            "trainer.max_steps": WARM_UP + self.steps,
            "trainer.accumulate_grad_batches": 1,
            "trainer.limit_val_batches": 0,
            "trainer.profiler": "simple",
        }
        self._experiment = experiment.with_values(changes)
        lightning.seed_everything(experiment.settings.seed, verbose=False)
        self._learner = self._experiment.fitted_learner(store)
        self._start = copy.deepcopy(self._learner.state_dict())
        self._rounds: list[Timing] = []

    @property
    def rate(self) -> float:
        """Highest rate of the model [FLOP/s], in training or alone."""
        return self._flops * self.steps / min(min(each.seconds, each.alone) for each in self._rounds)

    @property
    def best(self) -> Timing:
        """Fastest round."""
        return min(self._rounds, key=lambda each: each.seconds)

    def play(self) -> None:
        """Play one round: the training, then as many steps of the model alone."""
        self._marks: list[float] = []
        self._losses: list[Tensor] = []
        lightning.seed_everything(self._experiment.settings.seed, verbose=False)
        self._learner.load_state_dict(self._start)
        data = self._data()
        with TemporaryDirectory() as folder:
            trainer = make_trainer(self._experiment.config, Path(folder) / CHECKPOINTS, self)
            trainer.fit(self._learner, datamodule=data)
            if trainer.received_sigterm:  # Lightning ignores it in the last hook
                raise KeyboardInterrupt
        profiler: SimpleProfiler = trainer.profiler  # type: ignore[attr-defined]
        waiting = sum(profiler.recorded_durations[WAITING][WARM_UP : WARM_UP + self.steps])
        self._rounds.append(Timing(self._marks[1] - self._marks[0], waiting, self._alone, self._memory))
        self.loss = torch.stack(self._losses[WARM_UP + self.steps // 2 :]).mean().item()
        self._learner.zero_grad()

    def load(self) -> float:
        """Return the time of the loader for the batches of a round [s], without training."""
        data = self._data()
        data.setup("fit")
        data.make_batch.verify()
        stream = iter(data.train_dataloader())
        next(stream)
        started = time.perf_counter()
        for _ in range(self.steps):
            next(stream)
        return time.perf_counter() - started

    def _data(self) -> WindowDataModule:
        model = self._learner.model
        return self._experiment.data(self._store, model.history, model.chunk, model.text.tokenize)

    def on_train_start(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Verify the demonstrations, which long trainings do once, and reset the peak of the memory."""
        trainer.datamodule.make_batch.verify()  # type: ignore[attr-defined]
        self._held = reset_peak(pl_module.device)

    def on_train_batch_end(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Start the clock after the warm-up, and stop it after the last step."""
        self._losses.append(outputs["loss"].detach())
        if batch_idx + 1 in (WARM_UP, WARM_UP + self.steps):
            self._marks.append(_now(pl_module.device))
            self._batch = batch

    def on_train_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Measure the floors, while model and batch are on the device."""
        device, model = self._learner.device, self._learner.model
        self._memory = peak(device) - self._held
        optimizer = torch.optim.AdamW(model.parameters(), fused=True)
        started = 0.0
        for step in range(WARM_UP + self.steps):
            if step == WARM_UP:
                started = _now(device)
            optimizer.zero_grad()
            with trainer.precision_plugin.train_step_context():
                loss = model.loss(model.augment(self._batch))["loss"]
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
        """Return name → measure of the fastest round, given the peak of the device [FLOP/s] and a reference loss."""
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
    """Wait for the work of a device and return the time [s]."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()
