"""The decoder: one token after the other, with what it knows kept, is the same as all of them at once."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from defaults import defaults_of
from fake_batch import MOTIONS, make_decoder, make_rt1, with_motions
from saved_policies import save_policy
from toy import SPEC

from vla.models.decoder import Decoder
from vla.models.model import Model
from vla.models.policy_folder import read_policy
from vla.models.tokenizers.fast import Fast
from vla.models.tokenizers.quantile import Quantile
from vla.models.tokenizers.tokenizer import RT1Bins


def make_fast() -> Decoder:
    """A decoder that writes chunks as FAST does."""
    return make_decoder(chunk=4, tokenizer=Fast(bins=256, chunk=4, spec=SPEC, statistics=MOTIONS, scale=10.0))


MODELS: dict[str, Callable[[], Decoder]] = {
    "uniform": make_decoder,
    "chunk": lambda: make_decoder(history=3, chunk=3),
    "rt1": lambda: make_decoder(tokenizer=RT1Bins(spec=SPEC, **defaults_of("tokenizer/rt1"))),
    "quantile": lambda: make_decoder(tokenizer=Quantile(bins=64, spec=SPEC, statistics=MOTIONS)),
    "fast": make_fast,
}


@pytest.mark.parametrize("make", MODELS.values(), ids=MODELS.keys())
def test_writing_with_a_cache_is_decoding_the_growing_sequence_again_and_again(make: Callable[[], Decoder]) -> None:
    torch.manual_seed(0)  # of two tokens that are nearly as likely either may be written
    model = make()
    with torch.no_grad():
        for parameter in model.parameters():  # many biases are 0 at first, and would not be missed
            parameter.add_(0.3 * torch.randn_like(parameter))
    model.eval()
    batch = with_motions(model)
    batch["present"][:2, :-1] = False
    with torch.inference_mode():
        context = model.encode_context(batch)
        logits, tokens = model.generate(context)
        written = tokens[:, :0]
        for place in range(tokens.shape[1]):
            again = model.head(model.decode(written, context))
            assert torch.allclose(again, logits[:, : place + 1], atol=1e-4, rtol=1e-4)
            written = torch.cat([written, again[:, -1:].argmax(-1)], 1)
        assert torch.equal(written, tokens)
    assert len(tokens.unique()) > 1


def test_the_words_of_fast_tokens_come_with_the_policy(tmp_path: Path) -> None:
    model = make_fast().eval()
    other = make_decoder(chunk=4, tokenizer=Fast(bins=256, chunk=4, spec=SPEC, scale=10.0)).eval()  # without words
    node: dict[str, Any] = {"task": {}, "tokenizer": {}, "model": {}}
    read_policy(save_policy(tmp_path, node, state=model.state_dict())).restore(other)
    batch = with_motions(model)
    assert torch.equal(other.predict(batch).actions, model.predict(batch).actions)


def test_a_token_depends_on_those_before_it_and_on_no_later_one() -> None:
    model = make_decoder(chunk=2).eval()
    context = model.encode_context(with_motions(model))
    tokens = torch.randint(64, (4, 5))
    embedded: list[torch.Tensor] = []

    def keep(module: torch.nn.Module, inputs: object, output: torch.Tensor) -> torch.Tensor:
        embedded.append(output.detach().requires_grad_())
        return embedded[-1]

    model.embedding.register_forward_hook(keep)
    hidden = model.decode(tokens, context)
    for place in range(6):
        (gradient,) = torch.autograd.grad(hidden[:, place].square().sum(), embedded[0], retain_graph=True)
        assert (gradient[:, place:] == 0).all()
        assert (gradient[:, :place].abs().sum((0, 2)) > 0).all()


def test_every_frame_matters() -> None:
    model = make_decoder(history=3).eval()
    batch = with_motions(model)
    logits = model(batch)["logits"]
    for frame in range(3):
        changed = {name: images.clone() for name, images in batch["rgb"].items()}
        changed["eye"][:, frame] = 0
        assert not torch.allclose(model({**batch, "rgb": changed})["logits"], logits)


def test_frames_that_are_missing_are_as_frames_that_are_padding() -> None:
    model = make_decoder(history=3).eval()
    batch = with_motions(model)
    batch["present"][:, :2] = False
    alone = {name: batch[name][:, 2:] for name in ("state", "present")}
    rgb = {camera: images[:, 2:] for camera, images in batch["rgb"].items()}
    prediction = model.predict({**alone, "rgb": rgb, "text": batch["text"]})
    assert torch.allclose(prediction.actions, model.predict(batch).actions, atol=1e-6)


def test_writing_ends_when_all_have_ended() -> None:
    model = make_fast().eval()
    torch.nn.init.zeros_(model.head.weight)
    with torch.no_grad():
        model.head.bias.copy_(torch.eye(256)[model.tokenizer.end])
    _, tokens = model.generate(model.encode_context(with_motions(model)))
    assert tokens.tolist() == [[model.tokenizer.end]] * 4


@pytest.mark.parametrize("make", [make_decoder, make_rt1])
def test_a_model_that_would_see_nothing_is_refused(make: Callable[..., Model]) -> None:
    with pytest.raises(ValueError, match="a frame needs a token"):
        make(learned_tokens=0, keypoints=0, proprioception=False)
