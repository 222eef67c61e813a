"""A LeRobot dataset says the same as the store it came from, to whoever reads the layout."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections import Counter
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pyarrow.parquet as pq
import pytest
from exporting import content, exporter, stored
from lerobot_files import EPISODES, INFO, ROWS, TASKS
from rerun.chunk import RrdReader
from toy import ARM_SPEC

from vla.data.episodes import EpisodeStore
from vla.data.formats.lerobot_images import decode, encode
from vla.io.errors import UserError


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A `store` of seven episodes, and the `dataset` made of it, with two videos per camera."""
    home = tmp_path_factory.mktemp("home")
    store, _ = stored(home / "store", seeds=range(8))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("vla.data.formats.lerobot_export.EPISODES_PER_VIDEO", 4)
        exporter("lerobot", home / "dataset").export(store)
    return home


@pytest.mark.skipif(sys.platform != "linux", reason="the encoder asks for real-time priority on Linux only")
def test_a_video_leaves_the_priority_of_all_threads(tmp_path: Path) -> None:
    encode(tmp_path / "video.mp4", np.zeros((1, 3, 64, 64, 3), np.uint8), (64, 64), Fraction(10), 30)
    assert os.SCHED_FIFO not in {os.sched_getscheduler(int(thread)) for thread in os.listdir("/proc/self/task")}


def test_frames_before_a_key_frame_are_found_though_they_need_the_one_before_it(tmp_path: Path) -> None:
    """In open groups of pictures, as encoders of HEVC write them."""
    path, options = tmp_path / "video.mp4", {"g": "8", "x264-params": "open-gop=1:bframes=3:b-adapt=0:scenecut=0"}
    with av.open(path, "w", format="mp4") as file:
        stream = file.add_stream("libx264", rate=10, options=options)
        stream.width, stream.height, stream.pix_fmt = 64, 64, "yuv420p"
        stream.codec_context.max_b_frames = 3
        for level in range(20, 200, 5):
            file.mux(stream.encode(av.VideoFrame.from_ndarray(np.full((64, 64, 3), level, np.uint8), format="rgb24")))
        file.mux(stream.encode(None))
    frames = list(decode(path, 0.0, 36, Fraction(10), (64, 64)))
    assert len(frames) == 36
    for start in range(35):
        found = list(decode(path, start / 10, 2, Fraction(10), (64, 64)))
        np.testing.assert_array_equal(found, frames[start : start + 2])
    with pytest.raises(UserError, match=r"lacks the frame at 3\.600 s"):
        list(decode(path, 3.0, 7, Fraction(10), (64, 64)))


def test_every_row_is_that_of_the_store(home: Path) -> None:
    store = EpisodeStore(home / "store")
    rows, episodes = pq.read_table(home / "dataset" / ROWS), pq.read_table(home / "dataset" / EPISODES).to_pylist()
    tasks = {row["task_index"]: row["task"] for row in pq.read_table(home / "dataset" / TASKS).to_pylist()}
    info = json.loads((home / "dataset" / INFO).read_text())
    assert (info["codebase_version"], info["fps"]) == ("v3.0", 10)
    assert (info["total_episodes"], info["total_frames"], info["total_tasks"]) == (7, len(rows), 2)
    assert len(store.episodes) == len(episodes) == 7
    for number, (entry, episode) in enumerate(zip(store.episodes, episodes, strict=True)):
        expected, begin, end = store.read(entry), episode["dataset_from_index"], episode["dataset_to_index"]
        here = rows.slice(begin, end - begin).to_pydict()
        np.testing.assert_array_equal(np.float32(here["observation.state"]), expected["state"][:, ARM_SPEC.pose])
        np.testing.assert_array_equal(np.float32(here["velocities"]), expected["state"][:, ARM_SPEC.rates])
        for name in ("action", "executed"):
            np.testing.assert_array_equal(np.float32(here[name]), expected[name])
        assert here["index"] == list(range(begin, end)) and here["frame_index"] == list(range(entry.steps))
        assert here["episode_index"] == [number] * entry.steps and episode["length"] == entry.steps
        np.testing.assert_allclose(here["timestamp"], np.arange(entry.steps) / 10, rtol=1e-6)
        assert {tasks[index] for index in here["task_index"]} == {entry.instruction} == set(episode["tasks"])


def test_every_image_is_close_to_that_of_the_store(home: Path) -> None:
    store = EpisodeStore(home / "store")
    episodes = pq.read_table(home / "dataset" / EPISODES).to_pylist()
    assert {episode["videos/observation.images.front/file_index"] for episode in episodes} == {0, 1}
    for entry, episode in zip(store.episodes, episodes, strict=True):
        expected = store.read(entry)
        for camera in ARM_SPEC.cameras:
            video = f"videos/observation.images.{camera}"
            file = home / "dataset" / video / f"chunk-000/file-{episode[f'{video}/file_index']:03d}.mp4"
            begin, end = episode[f"{video}/from_timestamp"], episode[f"{video}/to_timestamp"]
            assert end - begin == pytest.approx(episode["length"] / 10)
            images = np.stack([*decode(file, begin, episode["length"], Fraction(10), ARM_SPEC.image_size)])
            green = images[..., 1].mean((1, 2))  # counts the steps in the toy world
            np.testing.assert_allclose(green, expected[f"rgb_{camera}"][..., 1].mean((1, 2)), atol=6)


def test_statistics_are_those_of_all_rows_and_pixels(home: Path) -> None:
    store = EpisodeStore(home / "store")
    statistics = json.loads((home / "dataset/meta/stats.json").read_text())
    action, pixels = store.rows("action")[:].astype(float), store.rows("rgb_wrist")[:].reshape(-1, 3) / 255
    found, image = statistics["action"], statistics["observation.images.wrist"]
    for name in ("min", "max", "mean", "std"):
        np.testing.assert_allclose(found[name], getattr(action, name)(0), atol=1e-12)
        np.testing.assert_allclose(np.reshape(image[name], 3), getattr(pixels, name)(0), atol=1e-6)
    np.testing.assert_allclose(found["q10"], np.quantile(action, 0.1, axis=0), atol=1e-12)
    np.testing.assert_allclose(np.reshape(image["q90"], 3), np.quantile(pixels, 0.9, axis=0), atol=1 / 255)
    assert found["count"] == image["count"] == [len(action)]
    first = pq.read_table(home / "dataset" / EPISODES).to_pylist()[0]
    np.testing.assert_allclose(first["stats/action/max"], store.read(store.episodes[0])["action"].max(0))
    assert np.shape(first["stats/observation.images.front/mean"]) == (3, 1, 1)
    assert first["stats/observation.images.front/count"] == [first["length"]]


def test_rerun_opens_it(home: Path, tmp_path: Path) -> None:
    store, recording = EpisodeStore(home / "store"), tmp_path / "dataset.rrd"
    command = [sys.executable, "-m", "rerun", home / "dataset", "--bind", "127.0.0.1", "--save", recording]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0 and "WARN" not in done.stdout + done.stderr, done.stdout + done.stderr
    reader = RrdReader(recording)
    assert len(reader.recordings()) == len(store.episodes)
    for entry, one in zip(store.episodes, sorted(reader.recordings(), key=lambda one: one.recording_id), strict=True):
        frames: Counter[str] = Counter()
        for chunk in reader.stream(store=one):
            if "VideoStream:sample" in chunk.to_record_batch().schema.names:
                frames[chunk.entity_path] += chunk.num_rows
        assert frames == {f"/observation.images.{camera}": entry.steps for camera in ARM_SPEC.cameras}


def test_a_dataset_that_is_there_is_left_alone_and_another_one_is_refused(home: Path, tmp_path: Path) -> None:
    store, before = EpisodeStore(home / "store"), content(home / "dataset")
    stamp = (home / "dataset" / INFO).stat().st_mtime_ns
    exporter("lerobot", home / "dataset").export(store)
    assert (home / "dataset" / INFO).stat().st_mtime_ns == stamp
    with pytest.raises(ValueError, match=r"dataset has content other .*: choose another export\.folder"):
        exporter("lerobot", home / "dataset").export(EpisodeStore(home / "store", episodes=3))
    assert content(home / "dataset") == before
    part = Path(shutil.copytree(home / "dataset", tmp_path / "part"))
    next(part.rglob("*.mp4")).unlink()
    with pytest.raises(ValueError, match=r"part has content other .*: choose another export\.folder"):
        exporter("lerobot", part).export(store)
    shutil.rmtree(part)
    with pytest.raises(ValueError, match=r"export\.crf must be less than or equal to 63, got 64"):
        exporter("lerobot", tmp_path / "none", "export.crf=64")
    with pytest.raises(ValueError, match="no episodes yet"):
        exporter("lerobot", tmp_path / "none").export(EpisodeStore.create_or_open(tmp_path / "empty", ARM_SPEC, {}))
    assert [path.name for path in tmp_path.iterdir()] == ["empty"]
