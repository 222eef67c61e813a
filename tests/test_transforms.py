"""What a model sees of an observation is the same in training, evaluation, serving and on a robot."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, get_args

import numpy as np
import pytest
import torch
from fake_batch import as_policy, make_bc, make_rt1
from small_training import make_learner, make_trainer
from torch import Tensor
from torch.utils.data import DataLoader
from toy import SPEC, ToyEnvironment, make_store

from vla.data.episodes import EpisodeStore
from vla.data.window_batches import WindowBatcher
from vla.deploy import messages
from vla.deploy.client_observation import Keys
from vla.deploy.inference import Inference
from vla.io.images import Fit, fit_images, resize
from vla.io.parts import Part
from vla.models.layers import Batch
from vla.models.model import Model

FITS = get_args(Fit)
TRAINED, RAW = replace(SPEC, image_size=(16, 24)), replace(SPEC, image_size=(45, 31))


def resized(image: np.ndarray, size: tuple[int, int], fit: Fit) -> np.ndarray:
    return fit_images(torch.from_numpy(image)[None, None], size, fit)[0, 0].numpy()


def test_the_centre_is_used_or_all_is_squeezed_or_framed() -> None:
    wide = np.zeros((480, 640, 3), np.uint8)
    wide[:, :80, 0], wide[:, 80:560, 1], wide[:, 560:, 2] = 255, 255, 255  # red and blue at the sides
    crop, stretch, pad = (resized(wide, (96, 96), fit) for fit in ("crop", "stretch", "pad"))
    assert (crop == (0, 255, 0)).all()
    assert (stretch[:, 0] == (255, 0, 0)).all() and (stretch[:, -1] == (0, 0, 255)).all()
    assert (pad[:12] == 0).all() and (pad[84:] == 0).all() and (pad[12:84, 0] == (255, 0, 0)).all()
    assert (pad[12:84, 20:76] == (0, 255, 0)).all()


@pytest.mark.parametrize("fit", FITS)
def test_any_size_is_taken_and_the_size_itself_is_left_alone(fit: Fit) -> None:
    for shape in ((1, 1), (1, 2000), (8, 8), (97, 95)):
        image = resized(np.full((*shape, 3), 77, np.uint8), (96, 64), fit)
        assert image.shape == (96, 64, 3) and set(np.unique(image)) <= {0, 77} and (image == 77).any()
    images = torch.zeros(2, 3, 96, 64, 3, dtype=torch.uint8)
    assert fit_images(images, (96, 64), fit) is images


@pytest.mark.parametrize("fit", FITS)
def test_what_importers_store_is_what_a_policy_makes_of_the_same_picture(fit: Fit) -> None:
    image = np.random.default_rng(0).integers(256, size=(90, 160, 3), dtype=np.uint8)
    for size in (None, (20, 20)):
        model, rest = make_bc(spec=TRAINED, image_size=size, fit=fit), {"text": torch.zeros(1, 1)}
        raw, stored = (
            model.transforms({"rgb": {"eye": torch.from_numpy(each)[None, None]}, **rest})["rgb"]["eye"]
            for each in (image, resize(image, TRAINED.image_size))
        )
        assert raw.shape[2:4] == (size or TRAINED.image_size) and torch.equal(raw, stored)
    assert resize(image, (90, 160)) is image


def test_every_pixel_counts() -> None:
    """Pixels that a small image leaves out would flicker where an edge moves."""
    stripes = np.zeros((960, 960, 3), np.uint8)
    stripes[:, ::2] = 255
    assert np.abs(resize(stripes, (96, 96)) - 127.5).max() < 4


def raw_world() -> ToyEnvironment:
    return ToyEnvironment(spec=RAW)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> EpisodeStore:
    """Demonstrations with larger images."""
    return make_store(tmp_path_factory.mktemp("raw"), raw_world)


def in_training(model: Model, store: EpisodeStore) -> object:
    batcher = WindowBatcher(store, model.history, model.chunk)
    windows = DataLoader([batcher(np.array([0]))], batch_size=None)  # type: ignore[arg-type]
    return make_trainer(1).validate(make_learner(model), windows, verbose=False)


def at_the_server(model: Model, seen: Any) -> object:
    message = {"image": seen.rgb["eye"], "state": seen.state, "prompt": seen.instruction}
    keys = Keys({"eye": "image"}, ["state"], "prompt")
    return as_policy(model, spec=TRAINED).plan([keys.observation(message, TRAINED)], [0])


def in_the_node(model: Model, seen: Any) -> object:
    message = messages.fill_image(SimpleNamespace(header=SimpleNamespace()), seen.rgb["eye"], "eye")
    observation = replace(seen, rgb={"eye": messages.image_from(message)})
    inference = Inference(as_policy(model, spec=TRAINED))
    inference.start(observation, is_first=True)
    inference.close()
    return inference.take()


@pytest.mark.parametrize("fit", FITS)
@pytest.mark.parametrize("make", [make_bc, make_rt1], ids=["bc", "rt1"])
def test_one_raw_observation_is_the_same_input_everywhere(
    make: Callable[..., Model], fit: Fit, store: EpisodeStore
) -> None:
    model = make(spec=TRAINED, image_size=(20, 20), fit=fit, **({} if make is make_bc else {"history": 1})).eval()
    inputs = list[list[Tensor]]()

    def keep(module: torch.nn.Module, arguments: tuple[Tensor, ...]) -> None:
        inputs[-1].extend(arguments)

    encoder: Any = model.features.images[0] if make is make_bc else model.context.image  # type: ignore[union-attr]
    encoder.register_forward_pre_hook(keep)
    made, transform = list[Batch](), model.transforms

    def transformed(batch: Batch) -> Batch:
        made.append(transform(batch))
        return made[-1]

    model.transforms = transformed  # type: ignore[assignment]
    seen = raw_world().reset(0)
    for path in (
        lambda: in_training(model, store),
        lambda: as_policy(model, spec=TRAINED).act(seen),
        lambda: at_the_server(model, seen),
        lambda: in_the_node(model, seen),
    ):
        inputs.append([])
        path()
    assert inputs[0][0].shape == (1, 3, 20, 20) and inputs[0][0].std() > 0.01
    for others in inputs[1:]:  # validation computes loss and prediction, each of which looks once
        assert all(torch.equal(*pair) for pair in zip(inputs[0][:2], others, strict=True))
    assert len(made) == 4
    for name in ("state", "text"):
        assert all(torch.equal(made[0][name], other[name]) for other in made)


def test_a_world_with_another_size_of_images_fits_unless_they_are_cut_out() -> None:
    TRAINED.require_input(replace(RAW, truth=()), "the policy", "the task")
    with pytest.raises(ValueError, match="the policy has image_size"):
        replace(TRAINED, parts=(Part("eye"),)).require_input(RAW, "the policy", "the task")
    with pytest.raises(ValueError, match="the policy has control_hz"):
        TRAINED.require_input(replace(RAW, control_hz=5.0), "the policy", "the task")
