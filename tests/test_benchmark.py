"""What a benchmark is asked for and what it reports."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from vla.config.experiment import Experiment
from vla.jobs.benchmark import run
from vla.jobs.benchmark.measure import measure
from vla.jobs.benchmark.memory import peak, reset_peak
from vla.jobs.benchmark.train import measures


def test_a_measure_stands_beside_its_floor() -> None:
    expected = {"value": 3.0, "unit": "ms", "n": 5, "floor": 2.0, "ratio": 1.5}
    assert measure(3.0, "ms", 5, 2.0) == expected


def test_a_peak_of_memory_is_remembered_until_it_is_forgotten() -> None:
    device, size = torch.device("cpu"), 64_000_000
    held = reset_peak(device)
    torch.ones(size, dtype=torch.uint8)
    assert peak(device) - held > 0.9 * size
    held = reset_peak(device)
    assert peak(device) - held < 0.5 * size


def test_a_benchmark_of_nothing_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"benchmark\.names is empty: the stages are collect, loader"):
        run(Experiment({"benchmark": {"names": []}, "output": str(tmp_path)}))


@pytest.mark.parametrize(
    ("precisions", "compiled", "problem"), [([], [True], "both need an entry"), (["fp32"], [True], r"install g\+\+")]
)
def test_what_cannot_be_timed_is_refused_before_any_work(
    precisions: list[str], compiled: list[bool], problem: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CXX", "no-such-compiler")
    asked = {"benchmark": {"precisions": precisions, "compile": compiled}, "trainer": {"accelerator": "cpu"}}
    with pytest.raises(ValueError, match=problem):
        measures(Experiment(asked))
