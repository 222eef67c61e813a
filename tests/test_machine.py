"""What is said on a machine without instructions for bfloat16, or without a compiler, before any work."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from composing import composed

from vla import jobs
from vla.config.experiment import Experiment, to_plain
from vla.jobs.machine import has_bfloat16, require_compiler, warn_of_bfloat16

FP32 = {"trainer": {"precision": "fp32", "accelerator": "cpu"}, "policy": {"precision": "fp32", "device": "cpu"}}
PARTS = ("trainer", "policy")


@pytest.mark.parametrize("part", PARTS)
def test_bfloat16_on_a_processor_that_is_slow_at_it_is_one_warning(
    part: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    assert isinstance(has_bfloat16(), bool)
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


@pytest.mark.parametrize("compiler", ["no-such-compiler", "g++ '-O1"])
def test_a_job_that_compiles_is_refused_without_a_compiler(
    compiler: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("CXX", compiler)
    monkeypatch.chdir(tmp_path)
    for compiling in (("job=train", "learner.compile=true"), ("job=evaluate", "policy.compile=true")):
        key = compiling[1].removesuffix("=true")
        message = rf"^{key} needs a C\+\+ compiler, and there is no {re.escape(compiler)}: .*, or set {key}=false$"
        with pytest.raises(ValueError, match=message):
            jobs.run(Experiment.from_config(composed(*compiling, "trainer.accelerator=cpu", "policy.device=cpu")))
    assert not [*tmp_path.iterdir()]
    others = ("job=train", "policy.compile=true"), ("job=evaluate", "agent=expert", "policy.compile=true")
    for compiles_nothing in (*others, ("job=collect", "learner.compile=true")):
        config = to_plain(composed(*compiles_nothing))
        require_compiler(config, jobs.find(config["job"]).needs(config))
    (tmp_path / "g++").touch(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setenv("CXX", "g++ -O1")
    require_compiler({"learner": {"compile": True}}, ("learner",))
