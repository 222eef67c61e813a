"""A machine without a compiler: what is to be compiled there is refused before any work, in every job."""

from __future__ import annotations

import sysconfig
from pathlib import Path

import pytest
import torch
from composing import composed

from vla import jobs
from vla.config.experiment import Experiment, plain
from vla.jobs.machine import require_compiler

CHECKPOINT = "checkpoint=nowhere.ckpt"


@pytest.mark.parametrize(
    ("overrides", "key", "off"),
    [
        (("job=train", "learner.compile=true"), "learner.compile", "false"),
        (("job=evaluate", "policy.compile=true"), "policy.compile", "false"),
        (("job=deploy", "deploy=server", CHECKPOINT, "policy.compile=true"), "policy.compile", "false"),
        (("job=benchmark", "policy.compile=true"), "policy.compile", "false"),
        (("job=benchmark",), "benchmark.compile", r"\[false\]"),
    ],
)
def test_every_job_that_compiles_is_refused_without_a_compiler(
    overrides: tuple[str, ...], key: str, off: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("CXX", "no-such-compiler")
    monkeypatch.chdir(tmp_path)
    on_cpu = ("trainer.accelerator=cpu", "policy.device=cpu")
    with pytest.raises(
        ValueError,
        match=rf"^{key} needs a C\+\+ compiler, and there is no no-such-compiler: install g\+\+, or set {key}={off}$",
    ):
        jobs.run(Experiment.of(composed(*overrides, *on_cpu)))
    assert not [*tmp_path.iterdir()]


@pytest.mark.parametrize(
    "overrides",
    [
        ("job=train", "policy.compile=true"),
        ("job=evaluate", CHECKPOINT, "learner.compile=true"),
        ("job=evaluate", "agent=expert", "learner.compile=true", "policy.compile=true"),
        ("job=collect", "learner.compile=true"),
        ("job=benchmark", "benchmark.names=[collect,loader]"),
        ("job=benchmark", "benchmark.compile=[false]"),
        ("job=evaluate",),
    ],
)
def test_a_job_that_compiles_nothing_needs_no_compiler(
    overrides: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CXX", "no-such-compiler")
    config = plain(composed(*overrides, "trainer.accelerator=cpu", "policy.device=cpu"))
    require_compiler(config, jobs.find(config["job"]).needs(config))


def test_a_compiler_may_have_arguments_and_needs_the_headers_of_python(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "g++").touch(0o755)
    (tmp_path / "Python.h").touch()
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setenv("CXX", "g++ -O1")
    monkeypatch.setattr(sysconfig, "get_path", lambda name: str(tmp_path))
    config = {"job": "train", "learner": {"compile": True}, "trainer": {"accelerator": "cpu"}}
    require_compiler(config, ("learner", "trainer"))
    (tmp_path / "Python.h").unlink()
    with pytest.raises(ValueError, match=r"needs the header files of Python in .*: install python3-dev, or set"):
        require_compiler(config, ("learner", "trainer"))


def test_on_a_gpu_the_compiler_is_one_of_c(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CC", raising=False)
    config = {"job": "train", "learner": {"compile": True}, "trainer": {"accelerator": "auto"}}
    with pytest.raises(ValueError, match="needs a C compiler, and there is no gcc or clang: install gcc, or set"):
        require_compiler(config, ("learner", "trainer"))
