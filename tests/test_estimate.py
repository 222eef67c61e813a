"""What is said of memory and time before a training, and that saying it changes nothing."""

from __future__ import annotations

import logging
import re
from functools import partial
from pathlib import Path

import pytest
import torch
from fake_batch import make_bc, make_rt1
from resuming import same, train

from vla.io.errors import UserError
from vla.models.vision.timm_encoders import FilmBackbone
from vla.training import estimate
from vla.training.estimate import Estimate, extrapolate

SIZES = {"data": {"batch_size": 8}, "model": {"width": 64, "context": {"history": 3}}}


MODELS = {
    "dropout": partial(make_rt1, dropout=0.2),
    "batch normalisation": partial(
        make_bc, shift=(9, 9), image=partial(FilmBackbone, "test_resnet", False, frozen=False, size=32, channels=8)
    ),
}


@pytest.mark.parametrize("name", MODELS)
def test_a_training_is_the_same_bit_for_bit_after_an_estimate(name: str, folder: Path, tmp_path: Path) -> None:
    contents = []
    for callback in (None, Estimate(SIZES)):
        torch.manual_seed(0)
        contents.append(train(MODELS[name](), folder, tmp_path, killer=callback, max_steps=3))
    for part in ("state_dict", "current_model_state", "optimizer_states"):
        assert same(contents[0][part], contents[1][part]), part


@pytest.mark.parametrize("scarce", [True, False])
def test_it_is_said_before_and_compared_after(
    folder: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch, scarce: bool
) -> None:
    monkeypatch.setattr(estimate, "SCARCE", 0.0 if scarce else 1.0)
    advice = r"; if that is too much, lower data\.batch_size \(now 8\), model\.context" if scarce else "$"
    with caplog.at_level(logging.INFO, logger=estimate.__name__):
        train(make_bc(), folder, tmp_path, killer=Estimate(SIZES), max_steps=4, accumulate_grad_batches=2)
    said, took = (each.getMessage() for each in caplog.records if each.name == estimate.__name__)
    numbers = re.match(
        r"training needs about ([\d.]+) of ([\d.]+) GB of memory \(it holds [\d.]+\) and [\d.]+ min for 8 batches "
        rf"of (\d+) ms, without validation{advice}",
        said,
    )
    assert numbers, said
    needed, there, milliseconds = map(float, numbers.groups())
    assert 0.1 < needed < there and milliseconds >= 1
    assert re.match(
        rf"training took [\d.]+ GB of memory and \d+ ms for a batch, after an estimate of {numbers[1]} GB", took
    ), took


def test_what_the_memory_cannot_hold_is_refused_before_the_first_step(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(estimate, "memory_of", lambda device: (1e5, 1e5))  # of a small machine
    model = make_bc()
    before = {name: value.clone() for name, value in model.state_dict().items()}
    with pytest.raises(
        UserError, match=r"training needs about [\d.]+ GB of memory, and [\d.]+ GB are there: lower data"
    ):
        train(model, folder, tmp_path, killer=Estimate(SIZES))
    assert same(before, dict(model.state_dict()))


def test_small_batches_tell_of_large_ones_by_the_line_through_the_last_two() -> None:
    assert extrapolate({0: 5.0, 1: 9.0, 4: 14.0, 16: 38.0}, 64) == 38 + 2 * 48
    assert extrapolate({0: 5.0, 1: 9.0, 4: 14.0}, 4) == 14
    assert extrapolate({0: 5.0, 1: 9.0}, 2) == 13
