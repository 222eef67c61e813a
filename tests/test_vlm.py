"""Vision-language-action models: as others compute them, as others published them, and as any other model here."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from command_line import SMALL, here
from defaults import defaults_of, part_of
from fake_batch import as_policy, make_batch, overfit, with_text
from safetensors.torch import load_file, save_file
from saved_policies import change_json
from small_training import CONFIG, loader, make_trainer, save
from tiny_vla import (
    CHUNK,
    KEYPOINTS,
    SENTENCES,
    SMOLVLA,
    SPEC,
    deviation,
    fill,
    inputs,
    make_smolvla,
    network_results,
    observation,
    published,
    reference,
    steps,
    write_tokenizer,
)
from toy_episodes import full_disk

from vla.io.errors import UserError
from vla.models.learner import Learner
from vla.models.lora import LoRA
from vla.models.packaged import PackagedFile
from vla.models.policy_folder import read_policy
from vla.models.trunk_folder import is_trunk
from vla.models.vision.timm_encoders import FilmEfficientNet
from vla.models.vlm.lerobot_export import LeRobotPolicyExporter
from vla.models.vlm.normalizer import Kind, Normalizer
from vla.models.vlm.policy import resize_with_padding
from vla.models.vlm.prompt import PADDING, WORDS, Prompt
from vla.models.vlm.smolvla import SmolVLA

TOLERANCE = 1e-5
SMALLER = {**SMOLVLA, "vocabulary": WORDS, "layers": 2, "vision_layers": 1}


@pytest.fixture(scope="module")
def tokenizer(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("tokenizer")
    write_tokenizer(folder)
    return folder


def test_losses_gradients_and_every_step_are_those_of_lerobot() -> None:
    network = SmolVLA(**SMOLVLA).eval()
    fill(published(network))
    ours, theirs = network_results(network, inputs(SMOLVLA)), reference("smolvla")
    for name, value in ours.items():
        assert deviation(value, theirs[name]) <= TOLERANCE, name


def test_the_way_from_an_observation_to_executed_actions_is_that_of_lerobot(tokenizer: Path) -> None:
    model, theirs = make_smolvla(tokenizer), reference("smolvla")
    seen = observation(0)
    frames = torch.stack([torch.from_numpy(seen.rgb[camera]) for camera in SPEC.cameras])
    assert deviation(model.image(frames), theirs["way.images"]) <= TOLERANCE
    state = model.state_normalizer(torch.from_numpy(seen.state))
    assert deviation(state, theirs["way.state"][0, : len(state)]) <= TOLERANCE
    assert not theirs["way.state"][0, len(state) :].any()
    assert (
        deviation(model.scaled(torch.from_numpy(steps(len(SPEC.action))[:CHUNK])), theirs["way.actions"]) <= TOLERANCE
    )
    assert torch.equal(model.text.tokenize([*SENTENCES]), theirs["way.tokens"])
    model.sample_noise = lambda random: theirs["policy.noise"]  # type: ignore[method-assign]
    policy = as_policy(model, SPEC)
    acted = [torch.from_numpy(policy.act(observation(number))) for number in range(len(theirs["policy.actions"]))]
    assert deviation(torch.stack(acted), theirs["policy.actions"]) <= TOLERANCE


def test_a_missing_camera_and_padding_have_no_effect() -> None:
    network, given = SmolVLA(**SMOLVLA).eval(), inputs(SMOLVLA)
    fill(published(network))
    names = ("images", "cameras", "tokens", "sentence", "state")
    whole = network.prefix(*(given[name][1:] for name in names))
    cut = {name: given[name][1:] for name in names}
    cut |= {name: cut[name][:, :1] for name in ("images", "cameras")}
    cut |= {name: cut[name][:, : int(cut["sentence"].sum())] for name in ("tokens", "sentence")}
    with torch.no_grad():
        noisy, time = given["noise"][1:], given["time"][1:]
        velocity = network.velocity(whole, noisy, time)
        assert deviation(network.velocity(network.prefix(*(cut[name] for name in names)), noisy, time), velocity) < 1e-5
        # A time for every action, and no action sees a later one.
        each = time[:, None].repeat(1, CHUNK)
        assert torch.equal(network.velocity(whole, noisy, each), velocity)
        later = torch.cat([noisy[:, :-1], noisy[:, -1:] + 1], 1)
        assert torch.equal(network.velocity(whole, later, time)[:, :-1], velocity[:, :-1])


@pytest.mark.parametrize("kind", ["mean_std", "quantiles"])
def test_normalisation_is_invertible_and_by_the_statistics_of_the_data(kind: Any) -> None:
    normalizer, data = Normalizer(kind, 3), steps(3)
    normalizer.fit(data)
    scaled = normalizer(torch.from_numpy(data))
    if kind == "mean_std":
        assert torch.allclose(scaled.mean(0), torch.zeros(3), atol=1e-5)
        assert torch.allclose(scaled.std(0, correction=0), torch.ones(3), atol=1e-5)
    else:
        assert torch.allclose(scaled.quantile(0.01, 0), -torch.ones(3), atol=1e-5)
        assert torch.allclose(scaled.quantile(0.99, 0), torch.ones(3), atol=1e-5)
    assert torch.allclose(normalizer.inverse(scaled), torch.from_numpy(data), atol=1e-5)


def test_what_rarely_or_never_changes_is_normalised_without_explosions() -> None:
    rare = np.zeros((1000, 2), np.float32)
    rare[-5:, 0] = 1  # a gripper that closes at the end
    normalizer = Normalizer("quantiles", 2)
    normalizer.fit(rare)
    assert torch.equal(normalizer(torch.tensor([[0.0, 0.0], [1.0, 0.0]]))[:, 0], torch.tensor([-1.0, 1.0]))
    for kind in ("mean_std", "quantiles"):
        normalizer = Normalizer(kind, 1)
        normalizer.fit(np.full((9, 1), 3.0, np.float32), constant=1.0)
        assert normalizer(torch.tensor([[3.5]])).abs().item() == pytest.approx(0.5)


@pytest.mark.parametrize("causal", [True, False])
def test_repeated_last_actions_count_where_others_attend_to_them(causal: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(SmolVLA, "causal", causal)
    model = make_smolvla()
    batch = model.with_noise(with_text(model, make_batch(1, CHUNK, spec=SPEC)))
    batch["perturbations"] = torch.zeros_like(batch["perturbations"])
    batch["perturbations"][..., -1] = -1  # beyond the episode
    batch["valid"] = batch["perturbations"] == 0
    output = model(batch)
    loss = model.action_loss(output, batch)["action_loss"]
    output["target"][:, -1] += 1
    assert (model.action_loss(output, batch)["action_loss"] != loss) == (not causal)


def test_images_of_another_aspect_ratio_lie_in_the_corner_or_in_the_centre() -> None:
    image = torch.ones(1, 3, 20, 40)
    corner, centre = (resize_with_padding(image, 8, place)[0, 0, :, 0] for place in ("corner", "centre"))
    assert corner.tolist() == [0, 0, 0, 0, 1, 1, 1, 1] and centre.tolist() == [0, 0, 1, 1, 1, 1, 0, 0]


def test_the_state_is_read_as_numbers_within_the_prompt(tokenizer: Path) -> None:
    for name in (str(tokenizer), None):
        prompt = Prompt(name, 90, state=True, width=1)
        state = torch.tensor([[-1.5, -1.0, 0.0, 0.999], [0.5, 0.25, -0.2, 2.0]])
        tokens = prompt(prompt.tokenize(["lift_it\n", "put the block away"]), state)
        # Bins as openpi computes them.
        numbers = np.digitize(state.numpy(), np.linspace(-1, 1, 257)[:-1]) - 1
        texts = [
            f"Task: {task}, State: {' '.join(map(str, row))};\nAction: "
            for task, row in zip(["lift it", "put the block away"], numbers, strict=True)
        ]
        rows = [prompt._ids(text, special=True) for text in texts]
        assert [row[row != PADDING].tolist() for row in tokens] == rows
        assert tokens.shape[1] <= 90 and prompt.tokenize(["lift it " * 99]).shape == (1, 90)
        assert prompt.tokenize(["lift it"]).shape[1] < prompt.tokenize(["lift it, and put it down " * 4]).shape[1]


def test_without_a_tokenizer_tokens_are_words() -> None:
    prompt = Prompt(None, 20, state=False, width=1)
    one, same, other, none = prompt.tokenize(["Put it down.", "put it  down .", "put it up.", ""])
    assert torch.equal(one, same) and (one != other).sum() == 1
    assert (none != PADDING).sum() == 1 and torch.equal(prompt.tokenize([""]), none[None])
    with pytest.raises(UserError, match=r"model\.network\.vocabulary=320 is less than the 4096 words"):
        make_smolvla(network=partial(SmolVLA, **SMOLVLA))


def test_a_tokenizer_of_more_words_than_the_network_is_refused(tokenizer: Path) -> None:
    count = Prompt(str(tokenizer), 20, state=False, width=1).words
    with pytest.raises(
        UserError, match=rf"vocabulary=9 is less than the {count} words of a prompt for the tokenizer of"
    ):
        make_smolvla(tokenizer, network=partial(SmolVLA, **SMOLVLA | {"vocabulary": 9}))


@pytest.mark.parametrize("normalization", ["mean_std", "quantiles"])
def test_motions_that_are_noise_in_the_demonstrations_are_no_huge_numbers(normalization: Kind) -> None:
    model, noise = make_smolvla(normalization=normalization), np.ones(len(SPEC.action), np.float32)
    noise[-1] = 1e-5
    model.fit(steps(len(SPEC.state)), steps(len(SPEC.action)) * noise)
    assert 1 < model.scaled(torch.tensor([SPEC.high]))[0, len(SPEC.action) - 1].abs() < 100


def test_a_model_with_keypoints_overfits_saves_and_ignores_truth() -> None:
    torch.manual_seed(0)
    network = partial(SmolVLA, **SMALLER | KEYPOINTS)
    model = make_smolvla(network=network, copies=4, auxiliary=0.1)
    model.train()
    batch = with_text(model, make_batch(1, CHUNK, spec=SPEC))
    batch["action"] = batch["action"] / 9  # about the statistics of the data
    before, unknown = overfit(model, batch, 1), model.train().loss(batch)["truth_loss"].item()
    assert overfit(model.train(), batch, 60) < 0.4 * before
    assert model.train().loss(batch)["truth_loss"].item() < 0.5 * unknown
    other = make_smolvla(network=network, auxiliary=0.1)
    other.load_state_dict(model.state_dict())
    del batch["truth"]
    with torch.inference_mode():
        assert torch.equal(other.predict(batch).actions, model.predict(batch).actions)


def test_linear_maps_in_another_layout_compute_the_same_and_follow_their_weights() -> None:
    model = make_smolvla()
    batch, optimizer = (
        with_text(model, make_batch(1, CHUNK, spec=SPEC)),
        torch.optim.AdamW(model.parameters(), fused=True),
    )
    changed = list[torch.Tensor]()
    for _ in range(2):
        with torch.no_grad():
            changed.append(model.eval().predict(batch).actions)
        with torch.inference_mode():
            assert deviation(model.predict(batch).actions, changed[-1]) < 1e-5
        model.loss(batch)["loss"].backward()  # in evaluation mode, as Lightning's validation may leave it
        optimizer.step()
    assert deviation(*changed) > 1e-4


def test_training_and_planning_compile_as_one_graph_each() -> None:
    model = make_smolvla(network=partial(SmolVLA, **SMALLER), steps=2)
    batch = with_text(model, make_batch(1, CHUNK, spec=SPEC))
    with torch.inference_mode():
        compiled = torch.compile(model.predict, backend="eager", fullgraph=True)
        assert deviation(compiled(batch).actions, model.predict(batch).actions) < 1e-5
    batch = model.with_noise(batch)
    compiled = torch.compile(model.train().loss, backend="eager", fullgraph=True)
    assert deviation(compiled(batch)["loss"].detach(), model.loss(batch)["loss"].detach()) < 1e-5


def written(folder: Path, tokenizer: Path, change: Callable[[dict[str, Any]], object] | None = None) -> Path:
    """A published policy of random weights."""
    model = make_smolvla(tokenizer)
    LeRobotPolicyExporter(folder).export(as_policy(model, SPEC))
    if change:
        path = folder / "model.safetensors"
        weights = load_file(path)
        change(weights)
        save_file(weights, path)
    return folder


def test_what_lerobot_cannot_build_is_not_exported(tmp_path: Path, tokenizer: Path) -> None:
    model = make_smolvla(tokenizer, network=partial(SmolVLA, **SMOLVLA | KEYPOINTS))
    with pytest.raises(UserError, match=r"sees no keypoints: train with model\.network\.keypoints=0"):
        LeRobotPolicyExporter(tmp_path / "published").export(as_policy(model, SPEC))
    with pytest.raises(UserError, match=r"needs a tokenizer, and this policy has none: train with model\.text\.name"):
        LeRobotPolicyExporter(tmp_path / "published").export(as_policy(make_smolvla(), SPEC))
    model = make_smolvla(tokenizer)
    model.text.state = True
    with pytest.raises(UserError, match=r"smolvla has no state in the sentence: train with model\.text\.state=false"):
        LeRobotPolicyExporter(tmp_path / "published").export(as_policy(model, SPEC))
    assert not [*tmp_path.iterdir()]


def test_weights_without_room_are_no_policy_of_lerobot(tmp_path: Path, tokenizer: Path) -> None:
    with full_disk(1000), pytest.raises(UserError, match=r"published cannot be written \(.*File too large"):
        LeRobotPolicyExporter(tmp_path / "published").export(as_policy(make_smolvla(tokenizer), SPEC))
    assert not [*tmp_path.iterdir()]


def test_keypoints_without_an_image_encoder_are_refused() -> None:
    with pytest.raises(UserError, match=r"keypoints=3 needs an image encoder in model\.network\.image"):
        SmolVLA(**SMOLVLA | {"keypoints": 3})


def test_published_weights_and_statistics_are_loaded(
    tmp_path: Path, tokenizer: Path, caplog: pytest.LogCaptureFixture
) -> None:
    def as_bfloat16(weights: dict[str, Any]) -> None:
        name = "model.vlm_with_expert.vlm.lm_head.weight"  # which is published, and no action depends on it
        weights[name] = torch.zeros(3, 4)
        for key in weights:
            weights[key] = weights[key].bfloat16().float() if "norm" in key else weights[key]

    folder = written(tmp_path / "published", tokenizer, as_bfloat16)
    cameras = {"front": "wrist", "wrist": "front"}
    with pytest.raises(UserError, match=r"names the cameras of .* in another order: it sees front, wrist"):
        make_smolvla(tokenizer, trunk=str(folder), cameras={"wrist": "front", "front": "wrist"})
    with pytest.raises(UserError, match=r"normalises by MEAN_STD, and model\.normalization is quantiles"):
        make_smolvla(tokenizer, trunk=str(folder), statistics="pretrained", normalization="quantiles", cameras=cameras)
    model = make_smolvla(tokenizer, trunk=str(folder), statistics="pretrained", cameras=cameras)
    assert model.cameras == ["wrist", "front"]
    assert not caplog.records
    make_smolvla(tokenizer, trunk=str(folder), normalization="quantiles", cameras=cameras)  # by the demonstrations
    assert "normalises by MEAN_STD, and model.normalization is quantiles: choose the same, unless" in caplog.text
    ours, theirs = make_smolvla(tokenizer), load_file(folder / "model.safetensors")
    loaded = {f"model.{name}": weight for name, weight in published(model.network)}
    assert loaded.keys() == theirs.keys() - {"model.vlm_with_expert.vlm.lm_head.weight"}
    assert all(torch.equal(weight, theirs[name]) for name, weight in loaded.items())
    assert torch.equal(model.action_normalizer.std, ours.action_normalizer.std)
    assert isinstance(model.network, SmolVLA) and str(model.network.vlm.source).startswith(str(folder))
    model.fit(steps(4) + 5, steps(3) + 5)  # which are not asked for
    assert torch.equal(model.action_normalizer.mean, ours.action_normalizer.mean)


@pytest.mark.parametrize("frozen", [[], ["network.vlm"]])
def test_factors_beside_published_weights_are_in_the_policy(frozen: list[str], tmp_path: Path, tokenizer: Path) -> None:
    published = written(tmp_path / "published", tokenizer)
    factors = LoRA(**defaults_of("learner/lora/low_rank", modules=("q_proj", "v_proj")))
    models = [make_smolvla(tokenizer, trunk=str(published)) for _ in range(3)]
    for model, plain in pairwise(models):  # the second training goes on from what the first one wrote
        options = defaults_of("learner/default", lr=1e-2, warmup_steps=0, frozen=frozen, lora=factors)
        learner = Learner(**options, model=model, spec=SPEC, config=CONFIG)
        trainer, batch = make_trainer(2), make_batch(1, CHUNK, spec=SPEC)
        trainer.fit(learner, loader(learner, [batch] * 2))
        folder = tmp_path / str(models.index(model))
        save(trainer, folder, "policy")
        saved, batch = read_policy(folder), with_text(model, batch)
        # A training that resumes finds them before it has factors.
        assert saved.training.trunks.keys() <= dict(plain.named_modules()).keys()
        with torch.inference_mode():
            before = plain.eval().predict(batch).actions
            saved.restore(plain)
            trained, restored = (each.eval().predict(batch).actions for each in (model, plain))
        lost, learned = ((trained - each).abs().max() / trained.abs().max() for each in (restored, before))
        assert lost < 2e-6 < 1e-3 < learned


def write_trunk(folder: Path) -> dict[str, torch.Tensor]:
    """Write a vision-language model alone, and return its weights."""
    folder.mkdir()
    (folder / "config.json").write_text('{"model_type": "smolvlm"}')
    state = make_smolvla().network.state_dict().items()
    weights = {f"model.{name.removeprefix('vlm.')}": weight for name, weight in state if name.startswith("vlm.")}
    further = {"model.text_model.layers.31.mlp.up_proj.weight": torch.zeros(2), "lm_head.weight": torch.zeros(2)}
    (words,) = (name for name in weights if name.endswith("embed_tokens.weight"))
    padded = {words: torch.cat([weights[words], torch.ones(3, weights[words].shape[1])])}  # as PaliGemma's is
    save_file({**weights, **further, **padded}, folder / "model.safetensors")
    return weights


def test_a_trunk_alone_leaves_the_expert_random(tmp_path: Path) -> None:
    folder = tmp_path / "trunk"
    weights = write_trunk(folder)
    torch.manual_seed(0)
    model = make_smolvla(trunk=str(folder))
    found = model.network.state_dict()
    assert all(torch.equal(found[name.replace("model.", "vlm.", 1)], weight) for name, weight in weights.items())
    norms, maps = (found[f"expert.layers.1.{name}.weight"] for name in ("input_layernorm", "self_attn.k_proj"))
    assert torch.equal(norms, torch.ones_like(norms)) and 0.015 < maps.std() < 0.025
    assert not hasattr(model.network.expert, "source") and hasattr(model.network.vlm, "source")
    with torch.inference_mode():
        assert model.predict(with_text(model, make_batch(1, CHUNK, spec=SPEC))).actions.isfinite().all()


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda w: w.pop("model.state_proj.bias"), "lacks weights of the model: state_proj.bias$"),
        (lambda w: w.update({"model.other.bias": torch.zeros(1)}), "has model.other.bias, which the model lacks"),
        (lambda w: w.update({"model.state_proj.bias": torch.zeros(5)}), "model.state_proj.bias in .* has shape"),
    ],
)
def test_other_weights_are_refused(tmp_path: Path, tokenizer: Path, change: Any, sentence: str) -> None:
    folder = written(tmp_path / "published", tokenizer, change)
    with pytest.raises(UserError, match=sentence):
        make_smolvla(tokenizer, trunk=str(folder))


def test_a_policy_of_an_older_lerobot_that_was_compiled_is_the_same(tmp_path: Path, tokenizer: Path) -> None:
    def older(weights: dict[str, torch.Tensor]) -> None:
        for name in [*weights]:
            weights[name.replace("model.", "model._orig_mod.", 1)] = weights.pop(name)
        weights["normalize_inputs.buffer_observation_state.mean"] = torch.zeros(6)
        weights["unnormalize_outputs.buffer_action.std"] = torch.ones(6)

    folders = written(tmp_path / "published", tokenizer), written(tmp_path / "older", tokenizer, older)
    one, other = (make_smolvla(tokenizer, trunk=str(folder)).network.state_dict() for folder in folders)
    assert one.keys() == other.keys() and all(torch.equal(one[name], other[name]) for name in one)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"num_expert_layers": 8}, "was trained with num_expert_layers=8, and only -1 is supported"),
        ({"max_period": 2.0}, r"was trained with max_period=2\.0, and only 4\.0 is supported"),
        ({"type": "act"}, "is a policy of LeRobot's type act, and only smolvla, pi0, pi05 are supported"),
        ({"resize_imgs_with_padding": [512, 512]}, r"sees images of \[512, 512\] pixels, and the model of \["),
    ],
)
def test_policies_of_other_options_and_types_are_refused(
    tmp_path: Path, tokenizer: Path, options: dict[str, Any], sentence: str
) -> None:
    folder = written(tmp_path / "published", tokenizer)
    change_json(folder / "config.json", lambda config: config | options)
    with pytest.raises(UserError, match=sentence):
        make_smolvla(tokenizer, trunk=str(folder))


def test_the_options_of_the_published_policy_are_known(tmp_path: Path, tokenizer: Path) -> None:
    # Those of lerobot/smolvla_base at c83c3163 that are not LeRobot's defaults, as copies of its config.json have them.
    published = {"num_expert_layers": 0, "prefix_length": 0, "pad_language_to": "max_length"}
    folder = written(tmp_path / "published", tokenizer)
    change_json(folder / "config.json", lambda config: config | published)
    assert make_smolvla(tokenizer, trunk=str(folder)).network.state_width


@pytest.mark.parametrize("trunk", [True, False])
def test_a_network_larger_than_the_free_memory_is_refused_before_it_is_built(
    trunk: bool, tmp_path: Path, tokenizer: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = written(tmp_path / "published", tokenizer) if trunk else None
    monkeypatch.setattr("vla.models.vlm.trunk.free_memory", lambda: 1000)
    with pytest.raises(UserError, match=r"SmolVLA need .* GB of memory, and 0\.0 GB are free: use a machine with more"):
        make_smolvla(tokenizer, trunk=folder and str(folder))


def test_a_pretrained_image_encoder_keeps_its_weights_beside_a_trunk(tmp_path: Path) -> None:
    weights = PackagedFile(**part_of("model/image/film_efficientnet_lite0", "pretrained"))
    image = partial(FilmEfficientNet, **defaults_of("model/image/film_efficientnet_lite0", pretrained=weights))
    network = partial(SmolVLA, **{**SMOLVLA, "vocabulary": WORDS, "keypoints": 4, "image": image})
    write_trunk(tmp_path / "trunk")
    with warnings.catch_warnings(action="error"):
        make_smolvla(network=network)
        model = make_smolvla(network=network, trunk=str(tmp_path / "trunk"))
    blocks = image(text_width=SMOLVLA["width"]).blocks.state_dict()
    kept = model.network.state_dict()
    assert blocks and all(torch.equal(kept[f"keypoints.encoder.blocks.{name}"], blocks[name]) for name in blocks)


def test_a_normaliser_without_the_action_and_a_camera_without_counterpart_are_refused(
    tmp_path: Path, tokenizer: Path
) -> None:
    folder = written(tmp_path / "published", tokenizer)
    path = folder / "policy_preprocessor_step_5_normalizer_processor.safetensors"
    statistics = load_file(path)
    save_file({f"so100.buffer.{name}": value for name, value in statistics.items()}, path)  # as in smolvla_base
    with pytest.raises(UserError, match=r"has no statistics observation\.state\.mean"):
        make_smolvla(tokenizer, trunk=str(folder), statistics="pretrained")
    save_file({name: value for name, value in statistics.items() if "action" not in name}, path)
    with pytest.raises(UserError, match=r"has no statistics action\.mean: choose model\.statistics=demonstrations"):
        make_smolvla(tokenizer, trunk=str(folder), statistics="pretrained")
    make_smolvla(tokenizer, trunk=str(folder))  # by the demonstrations
    config = json.loads((folder / "config.json").read_text())
    for key, other in (("input_features", ["front"]), ("input_features", {"a": 1}), ("normalization_mapping", [1])):
        (folder / "config.json").write_text(json.dumps({**config, key: other}))
        with pytest.raises(UserError, match=rf"{key} of .*config\.json is damaged or of another kind"):
            make_smolvla(tokenizer, trunk=str(folder), statistics="pretrained")
    names = {"observation.images.wrist": "observation.images.third"}
    config["input_features"] = {names.get(name, name): value for name, value in config["input_features"].items()}
    (folder / "config.json").write_text(json.dumps(config))
    with pytest.raises(UserError, match="sees front, third, and the demonstrations have front, wrist"):
        make_smolvla(tokenizer, trunk=str(folder))
    with pytest.raises(UserError, match=r"model\.cameras maps two cameras of the pretrained policy to front: map each"):
        make_smolvla(tokenizer, trunk=str(folder), cameras={"front": "front", "third": "front"})
    with pytest.raises(UserError, match="lacks third, which"):
        make_smolvla(tokenizer, trunk=str(folder), cameras={"front": "front"})
    with pytest.raises(UserError, match="names top, but the demonstrations have front, wrist"):
        make_smolvla(tokenizer, trunk=str(folder), cameras={"front": "front", "third": "top"})
    with pytest.raises(UserError, match=r"names thrid, but .*published sees front, third"):
        make_smolvla(tokenizer, trunk=str(folder), cameras={"front": "front", "third": None, "thrid": "wrist"})
    one = make_smolvla(tokenizer, trunk=str(folder), cameras={"front": "wrist", "third": None})
    assert one.cameras == ["wrist"]


def test_a_trunk_that_is_not_there_and_a_tokenizer_that_is_not_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="is no folder with pretrained weights"):
        make_smolvla(trunk=str(tmp_path / "nothing"))
    with pytest.raises(UserError, match=r"there is no policy and no download '.*nothing': name a run"):
        is_trunk(str(tmp_path / "nothing"))
    (tmp_path / "config.json").write_text("{}")
    with pytest.raises(UserError, match="has neither model_type nor input_features: download the model again"):
        is_trunk(str(tmp_path))
    with pytest.raises(UserError, match="cannot be fetched from the Hugging Face hub"):
        make_smolvla(trunk="hub:nobody/nothing")
    with pytest.raises(UserError, match="cannot be fetched from the Hugging Face hub"):
        make_smolvla(tmp_path / "nothing")
    (tmp_path / "tokenizer.json").write_text("{}")
    with pytest.raises(UserError, match="is no tokenizer"):
        make_smolvla(tmp_path)


def test_a_published_policy_is_fine_tuned_and_evaluated_from_the_command_line(home: Path) -> None:
    write_tokenizer(home / "tokenizer")
    small = ("vision_layers=1", "layers=2", "resolution=32", "vocabulary=320", "vision_width=32", "vision_heads=1")
    sizes = [f"model.network.{each}" for each in (*small, "keypoints=0")]
    tiny = [*SMALL, "model=smolvla_tiny", "model.text.name=tokenizer", "model.steps=2", "trainer.max_steps=2", *sizes]
    frozen = "learner.frozen=[network.vlm]"
    random = f"{frozen}: what is not pretrained there stays random"
    assert random in here(home, *tiny, frozen, "job=train", "output=first", "hydra.run.dir=first").stdout
    to = ["export=lerobot_policy", "export.folder=published"]
    here(home, "job=export", "checkpoint=first", *to, "output=exported", "hydra.run.dir=exported")
    refused = here(home, *SMALL, "pretrained=published", "job=train", "output=bc", "hydra.run.dir=bc", ok=False)
    assert "as in model=smolvla" in refused.stderr
    parts = ["pretrained=published", frozen, "learner/lora=low_rank"]
    second = here(home, *tiny, *parts, "output=second", "hydra.run.dir=second", "evaluate.episodes=1")
    assert random not in second.stdout
    published, tuned = (load_file(home / name / "model.safetensors") for name in ("published", "second/policy"))
    name = "connector.modality_projection.proj.weight"
    theirs, ours = published[f"model.vlm_with_expert.vlm.model.{name}"], tuned.get(f"network.vlm.{name}")
    assert ours is None or torch.equal(theirs, ours)
    assert not torch.equal(published["model.state_proj.weight"], tuned["network.state_proj.weight"])
    assert json.loads((home / "second/policy/config.json").read_text())["model"]["trunk"] == str(home / "published")
