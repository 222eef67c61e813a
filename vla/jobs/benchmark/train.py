"""Throughput of training, from the loader to the EMA weights."""

from __future__ import annotations

from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import lightning
import torch

from vla.config.experiment import Experiment
from vla.config.nodes import Benchmark
from vla.jobs.benchmark.measure import Measure, measure
from vla.jobs.collect import demonstrations
from vla.runs.folder import CHECKPOINTS
from vla.training.device import synchronized_time
from vla.training.trainer import explain_memory_errors, make_trainer, quiet_lightning

WARM_UP = 3  # steps of a round that are not timed: they allocate and compile


def train(experiment: Experiment) -> dict[str, Measure]:
    """Measure the throughput of training in each precision, compiled and not.

    The floor is forward pass, backward pass and optimiser step alone, on one batch. Rounds alternate and the fastest
    counts, so that other load on the machine affects all alike.
    """
    options = experiment.options(Benchmark)
    quiet_lightning()
    store, trials = demonstrations(experiment), list[tuple[str, Experiment, Any, list[_Stopwatch]]]()
    for precision, compiled in product(options.precisions, sorted(set(options.compile))):
        changes = {
            "learner.compile": compiled,
            "trainer.precision": precision,
            "trainer.max_steps": WARM_UP + options.steps,
            "trainer.accumulate_grad_batches": 1,
            "trainer.limit_val_batches": 0,
        }
        variant = experiment.with_values(changes)
        name = f"train: {precision}{' compile' if compiled else ''}"
        trials.append((name, variant, variant.fitted_learner(store), []))
    for _ in range(options.rounds):
        for _, variant, learner, rounds in trials:
            model, watch = learner.model, _Stopwatch(options.steps)
            data = variant.data(store, model.history, model.chunk, model)
            with explain_memory_errors(experiment.config), TemporaryDirectory() as folder:
                trainer = make_trainer(variant.config, Path(folder) / CHECKPOINTS, watch)
                trainer.fit(learner, datamodule=data)
            if trainer.received_sigterm:  # Lightning ignores it in the last hook
                raise KeyboardInterrupt
            rounds.append(watch)
    measures, samples = dict[str, Measure](), options.steps * experiment["data"]["batch_size"]
    for name, _, _, rounds in trials:
        seconds, floor = (min(getattr(stopwatch, field) for stopwatch in rounds) for field in ("seconds", "alone"))
        measures[name] = measure(samples / seconds, "samples/s", samples, samples / floor)
    return measures


class _Stopwatch(lightning.Callback):
    """Callback that times the steps of a training after a warm-up, then as many of the model alone [s]."""

    def __init__(self, steps: int) -> None:
        self.steps, self.seconds, self.alone = steps, 0.0, 0.0

    def on_train_start(self, trainer: Any, pl_module: lightning.LightningModule) -> None:
        """Verify the demonstrations, which long trainings do once."""
        trainer.datamodule.verify()

    def on_train_batch_end(
        self, trainer: Any, pl_module: lightning.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Start the clock after the warm-up, and stop it after the last step."""
        if batch_idx + 1 in (WARM_UP, WARM_UP + self.steps):
            self.seconds = synchronized_time(pl_module.device) - self.seconds
            self._batch = batch

    def on_train_end(self, trainer: Any, pl_module: Any) -> None:
        """Time the model alone, while it and a batch are on the device."""
        model, optimizer = pl_module.model, torch.optim.AdamW(pl_module.model.parameters(), fused=True)
        for step in range(WARM_UP + self.steps):
            if step == WARM_UP:
                self.alone = synchronized_time(pl_module.device)
            optimizer.zero_grad()
            with trainer.precision_plugin.train_step_context():
                loss = model.loss(model.augment(self._batch))["loss"]
            loss.backward()
            optimizer.step()
        self.alone = synchronized_time(pl_module.device) - self.alone
        del self._batch
        pl_module.zero_grad()
