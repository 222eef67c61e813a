"""Image encoders, tokens, keypoints and the random shift."""

from __future__ import annotations

from copy import deepcopy

import pytest
import torch
from torch import nn
from torch._inductor import config as inductor

from vla.models.compilation import prepare_compilation
from vla.models.vision.image_tokenizer import FiLM, FilmConv, Keypoints, RandomShift, TokenLearner


def test_film_scales_and_shifts_every_channel() -> None:
    film = FiLM(1, 2, identity=True)
    film.gamma.bias.data = torch.tensor([1.0, 0.0])
    film.beta.bias.data = torch.tensor([0.0, 5.0])
    out = film(torch.ones(1, 2, 1, 1), torch.zeros(1, 1)).flatten()
    assert out.tolist() == [2.0, 6.0]


def test_film_conv_listens_to_the_text() -> None:
    encoder = FilmConv([4, 6], [5, 3], [2, 2], text_width=8, chroma=True, positions=False, log_pixels=False)
    images = torch.rand(1, 3, 16, 16).expand(2, -1, -1, -1)
    features = encoder(images, torch.randn(2, 8))
    assert features.shape == (2, 6, 4, 4) and not torch.allclose(features[0], features[1])


def test_with_chroma_alone_a_dimmer_lamp_changes_little() -> None:
    torch.manual_seed(0)
    encoder = FilmConv([8], [5], [2], text_width=8, chroma=True, positions=False, log_pixels=False)
    torch.nn.init.zeros_(encoder.get_parameter("convs.0.weight"))  # so that only relative colours are left
    bright, text = 0.3 + 0.7 * torch.rand(1, 3, 16, 16), torch.randn(1, 8)
    with torch.no_grad():
        features, dim, other = (encoder(images, text) for images in (bright, bright / 2, bright.roll(1, 1)))
    assert (features - dim).norm() < 0.2 * (features - other).norm()


@pytest.mark.parametrize(("log_pixels", "at_least", "at_most"), [(False, 0.1, 0.15), (True, 0.5, 0.8)])
def test_logarithms_keep_contrasts_on_a_dark_table(log_pixels: bool, at_least: float, at_most: float) -> None:
    encoder = FilmConv([8], [5], [2], text_width=8, chroma=False, positions=False, log_pixels=log_pixels)
    table = torch.full((1, 3, 16, 16), 0.8)
    pad = table.clone()
    pad[:, :, 4:12, 4:12] = 0.4
    with torch.no_grad():
        first = encoder.get_submodule("convs.0")
        seen = []
        first.register_forward_hook(lambda module, inputs, output: seen.append(output))
        for images in (table, pad, table / 8, pad / 8):
            encoder(images, torch.zeros(1, 8))
    bright, dark = (seen[1] - seen[0]).norm(), (seen[3] - seen[2]).norm()
    assert at_least < dark / bright < at_most


def test_features_can_tell_their_position() -> None:
    encoder = FilmConv([4], [3], [1], text_width=8, chroma=True, positions=True, log_pixels=False)
    features = encoder(torch.rand(2, 3, 5, 7), torch.randn(2, 8))
    assert features.shape == (2, 4 + 2, 5, 7) == (2, encoder.channels, 5, 7)
    x, y = features[1, -2:]
    assert x[3, [0, 3, 6]].tolist() == pytest.approx([-4, 0, 4], abs=1e-6)
    assert y[[0, 2, 4], 3].tolist() == pytest.approx([-4, 0, 4], abs=1e-6)


def test_film_conv_wants_lists_of_one_length() -> None:
    with pytest.raises(ValueError, match="kernels and strides must be equally many"):
        FilmConv([4, 6], [5], [2, 2], text_width=8, chroma=True, positions=False, log_pixels=False)


def test_tokens_first_attend_to_a_few_positions() -> None:
    torch.manual_seed(0)
    learner = TokenLearner(32, 8)
    weights = learner.attention(torch.randn(16, 144, 32)).softmax(1)
    assert 5 < (1 / weights.square().sum(1)).mean() < 50  # of 144


def test_tokens_are_weighted_means_of_the_features_themselves() -> None:
    constant = torch.arange(6.0)[None, :, None, None].expand(1, 6, 3, 3)
    assert torch.allclose(TokenLearner(6, 8)(constant)[0, 0], torch.arange(6.0))


def test_keypoints_say_where_they_look_and_what_is_there() -> None:
    features = torch.zeros(1, 2, 5, 5)
    features[0, :, 1, 4] = torch.tensor([100.0, 7.0])
    keypoints = Keypoints(2, 1)
    keypoints.score.weight.data = torch.tensor([[1.0, 0.0]])
    keypoints.contrast.data.fill_(3.0)
    assert keypoints(features).flatten().tolist() == pytest.approx([4.0, -2.0, 100.0, 7.0])  # x right, y down


def test_keypoints_look_as_closely_at_a_faint_image_and_none_at_everything_alike() -> None:
    torch.manual_seed(0)
    keypoints, features = Keypoints(16, 32), torch.randn(4, 16, 24, 24)
    places = keypoints(features)[..., :2]
    assert torch.allclose(keypoints(7 + 0.01 * features)[..., :2], places, atol=1e-3)
    assert (places.std(0).mean(-1) > 0.1).all()  # of flat attention 0.0


def test_keypoints_of_an_image_of_one_colour_are_its_middle() -> None:
    places = Keypoints(3, 5)(torch.full((1, 3, 4, 6), 0.7))[..., :2]
    assert torch.allclose(places, torch.zeros(1, 5, 2), atol=1e-5)


def test_a_clip_is_shifted_as_one_and_clips_differ() -> None:
    torch.manual_seed(0)
    images = torch.randint(1, 256, (8, 1, 64, 64, 3)).byte().expand(-1, 3, -1, -1, -1)
    both = RandomShift(16, 32)({"front": images, "wrist": images})  # up to 4 px up or down, 8 px left or right
    shifted = both["front"]
    assert shifted.shape == images.shape and shifted.dtype == torch.uint8
    assert both.keys() == {"front", "wrist"} and not torch.equal(shifted, both["wrist"])
    assert torch.equal(shifted[:, 0], shifted[:, 2])
    assert torch.equal(shifted[:, :, 4:-4, 8:-8].unique(), images.unique())
    offsets = set()
    for before, after in zip(images[:, 0], shifted[:, 0], strict=True):
        found = [
            (y, x)
            for y in range(-4, 5)
            for x in range(-8, 9)
            if torch.equal(after[4:-4, 8:-8], before[4 + y : 60 + y, 8 + x : 56 + x])
        ]
        assert len(found) == 1
        offsets.add(found[0])
    assert len(offsets) > 4


def test_outside_training_nothing_is_shifted() -> None:
    rgb = {"front": torch.randint(256, (2, 1, 16, 16, 3)).byte()}
    assert RandomShift(64, 64).eval()(rgb) is rgb


def test_what_is_shifted_beyond_the_border_is_black() -> None:
    torch.manual_seed(0)
    images = torch.full((16, 2, 32, 48, 3), 255).byte()  # wider than high
    shifted = RandomShift(256, 256)({"front": images})["front"]  # up to the height of the image
    white = (shifted == 255).all(-1)
    rows, columns = white.any(3)[:, 0], white.any(2)[:, 0]
    assert torch.equal(shifted[white].unique(), torch.tensor([255])) and (shifted[~white] == 0).all()
    assert torch.equal(white[:, 0], rows[:, :, None] & columns[:, None, :])  # a rectangle
    assert (rows.sum(1) < 32).sum() > 8 and (columns.sum(1) >= 16).all()


def test_compiled_in_half_precision_it_has_the_same_gradients(monkeypatch: pytest.MonkeyPatch) -> None:
    torch.manual_seed(0)
    eager = nn.Sequential(nn.SiLU(), Keypoints(32, 16))
    compiled = deepcopy(eager)
    features = torch.randn(8, 32, 16, 16, dtype=torch.bfloat16).to(memory_format=torch.channels_last)
    direction, gradients = torch.randn(8, 16, 34), list[torch.Tensor]()
    prepare_compilation()
    # Without a program that tries the compiler, and without processes that compile.
    monkeypatch.setattr(inductor.cpp, "vec_isa_ok", True)
    monkeypatch.setattr(inductor, "compile_threads", 1)
    compiled.compile()
    for model in (eager, compiled):
        seen = features.clone().requires_grad_()
        with torch.autocast("cpu", torch.bfloat16):
            loss = (model(seen) * direction).sum()
        found = torch.autograd.grad(loss, [seen, *model.parameters()])
        gradients.append(torch.cat([each.float().flatten() for each in found]))
    assert (gradients[1] - gradients[0]).norm() < 0.03 * gradients[0].norm()
