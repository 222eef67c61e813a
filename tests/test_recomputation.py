"""Layers that keep less: what they compute, how much they keep, and which do it."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable
from contextlib import nullcontext
from functools import partial
from typing import Any

import pytest
import torch
from fake_batch import make_act, make_batch, make_bc, make_decoder, make_rt1, with_text
from trunk import make_trunk_model

from vla.io.errors import UserError
from vla.models.model import Model
from vla.models.recomputation import recompute_layers
from vla.models.vision.timm_encoders import FilmBackbone

MODELS: dict[str, Callable[[], Any]] = {
    "act": partial(make_act, width=64, layers=3),
    "rt1": partial(make_rt1, width=64, key_width=32, dropout=0.2),
    "decoder": partial(make_decoder, width=64, dropout=0.2),
    "timm": partial(make_bc, image=partial(FilmBackbone, "test_vit", False, frozen=False, size=32, channels=8)),
    "transformers": make_trunk_model,
}


def computed(model: Model, batch: dict[str, Any]) -> tuple[dict[str, torch.Tensor], int]:
    """Loss and gradients of a training step, and what was kept for them [bytes]."""
    kept: dict[int, int] = {}

    def keep(tensor: torch.Tensor) -> torch.Tensor:
        kept[tensor.untyped_storage().data_ptr()] = tensor.untyped_storage().nbytes()
        return tensor

    torch.manual_seed(1)
    with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
        loss = model.train().loss(with_text(model, batch))["loss"]
    held = sum(kept.values())
    loss.backward()
    return {"loss": loss.detach(), **{n: w.grad for n, w in model.named_parameters() if w.grad is not None}}, held


@pytest.mark.parametrize("name", MODELS)
def test_a_step_keeps_less_and_computes_the_same(name: str) -> None:
    torch.manual_seed(0)
    model = MODELS[name]()
    again = copy.deepcopy(model)
    recompute_layers(again)
    batch = make_batch(model.history, model.chunk, size=8)
    (expected, held), (found, less) = computed(model, batch), computed(again, batch)
    assert less < held
    assert found.keys() == expected.keys() and again.state_dict().keys() == model.state_dict().keys()
    for key, value in expected.items():
        torch.testing.assert_close(found[key], value, msg=key)
    for copied in (copy.deepcopy(again), pickle.loads(pickle.dumps(again))):
        with torch.inference_mode():
            actions = [each.eval().predict(with_text(model, batch)).actions for each in (again, copied)]
        assert torch.equal(*actions)


@pytest.mark.parametrize("norm", [torch.nn.LayerNorm, torch.nn.BatchNorm1d])
def test_what_has_batch_normalisation_is_left_alone_as_its_statistics_would_move_twice(norm: Any) -> None:
    network = torch.nn.ModuleList(torch.nn.Sequential(torch.nn.Linear(128, 128), norm(128)) for _ in range(2))
    fails = pytest.raises(UserError, match="no layers to recompute in ModuleList")
    with fails if norm is torch.nn.BatchNorm1d else nullcontext():
        recompute_layers(network)


def test_a_model_without_layers_is_told() -> None:
    with pytest.raises(UserError, match=r"learner\.checkpointing=true finds no layers to recompute in BC: omit it"):
        recompute_layers(make_bc())
