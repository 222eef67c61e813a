"""How far a long work is, on a terminal and elsewhere."""

from __future__ import annotations

import io
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from rich.console import Console
from small_training import make_learner

from vla.io import progress
from vla.io.progress import Bar
from vla.training.throughput import TrainingProgressBar


@pytest.fixture
def out(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> io.StringIO:
    """What rich prints, on a terminal of 80 columns if the test asks for one."""
    console = Console(file=io.StringIO(), force_terminal=getattr(request, "param", False), width=80)
    monkeypatch.setattr("rich._console", console)
    asked = Console(file=io.StringIO(), force_terminal=console.is_terminal)  # Lightning configures the other one anew
    monkeypatch.setattr(progress, "get_console", lambda: asked)
    monkeypatch.setattr(progress, "EVERY", 0.0)
    return console.file  # type: ignore[return-value]


@pytest.mark.parametrize("out", [True, False], indirect=True, ids=["terminal", "pipe"])
def test_a_pipe_gets_lines_and_a_terminal_a_bar(out: io.StringIO, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level("INFO"), Bar("collecting", 3, 1, "as before") as bar:
        bar.show(2, "success 50%")
        bar.show(3)
    assert "collecting" in out.getvalue() and "3/3" in out.getvalue()
    on_terminal = "\x1b" in out.getvalue()
    assert [line.partition(", 0:")[0] for line in caplog.messages] == (
        [] if on_terminal else ["collecting: 2 of 3, success 50%", "collecting: 3 of 3"]
    )


def test_lines_do_not_follow_each_other_closely(
    out: io.StringIO, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(progress, "EVERY", 1e6)
    with caplog.at_level("INFO"), Bar("collecting", 2) as bar:
        bar.show(1)
    assert not caplog.messages


def bar_of(trainer: Any) -> TrainingProgressBar:
    """The bar of a training."""
    trainer.progress_bar_callback = bar = TrainingProgressBar()
    bar._trainer = trainer
    bar._init_progress(trainer)
    assert bar.progress is not None
    bar.train_progress_bar_id = bar.progress.add_task("training  ", total=20000)
    return bar


def test_a_training_is_one_line(out: io.StringIO, caplog: pytest.LogCaptureFixture) -> None:
    logged = {"val/success": 0.85, "pace/samples_per_s": 1234.0, "pace/waiting": 0.01}
    trainer: Any = SimpleNamespace(
        callback_metrics=logged,
        state=SimpleNamespace(fn="fit"),
        sanity_checking=False,
        training=True,
        max_steps=20000,
        accumulate_grad_batches=1,
    )
    bar, learner = bar_of(trainer), make_learner()
    with caplog.at_level("INFO"):
        bar.on_train_batch_end(trainer, learner, {"loss": torch.tensor(12.5)}, {}, 1998)
    assert bar.progress is not None
    console = Console(file=io.StringIO(), width=80)
    console.print(bar.progress.get_renderable())
    (line,) = console.file.getvalue().splitlines()  # type: ignore[attr-defined]
    assert "1999/20000" in line and "loss: 12.500 success: 85%" in line and "…" not in line
    assert caplog.messages == ["training: 1999 of 20000, loss 12.500, success 85%"]
