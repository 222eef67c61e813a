"""Training: an interrupted and resumed run equals an uninterrupted one bit for bit; logging; out-of-memory errors."""

from __future__ import annotations

import csv
import json
import os
import pickle
import signal
from collections.abc import Callable
from functools import partial
from multiprocessing import active_children
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock, call

import lightning
import pytest
import torch
import toy
from composing import composed
from defaults import defaults_of
from fake_batch import as_policy, make_act, make_batch, make_bc, make_denoising, make_rt1
from omegaconf import OmegaConf
from resuming import STEPS, STOP, VALIDATED, same, train
from small_training import fit, make_learner

from vla.config.experiment import Experiment
from vla.io.errors import UserError
from vla.jobs.train import warn_of_length
from vla.models.diffusion import Diffusion
from vla.models.lora import LoRA
from vla.models.model import Model
from vla.spec import FIRST_SEED, Array, Observation
from vla.training.checkpoints import SAVE_EVERY, GracefulStop
from vla.training.closed_loop import ClosedLoop, processes_that_fit
from vla.training.throughput import TrainingProgressBar
from vla.training.trainer import explain_memory_errors


def make_with_factors() -> Model:
    """An ACT, which draws, with low-rank factors, which draw as well."""
    model, options = make_act(), {"rank": 4, "alpha": 8.0, "modules": ("encoder",), "dropout": 0.1}
    LoRA(**defaults_of("learner/lora/low_rank", **options)).inject(model)
    return model


def loaded(model: Model, state: dict[str, Any]) -> Model:
    """The model, with these weights."""
    model.load_state_dict(state)
    return model


def logged(output: Path) -> list[dict[str, str]]:
    """What was logged, but for how fast it was."""
    with (output / "metrics.csv").open(newline="") as file:
        rows = [{key: row[key] for key in sorted(row) if not key.startswith("pace/")} for row in csv.DictReader(file)]
    return [row for row in rows if any(value for key, value in row.items() if key not in ("step", "epoch"))]


RESUMED = {
    "bc": partial(make_bc, shift=(64, 64)),
    "rt1 with dropout": partial(make_rt1, dropout=0.2),
    "factors": make_with_factors,
    "diffusion, which draws": partial(make_denoising, Diffusion),
}


@pytest.mark.parametrize("make", RESUMED.values(), ids=RESUMED.keys())
def test_going_on_after_an_interruption_gives_the_same_bits(
    make: Callable[[], Model], folder: Path, tmp_path: Path
) -> None:
    torch.manual_seed(0)
    start = make().state_dict()
    whole = train(loaded(make(), start), folder, tmp_path / "whole")
    half = train(loaded(make(), start), folder, tmp_path / "half", stop=STOP)
    assert half["global_step"] == STOP and not half["finished"] and whole["finished"]
    last = tmp_path / "half/checkpoints/last.ckpt"
    torch.save({**half, "seconds": 1000.0}, last)
    rest = train(make(), folder, tmp_path / "half", checkpoint=last)
    assert rest["seconds"] > 1000
    for part in ("state_dict", "current_model_state", "optimizer_states", "lr_schedulers"):
        assert same(whole[part], rest[part]), part
    assert not same(half["state_dict"], rest["state_dict"])
    assert logged(tmp_path / "half") == logged(tmp_path / "whole") != []


class DieAt(lightning.Callback):
    """The process ends before a step, whatever is under way."""

    def __init__(self, step: int) -> None:
        self._step = step

    def on_train_batch_start(self, trainer: lightning.Trainer, *_: Any) -> None:
        if trainer.global_step == self._step:
            raise RuntimeError("killed")


@pytest.mark.parametrize("killed", [False, True], ids=["interrupted", "killed"])
def test_resuming_at_a_validation_step_keeps_its_validation(
    killed: bool, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    start = make_bc().state_dict()
    train(loaded(make_bc(), start), folder, tmp_path / "whole")
    if killed:
        monkeypatch.setattr("vla.training.checkpoints.SAVE_EVERY", VALIDATED)
        with pytest.raises(RuntimeError, match="killed"):
            train(loaded(make_bc(), start), folder, tmp_path / "half", killer=DieAt(VALIDATED + 1))
    else:
        train(loaded(make_bc(), start), folder, tmp_path / "half", stop=VALIDATED)
    last = tmp_path / "half/checkpoints/last.ckpt"
    assert torch.load(last, weights_only=True)["global_step"] == VALIDATED
    train(make_bc(), folder, tmp_path / "half", checkpoint=last)
    assert logged(tmp_path / "half") == logged(tmp_path / "whole") != []


def test_a_finished_training_that_goes_on_logs_at_the_steps_of_one_that_was_longer_from_the_start(
    folder: Path, tmp_path: Path
) -> None:
    last, longer = tmp_path / "two/checkpoints/last.ckpt", 3 * VALIDATED
    train(make_bc(), folder, tmp_path / "one", max_steps=longer)
    train(make_bc(), folder, tmp_path / "two", max_steps=2 * VALIDATED)
    train(make_bc(), folder, tmp_path / "two", checkpoint=last, max_steps=longer)
    one, two = (
        [(row["step"], *(name for name in row if row[name])) for row in logged(tmp_path / name)]
        for name in ("one", "two")
    )
    assert one == two and len(one) > 6


def test_a_policy_has_the_figures_of_a_validation_before_the_interruption(folder: Path, tmp_path: Path) -> None:
    half = train(make_bc(), folder, tmp_path, stop=VALIDATED + 1, max_steps=VALIDATED + 2)
    rest = train(make_bc(), folder, tmp_path, checkpoint=tmp_path / "checkpoints/last.ckpt", max_steps=VALIDATED + 2)
    assert rest["figures"] == half["figures"] != {}


def test_gradients_that_are_gathered_over_batches_are_not_cut_in_half(folder: Path, tmp_path: Path) -> None:
    torch.manual_seed(0)
    start, by_three = make_bc().state_dict(), {"accumulate_grad_batches": 3, "max_steps": 4}
    whole = train(loaded(make_bc(), start), folder, tmp_path / "whole", **by_three)
    half = train(loaded(make_bc(), start), folder, tmp_path / "half", stop=2, **by_three)
    assert half["global_step"] == 2
    checkpoint = tmp_path / "half/checkpoints/last.ckpt"
    rest = train(make_bc(), folder, tmp_path / "rest", checkpoint=checkpoint, **by_three)
    assert same(whole["current_model_state"], rest["current_model_state"])


def test_it_logs_how_fast_it_is_and_what_it_waits_for(folder: Path, tmp_path: Path) -> None:
    train(make_bc(), folder, tmp_path)
    with (tmp_path / "metrics.csv").open(newline="") as file:
        pace = [row for row in csv.DictReader(file) if row["pace/samples_per_s"]]
    assert len(pace) == STEPS // 2
    assert all(float(row["pace/samples_per_s"]) > 0 and 0 <= float(row["pace/waiting"]) <= 1 for row in pace)


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        ((), []),
        (("trainer.max_steps=1000", "learner.warmup_steps=1000"), ["does not reach its peak"]),
        (
            ("trainer.max_steps=499", "trainer.accumulate_grad_batches=2"),
            ["is more than the 998 batches: no validation"],
        ),
        (("trainer.max_steps=500", "trainer.accumulate_grad_batches=2"), []),
        (("trainer.max_steps=-1",), ["learner.schedule=cosine has no end"]),
        (("trainer.max_steps=-1", "learner.schedule=constant"), []),
        (("~learner.warmup_steps",), []),  # as of a learner that has none
        (("trainer.max_steps=-1", "~learner.schedule"), []),
    ],
)
def test_what_never_happens_in_a_training_is_said(
    overrides: tuple[str, ...], said: list[str], caplog: pytest.LogCaptureFixture
) -> None:
    warn_of_length(Experiment.from_config(composed(*overrides)))
    assert len(caplog.messages) == len(said) and all(text in caplog.text for text in said)


def test_out_of_memory_errors_name_the_options_to_lower() -> None:
    """Images larger than all addresses, none of which is there before the model wants to compute with them."""
    batch = make_batch(3)
    batch["rgb"] = {name: image[:, :, :1, :1].expand(-1, -1, 10**8, 10**8, -1) for name, image in batch["rgb"].items()}
    model = {"context": {"history": 3}, "image_size": None, "width": 32}
    sizes = OmegaConf.create({"data": {"batch_size": 4}, "model": model})
    wanted = (
        r"lower data\.batch_size \(now 4\), model\.context\.history \(now 3\), model\.width .*trainer\.precision=bf16"
    )
    with pytest.raises(UserError, match=wanted), explain_memory_errors(sizes):
        fit(make_learner(make_rt1()), batch, 1)
    of_cuda = RuntimeError("CUDA error: out of memory"), RuntimeError("CUDA error: CUBLAS_STATUS_ALLOC_FAILED when …")
    for error in (torch.OutOfMemoryError("CUDA out of memory"), MemoryError(), *of_cuda):
        with pytest.raises(UserError, match=wanted), explain_memory_errors(sizes):
            raise error
    with pytest.raises(RuntimeError, match="shapes"), explain_memory_errors(sizes):
        raise RuntimeError("shapes differ")


def test_the_second_signal_of_a_process_stops_at_once_and_leaves_the_checkpoint_before(tmp_path: Path) -> None:
    graceful_stop = GracefulStop(tmp_path)
    with graceful_stop.handling_signals():
        graceful_stop.requested = True  # as if requested by another process before
        os.kill(os.getpid(), signal.SIGTERM)
        assert not graceful_stop.stopped
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGTERM)
    assert graceful_stop.stopped


class Stumbling(toy.ToyExpert):
    """Cannot play one seed."""

    def reset(self, instruction: str, seed: int) -> None:
        if seed == 1:
            raise RuntimeError("the simulation diverged")
        super().reset(instruction, seed)


def test_an_episode_that_cannot_be_played_in_validation_costs_no_training(
    folder: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    closed_loop = ClosedLoop(toy.make_environment, lambda model: Stumbling(), range(4), tmp_path / "run/checkpoints")
    train(make_bc(), folder, tmp_path / "run", killer=closed_loop)
    assert closed_loop.success == pytest.approx(2 / 3)  # of the three that were played; seed 3 fails in this world
    assert "validation: seed 1 could not be played: RuntimeError: the simulation diverged" in caplog.text


class Partial(toy.ToyExpert):
    """Succeeds in the first episodes only."""

    def __init__(self, successes: int) -> None:
        super().__init__()
        self._left = successes

    def reset(self, instruction: str, seed: int) -> None:
        super().reset(instruction, seed)
        self._left -= 1

    def act(self, observation: Observation) -> Array:
        return super().act(observation) * (self._left >= 0)


def test_a_model_that_cannot_be_sent_to_a_worker_is_found_before_training(tmp_path: Path) -> None:
    model, trainer = make_bc(), SimpleNamespace(enable_validation=True)
    played = ClosedLoop(toy.make_environment, lambda model: toy.ToyExpert(), range(10), tmp_path, workers=2)
    played.on_fit_start(trainer, make_learner(model))  # type: ignore[arg-type]
    model.activation = lambda values: values  # type: ignore[assignment]
    with pytest.raises((AttributeError, pickle.PicklingError), match="lambda"):
        played.on_fit_start(trainer, make_learner(model))  # type: ignore[arg-type]


def test_the_best_weights_are_chosen_if_the_last_ones_are_clearly_worse(folder: Path, tmp_path: Path) -> None:
    """The interval of 18 of 20 ends at 69.9 %; of equally good ones the newest are the best."""
    seeds = [seed for seed in range(25) if seed % 5 != 3]  # which this world lets succeed
    rates, run = iter([10, 18, 18, 15]), tmp_path / "run"
    played = ClosedLoop(toy.make_environment, lambda model: Partial(next(rates)), seeds, run)
    train(make_bc(), folder, run, killer=played, max_steps=4, val_check_interval=1)
    assert (played.best, played.success) == (0.9, 0.75) and played.clearly_better_policy() is None
    played.success = 13 / 20
    assert played.clearly_better_policy() == run / "policy_best"
    made = json.loads((run / "policy_best/training.json").read_text())
    assert (made["steps"], made["figures"]["val/success"]) == (3, pytest.approx(0.9))
    for others, best in ((seeds, 0.9), (seeds[:-1], -1.0)):
        restored = ClosedLoop(toy.make_environment, lambda model: toy.ToyExpert(), others, run)
        restored.load_state_dict(played.state_dict())
        assert restored.best == best


def test_a_validation_without_a_played_episode_selects_nothing(folder: Path, tmp_path: Path) -> None:
    agents, run = iter([toy.ToyExpert(), Stumbling()]), tmp_path / "run"
    played = ClosedLoop(toy.make_environment, lambda model: next(agents), [1], run)
    train(make_bc(), folder, run, killer=played, max_steps=2, val_check_interval=1)
    assert (played.best, played.success) == (1.0, 1.0)
    assert json.loads((run / "policy_best/training.json").read_text())["steps"] == 1
    assert played.clearly_better_policy() is None


def test_between_validations_no_environment_is_held(folder: Path, tmp_path: Path) -> None:
    """Fifty compiled scenes of Meta-World would take 4 GB from the demonstrations in memory."""
    held: list[int] = []

    def make() -> toy.ToyEnvironment:
        held.append(1)
        environment = toy.ToyEnvironment()
        environment.close = lambda: held.append(-1)  # type: ignore[method-assign]
        return environment

    played = ClosedLoop(make, lambda model: toy.ToyExpert(), range(2), tmp_path / "run")
    train(make_bc(), folder, tmp_path / "run", killer=played)
    assert len(held) >= 4 and held == [1, -1] * (len(held) // 2)


@pytest.mark.parametrize(
    ("device", "gpu", "free", "expected"), [("cpu", 8e9, 8e9, 2666), ("cuda", 8e9, 64e9, 7), ("cuda", 99e9, 4e9, 3)]
)
def test_workers_have_room_for_a_small_model_and_on_a_gpu_for_its_libraries(
    device: str, gpu: float, free: float, expected: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("vla.training.closed_loop.memory_of", lambda device: (0.0, gpu))
    monkeypatch.setattr("vla.training.closed_loop.free_memory", lambda: free)
    assert processes_that_fit(torch.device(device), 1e6) == expected


@pytest.mark.parametrize("lanes", [1, 3])
def test_validation_finds_the_same_with_any_number_of_workers(
    lanes: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    learner, seeds = make_learner(make_rt1()), range(FIRST_SEED, FIRST_SEED + 5)
    torch.backends.cuda.enable_flash_sdp(True)  # as in a new process, whatever an interrupted training before left
    learner.on_fit_start()  # what a training sets must not matter
    try:
        with ClosedLoop(toy.Telling, partial(as_policy, lanes=lanes), seeds, tmp_path, workers=2) as closed_loop:
            with monkeypatch.context() as changed:
                changed.setattr("vla.training.closed_loop.memory_of", lambda device: (0.0, 1e4))  # for no other model
                alone = closed_loop.play(learner, seeds, 2)
                assert closed_loop._pool is None
            shared = closed_loop.play(learner, seeds, 2)
            for parameter in learner.model.parameters():
                parameter.data.mul_(-1)
            again, negated = (closed_loop.play(learner, seeds, workers) for workers in (1, 2))
    finally:
        learner.teardown("fit")
    alone, shared, again, negated = (
        sorted(part, key=lambda result: result.seed) for part in (alone, shared, again, negated)
    )
    assert shared == alone and all(result.draws["done"] for result in alone)
    assert negated == again != alone
    assert not active_children()


def test_damaged_training_curves_cost_no_training(
    folder: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    train(make_bc(), folder, tmp_path, stop=2, max_steps=3)
    last = tmp_path / "checkpoints/last.ckpt"
    (tmp_path / "metrics.csv").write_text("step,val/loss\nlast,2\n")
    assert train(make_bc(), folder, tmp_path / "rest", checkpoint=last, max_steps=3)["global_step"] == 3
    assert f"the training curves begin anew: {tmp_path / 'metrics.csv'} is damaged in line 2" in caplog.text


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("loops", {}),
        ("loops", {"fit_loop": {"epoch_loop.batch_progress": {"total": {"ready": "x"}}}}),
        ("optimizer_states", [{"state": {}, "param_groups": []}]),
        ("lr_schedulers", None),
        ("WindowDataModule", {"windows": "others"}),
        ("state_dict", {"model.x": 3}),
        ("current_model_state", {"model.x": 3}),
    ],
    ids=lambda value: str(value)[:40],
)
def test_a_damaged_state_of_a_training_is_refused_by_name(
    key: str, value: Any, interrupted: dict[str, Any], folder: Path, tmp_path: Path
) -> None:
    last = tmp_path / "checkpoints/last.ckpt"
    last.parent.mkdir()
    torch.save({**interrupted, key: value}, last)
    played = ClosedLoop(toy.make_environment, lambda model: toy.ToyExpert(), range(1), tmp_path)
    with pytest.raises(UserError, match=r"^\S+/last\.ckpt cannot be resumed: .+"):
        train(make_bc(), folder, tmp_path, checkpoint=last, killer=played)


@pytest.fixture(scope="module")
def interrupted(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The checkpoint of a training that was interrupted."""
    return train(make_bc(), folder, tmp_path_factory.mktemp("interrupted"), stop=2)


def test_where_gradients_are_accumulated_nothing_is_saved_within_a_step(tmp_path: Path) -> None:
    saved = []
    trainer: Any = SimpleNamespace(
        accumulate_grad_batches=2, enable_validation=False, val_check_batch=None, should_stop=False
    )
    trainer.strategy = SimpleNamespace(reduce_boolean_decision=lambda decision, all: decision)
    trainer.save_checkpoint = lambda path, weights_only: saved.append(trainer.global_step)
    graceful_stop, nothing = GracefulStop(tmp_path), None
    # Resumed from a save at step 500, whose batches are 998 and 999.
    for batch in range(1000, 2002):
        trainer.global_step = (batch + 1) // 2
        graceful_stop.on_train_batch_end(trainer, nothing, None, None, batch)  # type: ignore[arg-type]
    assert saved == [2 * SAVE_EVERY]


def test_the_progress_bar_shows_the_loss_of_the_first_step_after_resuming_and_the_share_of_waiting() -> None:
    logged = {"pace/waiting": torch.tensor(0.1)}
    trainer: Any = SimpleNamespace(callback_metrics=logged, accumulate_grad_batches=2, is_global_zero=True)
    bar, module, shown = TrainingProgressBar(), make_learner(), Mock()
    bar._bar = shown
    for batch in (5, 6, 10):
        bar.on_train_batch_end(trainer, module, {"loss": torch.tensor(batch / 8)}, {}, batch)
    notes = [f"loss {loss}, waiting 10%" for loss in ("1.250", "1.250", "2.500")]
    assert shown.show.call_args_list == [call(done, note) for done, note in zip((6, 7, 11), notes, strict=True)]
