"""Sentences through encoders of Hugging Face."""

from __future__ import annotations

import copy
import pickle
import shutil
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
import transformers
from fake_batch import make_batch, make_bc, overfit, with_text
from huggingface_hub import constants
from saved_policies import change_json
from tiny_encoder import LONGEST, numbers, sizes, write_encoder

from vla.config.annotations import locate
from vla.io.errors import UserError
from vla.models.text.huggingface import HuggingFace

SENTENCES = ["Lift the red block", "put the blue block on the red pad", ""]
VISION = {**sizes(), "image_size": 32, "patch_size": 16}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_encoder(tmp_path_factory.mktemp("encoders") / "bert")


def test_a_sentence_is_the_mean_over_its_tokens_whatever_stands_beside_it(folder: Path) -> None:
    encoder = HuggingFace(str(folder), width=8)
    together = encoder.tokenize(SENTENCES)
    with torch.no_grad():
        features = transformers.BertModel.from_pretrained(folder).eval()(numbers("lift the red block"))
    assert torch.allclose(together[0], features.last_hidden_state[0].mean(0), atol=1e-6)
    assert torch.equal(encoder.tokenize(SENTENCES[1:2])[0], together[1])
    assert together.shape == (3, 16) and encoder(together).shape == (3, 8)
    assert torch.isfinite(encoder(together)).all()
    long = "put the red block on the pad " * 9  # which is cut
    assert torch.equal(encoder.tokenize([long]), encoder.tokenize([long + "on the blue pad"]))


def test_every_distinct_sentence_goes_through_the_network_once(folder: Path) -> None:
    encoder, calls = HuggingFace(str(folder), width=8), list[int]()
    encoder.encoder.network.register_forward_hook(lambda *_: calls.append(1))
    with torch.inference_mode():
        encoder.tokenize(SENTENCES)
    for _ in range(3):
        encoder(encoder.tokenize(SENTENCES * 2)).sum().backward()  # also from vectors made in inference mode
        copy.deepcopy(encoder).tokenize(SENTENCES)  # as the averaging of weights makes one
    assert len(calls) == len(SENTENCES)


def test_the_projection_learns_and_the_encoder_does_not(folder: Path) -> None:
    torch.manual_seed(0)
    model = make_bc(text=partial(HuggingFace, str(folder)))
    text: Any = model.text
    assert {name.partition(".")[0] for name, _ in text.named_parameters()} == {"projection"}
    projection, frozen = (copy.deepcopy(m.state_dict()) for m in (text.projection, text.encoder.network))
    batch = with_text(model.train(), make_batch(1))
    untrained = model.loss(batch)["loss"].item()
    overfit(model, batch, steps=10)
    assert model.train().loss(batch)["loss"].item() < untrained
    assert not torch.equal(text.projection.state_dict()["1.weight"], projection["1.weight"])
    assert all(torch.equal(frozen[name], value) for name, value in text.encoder.network.state_dict().items())


TOWERS: dict[str, Callable[[], Any]] = {
    "clip": lambda: transformers.CLIPModel(
        transformers.CLIPConfig(
            text_config={**sizes(), "projection_dim": 12, "eos_token_id": 3}, vision_config=VISION, projection_dim=12
        )
    ),
    "siglip": lambda: transformers.SiglipModel(
        transformers.SiglipConfig(text_config={**sizes(), "projection_size": 12}, vision_config=VISION)
    ),
}


@pytest.mark.parametrize("name", TOWERS)
def test_a_text_tower_is_read_where_it_was_trained_to_be(name: str, tmp_path: Path) -> None:
    network = TOWERS[name]().eval()
    encoder = HuggingFace(str(write_encoder(tmp_path, network)), width=8)
    ids = numbers("lift the red block")
    if name == "siglip":  # which never saw a text that was not filled up
        ids = torch.nn.functional.pad(ids, (0, LONGEST - ids.shape[1]))
    with torch.no_grad():
        expected = network.get_text_features(ids).pooler_output[0]
    assert torch.allclose(encoder.tokenize(SENTENCES)[0], expected, atol=1e-6)
    assert not any("vision" in key for key in encoder.encoder.network.state_dict())


def test_of_an_encoder_with_a_decoder_only_the_encoder_is_read(tmp_path: Path) -> None:
    config = transformers.T5Config(vocab_size=12, d_model=16, d_kv=8, d_ff=32, num_layers=1, num_heads=2)
    network = transformers.T5ForConditionalGeneration(config).eval()
    encoder = HuggingFace(str(write_encoder(tmp_path, network)), width=8)
    with torch.no_grad():
        expected = network.encoder(numbers("lift the red block")).last_hidden_state[0].mean(0)
    assert torch.allclose(encoder.tokenize(SENTENCES)[0], expected, atol=1e-6)


def test_a_state_names_the_encoder_and_no_other_one_takes_its_place(folder: Path, tmp_path: Path) -> None:
    encoder = HuggingFace(str(folder), width=8)
    state = encoder.state_dict()
    assert sum(value.nbytes for value in state.values() if isinstance(value, torch.Tensor)) < 2000
    moved = HuggingFace(str(shutil.copytree(folder, tmp_path / "moved")), width=8)
    parameters = list(moved.parameters())
    moved.load_state_dict(state)
    assert all(mine is before for mine, before in zip(moved.parameters(), parameters, strict=True))
    again = pickle.loads(pickle.dumps(moved))  # for a worker process
    assert torch.equal(again(again.tokenize(SENTENCES)), encoder(encoder.tokenize(SENTENCES)))
    other = transformers.BertModel(transformers.BertConfig(**sizes(), hidden_act="relu"))
    torch.nn.init.ones_(other.embeddings.word_embeddings.weight)
    other.save_pretrained(tmp_path / "moved")
    with pytest.raises(
        UserError, match=r"moved is another text encoder than in training: .* SHA-256 \w{8}…, get those with"
    ):
        HuggingFace(str(tmp_path / "moved"), width=8).load_state_dict(state)


def test_a_configuration_cannot_make_transformers_fetch_or_run_code(folder: Path, tmp_path: Path) -> None:
    names = ("attn_implementation", "_attn_implementation", "experts_implementation")
    acting = {**dict.fromkeys(names, "somebody/kernel"), "auto_map": {"AutoModel": "own.Model"}}
    acting["quantization_config"] = {"quant_method": "mxfp4"}  # whose code comes from the hub
    expected = HuggingFace(str(folder), width=8).tokenize(SENTENCES)
    change_json(write_encoder(tmp_path / "bert") / "config.json", lambda values: values | acting)
    assert torch.equal(HuggingFace(str(tmp_path / "bert"), width=8).tokenize(SENTENCES), expected)
    tower = write_encoder(tmp_path / "clip", TOWERS["clip"]())
    change_json(tower / "config.json", lambda values: values | {"text_config": values["text_config"] | acting})
    HuggingFace(str(tower), width=8)


def without(name: str) -> Callable[[Path], object]:
    return lambda folder: (folder / name).unlink()


def damaged(name: str, content: bytes) -> Callable[[Path], object]:
    return lambda folder: (folder / name).write_bytes(content)


def pickled(folder: Path) -> None:
    (folder / "model.safetensors").unlink()
    torch.save({}, folder / "pytorch_model.bin")


def deeper(folder: Path) -> None:
    change_json(folder / "config.json", lambda values: values | {"num_hidden_layers": 2})


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        *((without(name), name) for name in ("config.json", "model.safetensors")),
        (without("tokenizer.json"), "tokenizer"),
        (damaged("model.safetensors", b"\x10"), "header"),
        (damaged("config.json", b'{"model_type": "bret"}'), "bret"),
        (damaged("config.json", b'{"model_type": "own", "auto_map": {"AutoModel": "own.Model"}}'), "own"),
        (damaged("tokenizer.json", b'{"model": '), "Expecting value"),
        (damaged("adapter_config.json", b"{}"), "it has an adapter"),
        (pickled, "no file named model.safetensors"),
        (deeper, r"weights are those of another network, encoder\.layer\.1\..* is missing"),
    ],
)
def test_what_is_no_encoder_is_told_in_one_line(change: Callable[[Path], object], reason: str, tmp_path: Path) -> None:
    change(write_encoder(tmp_path / "encoder"))
    with pytest.raises(
        UserError, match=rf"^\S+/encoder is no text encoder as save_pretrained writes them: .*{reason}"
    ) as told:
        HuggingFace(str(tmp_path / "encoder"), width=8)
    assert len(str(told.value)) < 600


@pytest.mark.parametrize("name", ["nowhere", "somebody/encoder@v1", "/nowhere/at/all"])
def test_without_folder_and_hub_the_name_is_named(name: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(constants, "ENDPOINT", "http://127.0.0.1:9")
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path))
    with pytest.raises(UserError, match=f"{name} cannot be fetched .*; nor is it a folder here: set model.text"):
        HuggingFace(name, width=8)


def test_without_transformers_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "transformers", None)
    monkeypatch.delitem(sys.modules, HuggingFace.__module__)
    with pytest.raises(UserError, match=r"transformers.* its extra vlm: pip install -e '\.\[vlm\]'"):
        locate("model.text._target_", f"{HuggingFace.__module__}.HuggingFace")
