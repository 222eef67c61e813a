"""`job=train`: fill the episode store and train a model on it."""

from __future__ import annotations

import gc
import logging
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from functools import partial
from pathlib import Path

import lightning
import torch
from lightning import Callback, LightningModule, Trainer

from vla.config.check import devices
from vla.config.experiment import Experiment, training_policy
from vla.data.datamodule import WindowDataModule, require_trainable
from vla.data.episodes import EpisodeStore
from vla.io.errors import UserError, counted
from vla.io.files import atomic_path, remove_drafts, warn_on_error, writing
from vla.jobs.collect import demonstration_spec, demonstrations
from vla.models.diffusion import Diffusion
from vla.models.learner import Learner
from vla.models.model import Model
from vla.models.policy_folder import BEST, POLICY
from vla.models.tokenizers.tokenizer import out_of_bounds, rounding
from vla.models.trunk import is_within, trunks
from vla.reports.observations import SHOWN_WINDOWS, draw_samples
from vla.reports.run_page import try_write_page
from vla.runs.files import Training
from vla.runs.folder import CHECKPOINTS, LAST, SAMPLES, archive_evaluation, read_training, save_config, save_training
from vla.runs.resume import first_process, training_lock, training_progress
from vla.training.checkpoints import GracefulStop
from vla.training.closed_loop import ClosedLoop
from vla.training.estimate import Estimate
from vla.training.trainer import end_wandb, explain_memory_errors, make_trainer, quiet_lightning, restore_metrics

log = logging.getLogger(__name__)

COARSE = 0.02  # mean rounding error of tokens, as a share of an action's range, above which a warning is logged


def run(experiment: Experiment) -> None:
    """Train, or continue the training in the output folder."""
    train(experiment)


def train(experiment: Experiment) -> Path | None:
    """Train, and return the folder of the policy that validation selects; None in all but the first process.

    An unfinished training in the output folder is resumed; a finished one is kept. Raises a UserError if the output
    folder has another training, or this one cannot start.
    """
    output = experiment.output
    if not first_process() and devices(experiment["trainer"]) == 1:
        raise UserError(
            "RANK, LOCAL_RANK or SLURM_PROCID says that this is not the first process of a training, but "
            "trainer.devices=1 has only one: unset these environment variables, and start one task"
        )
    last, policy = training_progress(output, experiment.config)
    if policy is not None:
        return policy if first_process() else None
    is_first = _run_training(experiment, last)
    gc.collect()  # reference cycles hold trainer and model, whose memory a later training or evaluation needs
    if not is_first:
        return None
    log.info("the policy is %s", output / POLICY)
    return output / POLICY


def _run_training(experiment: Experiment, last: Path | None) -> bool:
    """Train, from a `last` checkpoint if there is one; return whether this is the first process."""
    quiet_lightning()
    output = experiment.output
    graceful_stop, closed_loop = GracefulStop(output / CHECKPOINTS), _closed_loop(experiment)
    warn_of_length(experiment)
    with closed_loop or nullcontext(), training_lock(output / CHECKPOINTS):
        if first_process():
            remove_drafts(output / CHECKPOINTS / LAST, output / POLICY, output / BEST)
        # Before collection, so that missing devices are reported early.
        callbacks = [
            Estimate(experiment.config),
            _TrainingStart(experiment),
            *([closed_loop] if closed_loop else []),
            graceful_stop,
        ]
        trainer = make_trainer(experiment.config, output / CHECKPOINTS, *callbacks)
        if not trainer.is_global_zero:
            logging.getLogger("vla").setLevel(logging.WARNING)  # only the first process logs
        _fit(experiment, last, trainer, graceful_stop)
        if torch.distributed.is_available() and torch.distributed.is_initialized():
            torch.distributed.destroy_process_group()  # at once: at exit the other processes would wait for the first
        return trainer.is_global_zero


def warn_of_length(experiment: Experiment) -> None:
    """Log a warning for every part of the schedule that a training of this length never reaches."""
    learner, trainer = experiment["learner"], experiment["trainer"]
    steps, interval = trainer["max_steps"], trainer["val_check_interval"]
    if steps in (None, -1):
        if learner.get("schedule") == "cosine":  # a learner of a package may have no such key
            text = "without trainer.max_steps, learner.schedule=cosine has no end: the learning rate stays at its peak"
            log.warning(text)
        return
    if steps <= (warmup := learner.get("warmup_steps", 0)):
        text = "trainer.max_steps=%d ends within learner.warmup_steps=%d: the learning rate does not reach its peak"
        log.warning(text, steps, warmup)
    if interval > (batches := steps * trainer["accumulate_grad_batches"]):
        text = "trainer.val_check_interval=%d is more than the %s: no validation, and the last weights are used"
        log.warning(text, interval, counted(batches, "batch"))


def _fit(experiment: Experiment, last: Path | None, trainer: Trainer, graceful_stop: GracefulStop) -> None:
    """Collect missing demonstrations, train on them, from a `last` checkpoint if there is one, and write the policy."""
    extra_stores = [EpisodeStore(folder) for folder in experiment.collect.more or ()]
    output, origin = experiment.output, None if last else experiment.pretrained
    lightning.seed_everything(experiment.settings.seed, verbose=False)
    with explain_memory_errors(experiment.config), graceful_stop.explaining_restore(last):
        spec = demonstration_spec(experiment)
        learner = experiment.learner(spec, origin, last)
    model = learner.model
    require_trainable(model.spec, extra_stores)  # before episodes are collected
    store = demonstrations(experiment)
    if origin is last is None:
        experiment.fit_tokenizer(model.tokenizer, store)
        frozen = experiment["learner"].get("frozen", ())
        if parts := [part for part in frozen if not is_within(part, trunks(model))]:
            log.warning("learner.frozen=[%s]: what is not pretrained there stays random", ", ".join(parts))
    if last is None:
        model.fit(store.numbers("state"), store.numbers("action"))
    _warn_of_tokenization(model, [store, *(extra for extra in extra_stores if extra.episodes)])
    data = _windows(experiment, store, model, trainer)
    if last:
        restore_metrics(trainer, last)
    else:
        save_config(output, experiment.config, experiment.changes)  # also of a training that fails at its start
    with writing(output), _saving_result(experiment, trainer, graceful_stop, learner, last is not None):
        try:
            with (
                explain_memory_errors(experiment.config),
                graceful_stop.explaining_restore(last),
                graceful_stop.handling_signals(),
            ):
                trainer.fit(learner, datamodule=data, ckpt_path=last, weights_only=True)
        except SystemExit:  # on SIGTERM Lightning exits with status 0
            if not graceful_stop.requested:
                raise
        if not graceful_stop.stopped:
            _save(trainer, output)
        if graceful_stop.requested and trainer.is_global_zero:
            raise KeyboardInterrupt


def _windows(experiment: Experiment, store: EpisodeStore, model: Model, trainer: Trainer) -> WindowDataModule:
    """Return the windows of a store for a model, and draw some; raise a UserError if there are fewer than a batch."""
    data = experiment.data(store, model.history, model.chunk, model)
    data.setup()
    if data.batch_size > len(data.training_windows):
        raise UserError(
            f"data.batch_size={data.batch_size} is more than the {len(data.training_windows)} windows of "
            f"the episodes in {store.folder}: lower it, or collect more"
        )
    if not len(data.held_out_windows):
        trainer.limit_val_batches = 0  # else callbacks wait for a validation that never runs
        if experiment.validate.episodes:
            log.warning(
                "data.validation_fraction=0: no validation, so no episodes are played, and the last weights are used"
            )
    with warn_on_error(experiment.output / SAMPLES):
        draw_samples(data.make_batch(data.order(0)[:SHOWN_WINDOWS]), store.spec, experiment.output / SAMPLES)
    return data


def _save(trainer: Trainer, output: Path) -> None:
    """Save the policy, or a better earlier one, then the checkpoint, whose `finished` says that the policy exists."""
    callbacks: list[Callback] = trainer.callbacks  # type: ignore[attr-defined]
    (folder,) = [callback.clearly_better_policy() for callback in callbacks if isinstance(callback, ClosedLoop)] or [
        None
    ]
    if folder is None:
        trainer.save_checkpoint(output / POLICY, weights_only=False)
    elif trainer.is_global_zero:
        with atomic_path(output / POLICY) as draft:
            shutil.copytree(folder, draft)
    trainer.save_checkpoint(output / CHECKPOINTS / LAST, weights_only=False)


class _TrainingStart(Callback):
    """Archives an earlier evaluation in the run's folder, and saves the config, once training starts or continues."""

    def __init__(self, experiment: Experiment) -> None:
        self._experiment = experiment

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Do so here, because all state is restored by now."""
        if trainer.is_global_zero:
            training = read_training(self._experiment.output)
            archive_evaluation(self._experiment.output, training.steps if training else 0)
            save_config(self._experiment.output, self._experiment.config, self._experiment.changes)


def _warn_of_tokenization(model: Model, stores: list[EpisodeStore]) -> None:
    """Warn if actions lose much precision as tokens, in the first store, or exceed the tokenizer's bounds, in any."""
    for store in stores:
        chunks = store.statistics.chunks(model.chunk)
        if model.uses_tokens and store is stores[0]:
            component, loss = rounding(model.tokenizer, chunks, store.spec)
            if loss > COARSE:
                advice = "tokenizer=uniform and more tokenizer.bins are finer"
                text = "as tokens, the demonstrated actions lose %.1f %% of the range of %s on average: %s"
                log.warning(text, 100 * loss, component, advice)
        clips = model.uses_tokens or isinstance(model, Diffusion)
        if clips and (share := out_of_bounds(model.tokenizer, chunks)):
            subject = f"{100 * share:.2g} % of the demonstrated actions in {store.folder}"
            log.warning("%s exceed the bounds of the tokenizer, to which they are clipped", subject)


def _closed_loop(experiment: Experiment) -> ClosedLoop | None:
    """Return the callback that plays episodes in every validation, or None without episodes."""
    seeds = experiment.validate.seeds
    if not seeds:
        return None
    if not experiment.playable:
        raise UserError(f"validate.episodes={len(seeds)}: nothing can be played in a recording: set it to 0")
    make_environment = experiment.make_environment(experiment.validate.changes)
    options = experiment["policy"]
    make_policy = partial(training_policy, options.get("precision", "fp32"), options.get("lanes", 1))
    return ClosedLoop(make_environment, make_policy, seeds, experiment.output, experiment.build("cluster").workers)


@contextmanager
def _saving_result(
    experiment: Experiment, trainer: Trainer, graceful_stop: GracefulStop, learner: Learner, resumed: bool
) -> Iterator[None]:
    """Save result and page of a training however it ends; a resumed one keeps the origins of its earlier parts."""
    output, training, end = experiment.output, read_training(experiment.output), "done"
    origins = training.origins if training and resumed else []
    origins = origins if experiment.origin in origins else [*origins, experiment.origin]  # of its beginning, and later
    parameters = sum(parameter.numel() for parameter in learner.model.parameters())
    start = f", starting from {origin}" if (origin := experiment.settings.pretrained) else ""
    log.info("training %s with %.2f M parameters%s", type(learner.model).__name__, parameters / 1e6, start)
    try:
        yield
    except BaseException as error:
        end = "interrupted" if isinstance(error, KeyboardInterrupt) else str(error) or type(error).__name__
        raise
    finally:
        # A training that cannot be resumed stays as it was; one interrupted after its last step has nothing left to do.
        if trainer.is_global_zero and (graceful_stop.started or training is None or end == "done" != training.ended):
            size = parameters, trainer.global_step, round(graceful_stop.seconds, 1)
            save_training(output, Training(*size, end, origins))
            try_write_page(output)
        end_wandb()
    log.info("trained %s in %.0f s", counted(trainer.global_step, "step"), graceful_stop.seconds)
