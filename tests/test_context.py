"""Contexts: what heads know of a window, and that any head takes any of them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from composing import composed
from fake_batch import MODELS, as_policy, context_of, make_batch, overfit, with_text
from observing import act, observations
from toy import SPEC

from vla.config.build import build
from vla.config.experiment import to_plain
from vla.models.model import ContextModel
from vla.models.tokenizers.tokenizer import Uniform

CONTEXTS = {"keypoints": "model/act", "tokens": "model/decoder"}


def made(head: str, context: str, **options: Any) -> ContextModel:
    torch.manual_seed(0)
    return MODELS[head](context=context_of(CONTEXTS[context], keypoints=8, **options), chunk=2)


@pytest.mark.parametrize("context", CONTEXTS)
def test_a_context_has_its_length_and_sees_images_state_and_instruction(context: str) -> None:
    model = made("act", context).eval()
    batch = with_text(model, make_batch(model.history, 2))
    encoded = model.encode_context(batch)
    assert encoded.tokens.shape == (4, model.context.length, 32) and encoded.summary.shape == (4, 32)
    assert encoded.padding is None or encoded.padding.shape == encoded.tokens.shape[:2]
    other = {"rgb": {"eye": 255 - batch["rgb"]["eye"]}, "state": batch["state"] + 1, "text": batch["text"].roll(1, 0)}
    for name in other:
        changed = model.encode_context({**batch, name: other[name]})
        assert not torch.allclose(changed.summary, encoded.summary, atol=1e-4)


@pytest.mark.parametrize(
    ("head", "context"),
    [("act", "keypoints"), ("act", "tokens"), ("decoder", "keypoints"), ("diffusion", "tokens"), ("flow", "keypoints")],
)
def test_any_head_learns_with_any_context(head: str, context: str) -> None:
    model = made(head, context)
    assert overfit(model, with_text(model, make_batch(model.history, 2)), steps=120) < 0.08


@pytest.mark.parametrize("head", ["act", "flow", "decoder"])
def test_a_state_of_rates_alone_is_left_out(head: str) -> None:
    spec = replace(SPEC, state_units=("m/s", "m/s"))
    model = MODELS[head](context=context_of("model/act", keypoints=8), spec=spec)
    batch = with_text(model, make_batch(1, model.chunk, spec=spec))
    assert model.loss(batch)["loss"].isfinite()
    actions = model.eval().predict(batch).actions
    assert torch.equal(model.predict({**batch, "state": batch["state"] + 1}).actions, actions)


@pytest.mark.parametrize("head", ["act", "flow", "decoder"])
def test_tokens_are_kept_and_those_of_absent_frames_do_not_matter(head: str) -> None:
    model = made(head, "tokens", history=3).eval()
    passes = list[int]()
    model.get_submodule("context.image").register_forward_pre_hook(lambda module, inputs: passes.append(len(inputs[0])))
    policy, seen = as_policy(model), observations(4)
    act(policy, seen[:2])
    assert set(passes) == {1}  # the newest frame alone
    batch = with_text(model, make_batch(3, 2))
    batch["present"][:, 0] = False
    before = model.predict(batch).actions
    batch["rgb"]["eye"][:, 0] = 0
    assert torch.allclose(model.predict(batch).actions, before, atol=1e-6)


def test_an_option_chooses_the_context() -> None:
    flow = to_plain(composed("model=flow", "model/context=tokens", "model.context.history=3"))["model"]
    assert flow["_target_"].endswith("Flow") and flow["context"]["_target_"].endswith("TokenContext")
    tokenizer = Uniform(64, 0.05, 0.0, 0, spec=SPEC)
    assert build(flow, "model", spec=SPEC, tokenizer=tokenizer).history == 3
    rt1 = to_plain(composed("model=rt1_tiny", "model/context=keypoints"))["model"]
    with pytest.raises(ValueError, match=r"model\.context must be .*TokenContext"):
        build(rt1, "model", spec=SPEC, tokenizer=tokenizer)
