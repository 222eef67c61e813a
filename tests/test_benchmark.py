"""What a benchmark is asked for and what it reports."""

from __future__ import annotations

import os
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from composing import composed

from vla.config.experiment import Experiment
from vla.jobs.benchmark import deploy, loader
from vla.jobs.benchmark.machine import OtherLoad, is_unreliable, machine
from vla.jobs.benchmark.measure import measure
from vla.jobs.benchmark.memory import peak, reset_peak
from vla.jobs.benchmark.train import measures
from vla.parallel.limits import cores


def test_a_measure_stands_beside_its_floor() -> None:
    expected = {"value": 3.0, "unit": "ms", "n": 5, "floor": 2.0, "ratio": 1.5}
    assert measure(3.0, "ms", 5, 2.0) == expected


def test_the_machine_is_named() -> None:
    here = machine()
    assert here["processor"] and here["cores"] == cores()
    told = Path("/proc/cpuinfo").read_text().split()
    assert set(here["instructions"]) <= set(told) and ("avx2" in here["instructions"]) == ("avx2" in told)


def test_the_time_of_other_programs_is_told_from_ones_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of 4 s that the cores were busy, this process and its children took 3; the clock went on by 2 s."""
    readings = iter([(100.0, 10.0, 50.0), (104.0, 13.0, 52.0), None, (104.0, 13.0, 52.0)])
    monkeypatch.setattr(OtherLoad, "_now", lambda _: next(readings))
    assert OtherLoad().cores() == pytest.approx(0.5)
    assert OtherLoad().cores() is None


def test_the_clock_of_other_programs_runs() -> None:
    one, two = OtherLoad()._now(), OtherLoad()._now()
    assert one and two and all(late >= early > 0 for early, late in zip(one, two, strict=True))


@pytest.mark.parametrize(("share", "result"), [(0.04, False), (0.06, True)])
def test_figures_of_a_busy_machine_are_unreliable(share: float, result: bool) -> None:
    assert is_unreliable(share * (os.cpu_count() or 1)) is result


def test_a_peak_of_memory_is_remembered_until_it_is_forgotten() -> None:
    device, size = torch.device("cpu"), 64_000_000
    held = reset_peak(device)
    torch.ones(size, dtype=torch.uint8)
    assert peak(device) - held > 0.9 * size
    held = reset_peak(device)
    assert peak(device) - held < 0.5 * size


def test_large_images_are_loaded_and_their_size_is_extrapolated() -> None:
    """250 000 steps with three images of 224 by 224 pixels and some numbers take 113 GB raw."""
    experiment = Experiment.of(composed("job=benchmark", "benchmark.episodes=1", "benchmark.batches=1"))
    small = experiment.with_values({"task.image_size": [224, 224], "data.batch_size": 4})
    found = loader._of_large_images(small, chunk=2)
    for codec in ("lossless", "jpeg"):
        speed, size = (found[f"loader: 3 x 224 px, {codec}{end}"] for end in ("", ", 2500 x 100 steps"))
        assert (speed["unit"], speed["n"], size["unit"]) == ("windows/s", 4, "GB") and speed["floor"] > 0
        assert 0 < size["value"] < 40 and size["floor"] == pytest.approx(112.9, abs=0.1)


def test_training_without_a_precision_is_refused_before_any_work() -> None:
    asked = {"benchmark": {"precisions": [], "compile": [True]}, "trainer": {"accelerator": "cpu"}}
    with pytest.raises(ValueError, match="both need an entry"):
        measures(Experiment(asked))


def test_a_deployment_is_measured_against_its_settings(monkeypatch: pytest.MonkeyPatch) -> None:
    names = ("image to command p50 [ms]", "inference p50 [ms]", "tick p99 [ms]")
    operator = SimpleNamespace(status=dict(zip(names, ("30", "20", "21"), strict=True)), watchdog_delay=lambda: 0.25)
    operator.play = operator.begin_episode = lambda: None
    loop = SimpleNamespace(episodes=2, running=lambda: nullcontext(operator))
    monkeypatch.setattr(deploy, "deployment", lambda experiment: loop)
    found = deploy.measures(Experiment.of(composed("job=benchmark", "deploy=loop")))
    assert {name: (each["value"], each["floor"]) for name, each in found.items()} == {
        "deploy: image to command": (30, 20),
        "deploy: tick p99": (21, 20),
        "deploy: watchdog": (250, 200),
    }
