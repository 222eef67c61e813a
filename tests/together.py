"""One of the processes that train together, with every real part, on episodes of the toy world.

python together.py STORE FOLDER
"""

from __future__ import annotations

import copy
import sys
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import composing
import lightning
import reading
import resuming
import torch
import toy
from defaults import defaults_of
from fake_batch import make_batch, make_rt1, with_text
from small_training import CONFIG
from tiny_pi import KINDS, make_policy
from tiny_vla import deviation, make_smolvla
from torch.distributed.device_mesh import init_device_mesh
from torch.distributed.fsdp import FSDPModule
from trunk import make_trunk_model

from vla.config.experiment import Experiment
from vla.data.episodes import EpisodeStore
from vla.models.fsdp import full_tensor, shard
from vla.models.learner import Learner
from vla.models.lora import LoRA
from vla.models.policy_folder import POLICY
from vla.models.recomputation import recompute_layers
from vla.runs.folder import LAST
from vla.training.trainer import make_trainer, quiet_lightning

PAIRS = ("ddp,rt1_tiny", "fsdp,decoder")  # trainer, model
TRUNK = "fsdp,trunk"
VLAS = {"smolvla": make_smolvla, **{name: partial(make_policy, name) for name in KINDS}}
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
    return Experiment.from_config(composing.composed(*SMALL, *overrides))


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
    data = experiment.data(EpisodeStore(store), model.history, model.chunk, model)
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


def train_trunk(store: Path, folder: Path, batch_size: int, **trainer: Any) -> dict[str, float]:
    """Train factors of LoRA in a network of transformers, whose layers compute activations again, and all around it."""
    model = make_trunk_model()
    quiet_lightning()
    lora = LoRA(**defaults_of("learner/lora/low_rank", modules=("q_proj", "v_proj"), rank=4))
    options = defaults_of("learner/default", lr=1e-3, warmup_steps=0, schedule="constant", frozen=["context.trunk"])
    learner = Learner(**options | {"lora": lora, "checkpointing": True}, model=model, spec=toy.SPEC, config=CONFIG)
    made = make_trainer(resuming.config(max_steps=4, val_check_interval=2, **trainer), folder)
    data = reading.windows(
        store, history=1, chunk=model.chunk, tokenize=model.text.tokenize, batch_size=batch_size, validation_windows=16
    )
    made.fit(learner, datamodule=data)
    for name in (LAST, POLICY, POLICY):  # that of a training that goes on takes the place of the one before
        made.save_checkpoint(folder / name, weights_only=False)
    return {name: value.item() for name, value in made.callback_metrics.items() if name.startswith("val/")}


def train_trunks(store: Path, folder: Path) -> None:
    """Leave what two processes find that share the weights of every layer of a trunk."""
    strategy = {"_target_": "vla.training.checkpoints.Sharded"}
    found = train_trunk(store, folder / TRUNK, 8, devices=2, strategy=strategy)
    torch.save(found, folder / TRUNK / "found.pt")


def share_vlas(store: Path, folder: Path) -> None:
    """Leave how far gradients of vision-language-action models, whose layers two processes share, are from others."""
    off = dict[str, float]()
    for name, make in VLAS.items():
        torch.manual_seed(0)
        model = make()
        batch = model.with_noise(with_text(model, make_batch(1, model.chunk, spec=model.spec, size=2)))
        LoRA(**defaults_of("learner/lora/low_rank", rank=2)).inject(model)
        recompute_layers(model.train())
        whole = copy.deepcopy(model)
        with patch("vla.models.fsdp.MIN_PARAMETERS", 1000):
            shard(model, init_device_mesh("cpu", (1, 2), mesh_dim_names=("copies", "shards")))
        assert sum(isinstance(part, FSDPModule) for part in model.modules()) > 2
        ways = list[torch.Tensor]()
        for each in (model, whole):
            each.loss(batch)["loss"].backward()
            gradients = [full_tensor(weight.grad) for weight in each.parameters() if weight.grad is not None]
            ways.append(torch.cat([gradient.flatten() for gradient in gradients]))
        off[name] = deviation(*ways)
    torch.save(off, folder / "vlas.pt")


def train_in_pieces(store: Path, folder: Path) -> None:
    """Save the checkpoints of an uninterrupted training, of its first half, and of the resumed second half."""
    model = make_rt1(dropout=0.2)
    start = {name: value.clone() for name, value in model.state_dict().items()}
    half = folder / "half/checkpoints" / LAST
    for name, stop, checkpoint in (("whole", None, None), ("half", resuming.STOP, None), ("rest", None, half)):
        model.load_state_dict(start)
        resuming.train(model, store, folder / name, stop, checkpoint, devices=2, strategy="ddp")


if __name__ == "__main__":
    torch.set_num_threads(1)
    store, folder = Path(sys.argv[1]), Path(sys.argv[2])
    for leave in (train_pairs, train_trunks, train_in_pieces, share_vlas):
        leave(store, folder)
