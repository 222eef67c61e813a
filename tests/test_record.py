"""Recordings, read back from their files."""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from psutil import Process
from rerun.chunk import RrdReader
from toy_recordable import ThinkingAgent, make_environment

from vla.rollouts import recorder
from vla.rollouts.recorder import TOKENS, VIEWER, RerunRecorder, _Writer, merge
from vla.rollouts.results import recording_name
from vla.rollouts.rollout import rollout
from vla.spec import Episode, Shape

SUCCESS, FAILURE = 1_000_000, 1_000_003  # the toy world fails at seeds that are three more than a multiple of five


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[int, Episode]]:
    folder = tmp_path_factory.mktemp("recordings")
    recorder, environment, agent = RerunRecorder(folder, pictures=0), make_environment(), ThinkingAgent()
    return folder, {seed: rollout(environment, agent, seed, recorder) for seed in (SUCCESS, FAILURE)}


def entities_of(recorded: tuple[Path, dict[int, Episode]], seed: int) -> tuple[Episode, dict[str, dict[str, Any]]]:
    """An episode, and from its recording entity → column → values, static ones included."""
    folder, episodes = recorded
    entities: dict[str, dict[str, Any]] = {}
    file = folder / f"{recording_name(seed, episodes[seed].outcome)}.rrd"
    for chunk in RrdReader(file).stream().to_chunks():
        entities.setdefault(chunk.entity_path, {}).update(chunk.to_record_batch().to_pydict())
    return episodes[seed], entities


def test_every_step_is_recorded(recorded: tuple[Path, dict[int, Episode]]) -> None:
    episode, entities = entities_of(recorded, SUCCESS)
    steps = len(episode.observations)
    per_step = [f"state/{unit}" for unit in ("rad", "rad.s", "m")]
    per_step += ["tokens", "action/m/executed", "action/m/clean", "action/1/executed"]
    per_step += [f"camera/{name}/{kind}" for name in ("front", "wrist") for kind in ("rgb", "depth")]
    for path in per_step:
        assert entities[f"/{path}"]["step"] == list(range(steps)), path
    seconds = [time.total_seconds() for time in entities["/state/rad"]["time"]]
    np.testing.assert_allclose(seconds, np.arange(steps) / 10)
    executed = np.array(entities["/action/m/executed"]["Scalars:scalars"])
    np.testing.assert_allclose(executed, episode.executed[:, :2], atol=1e-7)
    assert entities["/action/m/clean"]["SeriesLines:names"] == [["x, clean", "y, clean"]]


def test_bodies_are_recorded_where_they_move_and_shapes_once(recorded: tuple[Path, dict[int, Episode]]) -> None:
    episode, entities = entities_of(recorded, SUCCESS)
    assert entities["/world/arm.point"]["step"] == list(
        range(len(episode.observations) + 1)
    )  # and where the last action led to
    assert entities["/world/table"]["step"] == [0]
    for solid in ("box", "cylinder", "sphere", "capsule", "mesh"):
        assert "step" not in entities[f"/world/arm.point/{solid}"], solid
    normals = np.array(entities["/world/arm.point/mesh"]["Mesh3D:vertex_normals"][0])
    np.testing.assert_allclose(normals, [[0, 0, 1]] * 3, atol=1e-6)


def test_depth_is_lossless_and_in_millimetres(recorded: tuple[Path, dict[int, Episode]]) -> None:
    episode, entities = entities_of(recorded, SUCCESS)
    depth = entities["/camera/front/depth"]
    image = np.frombuffer(bytes(depth["DepthImage:buffer"][2][0]), np.uint16).reshape(16, 16)
    np.testing.assert_array_equal(image, episode.observations[2].depth["front"])
    assert depth["DepthImage:meter"] == [[1000.0]]


def test_text_tells_what_was_asked_what_happened_and_what_was_drawn(recorded: tuple[Path, dict[int, Episode]]) -> None:
    episode, entities = entities_of(recorded, FAILURE)
    [[instruction]] = entities["/instruction"]["TextDocument:text"]
    assert episode.instruction in instruction
    assert "timeout** after 40 steps, seed 1000003" in instruction
    assert str(episode.draws["colour"]) in entities["/draws"]["TextDocument:text"][0][0]
    facts = entities["/__properties/episode"]
    assert (facts["outcome"], facts["seed"], facts["steps"]) == ([["timeout"]], [[FAILURE]], [[40]])


def test_merged_episodes_stay_apart_and_failures_come_first(
    recorded: tuple[Path, dict[int, Episode]], tmp_path: Path
) -> None:
    folder, episodes = recorded
    again, target = tmp_path / "again", tmp_path / "rollouts.rrd"
    rollout(make_environment(), ThinkingAgent(), SUCCESS, RerunRecorder(again, pictures=0))
    assert sorted(file.name for file in folder.iterdir()) == ["failure-01000003-timeout.rrd", "success-01000000.rrd"]
    merge([*sorted(folder.glob("*.rrd")), *again.glob("*.rrd")], target)
    assert subprocess.run([VIEWER, "rrd", "verify", target], capture_output=True).returncode == 0
    reader = RrdReader(target)
    names = [entry.recording_id.rpartition("-")[0] for entry in reader.recordings()]
    assert names == ["failure-01000003-timeout", "success-01000000", "success-01000000"]
    assert len(reader.blueprints()) == 3
    for entry, seed in zip(reader.recordings(), (FAILURE, SUCCESS, SUCCESS), strict=True):
        [joints] = [
            chunk
            for chunk in reader.stream(store=entry).to_chunks()
            if chunk.entity_path == "/state/rad" and not chunk.is_static
        ]
        assert joints.num_rows == len(episodes[seed].observations)


def test_merging_refuses_nonsense(tmp_path: Path) -> None:
    nonsense = tmp_path / "nonsense.rrd"
    nonsense.write_text("this is no recording")
    with pytest.raises(ValueError, match="could not merge 1 recording into"):
        merge([nonsense], tmp_path / "rollouts.rrd")
    assert list(tmp_path.iterdir()) == [nonsense]


def test_colours_beyond_the_range_are_clipped() -> None:
    rgba = np.array([-0.2, 1.25, 0.5, 1])
    shape = Shape("table", "top", "box", np.zeros(3), np.array([1.0, 0, 0, 0]), np.ones(3), rgba)
    assert recorder._solid(shape).colors.as_arrow_array().to_pylist() == [0x00FF80FF]


@pytest.mark.parametrize("components", [56, 60])
def test_probabilities_of_many_components_have_a_row_each(components: int) -> None:
    writer, shades = _Writer(Mock(), Mock(action=[*map(str, range(components))])), Mock()
    writer._shades = shades  # type: ignore[method-assign]
    writer.tokens(np.arange(2), np.full((2, components, 16), 1 / 16))
    pixels = shades.call_args.args[2]
    assert pixels.shape == (2, components, TOKENS[1]) and (pixels == 255).all()


def test_recordings_leave_no_threads_behind(tmp_path: Path) -> None:
    recorder, environment, agent = RerunRecorder(tmp_path, pictures=0), make_environment(), ThinkingAgent()
    threads = []
    for seed in range(SUCCESS, SUCCESS + 3):
        rollout(environment, agent, seed, recorder)
        threads.append(Process().num_threads())
    assert len(set(threads)) == 1
