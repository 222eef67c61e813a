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
    monkeypatch.setattr(progress, "LOG_INTERVAL", 0.0)
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
    monkeypatch.setattr(progress, "LOG_INTERVAL", 1e6)
    with caplog.at_level("INFO"), Bar("collecting", 2) as bar:
        bar.show(1)
    assert not caplog.messages


@pytest.mark.parametrize(("steps", "of"), [(20000, " of 20000"), (-1, "")])
def test_a_training_is_one_line(steps: int, of: str, out: io.StringIO, caplog: pytest.LogCaptureFixture) -> None:
    trainer: Any = SimpleNamespace(
        callback_metrics={"val/success": 0.85, "pace/samples_per_s": 1234.0, "pace/waiting": 0.01},
        is_global_zero=True,
        max_steps=steps,
        accumulate_grad_batches=1,
    )
    bar, learner = TrainingProgressBar(), make_learner()
    with caplog.at_level("INFO"):
        bar.on_train_batch_end(trainer, learner, {"loss": torch.tensor(12.5)}, {}, 1998)
        bar.on_train_end(trainer, learner)
    (line,) = filter(None, out.getvalue().splitlines())
    notes = "loss 12.500, 1234 samples/s, success 85%"
    assert f"1999/{steps if of else '?'} {notes}" in line and "…" not in line
    (said,) = caplog.messages
    assert said.startswith(f"training: 1999{of}, {notes}")
