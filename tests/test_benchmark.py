"""What a benchmark is asked for and what it reports."""

from __future__ import annotations

from pathlib import Path

import pytest
from composing import composed

from vla.config.experiment import Experiment
from vla.jobs.benchmark import loader
from vla.jobs.benchmark.measure import machine, measure, other_load
from vla.parallel.limits import cores


def test_a_measure_stands_beside_its_floor_and_the_machine() -> None:
    expected = {"value": 3.0, "unit": "ms", "n": 5, "floor": 2.0, "ratio": 1.5}
    assert measure(3.0, "ms", 5, 2.0) == expected
    here = machine()
    assert here["processor"] and here["cores"] == cores()
    assert ("AVX" in here["instructions"]) == ("avx2" in Path("/proc/cpuinfo").read_text().split())


def test_the_time_of_other_programs_is_told_from_ones_own() -> None:
    one, two = other_load(), other_load()
    assert two[0] >= one[0] - 0.1 and two[1] >= one[1] > 0


def test_large_images_are_loaded_and_their_size_is_extrapolated() -> None:
    """250 000 steps with three images of 224 by 224 pixels and some numbers take 113 GB raw."""
    experiment = Experiment.of(composed("job=benchmark", "benchmark.episodes=1", "benchmark.batches=1"))
    small = experiment.with_values({"task.image_size": [224, 224], "data.batch_size": 4})
    found = loader._of_large_images(small, chunk=2)
    for codec in ("lossless", "jpeg"):
        speed, size = (found[f"loader: 3 x 224 px, {codec}{end}"] for end in ("", ", 2500 x 100 steps"))
        assert (speed["unit"], speed["n"], size["unit"]) == ("windows/s", 4, "GB") and speed["floor"] > 0
        assert 0 < size["value"] < 40 and size["floor"] == pytest.approx(112.9, abs=0.1)
