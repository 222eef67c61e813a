"""The stage in between: a model is trained on an episode store, which is filled first; the page tells how it went."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import lightning
from lightning import Trainer
from omegaconf import DictConfig

from vla.collect import effort
from vla.data.episodes import EpisodeStore
from vla.files import writing
from vla.models.chunks import ChunkModel
from vla.models.fidelity import beyond, fidelity
from vla.models.learner import Learner
from vla.models.model import Model
from vla.page import PAGE, optional, write_page
from vla.parts import (
    collected,
    demonstrated,
    fit,
    in_training,
    make_data,
    make_environment,
    note_config,
    output_folder,
    plain,
    unfitted_learner,
)
from vla.results import note_choice, note_training
from vla.resume import LAST, alone
from vla.samples import FILE, SHOWN, draw_samples
from vla.trainer import Interruption, enough_memory, keep_metrics, make_trainer, quiet_lightning
from vla.validation import ClosedLoop

log = logging.getLogger(__name__)


def trained(config: DictConfig) -> Path | None:
    """Path of the checkpoint that training leaves behind, and that does best in validation; None in all but the first
    of the processes that train."""
    quiet_lightning()
    output = output_folder(config)
    checkpoints = output / "checkpoints"
    interruption = Interruption(checkpoints)
    closed_loop = _closed_loop(config, checkpoints)
    if _endless(config):
        log.info("trainer.max_steps=-1: training goes on until it is interrupted; Ctrl-C saves and stops")
    with alone(checkpoints):
        # Before anything is collected: the devices asked for may be missing, and so may be pretrained weights.
        trainer = make_trainer(config, checkpoints, *([closed_loop] if closed_loop else []), interruption)
        if not trainer.is_global_zero:
            logging.getLogger("vla").setLevel(logging.WARNING)  # the first process speaks for all
        lightning.seed_everything(config.seed, verbose=False)
        with enough_memory(config):
            learner = unfitted_learner(config, demonstrated(config))
        store = collected(config)
        fit(learner.model.tokenizer, config, store)
        data = make_data(config, store, learner.model)
        _tell_losses(learner.model, store)
        data.setup()
        if config.data.batch_size > len(data.training_windows):
            raise ValueError(
                f"data.batch_size={config.data.batch_size} is more than the {len(data.training_windows)} windows of "
                f"the episodes in {store.folder}: lower it, or collect more"
            )
        if not len(data.held_out_windows):
            trainer.limit_val_batches = 0  # else what waits for a validation would wait in vain
        first = data.gather(data.order(0)[:SHOWN])
        with optional(output / FILE):
            draw_samples(first, store.spec, output / FILE)
        if config.checkpoint:
            keep_metrics(trainer, Path(config.checkpoint))
        with writing(output), _told(config, trainer, interruption, learner, effort(store, config.collect.episodes)):
            try:
                with enough_memory(config), interruption.listening():
                    trainer.fit(learner, datamodule=data, ckpt_path=config.checkpoint, weights_only=True)
            except SystemExit:  # at a SIGTERM Lightning leaves as if all were well
                if not interruption.asked:
                    raise
            if not interruption.stopped:
                trainer.save_checkpoint(checkpoints / LAST, weights_only=False)
            if interruption.asked and trainer.is_global_zero:
                raise KeyboardInterrupt
    if not trainer.is_global_zero:
        return None  # what follows training is done once
    chosen = closed_loop.chosen(checkpoints / LAST) if closed_loop else checkpoints / LAST
    note_choice(output, chosen.name)
    return chosen


def _endless(config: DictConfig) -> bool:
    limits = [config.trainer.get(name) for name in ("max_steps", "max_epochs", "max_time")]
    return all(limit in (None, -1) for limit in limits)


def _tell_losses(model: Model, store: EpisodeStore) -> None:
    """Log what becomes of the demonstrated actions between a model's bounds, and as its tokens where it has some."""
    chunks = store.statistics.chunks(model.chunk)
    if not isinstance(model, ChunkModel):
        lost = fidelity(model.tokenizer, chunks, store.spec.units)
        log.info("%s: %s", type(model.tokenizer).__name__, lost)
    if outside := beyond(model.tokenizer, chunks):
        log.warning("%.2g %% of what was demonstrated is beyond the bounds of the tokenizer", 100 * outside)


def _closed_loop(config: DictConfig, checkpoints: Path) -> ClosedLoop | None:
    """What lets the policy act in every validation, if it is to."""
    seeds = range(config.validate.seed, config.validate.seed + config.validate.episodes)
    task = plain(config.task)
    task["randomize"] = {**task["randomize"], "phrasing": None}  # what is held out chooses no weights
    makers = partial(make_environment, task), partial(in_training, plain(config.policy))
    return ClosedLoop(*makers, seeds, checkpoints) if seeds else None


@contextmanager
def _told(
    config: DictConfig, trainer: Trainer, interruption: Interruption, learner: Learner, collection: float | None
) -> Iterator[None]:
    """However the training within ends, its page and the log tell how it did, all that it went on from included."""
    output = output_folder(config)
    note_config(config)
    parameters = sum(parameter.numel() for parameter in learner.model.parameters())
    start = f", starting from {config.pretrained}" if config.pretrained and not config.checkpoint else ""
    log.info("training %s with %.2f M parameters%s", type(learner.model).__name__, parameters / 1e6, start)
    ended = "done"
    try:
        yield
    except BaseException as error:
        ended = "interrupted" if isinstance(error, KeyboardInterrupt) else str(error) or type(error).__name__
        raise
    finally:
        seconds = interruption.seconds
        if trainer.is_global_zero:
            with optional(output / PAGE):
                note_training(output, parameters, trainer.global_step, seconds, ended, collection)
                write_page(output)
    log.info("trained %d steps in %.0f s: %s", trainer.global_step, seconds, output / "checkpoints")
