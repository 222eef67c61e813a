"""One of the processes that train together, with every real part, on episodes of the toy world.

python together.py STORE FOLDER
"""

from __future__ import annotations

import sys
from pathlib import Path

import composing
import lightning
import numpy as np
import reading
import resuming
import torch
from fake_batch import make_rt1

from vla.config.experiment import Experiment
from vla.data.episodes import EpisodeStore
from vla.models.learner import Learner
from vla.models.policy_folder import POLICY
from vla.runs.folder import LAST
from vla.training.trainer import make_trainer, quiet_lightning

PAIRS = ("ddp,rt1_tiny", "fsdp,decoder")  # trainer, model
SMALL = (
    "collect.episodes=30",
    "data.validation_fraction=0.2",
    "data.validation_windows=16",
    "data.batch_size=8",
    "trainer.max_steps=4",
    "trainer.val_check_interval=2",
    "learner.ema=0.9",
    "learner.warmup_steps=0",
    "learner.schedule=constant",  # or a longer training would begin otherwise
    "model.text.dropout=0",  # processes would not drop the same
    "model.shift=[0,0]",
    "model.context.history=1",  # padding would count per process
    "tokenizer.smoothing=0",  # or a decoder would draw what it is told
)


def composed(*overrides: str) -> Experiment:
    """An experiment of few and small steps."""
    return Experiment.of(composing.composed(*SMALL, *overrides))


def untrained(store: Path, *overrides: str) -> Learner:
    """The same weights every time."""
    lightning.seed_everything(0, verbose=False)
    return composed(*overrides).fitted_learner(EpisodeStore(store))


def train(store: Path, folder: Path, *overrides: str, checkpoint: Path | None = None) -> dict[str, float]:
    """Train, from a checkpoint on if there is one, leave `last.ckpt` and return what the last validation found."""
    experiment = composed(*overrides)
    quiet_lightning()
    learner = untrained(store, *overrides)
    trainer = make_trainer(experiment.config, folder)
    model = learner.model
    data = experiment.data(EpisodeStore(store), model.history, model.chunk, model.text.tokenize)
    trainer.fit(learner, datamodule=data, ckpt_path=checkpoint, weights_only=True)
    for name in (LAST, POLICY):
        trainer.save_checkpoint(folder / name, weights_only=False)
    return {name: value.item() for name, value in trainer.callback_metrics.items() if name.startswith("val/")}


def train_pairs(store: Path, folder: Path) -> None:
    """Leave in a folder for each of `PAIRS` a checkpoint, and what validation found."""
    for pair in PAIRS:
        trainer, model = pair.split(",")
        two = ("trainer.accelerator=cpu", "trainer.devices=2")
        found = train(store, folder / pair, f"trainer={trainer}", f"model={model}", *two)
        torch.save(found, folder / pair / "found.pt")


def train_in_pieces(store: Path, folder: Path) -> None:
    """Save the checkpoints of an uninterrupted training, of its first half, and of the resumed second half."""
    model = make_rt1(dropout=0.2)
    start = {name: value.clone() for name, value in model.state_dict().items()}
    half = folder / "half/checkpoints" / LAST
    for name, stop, checkpoint in (("whole", None, None), ("half", resuming.STOP, None), ("rest", None, half)):
        model.load_state_dict(start)
        resuming.train(model, store, folder / name, stop, checkpoint, devices=2, strategy="ddp")


def see_windows(store: Path, folder: Path) -> None:
    """Leave what this process saw while the two saw every window once."""
    steps = -(-len(reading.windows(store).training_windows) // (8 * 2))
    model = reading.fit(store, steps, devices=2)
    np.save(folder / f"seen{model.global_rank}.npy", np.stack([seen.numpy() for seen in model.seen]))


if __name__ == "__main__":
    torch.set_num_threads(1)
    store, folder = Path(sys.argv[1]), Path(sys.argv[2])
    for leave in (train_pairs, train_in_pieces, see_windows):
        leave(store, folder)
