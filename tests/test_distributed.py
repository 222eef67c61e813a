"""Processes that train together learn what one would, and leave what one would."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from socket import create_server

import numpy as np
import pytest
import torch
import toy
from test_run import SMALL, vla
from together import composed, train

from vla.cluster import Local
from vla.collect import collect
from vla.data.episodes import EpisodeStore
from vla.parts import make_policy
from vla.policy import noise
from vla.training import LAST, make_trainer

TORCHRUN = {"TORCHELASTIC_RUN_ID": "1", "RANK": "0", "LOCAL_RANK": "0", "WORLD_SIZE": "2"}  # what it sets
PAIRS = ("ddp,rt1_tiny", "fsdp,rt1_tiny", "fsdp,decoder")


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("episodes")
    collect(EpisodeStore.create_or_open(folder, toy.SPEC, {}), toy.make_environment, toy.make_expert, 30, Local(1), 0)
    return folder


@pytest.fixture(scope="module")
def together(store: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where two processes have left what they trained, in a folder for each of `PAIRS`."""
    folder = tmp_path_factory.mktemp("together")
    with create_server(("127.0.0.1", 0)) as free:
        port = str(free.getsockname()[1])
    script = [sys.executable, str(Path(__file__).with_name("together.py")), str(store), str(folder), *PAIRS]
    shared = {**os.environ, "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port, "NODE_RANK": "0"}
    processes = [subprocess.Popen(script, env={**shared, "LOCAL_RANK": str(rank)}, cwd=folder) for rank in (0, 1)]
    try:
        assert [process.wait(120) for process in processes] == [0, 0]
    finally:
        for process in processes:
            process.kill()
    return folder


def require_equal(one: Path, other: Path) -> None:
    """Two checkpoints with the same averaged and the same trained weights, to rounding, which Adam magnifies."""
    ones, others = (torch.load(path, weights_only=True) for path in (one, other))
    for state in ("state_dict", "current_model_state"):
        torch.testing.assert_close(others[state], ones[state], rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("pair", ["ddp,rt1_tiny", "fsdp,rt1_tiny"])
def test_two_processes_learn_what_one_learns_from_batches_twice_as_large(
    store: Path, together: Path, pair: str, tmp_path: Path
) -> None:
    found = train(store, tmp_path, "trainer=cpu", "model=rt1_tiny", "data.batch_size=16")
    assert torch.load(together / pair / "found.pt", weights_only=True) == pytest.approx(found, rel=1e-3)
    require_equal(tmp_path / LAST, together / pair / LAST)


@pytest.mark.parametrize("pair", PAIRS)
def test_what_several_processes_leave_is_a_checkpoint_like_any_other(
    store: Path, together: Path, pair: str, tmp_path: Path
) -> None:
    path = together / pair / LAST
    policy = make_policy({"_target_": "vla.policy.Policy", "device": "cpu"}, path)
    action = policy.act(noise(toy.SPEC, np.random.default_rng(0)))
    assert action.shape == (3,) and np.isfinite(action).all()


def test_training_goes_on_with_another_number_of_processes(store: Path, together: Path, tmp_path: Path) -> None:
    longer = ("trainer=cpu", "model=rt1_tiny", "data.batch_size=16", "trainer.max_steps=6")
    train(store, tmp_path / "on", *longer, checkpoint=together / "fsdp,rt1_tiny" / LAST)
    train(store, tmp_path / "whole", *longer)
    require_equal(tmp_path / "whole" / LAST, tmp_path / "on" / LAST)


@pytest.mark.parametrize(
    ("overrides", "environment", "says"),
    [
        (("trainer=fsdp",), {}, "gpu"),
        (("trainer=ddp", "trainer.strategy=dpp"), {}, "dpp"),
        (("trainer=ddp", "trainer.devices=3"), TORCHRUN, "does not match the world size"),
        (("trainer=fsdp", "trainer.precision=16-mixed"), {}, "16-mixed"),
    ],
)
def test_what_the_machine_lacks_is_said_before_anything_is_done(
    overrides: tuple[str, ...], environment: dict[str, str], says: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    on = [] if overrides == ("trainer=fsdp",) else ["trainer.accelerator=cpu"]
    with pytest.raises(ValueError, match=f"cannot be had here .*{says}.*: try trainer=cpu"):
        make_trainer(composed("model=rt1_tiny", *overrides, *on), None)


def test_ddp_trains_on_two_processes_and_evaluates_once(tmp_path: Path) -> None:
    done = vla(tmp_path, *SMALL, "trainer=ddp", "trainer.devices=2", "output=run", "hydra.run.dir=run")
    assert done.stdout.count("trained 4 steps") == done.stdout.count("\nsuccess ") == 1
    assert json.loads((tmp_path / "run/report.json").read_text())["episodes"] == 2
    assert not (tmp_path / "outputs/runs").exists()
