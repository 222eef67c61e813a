"""Lightning's trainer from a config, with all callbacks, and random numbers that resume exactly."""

from __future__ import annotations

import ctypes
import logging
import platform
import sys
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.accelerators import CPUAccelerator
from lightning.pytorch.callbacks import Checkpoint
from lightning.pytorch.loggers import CSVLogger
from lightning.pytorch.plugins.layer_sync import TorchSyncBatchNorm
from lightning.pytorch.strategies import ParallelStrategy
from lightning.pytorch.utilities.exceptions import MisconfigurationException

from vla.config.build import build
from vla.config.differences import value_at
from vla.io.errors import UserError
from vla.models.checkpoint import read_header
from vla.parallel.limits import cores
from vla.runs.folder import METRICS, metric_rows
from vla.training.checkpoints import AtomicCheckpointIO
from vla.training.ema import EMA
from vla.training.throughput import Throughput, TrainingProgressBar

log = logging.getLogger(__name__)

PRECISIONS = {"fp32": "32-true", "bf16": "bf16-mixed"}  # config → Lightning
SIZE_KEYS = ("data.batch_size", "model.context.history", "model.image_size", "model.chunk", "model.width")
# In error messages: of PyTorch on a CPU, of PyTorch on a GPU, and of CUDA libraries that fail to allocate memory.
OUT_OF_MEMORY = ("can't allocate memory", "out of memory", "ALLOC_FAILED", "ALLOCATION_FAILED")
TRIM_THRESHOLD, MMAP_THRESHOLD = -1, -3  # of mallopt(3)
MAX_MMAP_THRESHOLD = 2**25  # [B]


class StepSeeding(Callback):
    """Seeds torch before every batch from the seed, the step and the rank.

    Random numbers of a step are therefore independent of validations, interruptions and resuming.
    """

    def __init__(self, seed: int) -> None:
        self._seed = seed

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        """Seed the generators of the processor and of the module's device."""
        parts = trainer.accumulate_grad_batches
        step = trainer.global_step * parts + batch_idx % parts
        numbers = np.random.SeedSequence([self._seed, step, trainer.global_rank]).generate_state(1, np.uint64)
        seed = int(numbers[0])
        if pl_module.device.type == "cpu":
            torch.default_generator.manual_seed(seed)  # `torch.manual_seed` asks for other devices, which takes longer
        else:
            torch.manual_seed(seed)


class SyncBatchNorm(TorchSyncBatchNorm):
    """Batch normalisation over all processes; timm's layers keep their activations, which torch's conversion drops."""

    def apply(self, model: torch.nn.Module) -> torch.nn.Module:
        """Return the model with its layers converted."""
        from vla.models.vision.timm_encoders import synchronize_batch_norm

        return synchronize_batch_norm(model)


def make_trainer(config: Mapping[str, Any], checkpoints: Path, *callbacks: Callback) -> Trainer:
    """Create the trainer of a config, with EMA, and with loggers that write into the parent folder of `checkpoints`.

    The given callbacks run before EMA at the end of a validation, so that they use the EMA weights.

    Raises:
        UserError: the machine lacks what the config requires, or a library that a logger needs.
    """
    _keep_freed_memory()
    decay, loggers = config["learner"].get("ema"), (config["logger"] or {}).values()
    trainer = _trainer(
        config["trainer"],
        callbacks=[
            TrainingProgressBar(),
            *callbacks,
            *([EMA(decay)] if decay else []),
            Throughput(),
            StepSeeding(config["seed"]),  # after callbacks that may use random numbers
        ],
        logger=[build(node, "logger", save_dir=str(checkpoints.parent)) for node in loggers],
        enable_checkpointing=any(isinstance(item, Checkpoint) for item in callbacks),  # else Lightning adds its own
        enable_progress_bar=False,
    )
    environment = getattr(trainer.strategy, "cluster_environment", None)
    external = environment is not None and environment.creates_processes_externally
    # Two processes are always allowed, to try distributed training on any machine.
    if isinstance(trainer.accelerator, CPUAccelerator) and not external and trainer.num_devices > max(cores(), 2):
        raise UserError(
            f"trainer.devices={trainer.num_devices} asks for more processes than this machine has cores: set "
            f"trainer.devices={cores()} or fewer"
        )
    trainer.strategy.checkpoint_io = AtomicCheckpointIO()
    return trainer


def _trainer(node: Mapping[str, Any], **options: Any) -> Trainer:
    """Build the trainer of a node; a UserError if the machine, or a cluster, lacks what it requires."""
    options |= {"precision": PRECISIONS[node["precision"]]}
    if node.get("sync_batchnorm"):
        options["plugins"] = [SyncBatchNorm()]
    try:
        arguments = {name: value for name, value in node.items() if name != "precision"}
        trainer: Trainer = build(arguments, "trainer", **options)
        if isinstance(trainer.strategy, ParallelStrategy) and trainer.strategy.cluster_environment:
            # Compare the number of processes with the cluster now; Lightning would only at the start of training.
            trainer.strategy.cluster_environment.validate_settings(trainer.num_devices, trainer.num_nodes)
    except (MisconfigurationException, RuntimeError, TypeError, ValueError) as error:
        names = ("accelerator", "devices", "num_nodes", "strategy", "precision")
        settings = {name: node[name] for name in names if isinstance(node.get(name), str | int | list)}
        runs_anywhere = settings.get("accelerator") in ("auto", "cpu") and "strategy" not in node
        if runs_anywhere and settings.get("devices") == 1:  # no machine lacks that
            raise UserError(f"Lightning refuses the trainer: {error}") from error
        options_text = " ".join(f"trainer.{name}={value}" for name, value in settings.items())
        fallback = "trainer=auto trainer.accelerator=auto trainer.devices=1"
        raise UserError(f"{options_text} is not available here ({error}): try {fallback}") from error
    return trainer


@contextmanager
def explain_memory_errors(config: Mapping[str, Any]) -> Iterator[None]:
    """Convert out-of-memory errors into an explanation that names the options to lower.

    Raises:
        UserError: the memory of the GPU or of the machine is not enough.
    """
    try:
        yield
    except (MemoryError, RuntimeError) as error:
        if not isinstance(error, MemoryError) and not any(sign in str(error) for sign in OUT_OF_MEMORY):
            raise
        raise UserError(f"training needs more memory than available: {what_to_lower(config)}") from error


def what_to_lower(config: Mapping[str, Any]) -> str:
    """Return which options to change so that training needs less memory."""
    keys = [f"{key} (now {size})" for key in SIZE_KEYS if (size := value_at(config, key, None))]
    return (
        f"lower {', '.join(keys)}; trainer.precision=bf16 and learner.checkpointing=true need less, and "
        "half the data.batch_size with trainer.accumulate_grad_batches=2 trains on as many windows per step"
    )


def restore_metrics(trainer: Trainer, checkpoint: Path) -> None:
    """Start the metrics file of a resumed training with the rows up to its checkpoint, unless they are damaged."""
    source = checkpoint.parent.parent / METRICS
    writers = [logger for logger in trainer.loggers if isinstance(logger, CSVLogger)]
    if not writers or not source.exists() or not trainer.is_global_zero:
        return
    steps = read_header(checkpoint).steps
    try:
        rows = metric_rows(source)
    except (OSError, ValueError) as error:  # they only inform
        log.warning("the training curves begin anew: %s", error)
        return
    # Lightning starts with an empty file.
    writers[0].experiment.metrics = [row for row in rows if int(row["step"]) < steps]
    writers[0].save()


def _keep_freed_memory() -> None:
    """Keep freed memory in the process for the next step.

    Page faults after returning it to the system took 7 % of a step of `bc` on a CPU, and 12 % of `rt1_tiny`.
    """
    if platform.libc_ver()[0] == "glibc":
        library = ctypes.CDLL(None)
        library.mallopt(MMAP_THRESHOLD, MAX_MMAP_THRESHOLD)
        library.mallopt(TRIM_THRESHOLD, -1)  # never


def quiet_lightning() -> None:
    """Suppress Lightning's tips, irrelevant warnings, and its own log handlers, which duplicate lines under Hydra."""
    for name in ("lightning", "lightning.pytorch", "lightning.fabric"):
        logging.getLogger(name).handlers.clear()
    logging.getLogger("lightning.pytorch.utilities.rank_zero").setLevel(logging.WARNING)
    # Warnings about its own callbacks and hooks, which users cannot change.
    warnings.filterwarnings("ignore", module=r"lightning\.")
    warnings.filterwarnings("ignore", "FSDP2-wrapped module .* returned a view")  # not written to here


def end_wandb() -> None:
    """End the run of Weights & Biases, which the next training of a sweep or a round would continue otherwise."""
    if wandb := sys.modules.get("wandb"):
        wandb.finish()
