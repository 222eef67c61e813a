"""What is said, and left out, on a processor without instructions for bfloat16."""

from __future__ import annotations

import logging

import pytest

from vla.jobs.benchmark.train import _precisions
from vla.jobs.machine import has_bfloat16, warn_of_bfloat16

FP32 = {"trainer": {"precision": "fp32", "accelerator": "cpu"}, "policy": {"precision": "fp32", "device": "cpu"}}
PARTS = ("trainer", "policy")


@pytest.mark.parametrize("part", PARTS)
def test_bfloat16_on_a_processor_that_is_slow_at_it_is_one_warning(
    part: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    slow = FP32 | {part: FP32[part] | {"precision": "bf16"}}
    monkeypatch.setattr("vla.jobs.machine.has_bfloat16", lambda: True)
    warn_of_bfloat16(slow, PARTS)
    monkeypatch.setattr("vla.jobs.machine.has_bfloat16", lambda: False)
    warn_of_bfloat16(FP32, PARTS)
    warn_of_bfloat16(slow, ("task", "expert"))  # nothing is computed
    assert not caplog.messages
    warn_of_bfloat16(slow, PARTS)
    (message,) = caplog.messages
    assert f"{part}.precision=bf16 is slow here" in message and f"in 32 bits, {part}.precision=fp32" in message


def test_the_benchmark_leaves_slow_bfloat16_out_unless_it_is_asked_for(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("vla.jobs.benchmark.train.has_bfloat16", lambda: False)
    caplog.set_level(logging.INFO)
    assert _precisions(None, on_processor=True) == ["fp32"]
    assert len(caplog.messages) == 1 and "bf16 is left out" in caplog.messages[0]
    assert _precisions(["bf16"], on_processor=True) == ["bf16"]
    assert list(_precisions(None, on_processor=False)) == ["fp32", "bf16"]
    assert isinstance(has_bfloat16(), bool)
