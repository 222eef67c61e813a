"""Low-rank factors beside frozen weights, trunks that a policy names, and what of both is in its folder."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import pytest
import timm
import torch
from defaults import defaults_of
from fake_batch import make_act, make_batch, make_bc, make_decoder, with_text
from safetensors.torch import load_file, save_file
from small_training import loader, make_learner, make_trainer, save
from together import composed, train

from vla.data.episodes import EpisodeStore
from vla.io.errors import UserError
from vla.models.learner import Learner
from vla.models.lora import LoRA
from vla.models.model import Model
from vla.models.policy_folder import WEIGHTS, read_policy
from vla.models.vision.timm_encoders import FilmBackbone
from vla.runs.folder import LAST
from vla.training.ema import EMA

FILE = "trunk.safetensors"


def lora(*modules: str, **options: Any) -> LoRA:
    return LoRA(**defaults_of("learner/lora/low_rank", rank=4, alpha=8.0, modules=modules, **options))


def trained(model: Model, folder: Path, steps: int = 9, **options: Any) -> Learner:
    """A learner that has trained, with its average as its weights, and as the policy in a folder."""
    learner = make_learner(model, lr=1e-2, warmup_steps=0, **options)
    trainer = make_trainer(steps, EMA(0.9))
    trainer.fit(learner, loader(learner, [make_batch(1, model.chunk)] * steps))
    save(trainer, folder, "policy", LAST)
    learner.load_state_dict(torch.load(folder / LAST, weights_only=True)["state_dict"])
    return learner


@torch.inference_mode()
def require_same_actions(one: Model, other: Model) -> None:
    """To 1e-6 of their range."""
    batch = make_batch(1, one.chunk)
    actions, others = (one.scaled(model.eval().predict(with_text(model, batch)).actions) for model in (one, other))
    assert (actions - others).abs().max() < 1e-6


def with_trunk(file: Path | bool, frozen: bool = True) -> Any:
    image = partial(FilmBackbone, "test_vit", str(file) if file else False, frozen=frozen, size=32, channels=8)
    return make_bc(image=image)


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    torch.manual_seed(0)
    file = tmp_path_factory.mktemp("trunk") / FILE
    save_file(timm.create_model("test_vit", num_classes=0).state_dict(), file)
    return file


@pytest.mark.parametrize(("make", "part"), [(make_act, "encoder"), (make_decoder, "decoder")])
def test_the_policy_of_a_model_of_our_own_has_the_product_in_its_weights(make: Any, part: str, tmp_path: Path) -> None:
    torch.manual_seed(0)
    model, plain = make(), make()
    before = {name: value.clone() for name, value in model.state_dict().items()}
    learner = trained(model, tmp_path, lora=lora(part), rates={part: 3.0})
    frozen = f"{part}.layers.0.linear1"
    assert torch.equal(before[f"{frozen}.weight"], model.state_dict()[f"{frozen}.base_layer.weight"])
    assert not torch.equal(before["head.weight"], model.state_dict()["head.weight"])  # the rest learns as ever
    saved = read_policy(tmp_path)
    assert saved.state.keys() == before.keys() and not torch.equal(
        saved.state[f"{frozen}.weight"], before[f"{frozen}.weight"]
    )
    saved.restore(plain)
    require_same_actions(learner.model, plain)


def test_a_policy_names_its_trunk_and_holds_what_was_trained_in_it(weights: Path, tmp_path: Path) -> None:
    model = with_trunk(weights)
    learner = trained(model, tmp_path, lora=lora("qkv", dropout=0.1), frozen=["features.images.0.backbone"])
    trunk = "features.images.0.backbone"
    source = read_policy(tmp_path).training.trunks[trunk]
    assert source.name == str(weights) and source.size == weights.stat().st_size
    file = load_file(tmp_path / "policy" / WEIGHTS)
    of_trunk = {name for name in file if name.startswith(f"{trunk}.")}
    blocks = [
        f"{trunk}.blocks.{number}.attn.qkv.lora_{factor}"
        for number in range(len(model.features.images[0].backbone.blocks))
        for factor in "AB"
    ]
    assert of_trunk == set(blocks) and "features.images.0.projection.weight" in file
    assert f"trunk {trunk}" in (tmp_path / "policy/README.md").read_text()
    plain = with_trunk(weights)
    read_policy(tmp_path).restore(plain)
    require_same_actions(learner.model, plain)
    # What goes on from there has no such trunk any more, so its policy is whole.
    trained(plain, tmp_path / "on", 1)
    assert f"{trunk}.blocks.0.attn.qkv.weight" in load_file(tmp_path / "on/policy" / WEIGHTS)


def test_another_trunk_or_none_is_told(weights: Path, tmp_path: Path) -> None:
    trained(with_trunk(weights), tmp_path, 1)
    saved = read_policy(tmp_path)
    changed = {name: value + 1 for name, value in load_file(weights).items()}
    save_file(changed, tmp_path / FILE)
    with pytest.raises(
        UserError, match=r"policy was trained with features\.images\.0\.backbone from .*, and here it is"
    ):
        saved.restore(with_trunk(tmp_path / FILE))
    with pytest.raises(UserError, match=r"and that is not here: get the one of the training"):
        saved.restore(with_trunk(False))


def test_a_trunk_that_is_trained_is_in_the_policy(weights: Path, tmp_path: Path) -> None:
    trained(with_trunk(weights, frozen=False), tmp_path, 1)
    assert read_policy(tmp_path).training.trunks == {}
    assert "features.images.0.backbone.pos_embed" in load_file(tmp_path / "policy" / WEIGHTS)
    trained(with_trunk(weights, frozen=False), tmp_path / "frozen", 1, frozen=["features.images.0"])
    assert set(read_policy(tmp_path / "frozen").training.trunks) == {"features.images.0.backbone"}


def test_a_trunk_beyond_the_memory_is_told_before_it_is_built(weights: Path, tmp_path: Path) -> None:
    trained(with_trunk(weights), tmp_path, 1)
    saved = read_policy(tmp_path)
    (source,) = saved.training.trunks.values()
    object.__setattr__(source, "size", 2**50)
    with pytest.raises(UserError, match=r"needs weights of 1125899\.9 GB, and \d+\.\d GB of memory are free"):
        saved.budget()


def test_frozen_parts_learn_by_their_factors_alone_at_a_rate_of_their_own() -> None:
    model = make_act()
    options = {"frozen": ["decoder", "context"], "rates": {"decoder": 0.1}, "lr": 0.01, "warmup_steps": 0}
    learner = make_learner(model, lora=lora("decoder.*.linear?"), **options)
    learner.trainer = make_trainer(1)
    groups = learner.configure_optimizers()["optimizer"].param_groups
    rates = {id(weight): group["lr"] for group in groups for weight in group["params"]}
    of_decoder = {
        name for name, weight in model.named_parameters() if name.startswith("decoder.") and id(weight) in rates
    }
    assert len(of_decoder) == 2 * 2 * 2 and all(".lora_" in name for name in of_decoder)
    of_factors = [rates[id(weight)] for name, weight in model.named_parameters() if name in of_decoder]
    assert of_factors == pytest.approx([0.001] * len(of_decoder))
    assert not any(id(weight) in rates for weight in model.context.parameters()) and id(model.head.weight) in rates


def test_every_factor_has_an_effect_and_keypoints_without_any_stay_trained() -> None:
    model = make_act()
    lora("context").inject(model)
    model.loss(with_text(model, make_batch(1, model.chunk)))["loss"].backward()
    assert all(weight.grad is not None for weight in model.parameters() if weight.requires_grad)
    assert model.get_parameter("context.features.keypoints.0.score.weight").requires_grad


@pytest.mark.parametrize("module", ["q_prj", "encoder.layers.0.self_attn", "text"])
def test_a_name_of_no_linear_map_is_told_with_those_there_are(module: str) -> None:
    says = rf"lora\.modules names {module}, which matches no linear map .*: there are .*linear1, linear2.* in .*decoder"
    with pytest.raises(UserError, match=says):
        make_learner(make_act(), lora=lora(module))


def test_a_configuration_chooses_the_factors_and_a_checkpoint_has_them(folder: Path, tmp_path: Path) -> None:
    chosen = (
        "trainer.accelerator=cpu",
        "model=decoder",
        "learner/lora=low_rank",
        "learner.lora.modules=[decoder]",
        "learner.lora.rank=2",
    )
    train(folder, tmp_path, *chosen, "trainer.precision=bf16", "trainer.accumulate_grad_batches=2")
    experiment = composed(*chosen)
    again = experiment.learner(EpisodeStore(folder).spec, None, tmp_path / LAST)
    saved = torch.load(tmp_path / LAST, weights_only=True)["state_dict"]
    assert all(torch.equal(value, saved[f"model.{name}"]) for name, value in again.model.state_dict().items())
    assert again.model.state_dict()["decoder.layers.0.linear1.lora_B.default.weight"].abs().max() > 0
