"""Contexts: what heads know of a window, and that any head takes any of them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from composing import composed
from fake_batch import MODELS, as_policy, context_of, make_act, make_batch, make_denoising, overfit, with_text
from observing import act, observations
from toy import SPEC

from vla.config.build import build
from vla.config.experiment import plain
from vla.io.types import Inherited
from vla.models.context import Context, Encoded
from vla.models.flow import Flow
from vla.models.model import ContextModel
from vla.models.tokenizers.tokenizer import Uniform

HEADS = {name: MODELS[name] for name in ("act", "flow", "decoder")}
CONTEXTS = {"keypoints": "model/act", "tokens": "model/decoder"}
heads = pytest.mark.parametrize("make", HEADS.values(), ids=HEADS.keys())
contexts = pytest.mark.parametrize("context", CONTEXTS)


def made(make: Callable[..., ContextModel], context: str, **options: Any) -> ContextModel:
    torch.manual_seed(0)
    return make(context=context_of(CONTEXTS[context], keypoints=8, **options), chunk=2)


@contexts
def test_a_context_has_its_length_and_sees_images_state_and_instruction(context: str) -> None:
    model = made(make_act, context).eval()
    batch = with_text(model, make_batch(model.history, 2))
    encoded = model.encoded(batch)
    assert encoded.tokens.shape == (4, model.context.length, 32) and encoded.summary.shape == (4, 32)
    assert encoded.padding is None or encoded.padding.shape == encoded.tokens.shape[:2]
    other = {"rgb": {"eye": 255 - batch["rgb"]["eye"]}, "state": batch["state"] + 1, "text": batch["text"].roll(1, 0)}
    for name in other:
        changed = model.encoded({**batch, name: other[name]})
        assert not torch.allclose(changed.summary, encoded.summary, atol=1e-4)


@contexts
@heads
def test_any_head_learns_with_any_context(make: Callable[..., ContextModel], context: str) -> None:
    model = made(make, context)
    assert overfit(model, with_text(model, make_batch(model.history, 2)), steps=200) < 0.08


@heads
def test_tokens_are_kept_and_those_of_absent_frames_do_not_matter(make: Callable[..., ContextModel]) -> None:
    model = made(make, "tokens", history=3).eval()
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


class Trunk(Context):
    """What a pretrained trunk would be: token ids and pixels in, hidden states and their padding out."""

    length = 5

    def __init__(self, **inherited: Inherited) -> None:
        super().__init__(**inherited)
        self.trunk = torch.nn.Linear(3, self.width)

    def encode(self, batch: Any, text: torch.Tensor) -> torch.Tensor:
        colours = torch.stack(
            [batch["rgb"][camera].float().mean((2, 3)) for camera in self.spec.cameras], 2
        )  # (B, 1, n, 3)
        return self.trunk(colours / 255)

    def forward(self, batch: Any, text: torch.Tensor) -> Any:
        prefix = batch["tokens"] if "tokens" in batch else self.encode(batch, text)
        tokens = prefix.flatten(1, 2).expand(-1, 5, -1)
        return Encoded(tokens, tokens[:, 0], torch.arange(5).expand(len(tokens), -1) > 1)


def test_a_trunk_of_ones_own_is_one_more_context() -> None:
    node = plain(composed("model=flow", "model.width=32", "model.text_width=8", "model.auxiliary=0.0"))["model"]
    options = {name: value for name, value in node["context"].items() if name == "_partial_"}
    node["context"] = {"_target_": f"{Trunk.__module__}.Trunk", **options}
    tokenizer = Uniform(64, 0.05, 0.0, 0, spec=SPEC)
    with pytest.raises(ValueError, match="is not trusted"):  # until its package is
        build(node, "model", spec=SPEC, tokenizer=tokenizer)
    model = make_denoising(Flow, context=Trunk, chunk=2)
    groups = model.parameter_groups(1e-3, 0.0, {"context.trunk": 0.1}, [])
    assert {(group["lr"], len(group["params"])) for group in groups} >= {(1e-4, 1)}
    assert act(as_policy(model), observations(3)).shape == (3, 3)


def test_an_option_chooses_the_context() -> None:
    flow = plain(composed("model=flow", "model/context=tokens", "model.context.history=3"))["model"]
    assert flow["_target_"].endswith("Flow") and flow["context"]["_target_"].endswith("TokenContext")
    tokenizer = Uniform(64, 0.05, 0.0, 0, spec=SPEC)
    assert build(flow, "model", spec=SPEC, tokenizer=tokenizer).history == 3
    rt1 = plain(composed("model=rt1_tiny", "model/context=keypoints"))["model"]
    with pytest.raises(ValueError, match=r"model\.context must be .*TokenContext"):
        build(rt1, "model", spec=SPEC, tokenizer=tokenizer)
