"""What the learner optimises, logs and leaves behind."""

from __future__ import annotations

import math
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import Any

import lightning
import pytest
import torch
from defaults import defaults_of
from fake_batch import make_act, make_batch, make_bc, make_decoder, make_rt1, with_text
from small_training import fit, loader, make_learner, make_trainer

from vla.models.bc import BC
from vla.models.layers import Batch
from vla.models.model import Model, Prediction
from vla.models.text.ngrams import NGrams
from vla.models.vision.timm_encoders import FilmBackbone, FilmEfficientNet
from vla.training.checkpoints import AtomicCheckpointIO


def test_training_lowers_the_loss_and_validation_reports_errors_in_readable_units() -> None:
    torch.manual_seed(0)
    batch = make_batch(1)
    untrained = fit(make_learner(), batch, 1).callback_metrics
    trained = fit(make_learner(lr=3e-3, warmup_steps=5), batch, 100).callback_metrics
    assert trained["val/loss"] < untrained["val/loss"]
    names = {name for name in trained if name.startswith("val/error_")}
    assert names == {"val/error_x_mm", "val/error_y_mm", "val/error_gripper"}
    assert trained["val/error_x_mm"] < 10 < untrained["val/error_x_mm"]
    assert trained["val/token_accuracy"] > untrained["val/token_accuracy"]


def test_the_error_of_a_component_is_the_mean_distance_over_what_is_valid() -> None:
    model = make_bc(auxiliary=0.0)
    learner = make_learner(model).eval()
    batch = make_batch(1)
    batch["valid"][0] = False
    metrics = make_trainer(1).validate(learner, loader(learner, [batch]), verbose=False)[0]
    logits = model(with_text(model, batch))["logits"]
    error = (model.tokenizer.decode_logits(logits) - batch["action"]).abs()[1:, ..., 0].mean() * 1000
    assert metrics["val/error_x_mm"] == pytest.approx(error.item(), rel=1e-4)


def test_validation_shows_a_model_no_more_than_a_policy_does() -> None:
    class Peeking(BC):
        def predict(self, batch: Batch) -> Prediction:
            return Prediction(batch["action"][:, -1])

    model = make_bc()
    model.__class__ = Peeking
    learner = make_learner(model).eval()
    with pytest.raises(KeyError, match="action"):
        make_trainer(1).validate(learner, loader(learner, [make_batch(1)]), verbose=False)


@pytest.mark.parametrize("model", [make_bc(), make_rt1(), make_decoder()], ids=["bc", "rt1", "decoder"])
def test_bfloat16_trains(model: Model) -> None:
    metrics = fit(make_learner(model), make_batch(model.history), 2, precision="bf16").callback_metrics
    assert torch.isfinite(metrics["val/loss"])


def test_the_step_is_named_whose_loss_was_the_first_that_was_not_finite(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Though it is looked for less often than every step, nothing is saved in between."""
    good, bad = make_batch(1), make_batch(1)
    bad["state"][:] = math.nan
    learner = make_learner()
    batches = loader(learner, [good, good, bad, good, good])
    for every, stopped in ((50, 5), (3, 3)):
        monkeypatch.setattr("vla.models.learner.CHECK_FINITE_EVERY", every)
        trainer = make_trainer(5)
        with pytest.raises(ValueError, match="at step 2: lower"):
            trainer.fit(make_learner(), batches)
        assert trainer.global_step == stopped

    class Save(lightning.Callback):
        def on_train_batch_end(self, trainer: Any, *_: Any) -> None:
            trainer.save_checkpoint(tmp_path / f"{trainer.global_step}.ckpt")

    with pytest.raises(ValueError, match="at step 2: lower"):
        make_trainer(5, Save()).fit(make_learner(), batches)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["1.ckpt", "2.ckpt"]


@pytest.mark.parametrize("fails", [False, True])
def test_training_leaves_no_setting_behind_that_changes_what_a_policy_computes(fails: bool) -> None:
    flash = torch.backends.cuda.flash_sdp_enabled
    during = []

    class Watch(lightning.Callback):
        def on_train_batch_start(self, *arguments: Any) -> None:
            during.append(flash())
            if fails:
                raise RuntimeError("as a loss that is not finite in a cell of a sweep")

    torch.backends.cuda.enable_flash_sdp(True)
    learner = make_learner()
    with pytest.raises(RuntimeError, match="not finite") if fails else nullcontext():
        make_trainer(1, Watch()).fit(learner, loader(learner, [make_batch(1)]))
    assert during == [False] and flash()


def test_schedules() -> None:
    def rates(schedule: Any) -> list[float]:
        seen: list[float] = []

        class Watch(lightning.Callback):
            def on_train_batch_start(self, trainer: Any, *_: Any) -> None:
                seen.append(trainer.optimizers[0].param_groups[0]["lr"])

        learner = make_learner(lr=1.0, warmup_steps=4, schedule=schedule)
        make_trainer(12, Watch()).fit(learner, loader(learner, [make_batch(1)] * 12))
        return seen

    cosine, constant = rates("cosine"), rates("constant")
    assert cosine[:5] == constant[:5] == sorted(cosine[:5])
    assert cosine[4:] == sorted(cosine[4:], reverse=True) and cosine[4] == 1.0 and cosine[-1] < 0.1
    assert set(constant[4:]) == {1.0}


def test_weight_decay_spares_biases_norms_and_embeddings() -> None:
    learner = make_learner(make_rt1(), weight_decay=0.5)
    learner.trainer = make_trainer(1)
    decayed, spared = learner.configure_optimizers()["optimizer"].param_groups
    model = learner.model
    names = {id(parameter): name for name, parameter in model.named_parameters()}
    spared_names = {names[id(parameter)] for parameter in spared["params"]}
    assert decayed["weight_decay"] == 0.5 and spared["weight_decay"] == 0.0
    assert {"positions.weight", "text.embedding.weight", "head.bias", "layers.0.attention_norm.weight"} <= spared_names
    assert "head.weight" in {names[id(parameter)] for parameter in decayed["params"]}
    assert len(decayed["params"]) + len(spared["params"]) == len(names)


def test_weight_decay_spares_the_embeddings_of_a_network_of_timm() -> None:
    model = make_bc(image=partial(FilmBackbone, "test_vit", False, frozen=False, size=32, channels=8))
    learner = make_learner(model, weight_decay=0.5)
    learner.trainer = make_trainer(1)
    decayed, spared = (
        set(map(id, group["params"])) for group in learner.configure_optimizers()["optimizer"].param_groups
    )
    encoder: Any = model.features.images[0]
    assert id(encoder.backbone.pos_embed) in spared and id(encoder.backbone.patch_embed.proj.weight) in decayed


def test_parts_have_rates_of_their_own_and_frozen_ones_stay() -> None:
    model = make_act()
    learner = make_learner(model, rates={"context": 0.1, "context.features.images": 0.5}, frozen=["text"], ema=0.0)
    before = {name: value.clone() for name, value in model.named_parameters()}
    trainer = fit(learner, make_batch(1, 4), 2)
    rates = {id(each): group["lr"] for group in trainer.optimizers[0].param_groups for each in group["params"]}
    found = {name: rates.get(id(value)) for name, value in model.named_parameters()}
    assert found["text.norm.weight"] is None
    whole = found["head.weight"]
    assert whole and found["context.fuse.1.weight"] == pytest.approx(whole / 10)
    assert found["context.features.images.0.convs.0.weight"] == pytest.approx(whole / 2)
    changed = [name for name, value in model.named_parameters() if not torch.equal(value, before[name])]
    assert not any(name.startswith("text.") for name in changed) and "context.fuse.1.weight" in changed


@pytest.mark.parametrize("frozen", [["features", "text"], []])
def test_nothing_is_counted_or_averaged_in_a_frozen_part(frozen: list[str]) -> None:
    image = partial(FilmEfficientNet, "test_efficientnet", False, 8)
    model = make_bc(image=image, text=partial(NGrams, **defaults_of("model/text/known_words", vocabulary=64)))
    before = {name: value.clone() for name, value in model.state_dict().items()}
    fit(make_learner(model, frozen=frozen), make_batch(1), 2)
    changed = [name for name, value in model.state_dict().items() if not torch.equal(value, before[name])]
    counted = {"text.heard", "features.images.0.stem.1.running_var", "features.proprioception.normalizer.mean"}
    assert counted <= set(before) and counted.isdisjoint(changed) == bool(frozen)
    assert any(name.startswith(("features", "text")) for name in changed) != bool(frozen)


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"frozen": ["contxt"]}, r"learner\.frozen names contxt, .* it has text, truth_head, features, mlp, head"),
        ({"rates": {"features.image": 0.1}}, r"names features\.image, which is no part .*: features has images, "),
        ({"frozen": ["text", "truth_head", "features", "mlp", "head"]}, "leaves nothing to train"),
    ],
)
def test_a_part_that_is_not_there_is_refused(options: dict[str, Any], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        make_learner(make_bc(), **options)


def test_compiling_keeps_the_names_in_the_checkpoint() -> None:
    learner = make_learner(make_bc(auxiliary=0.0), compile=True)
    plain = make_bc(auxiliary=0.0)
    plain.load_state_dict(learner.model.state_dict())
    learner.configure_model()
    assert learner.model._compiled_call_impl is not None
    assert learner.model.state_dict().keys() == plain.state_dict().keys()


def test_a_checkpoint_that_cannot_be_written_leaves_the_one_before(tmp_path: Path) -> None:
    files = AtomicCheckpointIO()
    files.save_checkpoint({"step": 1}, tmp_path / "last.ckpt")

    class Unwritable:
        def __reduce__(self) -> str:
            raise OSError(28, "No space left on device")

    with pytest.raises(OSError, match=r"last\.ckpt cannot be written \(.*\), and the earlier one is kept"):
        files.save_checkpoint({"step": 2, "more": Unwritable()}, tmp_path / "last.ckpt")
    assert torch.load(tmp_path / "last.ckpt", weights_only=True) == {"step": 1}
    assert [path.name for path in tmp_path.iterdir()] == ["last.ckpt"]
