"""Sentences through encoders of Hugging Face."""

from __future__ import annotations

import copy
import json
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
import transformers
from defaults import defaults_of
from fake_batch import make_batch, make_bc, overfit, with_text
from huggingface_hub import constants
from tiny_encoder import LONGEST, numbers, sizes, write_encoder

from vla.models.text.huggingface import HuggingFace

SENTENCES = ["Lift the red block", "put the blue block on the red pad", ""]
VISION = {**sizes(), "image_size": 32, "patch_size": 16}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_encoder(tmp_path_factory.mktemp("encoders") / "bert")


def calls_of(encoder: HuggingFace) -> list[Any]:
    """A list that grows by one with each pass through the frozen network."""
    calls: list[Any] = []
    encoder.encoder.network.register_forward_hook(lambda *_: calls.append(1))
    return calls


def test_a_sentence_is_the_mean_over_its_tokens_whatever_stands_beside_it(folder: Path) -> None:
    encoder = HuggingFace(str(folder), width=8)
    together = encoder.tokenize(SENTENCES)
    with torch.no_grad():
        features = transformers.BertModel.from_pretrained(folder).eval()(numbers("lift the red block"))
    assert torch.allclose(together[0], features.last_hidden_state[0].mean(0), atol=1e-6)
    assert torch.equal(encoder.tokenize(SENTENCES[1:2])[0], together[1])
    assert together.shape == (3, 16) and encoder(together).shape == (3, 8)
    assert torch.isfinite(encoder(together)).all()


def test_every_distinct_sentence_goes_through_the_network_once(folder: Path) -> None:
    encoder = HuggingFace(str(folder), width=8)
    calls = calls_of(encoder)
    for _ in range(3):
        encoder.tokenize(SENTENCES * 2)
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


def test_vectors_made_in_inference_mode_can_be_learned_from(folder: Path) -> None:
    encoder = HuggingFace(str(folder), width=8)
    with torch.inference_mode():
        encoder.tokenize(SENTENCES)
    encoder(encoder.tokenize(SENTENCES)).sum().backward()


def test_a_state_holds_the_whole_encoder(folder: Path, tmp_path: Path) -> None:
    encoder = HuggingFace(str(folder), width=8)
    torch.save(encoder.state_dict(), tmp_path / "state.pt")
    again = HuggingFace(width=8, **defaults_of("model/text/huggingface", name=""))
    again.load_state_dict(torch.load(tmp_path / "state.pt", weights_only=True))
    assert torch.equal(again.tokenize(SENTENCES), encoder.tokenize(SENTENCES))
    assert torch.equal(again(again.tokenize(SENTENCES)), encoder(encoder.tokenize(SENTENCES)))


def test_without_a_name_an_encoder_must_come_from_a_checkpoint() -> None:
    with pytest.raises(ValueError, match="is empty, and no checkpoint"):
        HuggingFace(width=8, **defaults_of("model/text/huggingface", name="")).tokenize(SENTENCES)


def test_loading_a_state_keeps_the_parameters_that_an_optimizer_knows(folder: Path) -> None:
    encoder = HuggingFace(str(folder), width=8)
    parameters = list(encoder.parameters())
    encoder.load_state_dict(HuggingFace(str(folder), width=8).state_dict())
    assert all(mine is before for mine, before in zip(encoder.parameters(), parameters, strict=True))


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
    assert not any("vision" in key for key in encoder.get_extra_state()["weights"])
    again = HuggingFace(width=8, **defaults_of("model/text/huggingface", name=""))
    again.load_state_dict(encoder.state_dict())
    weights, loaded = (each.get_extra_state()["weights"] for each in (encoder, again))
    assert weights.keys() == loaded.keys() and all(torch.equal(weights[key], loaded[key]) for key in weights)
    assert torch.allclose(again.tokenize(SENTENCES), encoder.tokenize(SENTENCES), atol=1e-6)


def test_of_an_encoder_with_a_decoder_only_the_encoder_is_read(tmp_path: Path) -> None:
    config = transformers.T5Config(vocab_size=12, d_model=16, d_kv=8, d_ff=32, num_layers=1, num_heads=2)
    network = transformers.T5ForConditionalGeneration(config).eval()
    encoder = HuggingFace(str(write_encoder(tmp_path, network)), width=8)
    with torch.no_grad():
        expected = network.encoder(numbers("lift the red block")).last_hidden_state[0].mean(0)
    assert torch.allclose(encoder.tokenize(SENTENCES)[0], expected, atol=1e-6)


def test_a_long_text_is_cut(folder: Path) -> None:
    encoder = HuggingFace(str(folder), width=8)
    long = "put the red block on the pad " * 9
    assert torch.equal(encoder.tokenize([long]), encoder.tokenize([long + "on the blue pad"]))


def test_pickled_weights_are_not_read(folder: Path, tmp_path: Path) -> None:
    write_encoder(tmp_path)
    weights = transformers.BertModel.from_pretrained(folder).state_dict()
    (tmp_path / "model.safetensors").unlink()
    torch.save(weights, tmp_path / "pytorch_model.bin")
    with pytest.raises(ValueError, match=r"has no model.safetensors.*run code.*save_pretrained"):
        HuggingFace(str(tmp_path), width=8)


def saved(folder: Path, **configuration: Any) -> dict[str, Any]:
    """The state of an encoder as a checkpoint holds it, with another configuration."""
    state = HuggingFace(str(folder), width=8).get_extra_state()
    return {**state, "config": json.dumps({**json.loads(state["config"]), **configuration})}


@pytest.mark.parametrize("kind", ["gpt2", "mamba", "vit", "clip_vision_model", "timm_wrapper", 3, None, "bert" * 999])
def test_of_a_checkpoint_or_folder_only_known_kinds_of_text_encoders_are_built(
    kind: Any, folder: Path, tmp_path: Path
) -> None:
    refused = r"cannot be read.*: .{1,100} is none of the text encoders albert, bert, "
    with pytest.raises(ValueError, match=refused):
        HuggingFace("", width=8).set_extra_state(saved(folder, model_type=kind))
    broken = write_encoder(tmp_path)
    (broken / "config.json").write_text(json.dumps({"model_type": kind}))
    with pytest.raises(ValueError, match=refused):
        HuggingFace(str(broken), width=8)


def test_a_configuration_cannot_make_transformers_fetch_or_run_code(folder: Path, tmp_path: Path) -> None:
    names = ("attn_implementation", "_attn_implementation", "experts_implementation")
    acting = {**dict.fromkeys(names, "somebody/kernel"), "auto_map": {"AutoModel": "own.Model"}}
    encoder, expected = HuggingFace("", width=8), HuggingFace(str(folder), width=8)
    encoder.set_extra_state(saved(folder, **acting))
    assert torch.equal(encoder.tokenize(SENTENCES), expected.tokenize(SENTENCES))
    config = write_encoder(tmp_path) / "config.json"
    config.write_text(json.dumps({**json.loads(config.read_text()), **acting}))
    assert torch.equal(HuggingFace(str(tmp_path), width=8).tokenize(SENTENCES), expected.tokenize(SENTENCES))
    tower = write_encoder(tmp_path / "clip", TOWERS["clip"]())
    values = json.loads((tower / "config.json").read_text())
    values["text_config"] |= acting
    (tower / "config.json").write_text(json.dumps(values))
    HuggingFace(str(tower), width=8)


def test_an_encoder_has_no_more_layers_than_weights(folder: Path) -> None:
    with pytest.raises(ValueError, match=r"num_hidden_layers is 1000000, with \d+ weights"):
        HuggingFace("", width=8).set_extra_state(saved(folder, num_hidden_layers=10**6))


@pytest.mark.parametrize(
    ("part", "content", "says"),
    [
        ("padding", {"strategy": {"Fixed": 10**12}}, "pads texts to more than 65536 tokens"),
        ("padding", {"pad_to_multiple_of": 10**9}, "pads texts to more than 65536 tokens"),
        (
            "normalizer",
            {
                "type": "Sequence",
                "normalizers": [{"type": "Replace", "pattern": {"String": "a"}, "content": "aa"}] * 60,
            },
            "more than 4 replacements",
        ),
        ("normalizer", {"type": "Prepend", "prepend": "a" * 9}, "of over 8 characters"),
    ],
)
def test_a_tokenizer_that_makes_texts_grow_without_bound_is_refused(
    part: str, content: dict[str, Any], says: str, folder: Path
) -> None:
    state = saved(folder)
    padding = {"direction": "Right", "pad_to_multiple_of": None, "pad_id": 0, "pad_type_id": 0, "pad_token": "[PAD]"}
    content = {"strategy": "BatchLongest", **padding, **content} if part == "padding" else content
    state["tokenizer"] = json.dumps({**json.loads(state["tokenizer"]), part: content})
    with pytest.raises(ValueError, match=says):
        HuggingFace("", width=8).set_extra_state(state)


def test_what_is_missing_or_damaged_is_named(folder: Path, tmp_path: Path) -> None:
    for name, content in {
        "model.safetensors": b"\x10",
        "config.json": b'{"model_type": "bret"}',
        "tokenizer.json": b'{"model": ',
    }.items():
        broken = write_encoder(tmp_path / name)
        (broken / name).write_bytes(content)
        with pytest.raises(ValueError, match=f"{broken} cannot be read as an encoder"):
            HuggingFace(str(broken), width=8)
        (broken / name).unlink()
        with pytest.raises(ValueError, match=f"{broken} has no {name}"):
            HuggingFace(str(broken), width=8)


def test_weights_of_another_network_are_named(folder: Path, tmp_path: Path) -> None:
    config = transformers.BertConfig(**sizes() | {"num_hidden_layers": 2})
    write_encoder(tmp_path, transformers.BertModel(config))
    (tmp_path / "model.safetensors").write_bytes((folder / "model.safetensors").read_bytes())
    with pytest.raises(ValueError, match=r"those of another network: encoder\.layer\.1\..* is missing"):
        HuggingFace(str(tmp_path), width=8)


def test_code_that_comes_with_an_encoder_is_not_run(tmp_path: Path) -> None:
    write_encoder(tmp_path)
    (tmp_path / "config.json").write_text(
        '{"model_type": "own", "auto_map": {"AutoConfig": "own.Config", "AutoModel": "own.Model"}}'
    )
    (tmp_path / "own.py").write_text(f"open({str(tmp_path / 'attacked')!r}, 'w')")
    with pytest.raises(ValueError, match="cannot be read as an encoder"):
        HuggingFace(str(tmp_path), width=8)
    assert not (tmp_path / "attacked").exists()


@pytest.mark.parametrize("name", ["nowhere", "somebody/encoder", "/nowhere/at/all"])
def test_without_folder_and_hub_the_name_is_named(name: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(constants, "ENDPOINT", "http://127.0.0.1:9")
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path))
    with pytest.raises(ValueError, match=f"model.text.name={name} is no folder here, and cannot be fetched"):
        HuggingFace(name, width=8)


def test_without_transformers_the_extra_is_named(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for module in ("transformers", "transformers.utils"):
        monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(ValueError, match=r"needs transformers: install .*'\.\[hf\]'"):
        HuggingFace(str(folder), width=8)
