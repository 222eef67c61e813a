"""What a benchmark is asked for and what it reports."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import psutil
import pytest
import toy
from composing import composed
from torch import Tensor

from vla.config.experiment import Experiment
from vla.io.errors import UserError
from vla.jobs.benchmark import acting, collect, loader, run
from vla.jobs.benchmark.measure import machine, measure, other_load
from vla.models.layers import Batch
from vla.models.model import Model
from vla.parallel.limits import cores
from vla.spec import Array, Observation


def test_an_evaluation_without_a_trained_policy_is_refused_before_other_stages(tmp_path: Path) -> None:
    asked = ("benchmark.names=[collect,evaluate]", f"output={tmp_path}/run", f"collect.folder={tmp_path}/episodes")
    with pytest.raises(UserError, match=r"plays a trained policy: add checkpoint=RUN"):
        run(Experiment.from_config(composed("job=benchmark", *asked)))
    assert not list(tmp_path.iterdir())


def test_training_on_several_devices_is_refused_as_every_process_would_measure_its_own(tmp_path: Path) -> None:
    asked = ("trainer=ddp", "trainer.devices=2", "benchmark.names=[loader,train]", f"output={tmp_path}/run")
    with pytest.raises(UserError, match=r"measures training on one device: add trainer\.devices=1"):
        run(Experiment.from_config(composed("job=benchmark", *asked)))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("names", ["[collect]", "[train,evaluate]"])
def test_recordings_are_measured_where_nothing_is_played(recording: None, tmp_path: Path, names: str) -> None:
    asked = ("task=recorded", "job=benchmark", f"benchmark.names={names}", f"output={tmp_path}/run")
    with pytest.raises(UserError, match=r"which recordings cannot: set benchmark\.names=\[loader,train,policy\]"):
        run(Experiment.from_config(composed(*asked)))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("options", "large"), [((), ["large"]), (("task=recorded",), []), (("expert=lerobot", "expert.folder=x"), [])]
)
def test_large_images_are_measured_where_an_expert_can_make_some(
    recording: None, monkeypatch: pytest.MonkeyPatch, options: tuple[str, ...], large: list[str]
) -> None:
    found = measure(3.0, "windows/s", 5, 2.0)
    monkeypatch.setattr(loader, "demonstrations", lambda experiment: None)
    learner = SimpleNamespace(model=SimpleNamespace(history=1, chunk=1))
    monkeypatch.setattr(Experiment, "fitted_learner", lambda experiment, store: learner)
    monkeypatch.setattr(loader, "_measure_loading", lambda *arguments: found)
    monkeypatch.setattr(loader, "_measure_large_images", lambda *arguments: {"large": found})
    measures = loader.loader(Experiment.from_config(composed("job=benchmark", *options)))
    assert [*measures] == ["loader", "loader: 1 frame", "loader: 6 frames", *large]


class Looking(toy.ToyExpert):
    """An expert that cannot act without images."""

    looks = True

    def act(self, observation: Observation) -> Array:
        assert observation.rgb
        return super().act(observation)


@pytest.mark.parametrize(
    ("expert", "parts"), [(toy.ToyExpert, {"full", "blind", "replay"}), (Looking, {"full", "replay"})]
)
def test_an_expert_that_looks_at_the_images_is_not_timed_without(expert: type[toy.ToyExpert], parts: set[str]) -> None:
    episodes, times = collect._time_parts(toy.make_environment(), expert(), 2)
    assert len(episodes) == 2 and {*times} == parts


def test_a_measure_stands_beside_its_floor_and_the_machine() -> None:
    expected = {"value": 3.0, "unit": "ms", "n": 5, "floor": 2.0, "ratio": 1.5}
    assert measure(3.0, "ms", 5, 2.0) == expected
    here = machine()
    assert here["processor"] and here["cores"] == cores()
    assert ("AVX" in here["instructions"]) == ("avx2" in Path("/proc/cpuinfo").read_text().split())


def test_the_time_of_other_programs_is_told_from_ones_own(monkeypatch: pytest.MonkeyPatch) -> None:
    times = psutil.cpu_times()

    def loaded(busy: float, idle: float, own: float) -> float:
        cores = times._replace(user=times.user + busy, idle=times.idle + idle)
        monkeypatch.setattr(psutil, "cpu_times", lambda: cores)
        monkeypatch.setattr("os.times", lambda: (own, 0.0, 0.0, 0.0, 0.0))
        return other_load()[0]

    assert loaded(5.0, 9.0, 3.0) - loaded(0.0, 0.0, 0.0) == pytest.approx(5.0 - 3.0)


def test_a_benchmark_says_where_its_figures_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(acting, "policy", lambda experiment: {"policy": measure(3.0, "ms", 5, 2.0)})
    with caplog.at_level("INFO", "vla"):
        run(Experiment.from_config(composed("job=benchmark", "benchmark.names=[policy]", f"output={tmp_path}")))
    assert caplog.messages[-1] == f"wrote {tmp_path / 'benchmark.json'}" and (tmp_path / "benchmark.json").is_file()


def test_an_evaluation_is_measured_without_further_conditions(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    played: list[Experiment] = []
    monkeypatch.setattr("vla.jobs.evaluate.run", played.append)
    options = ("evaluate=language", "evaluate.until=decided", "evaluate.seed=1000005", f"output={tmp_path}")
    measures = acting.evaluate(Experiment.from_config(composed("job=benchmark", "benchmark.episodes=3", *options)))
    assert measures["evaluate"]["n"] == 3 and len(played) == 2
    for evaluation in (trial.evaluate for trial in played):
        assert not evaluation.changes and evaluation.until is None
        assert evaluation.seeds == range(1_000_005, 1_000_008) and evaluation.recordings == "all"


class Peer:
    """Another implementation of a model, which is the model itself and errs by `error`."""

    def __init__(self, model: Model, error: float) -> None:
        self.model, self.error = model, error

    def __call__(self, window: Batch) -> Tensor:
        return self.model.predict(window).actions + self.error


def test_another_implementation_of_equal_actions_is_the_floor_of_a_plan(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("VLA_TRUST", "test_benchmark")
    peer = {"_target_": "test_benchmark.Peer", "_partial_": True, "error": 0.0}
    small = ("benchmark.steps=3", "collect.episodes=1", f"collect.folder={tmp_path}", "task.image_size=[32,32]")
    experiment = Experiment.from_config(composed("job=benchmark", *small)).with_values({"benchmark.peer": peer})
    found = acting.policy(experiment)["policy"]
    assert found["n"] == 3 and found["floor"] > 0
    with pytest.raises(UserError, match=r"benchmark.peer plans other actions: they differ by \d"):
        acting.policy(experiment.with_values({"benchmark.peer.error": 0.1}))
