"""What Lightning's trainer is given beside the learner: averages of the weights, and a sentence for want of memory."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import lightning
import pytest
import torch
from fake_batch import make_batch, make_bc, make_rt1
from omegaconf import OmegaConf
from test_learner import fit, loader, make_learner, make_trainer
from torch import Tensor

from vla.training import Averaging, Progress, enough_memory


class Weights(lightning.Callback):
    """The weights and statistics after every step."""

    def __init__(self) -> None:
        self.seen: list[dict[str, Tensor]] = []

    def on_train_batch_end(self, trainer: Any, pl_module: Any, *_: Any) -> None:
        self.seen.append({name: value.clone() for name, value in pl_module.state_dict().items()})


def test_the_average_starts_with_the_first_weights_and_forgets_them_at_its_pace() -> None:
    watch = Weights()
    learner = make_learner(lr=1e-2, warmup_steps=0)
    make_trainer(3, Averaging(0.75), watch).fit(learner, loader(make_batch(1), 3))
    first, second, third = watch.seen
    for name, value in learner.state_dict().items():
        expected = 0.75 * (0.75 * first[name] + 0.25 * second[name]) + 0.25 * third[name]
        torch.testing.assert_close(value, expected)
    assert not torch.equal(first["model.head.weight"], third["model.head.weight"])


def test_averaging_goes_on_where_it_was(tmp_path: Path) -> None:
    batch = make_batch(1)
    torch.manual_seed(0)
    start = make_bc().state_dict()

    def train(steps: int, checkpoint: Path | None = None) -> tuple[lightning.Trainer, dict[str, Tensor]]:
        learner = make_learner(make_bc(), lr=1e-2, schedule="constant", warmup_steps=0)
        learner.model.load_state_dict(start)
        trainer = make_trainer(steps, Averaging(0.9))
        trainer.fit(learner, loader(batch, 4), ckpt_path=checkpoint, weights_only=True)
        return trainer, learner.state_dict()

    class Keep(lightning.Callback):
        def on_train_batch_end(self, trainer: Any, *_: Any) -> None:
            if trainer.global_step == 2:
                trainer.save_checkpoint(tmp_path / "half.ckpt")

    whole = train(4)[1]
    learner = make_learner(make_bc(), lr=1e-2, schedule="constant", warmup_steps=0)
    learner.model.load_state_dict(start)
    make_trainer(2, Averaging(0.9), Keep()).fit(learner, loader(batch, 4))
    parts = train(4, tmp_path / "half.ckpt")[1]
    for name, value in whole.items():
        torch.testing.assert_close(parts[name], value)


def test_the_bar_shows_the_loss_of_one_step_in_ten() -> None:
    shown = []

    class Shown(Progress):
        def get_metrics(self, *arguments: Any) -> dict[str, Any]:
            shown.append(super().get_metrics(*arguments)["train/loss"])
            return {}

    trainer = lightning.Trainer(
        accelerator="cpu",
        max_steps=12,
        logger=False,
        enable_checkpointing=False,
        enable_model_summary=False,
        callbacks=[Shown()],
    )
    trainer.fit(make_learner(), loader(make_batch(1), 12))
    assert len(set(shown[:10])) == 1 and len(set(shown[:11])) == 2


def test_want_of_memory_names_what_to_lower() -> None:
    """Images larger than all addresses, none of which is there before the model wants to compute with them."""
    model = make_rt1()
    batch = make_batch(3)
    batch["rgb"] = {name: image[:, :, :1, :1].expand(-1, -1, 10**8, 10**8, -1) for name, image in batch["rgb"].items()}
    config = OmegaConf.create({"data": {"batch_size": 4}, "model": {"history": 3, "image_size": None, "width": 32}})
    wanted = r"lower data\.batch_size \(now 4\), model\.history \(now 3\), model\.width"
    with pytest.raises(ValueError, match=wanted), enough_memory(config):
        fit(make_learner(model), batch, 1)


@pytest.mark.parametrize("error", [torch.OutOfMemoryError("CUDA out of memory"), MemoryError()])
def test_memory_of_a_gpu_or_of_the_loader_is_named_alike(error: Exception) -> None:
    config = OmegaConf.create({"data": {"batch_size": 4}, "model": {}})
    with pytest.raises(ValueError, match=r"trainer\.precision=bf16"), enough_memory(config):
        raise error


def test_other_errors_stay_what_they_are() -> None:
    with pytest.raises(RuntimeError, match="shapes"), enough_memory(OmegaConf.create({})):
        raise RuntimeError("shapes differ")
