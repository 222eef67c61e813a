"""Processes that train together learn what one would, and leave what one would."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
import toy
import warm
from command_line import SMALL, vla
from defaults import defaults_of
from lightning.pytorch.utilities import rank_zero_only
from lightning_utilities.core.imports import RequirementCache
from resuming import STOP, same
from together import PAIRS, TRUNK, VLAS, composed, train, train_trunk, untrained
from trunk import make_trunk_model

from vla.config.experiment import make_policy
from vla.jobs.train import train as train_policy
from vla.models.learner import Learner
from vla.models.policy_folder import POLICY
from vla.runs.folder import LAST
from vla.training.trainer import make_trainer

TORCHRUN = {"TORCHELASTIC_RUN_ID": "1", "RANK": "0", "LOCAL_RANK": "0", "WORLD_SIZE": "2"}  # what it sets


@pytest.fixture(scope="module")
def together(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where two processes have left what they trained."""
    left = tmp_path_factory.mktemp("together")
    warm.run_together(left, "together", str(folder), str(left))
    return left


def require_equal(one: Path, other: Path, start: Learner) -> None:
    """Checkpoints whose averaged and whose trained weights went the same way from the start, to rounding: all together,
    as Adam magnifies that of the few whose gradient is next to nothing."""
    ends = [torch.load(path, weights_only=True) for path in (one, other)]
    for state in ("state_dict", "current_model_state"):
        assert ends[0][state].keys() == ends[1][state].keys()
        way, other_way = (
            torch.cat([(end[state][name] - weight.detach()).flatten() for name, weight in start.named_parameters()])
            for end in ends
        )
        assert (other_way - way).norm() < 0.002 * way.norm()


@pytest.mark.parametrize("pair", PAIRS)
def test_two_processes_learn_what_one_learns_from_batches_twice_as_large(
    folder: Path, together: Path, pair: str, tmp_path: Path
) -> None:
    model = f"model={pair.partition(',')[2]}"
    found = train(folder, tmp_path, "trainer.accelerator=cpu", model, "data.batch_size=16")
    assert torch.load(together / pair / "found.pt", weights_only=True) == pytest.approx(found, rel=1e-3)
    require_equal(tmp_path / LAST, together / pair / LAST, untrained(folder, model))


def test_two_processes_learn_what_one_learns_in_a_trunk_whose_layers_they_share(
    folder: Path, together: Path, tmp_path: Path
) -> None:
    found = train_trunk(folder, tmp_path, 16)
    assert torch.load(together / TRUNK / "found.pt", weights_only=True) == pytest.approx(found, rel=1e-3)
    ends = [torch.load(path / LAST, weights_only=True)["current_model_state"] for path in (tmp_path, together / TRUNK)]
    assert ends[0].keys() == ends[1].keys()
    start = {f"model.{name}": value for name, value in make_trunk_model().state_dict().items()}
    for name, value in ends[0].items():
        torch.testing.assert_close(ends[1][name], value, rtol=1e-3, atol=1e-4, msg=name)
        if ".trunk." in name and ".lora_" not in name:
            assert torch.equal(value, start[name.replace(".base_layer", "")])


def test_two_processes_share_the_layers_of_vision_language_action_models(together: Path) -> None:
    off = torch.load(together / "vlas.pt", weights_only=True)
    assert off.keys() == VLAS.keys() and max(off.values()) < 1e-5


@pytest.mark.parametrize("pair", PAIRS)
def test_what_several_processes_leave_is_a_policy_like_any_other(together: Path, pair: str) -> None:
    path = together / pair / POLICY
    policy = make_policy({"_target_": "vla.policy.Policy", **defaults_of("policy/default", device="cpu")}, path)
    action = policy.act(toy.SPEC.random_observation(np.random.default_rng(0)))
    assert action.shape == (3,) and np.isfinite(action).all()


def test_training_goes_on_with_another_number_of_processes(folder: Path, together: Path, tmp_path: Path) -> None:
    longer = ("trainer.accelerator=cpu", "model=decoder", "data.batch_size=16", "trainer.max_steps=6")
    train(folder, tmp_path / "on", *longer, checkpoint=together / "fsdp,decoder" / LAST)
    train(folder, tmp_path / "whole", *longer)
    start = untrained(folder, "model=decoder")
    require_equal(tmp_path / "whole" / LAST, tmp_path / "on" / LAST, start)


def test_two_processes_go_on_with_the_same_bits(together: Path) -> None:
    whole, half, rest = (
        torch.load(together / name / "checkpoints" / LAST, weights_only=True) for name in ("whole", "half", "rest")
    )
    assert half["global_step"] == STOP
    for part in ("state_dict", "current_model_state", "optimizer_states"):
        assert same(whole[part], rest[part]), part
    assert not same(whole["state_dict"], half["state_dict"])


@pytest.mark.parametrize(
    ("overrides", "environment", "says"),
    [
        (("trainer=fsdp",), {}, "gpu"),
        (("trainer=ddp", "trainer.strategy=dpp"), {}, "dpp"),
        (("trainer.devices=[0]",), {}, "should be an int > 0"),
        (("trainer=ddp", "trainer.devices=3"), TORCHRUN, "does not match the world size"),
    ],
)
def test_what_the_machine_lacks_is_said_before_anything_is_done(
    overrides: tuple[str, ...], environment: dict[str, str], says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    on = [] if overrides == ("trainer=fsdp",) else ["trainer.accelerator=cpu"]
    with pytest.raises(ValueError, match=f"is not available here .*{says}.* trainer=auto trainer.accelerator=auto"):
        make_trainer(composed("model=rt1_tiny", *overrides, *on).config, tmp_path)


def test_one_device_has_no_other_process_than_the_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rank_zero_only, "rank", 1)  # as with RANK=1 left in the environment
    with pytest.raises(ValueError, match=r"^RANK, .* is not the first process .* trainer\.devices=1 has only one"):
        train_policy(composed("model=rt1_tiny", "trainer.accelerator=cpu", f"output={tmp_path}"))


def test_what_lightning_refuses_is_not_blamed_on_the_machine(tmp_path: Path) -> None:
    wrong = "trainer.accelerator=cpu", "+trainer.gradient_clip_algorithm=nrom"
    with pytest.raises(ValueError, match=r"^Lightning refuses the trainer: .*algorithm"):
        make_trainer(composed("model=rt1_tiny", *wrong).config, tmp_path)


def test_a_logger_without_its_library_says_which_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lightning.pytorch.loggers.wandb._WANDB_AVAILABLE", RequirementCache("no-such-library"))
    with pytest.raises(ValueError, match=r"logger needs a library that is not installed: .*no-such-library"):
        make_trainer(composed("model=rt1_tiny", "logger=wandb").config, tmp_path)


def test_ddp_trains_on_two_processes_and_evaluates_once(home: Path) -> None:
    two = ("trainer=ddp", "trainer.devices=2", "recorder=none", "output=two", "hydra.run.dir=two")
    done = vla(home, *SMALL, *two)
    assert done.stdout.count("trained 4 steps") == done.stdout.count("\nsuccess ") == 1
    assert json.loads((home / "two/report.json").read_text())["episodes"] == 2
    assert not (home / "outputs/runs").exists()
