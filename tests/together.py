"""One of the processes that train small models together, with every real part, on episodes of the toy world.

python together.py STORE FOLDER TRAINER,MODEL …
"""

from __future__ import annotations

import sys
from pathlib import Path

import lightning
import torch
from hydra import compose, initialize_config_dir
from omegaconf import DictConfig

from vla.data.episodes import EpisodeStore
from vla.parts import make_data, make_learner
from vla.training import LAST, make_trainer, quiet_lightning

CONF = Path(__file__).parents[1] / "conf"
SMALL = (
    "collect.episodes=30",
    "data.validation_fraction=0.2",
    "data.validation_windows=16",
    "data.batch_size=8",
    "trainer.max_steps=4",
    "trainer.val_check_interval=2",
    "learner.ema=0.9",
    "model.shift=[0,0]",
    "model.history=1",  # padding would count per process
)


def composed(*overrides: str) -> DictConfig:
    """A configuration of few and small steps."""
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return compose("config", overrides=["output=out", *SMALL, *overrides])


def train(store: Path, folder: Path, *overrides: str, checkpoint: Path | None = None) -> dict[str, float]:
    """Train, from a checkpoint on if there is one, leave `last.ckpt` and return what the last validation found."""
    config = composed(*overrides)
    quiet_lightning()
    lightning.seed_everything(0, verbose=False)
    learner = make_learner(config, EpisodeStore(store))
    trainer = make_trainer(config, folder)
    data = make_data(config, EpisodeStore(store), learner.model)
    trainer.fit(learner, datamodule=data, ckpt_path=checkpoint, weights_only=True)
    trainer.save_checkpoint(folder / LAST)
    return {name: value.item() for name, value in trainer.callback_metrics.items() if name.startswith("val/")}


if __name__ == "__main__":
    torch.set_num_threads(1)
    store, folder = Path(sys.argv[1]), Path(sys.argv[2])
    for pair in sys.argv[3:]:
        trainer, model = pair.split(",")
        found = train(
            store, folder / pair, f"trainer={trainer}", f"model={model}", "trainer.accelerator=cpu", "trainer.devices=2"
        )
        torch.save(found, folder / pair / "found.pt")
