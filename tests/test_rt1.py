"""RT-1 against its specification (arXiv 2212.06817)."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import pytest
import torch
from defaults import defaults_of
from fake_batch import TINY_IMAGE, TINY_TEXT, context_of, make_batch, make_rt1, with_text
from torch import Tensor
from toy import SPEC

from vla.models.rt1 import RT1, attention_mask
from vla.models.text.ngrams import NGrams
from vla.models.tokenizers.tokenizer import RT1Bins, Uniform
from vla.models.vision.timm_encoders import FilmEfficientNet


def encoded(tokens: Tensor) -> dict[str, Tensor]:
    """A batch of tokens (B, T, N, E), all of whose frames are present."""
    return {"tokens": tokens, "present": torch.ones(tokens.shape[:2], dtype=torch.bool)}


def test_the_mask_is_causal_and_hides_actions_from_actions() -> None:
    # two frames of two image tokens and two action slots
    expected = [
        "1.......",
        "11......",
        "11......",
        "11......",
        "11111...",
        "111111..",
        "11..11..",
        "11..11..",
    ]
    mask = attention_mask(frames=2, tokens=2, slots=2)
    assert ["".join("1" if allowed else "." for allowed in row) for row in mask.tolist()] == expected


def test_no_gradient_reaches_a_frame_from_an_earlier_prediction() -> None:
    model = make_rt1(history=3)
    batch = with_text(model, make_batch(3))
    tokens = model.encode(batch).detach().requires_grad_()
    for frame in range(3):
        (gradient,) = torch.autograd.grad(model({**batch, "tokens": tokens})["logits"][:, frame].sum(), tokens)
        assert (gradient[:, frame + 1 :] == 0).all()
        assert (gradient[:, : frame + 1].abs().sum((0, 2, 3)) > 0).all()


def test_one_pass_equals_a_loop_over_the_action_tokens() -> None:
    model = make_rt1(history=2, chunk=2).eval()
    tokens = model.encode(with_text(model, make_batch(2)))  # (B, 2, N, E)
    empty = tokens.new_zeros(4, model.slots, tokens.shape[-1])
    sequence = torch.cat([tokens[:, 0], empty, tokens[:, 1], empty], 1)
    start = sequence.shape[1] - model.slots  # of the newest frame's action slots
    loop = [model.head(model.transform(sequence[:, : start + slot])[:, -1]) for slot in range(model.slots)]
    one_pass = model(encoded(tokens))["logits"][:, -1].flatten(1, 2)
    assert torch.allclose(torch.stack(loop, 1), one_pass, atol=1e-5)


def test_no_prediction_depends_on_another_one_of_its_frame_nor_on_what_was_done() -> None:
    model = make_rt1(history=2, chunk=2).eval()
    frame = model.context.per_frame + model.slots
    sequence = torch.randn(1, 2 * frame, 32, requires_grad=True)  # whatever slots may hold
    hidden = model.transform(sequence)
    for slots in (range(model.context.per_frame, frame), range(frame + model.context.per_frame, 2 * frame)):
        for place in slots:
            (gradient,) = torch.autograd.grad(hidden[0, place].sum(), sequence, retain_graph=True)
            assert [other for other in slots if gradient[0, other].abs().sum() > 0] == [place]
    batch = with_text(model, make_batch(2, chunk=2))
    batch["action"].requires_grad_()
    logits = model(batch)["logits"]
    assert torch.autograd.grad(logits.sum(), batch["action"], allow_unused=True) == (None,)


def test_fewer_frames_than_the_history_give_what_the_first_slots_of_a_full_window_give() -> None:
    model = make_rt1(history=3).eval()
    tokens = model.encode(with_text(model, make_batch(3)))
    full = model(encoded(tokens))["logits"]
    for frames in (1, 2):
        assert torch.allclose(model(encoded(tokens[:, :frames]))["logits"], full[:, :frames], atol=1e-5)


def test_absent_frames_before_the_first_do_not_matter_as_they_are_none_in_a_policy() -> None:
    model = make_rt1(history=3).eval()
    tokens = model.encode(with_text(model, make_batch(3)))
    window = torch.cat([torch.randn_like(tokens[:, :1]), tokens[:, :2]], 1)  # as in training: absent ones come first
    present = torch.tensor([False, True, True]).expand(len(tokens), -1)
    logits = model({"tokens": window, "present": present})["logits"]
    assert torch.allclose(logits[:, 1:], model(encoded(tokens[:, :2]))["logits"], atol=1e-5)


def test_every_frame_of_the_window_is_learned_from() -> None:
    model = make_rt1(history=3)
    batch = with_text(model, make_batch(3))
    for frame in range(3):
        only = {**batch, "valid": torch.zeros_like(batch["valid"])}
        only["valid"][:, frame] = True
        logits = model(batch)["logits"][:, frame]
        losses = model.tokenizer.cross_entropy(logits, batch["action"][:, frame]).mean(-1)
        expected = losses[only["valid"][:, frame]].mean()
        assert model.loss(only)["action_loss"].item() == pytest.approx(expected.item(), rel=1e-4)


def test_the_tokens_of_the_cameras_stand_side_by_side() -> None:
    image = partial(FilmEfficientNet, "efficientnet_b0", pretrained=False, channels=16)
    spec = replace(SPEC, cameras=("front", "wrist"))
    tokenizer = RT1Bins(spec=spec, **defaults_of("tokenizer/rt1"))
    sizes = {"history": 2, "learned_tokens": 8, "keypoints": 0, "image_size": (64, 64), "layers": 1, "heads": 1}
    model = make_rt1(image=image, spec=spec, tokenizer=tokenizer, **sizes).eval()
    batch = with_text(model, make_batch(2, spec=spec))
    assert model.encode(batch).shape == (4, 2, 16, 32)
    assert model(batch)["logits"].shape == (4, 2, 1, 3, 256)


def parameters_of(module: torch.nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())


def test_the_paper_network_has_its_size_and_its_81_positions() -> None:
    spec = replace(
        SPEC,
        cameras=("front",),
        image_size=(256, 320),
        action=tuple(f"component{number}" for number in range(11)),
        units=("1",) * 11,
        low=(-1.0,) * 11,
        high=(1.0,) * 11,
    )
    image = partial(FilmEfficientNet, **defaults_of("model/image/film_efficientnet", pretrained=False))
    model: Any = RT1(
        image=image,
        text=partial(NGrams, **defaults_of("model/text/ngrams")),
        spec=spec,
        tokenizer=RT1Bins(spec=spec, **defaults_of("tokenizer/rt1")),
        context=context_of("model/rt1"),
        **defaults_of("model/rt1"),
    ).eval()
    language = parameters_of(model.text)  # a frozen encoder in the paper
    transformer = [model.context.image_tokens, model.positions, model.layers, model.head]
    images = parameters_of(model.context.image), parameters_of(model.context.token_learners)
    parts = (*images, sum(map(parameters_of, transformer)))
    assert parts == (15_709_784, 34_376, 19_375_872)
    assert parameters_of(model) == sum(parts) + language
    # The published code embeds the actions of the past too, and multiplies what comes of it by zero.
    unused = 256 * 512
    assert sum(parts) + unused == pytest.approx(35.25e6, abs=0.005e6)
    assert len(model.context.image.films) + 1 == 27
    assert model.mask.shape == (114, 114)
    positions = []
    model.context.token_learners[0].register_forward_pre_hook(lambda module, inputs: positions.append(inputs[0].shape))
    with torch.inference_mode():
        tokens = model.encode(model.transforms(make_batch(1, size=1, spec=spec)))
    assert positions == [(1, 512, 9, 9)]
    assert tokens.shape == (1, 1, 8, 512)


@pytest.mark.parametrize("option", ["model/rt1", "model/rt1_small"])
def test_rt1_sees_images_and_the_instruction_only(option: str) -> None:
    small = {"image_size": None, "width": 32, "text_width": 16, "layers": 1, "heads": 2, "key_width": 16}
    tokenizer = Uniform(spec=SPEC, **defaults_of("tokenizer/uniform"))
    parts: dict[str, Any] = {"image": TINY_IMAGE, "text": TINY_TEXT, "spec": SPEC, "tokenizer": tokenizer}
    parts["context"] = context_of(option)
    model = RT1(**parts, **defaults_of(option, **small)).eval()
    batch = with_text(model, make_batch(model.history))
    logits = model(batch)["logits"]
    numbers = {name: torch.randn_like(batch[name]) for name in ("state", "truth", "action")}
    assert torch.equal(model({**batch, **numbers})["logits"], logits)
    images = {name: 255 - image for name, image in batch["rgb"].items()}
    assert not torch.equal(model({**batch, "rgb": images})["logits"], logits)
    assert not torch.equal(model({**batch, "text": batch["text"].roll(1, 0)})["logits"], logits)
