"""What is said, and left out, on a processor without instructions for bfloat16."""

from __future__ import annotations

import logging
import os
import subprocess
import sys

import pytest
from omegaconf import DictConfig, OmegaConf

from vla.jobs.benchmark.train import _precisions
from vla.jobs.machine import has_bfloat16, warn_of_bfloat16


def config(trainer: str = "fp32", policy: str = "fp32") -> DictConfig:
    """As much of a configuration as the warning looks at."""
    content = {
        "trainer": {"precision": trainer, "accelerator": "cpu"},
        "policy": {"precision": policy, "device": "cpu"},
    }
    return OmegaConf.create(content)


@pytest.fixture
def slow(monkeypatch: pytest.MonkeyPatch) -> None:
    """A processor without the instructions."""
    monkeypatch.setattr("vla.jobs.machine.has_bfloat16", lambda: False)
    monkeypatch.setattr("vla.jobs.benchmark.train.has_bfloat16", lambda: False)


@pytest.mark.usefixtures("slow")
@pytest.mark.parametrize(
    ("asked", "says"),
    [
        (config(trainer="bf16"), "trainer.precision=bf16 is slow here"),
        (config(trainer="bf16"), "about a hundred times faster in 32 bits, trainer.precision=fp32"),
        (config(policy="bf16"), "about a hundred times faster in 32 bits, policy.precision=fp32"),
    ],
)
def test_bfloat16_on_a_processor_that_is_slow_at_it_is_one_warning(
    asked: DictConfig, says: str, caplog: pytest.LogCaptureFixture
) -> None:
    warn_of_bfloat16(asked, ("trainer", "policy"))
    assert len(caplog.messages) == 1 and says in caplog.messages[0]
    assert caplog.records[0].levelno == logging.WARNING


@pytest.mark.usefixtures("slow")
def test_what_is_not_slow_is_not_warned_of(caplog: pytest.LogCaptureFixture) -> None:
    warn_of_bfloat16(config(), ("trainer", "policy"))
    warn_of_bfloat16(config("bf16", "bf16"), ("task", "expert"))  # nothing is computed
    assert not caplog.messages


def test_where_the_processor_is_made_for_it_there_is_no_warning(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("vla.jobs.machine.has_bfloat16", lambda: True)
    warn_of_bfloat16(config("bf16", "bf16"), ("trainer", "policy"))
    assert not caplog.messages


@pytest.mark.usefixtures("slow")
def test_the_benchmark_leaves_slow_bfloat16_out_unless_it_is_asked_for(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    assert _precisions(None, on_processor=True) == ["fp32"]
    assert len(caplog.messages) == 1 and "bf16 is left out" in caplog.messages[0]
    assert _precisions(["bf16"], on_processor=True) == ["bf16"]
    assert list(_precisions(None, on_processor=False)) == ["fp32", "bf16"]
    assert len(caplog.messages) == 1


def test_hidden_instructions_are_not_there() -> None:
    program = "from vla.jobs.machine import has_bfloat16; print(has_bfloat16())"
    hidden = {**os.environ, "ONEDNN_MAX_CPU_ISA": "AVX2", "ATEN_CPU_CAPABILITY": "avx2"}
    printed = subprocess.run([sys.executable, "-c", program], env=hidden, capture_output=True, text=True, check=True)
    assert printed.stdout.strip() == "False" and isinstance(has_bfloat16(), bool)
