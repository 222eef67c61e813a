"""LeRobot datasets become episodes to learn from, or one sentence says why they do not fit."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from test_episodes import content
from test_export import stored
from toy import SPEC, ToyEnvironment

from vla.data.episodes import EpisodeStore
from vla.data.lerobot import LeRobot as Export
from vla.data.lerobot_import import LeRobot
from vla.parts import make_expert
from vla.spec import Spec


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A `store` of three episodes, and the `dataset` made of it."""
    home = tmp_path_factory.mktemp("home")
    Export(home / "dataset", crf=5, workers=1).export(stored(home / "store", seeds=range(3))[0])
    return home


def imported(dataset: Path, folder: Path, episodes: int = 3) -> EpisodeStore:
    expert = LeRobot(str(dataset), spec=SPEC)
    store = EpisodeStore.create_or_open(folder, expert.spec, {})
    expert.fill(store, episodes)
    return store


def test_what_was_exported_comes_back(home: Path, tmp_path: Path) -> None:
    before, after = EpisodeStore(home / "store"), imported(home / "dataset", tmp_path / "store")
    assert after.spec == replace(SPEC, truth=()) and "truth" not in after.fields
    for there, here in zip(before.episodes, after.episodes, strict=True):
        assert here.instruction == there.instruction
        expected, rows = before.read(there), after.read(here)
        for name in ("joints", "velocities", "gripper", "action", "executed"):
            np.testing.assert_array_equal(rows[name], expected[name])
        for camera in SPEC.cameras:
            assert np.abs(rows[f"rgb_{camera}"].astype(float) - expected[f"rgb_{camera}"]).mean() < 10
            assert not rows[f"depth_{camera}"].any()
        assert here.draws == {"recorded": {"episode": here.seed, "lacks": ["depth"]}}


def test_depth_comes_back_bit_for_bit_if_it_was_exported(home: Path, tmp_path: Path) -> None:
    before = EpisodeStore(home / "store")
    after = imported(Export(tmp_path / "dataset", depth=True, workers=1).export(before), tmp_path / "store")
    for there, here in zip(before.episodes, after.episodes, strict=True):
        expected, rows = before.read(there), after.read(here)
        for camera in SPEC.cameras:
            np.testing.assert_array_equal(rows[f"depth_{camera}"], expected[f"depth_{camera}"])
        assert here.draws["recorded"]["lacks"] == []


def test_an_import_goes_on_where_it_was(home: Path, tmp_path: Path) -> None:
    imported(home / "dataset", tmp_path / "store", episodes=1)
    imported(home / "dataset", tmp_path / "store")
    imported(home / "dataset", tmp_path / "whole")
    assert content(tmp_path / "store") == content(tmp_path / "whole")
    with pytest.raises(ValueError, match=r"only 3 recorded episodes: set collect\.episodes=3"):
        imported(home / "dataset", tmp_path / "store", episodes=4)
    other = Export(tmp_path / "other", workers=1).export(stored(tmp_path / "another", seeds=range(4, 7))[0])
    with pytest.raises(ValueError, match=r"holds other episodes than are recorded now: choose another collect\.folder"):
        imported(other, tmp_path / "store")


def changed_info(home: Path, tmp_path: Path, change: Callable[[Any], None]) -> Path:
    """A copy of the dataset whose description was changed."""
    dataset = Path(shutil.copytree(home / "dataset", tmp_path / "dataset"))
    info = json.loads((dataset / "meta/info.json").read_text())
    change(info)
    (dataset / "meta/info.json").write_text(json.dumps(info))
    return dataset


def test_what_other_people_leave_out_is_made_up_and_said(home: Path, tmp_path: Path) -> None:
    def change(info: Any) -> None:
        features = info["features"]
        del features["executed"], features["velocities"]
        features["action"]["names"] = None  # anonymous components count as ours
        features["observation.state"]["names"] = {"motors": [*SPEC.joints, "gripper"]}
        features["observation.images.front"] |= {"shape": [3, 16, 16], "names": ["channels", "height", "width"]}

    dataset = changed_info(home, tmp_path, change)
    path = dataset / "meta/tasks.parquet"  # as pandas writes an index without a name
    tasks = pq.read_table(path)
    pq.write_table(tasks.rename_columns(["task_index", "__index_level_0__"]).cast(
        pa.schema([("task_index", pa.int64()), ("__index_level_0__", pa.large_string())])), path)  # fmt: skip
    store = imported(dataset, tmp_path / "store")
    assert store.episodes[0].draws["recorded"]["lacks"] == ["depth", "executed", "velocities"]
    rows = store.read(store.episodes[0])
    np.testing.assert_array_equal(rows["executed"], rows["action"])
    np.testing.assert_allclose(rows["velocities"][1:], np.diff(rows["joints"], axis=0) * 10, rtol=1e-6)
    assert not rows["velocities"][0].any()


@pytest.mark.parametrize(
    ("spec", "says"),
    [
        (replace(SPEC, control_hz=20.0), r"a rate of 10, but the task has 20\.0"),
        (replace(SPEC, cameras=("side",)), r"no video observation\.images\.side, .* it has observation\.images\.front"),
        (replace(SPEC, image_size=(16, 32)), r"observation\.images\.front of \[16, 16\], but the task has \[16, 32\]"),
        (replace(SPEC, joints=SPEC.joints[:6]), r"observation\.state of shape \[8\], but the task has \[7\]"),
        (replace(SPEC, action=("x", "z", "gripper")), r"action of \['x', 'y', .*but the task has \['x', 'z'"),
        (replace(SPEC, high=(0.01, 0.01, 1.0)), r"actions x from .* to 0\.01 m: are they in other units, or absolute"),
    ],
    ids=["rate", "camera", "size", "joints", "names", "units"],
)
def test_the_first_difference_from_the_task_is_named(home: Path, spec: Spec, says: str) -> None:
    with pytest.raises(ValueError, match=says):
        LeRobot(str(home / "dataset"), spec=spec)


def test_a_recording_does_not_act(home: Path) -> None:
    node = {"_target_": "vla.data.lerobot_import.LeRobot", "folder": str(home / "dataset")}
    with pytest.raises(ValueError, match="cannot act: this job needs another expert"):
        make_expert(node, ToyEnvironment())


def test_what_cannot_be_read_is_named(home: Path, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"expert\.folder=DIR"):
        LeRobot(spec=SPEC)
    with pytest.raises(ValueError, match=r"no LeRobot dataset in .*nowhere"):
        LeRobot(str(tmp_path / "nowhere"), spec=SPEC)
    old = changed_info(home, tmp_path / "old", lambda info: info.update(codebase_version="v2.1"))
    with pytest.raises(ValueError, match=r"version v2\.1: convert it to v3\.0"):
        LeRobot(str(old), spec=SPEC)
    with pytest.raises(ValueError, match=r"info\.json cannot be read"):
        LeRobot(str(changed_info(home, tmp_path / "bare", lambda info: info.pop("features"))), spec=SPEC)
    for name, says in {
        "data/chunk-000/file-000.parquet": "cannot be read",
        "meta/episodes/chunk-000/file-000.parquet": "cannot be read",
        "meta/tasks.parquet": "cannot be read",
        "videos/observation.images.wrist/chunk-000/file-000.mp4": "cannot be read as a video",
    }.items():
        dataset = Path(shutil.copytree(home / "dataset", tmp_path / name.replace("/", "_")))
        (dataset / name).write_bytes((dataset / name).read_bytes()[:100])
        with pytest.raises(ValueError, match=says):
            LeRobot(str(dataset), spec=SPEC).episode(0)


def test_an_episode_that_the_data_does_not_hold_is_refused(home: Path, tmp_path: Path) -> None:
    dataset = Path(shutil.copytree(home / "dataset", tmp_path / "dataset"))
    path = dataset / "data/chunk-000/file-000.parquet"
    rows = pq.read_table(path)
    pq.write_table(rows.slice(0, len(rows) - 1), path)
    with pytest.raises(ValueError, match="says of episode 2 what its data does not hold"):
        LeRobot(str(dataset), spec=SPEC)
