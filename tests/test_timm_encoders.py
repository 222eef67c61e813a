"""Image encoders around networks of timm, and where their weights come from."""

from __future__ import annotations

import logging
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import timm
import torch
from defaults import defaults_of
from fake_batch import make_batch, make_bc, overfit, with_text
from huggingface_hub import constants
from safetensors.torch import save_file

from vla.io.errors import UserError
from vla.models.vision import timm_encoders
from vla.models.vision.timm_encoders import WEIGHTS, FilmBackbone, FilmEfficientNet, load_backbone
from vla.training.trainer import SyncBatchNorm


def test_at_the_start_the_efficientnet_is_the_plain_one_bit_for_bit() -> None:
    torch.manual_seed(0)
    plain: Any = timm.create_model("efficientnet_b0", num_classes=0).eval()
    ours: Any = FilmEfficientNet("efficientnet_b0", pretrained=False, channels=32, text_width=8).eval()
    blocks = torch.nn.ModuleList(block for stage in plain.blocks for block in stage)
    for module, source in (
        (ours.stem, torch.nn.Sequential(plain.conv_stem, plain.bn1)),
        (ours.blocks, blocks),
        (ours.top, torch.nn.Sequential(plain.conv_head, plain.bn2)),
    ):
        module.load_state_dict(source.state_dict())
    images = torch.rand(2, 3, 64, 64)
    plain.to(memory_format=torch.channels_last)
    with torch.inference_mode():
        expected = ours.projection(plain.forward_features(ours.normalize(images)))
        assert torch.equal(ours(images, torch.randn(2, 8)), expected)
    assert len(ours.films) == len(ours.blocks) == 16


def test_batch_normalisation_over_processes_keeps_the_activations() -> None:
    torch.manual_seed(0)
    network = FilmEfficientNet("efficientnet_b0", pretrained=False, channels=32, text_width=8).eval()
    images, text = torch.rand(2, 3, 64, 64), torch.randn(2, 8)
    with torch.inference_mode():
        expected = network(images, text)
        synchronised = SyncBatchNorm().apply(network)
        assert any(isinstance(module, torch.nn.SyncBatchNorm) for module in synchronised.modules())
        assert torch.allclose(synchronised(images, text), expected, atol=1e-5)


NETWORKS = [("test_vit", 32), ("test_resnet", None), ("test_vit3", 32), ("test_vit4", None)]


@pytest.mark.parametrize(("name", "size"), NETWORKS)
def test_at_the_start_a_feature_map_is_that_of_the_network(name: str, size: int | None, tmp_path: Path) -> None:
    torch.manual_seed(0)
    plain: Any = timm.create_model(name, num_classes=0, img_size=size if "vit" in name else None).eval()
    save_file(plain.state_dict(), tmp_path / WEIGHTS)
    ours = FilmBackbone(
        text_width=4,
        **defaults_of("model/image/timm", name=name, pretrained=str(tmp_path / WEIGHTS), size=size, channels=8),
    ).eval()
    side = ours.size
    assert side == (size or plain.pretrained_cfg["input_size"][-1])
    images = torch.rand(2, 3, side, side)
    mean, std = (torch.tensor(plain.pretrained_cfg[key]).view(3, 1, 1) for key in ("mean", "std"))
    with torch.inference_mode():
        expected = plain.forward_features((images - mean) / std)
        if "vit" in name:  # (N, prefix + h·w, C)
            patches = expected[:, plain.num_prefix_tokens :]
            h = round(patches.shape[1] ** 0.5)
            expected = patches.mT.unflatten(-1, (h, h))
        features = ours(images, torch.randn(2, 4))
        # On some processors the last bits of a ViT's attention depend on where its memory happens to lie.
        bound = 1e-6 if "vit" in name else 0
        torch.testing.assert_close(features, ours.projection(expected), atol=bound, rtol=bound)
        smaller = ours(torch.rand(2, 3, 24, 20), torch.randn(2, 4))  # resized first
        assert smaller.shape == (2, 8, *expected.shape[-2:])


def test_a_frozen_backbone_is_unchanged_while_the_rest_of_the_model_learns() -> None:
    torch.manual_seed(0)
    model = make_bc(image=partial(FilmBackbone, "test_resnet", False, frozen=True, size=32, channels=8))
    encoder: Any = model.features.images[0]
    trunk = encoder.backbone
    before = {name: value.clone() for name, value in trunk.state_dict().items()}
    encoder(torch.rand(2, 3, 32, 32), torch.randn(2, encoder.film.gamma.in_features))  # in the mode of the beginning
    batch = with_text(model.train(), make_batch(1))
    untrained = model.loss(batch)["loss"].item()
    overfit(model, batch, steps=20)
    assert all(torch.equal(before[name], value) for name, value in trunk.state_dict().items())
    assert model.loss(batch)["loss"].item() < 0.9 * untrained
    assert encoder.film.gamma.weight.abs().max() > 0


def test_a_network_that_is_not_frozen_learns_in_all_its_parts() -> None:
    encoder = FilmBackbone("test_vit", False, frozen=False, size=32, channels=8, text_width=4).train()
    encoder(torch.rand(2, 3, 32, 32), torch.randn(2, 4)).square().sum().backward()
    assert [name for name, parameter in encoder.backbone.named_parameters() if parameter.grad is None] == []


@pytest.mark.parametrize("ending", ["pth", "safetensors"])
def test_weights_come_from_a_file(ending: str, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    source: Any = timm.create_model("efficientnet_b0")
    path = tmp_path / f"weights.{ending}"
    (torch.save if ending == "pth" else save_file)(source.state_dict(), path)
    with caplog.at_level(logging.INFO, logger=timm_encoders.__name__):
        net = load_backbone("efficientnet_b0", str(path))
    assert torch.equal(net.conv_stem.weight, source.conv_stem.weight) and f"weights loaded from {path}" in caplog.text
    with pytest.raises(UserError, match="does not hold the weights of timm's efficientnet_b1"):
        load_backbone("efficientnet_b1", str(path))


def test_weights_are_those_downloaded_before_or_random_with_a_warning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(constants, "ENDPOINT", "http://127.0.0.1:9")
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path))
    with pytest.raises(UserError, match=r"refused.*path of a weights file, or false"):
        load_backbone("test_vit", True)
    load_backbone("test_vit", False)
    assert not caplog.records
    source: Any = load_backbone("test_vit", "auto")
    assert "starts with RANDOM weights: timm/test_vit.r160_in1k cannot be fetched" in caplog.text
    folder = tmp_path / f"models--timm--{source.pretrained_cfg['architecture']}.{source.pretrained_cfg['tag']}"
    (folder / "snapshots/abc").mkdir(parents=True)
    (folder / "refs").mkdir()
    (folder / "refs/main").write_text("abc")
    save_file(source.state_dict(), folder / "snapshots/abc" / WEIGHTS)
    assert torch.equal(load_backbone("test_vit", True).pos_embed, source.pos_embed)


@pytest.mark.parametrize(
    ("kind", "options", "message"),
    [
        ("timm", {"name": "vit_smal_patch16_dinov3"}, "is no network of timm, did you mean vit_small"),
        ("timm", {"name": "test_vit.nowhere"}, "nowhere is no network of timm, did you mean test_vit"),
        ("timm", {"name": "test_vit", "size": 40}, "size=40 must be a multiple of 16"),
        ("timm", {"name": "test_vit", "pretrained": "nowhere.pth"}, "no file nowhere.pth"),
        ("film_efficientnet", {"name": "resnet18"}, "name=resnet18 is no EfficientNet"),
    ],
)
def test_what_cannot_be_had_is_named(kind: str, options: dict[str, Any], message: str) -> None:
    make: Any = {"timm": FilmBackbone, "film_efficientnet": FilmEfficientNet}[kind]
    with pytest.raises(UserError, match=message):
        make(text_width=4, **defaults_of(f"model/image/{kind}", **{"pretrained": False, **options}))


def test_files_that_hold_no_weights_are_named(tmp_path: Path) -> None:
    class Attack:
        def __reduce__(self) -> tuple[Any, tuple[Path]]:
            return Path.touch, (tmp_path / "attacked",)

    torch.save({"stem.weight": Attack()}, tmp_path / "attack.pth")
    (tmp_path / "torn.safetensors").write_bytes(b"\x10")
    (tmp_path / "empty.pth").write_bytes(b"")
    torch.save({}, tmp_path / "nothing.pth")
    for name in ("attack.pth", "torn.safetensors", "empty.pth", "nothing.pth"):
        with pytest.raises(UserError, match=f"{name} cannot be read as weights"):
            load_backbone("test_vit", str(tmp_path / name))
    assert not (tmp_path / "attacked").exists()
