"""LeRobot datasets that were merged, cut, relabelled or copied by halves are read as they are, or refused."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from defaults import defaults_of
from lerobot_files import (
    EPISODES,
    PICTURE,
    ROWS,
    VIDEO,
    as_file,
    as_pictures,
    changed_info,
    changed_table,
    copied,
    demonstrations,
    imported,
    made,
    png,
)
from PIL import Image
from toy import ARM_SPEC
from toy_episodes import content

from vla.data.datamodule import held_out
from vla.data.episodes import EpisodeStore
from vla.data.formats.lerobot_images import decode, encode, require_video
from vla.data.formats.lerobot_import import LeRobotDemonstrations

FRONT = "observation.images.front"


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """See `made`, with the `imported` store of the dataset."""
    home = made(tmp_path_factory.mktemp("home"))
    imported(home / "dataset", home / "imported")
    return home


def spread(dataset: Path) -> Path:
    """Move the first two episodes into a file after that of the third one; the metadata stay as they are."""
    rows = pq.read_table(dataset / ROWS)
    third = np.array(rows["episode_index"]) == 2
    pq.write_table(rows.filter(pa.array(third)), dataset / ROWS)
    pq.write_table(rows.filter(pa.array(~third)), dataset / ROWS.replace("file-000", "file-001"))
    return dataset


def test_rows_are_found_wherever_they_are(home: Path, tmp_path: Path) -> None:
    dataset = spread(copied(home, tmp_path / "dataset"))
    changed_table(dataset / EPISODES, "data/file_index", lambda table: pa.array([7] * len(table)))
    imported(dataset, tmp_path / "store")
    assert content(tmp_path / "store") == content(home / "imported")
    after = imported(spread(as_pictures(home, tmp_path / "pictures")), tmp_path / "drawn")
    before = EpisodeStore(home / "store")
    for there, here in zip(before.episodes, after.episodes, strict=True):
        for name in ("state", "action", "rgb_front"):
            np.testing.assert_array_equal(after.read(here)[name], before.read(there)[name])
    (dataset / ROWS).unlink()
    with pytest.raises(ValueError, match=r"data holds 0 of the \d+ steps of episode 2: copy the dataset again"):
        demonstrations(dataset, ARM_SPEC)


def test_a_column_that_a_later_file_lacks_is_named_before_the_import(home: Path, tmp_path: Path) -> None:
    dataset = spread(as_pictures(home, tmp_path / "dataset"))
    path = dataset / ROWS.replace("file-000", "file-001")
    pq.write_table(pq.read_table(path).drop_columns([FRONT]), path)
    with pytest.raises(ValueError, match=rf"file-001\.parquet lacks the columns {FRONT}: correct the dataset"):
        demonstrations(dataset, ARM_SPEC)


def without_second(dataset: Path) -> Path:
    """Leave out the second episode as a person does by hand."""
    for path in (dataset / EPISODES, dataset / ROWS):
        table = pq.read_table(path)
        pq.write_table(table.filter(pa.array(np.array(table["episode_index"]) != 1)), path)
    return dataset


def test_half_a_dataset_is_refused(home: Path, tmp_path: Path) -> None:
    dataset = without_second(copied(home, tmp_path / "dataset"))
    for build in (lambda: demonstrations(dataset, ARM_SPEC), lambda: recording(dataset)):
        with pytest.raises(
            ValueError,
            match=r"lists 2 of the 3 episodes that meta/info\.json counts: copy the dataset again .* or correct total_",
        ):
            build()
    longer = changed_info(home, tmp_path / "longer", lambda info: info.update(total_frames=1000))
    with pytest.raises(ValueError, match=r"lists \d+ of the 1000 frames that meta/info\.json counts: copy"):
        demonstrations(longer, ARM_SPEC)


def test_numbers_of_episodes_may_have_holes(home: Path, tmp_path: Path) -> None:
    dataset = without_second(changed_info(home, tmp_path, lambda info: info.update(total_episodes=2, total_frames=2)))
    found, whole = imported(dataset, tmp_path / "store", 2), EpisodeStore(home / "imported")
    assert [(entry.seed, entry.recording) for entry in found.episodes] == [(0, 0), (1, 2)]
    for name, values in found.read(found.episodes[1]).items():
        np.testing.assert_array_equal(values, whole.read(whole.episodes[2])[name])


def recording(dataset: Path, **options: Any) -> Any:
    return LeRobotDemonstrations.recording(**defaults_of("expert/lerobot", folder=dataset, **options))


def relabelled(home: Path, tmp_path: Path, tasks: Callable[[pa.Table], list[int]]) -> Path:
    """A copy whose steps have the tasks "reach", 0, and "grasp", 1, and no velocities."""
    dataset = changed_info(home, tmp_path, lambda info: info["features"].pop("velocities"))
    pq.write_table(pa.table({"task_index": [0, 1], "task": ["reach", "grasp"]}), dataset / "meta/tasks.parquet")
    changed_table(dataset / ROWS, "task_index", lambda table: pa.array(tasks(table)))
    return dataset


def test_every_step_has_the_instruction_of_its_task(home: Path, tmp_path: Path, caplog: Any) -> None:
    def from_fourth(table: pa.Table) -> list[int]:
        frames, episodes = np.array(table["frame_index"]), np.array(table["episode_index"])
        return ((frames >= 4) & (episodes < 2)).astype(int).tolist()

    dataset, whole = relabelled(home, tmp_path, from_fourth), EpisodeStore(home / "imported")
    assert recording(dataset).episodes == 5
    caplog.set_level("INFO")
    found = imported(dataset, tmp_path / "store", 5)
    assert "3 episodes become 5" in caplog.text
    assert [entry.instruction for entry in found.episodes] == ["reach", "grasp", "reach", "grasp", "reach"]
    assert [entry.recording for entry in found.episodes] == [0, 0, 1, 1, 2]
    assert [entry.draws["recorded"]["first_step"] for entry in found.episodes] == [0, 4, 0, 4, 0]
    for name in ("state", "action", "executed", "rgb_front"):
        there = np.concatenate([whole.read(entry)[name] for entry in whole.episodes])
        here = np.concatenate([found.read(entry)[name] for entry in found.episodes])
        if name == "state":  # the joints' velocities are differences, across a change of the task as well
            joints, starts = there[:, :7], [entry.start for entry in whole.episodes]
            there[:, 7:14] = np.diff(joints, axis=0, prepend=joints[:1]) * np.float32(10)
            there[starts, 7:14] = 0
        np.testing.assert_allclose(here, there, rtol=1e-6)
    for fraction in np.linspace(0, 1, 11):  # what shows the same scene is on the same side
        sides = [held_out(entry.recording, fraction) for entry in found.episodes]
        assert sides[0] == sides[1] and sides[2] == sides[3]


def test_kept_frames_begin_anew_where_the_task_changes(home: Path, tmp_path: Path) -> None:
    def first_three(table: pa.Table) -> list[int]:
        return (np.array(table["frame_index"]) >= 3).astype(int).tolist()

    spec = ARM_SPEC.from_dict({**ARM_SPEC.to_dict(), "control_hz": 5.0}, "test")
    expert = demonstrations(relabelled(home, tmp_path, first_three), spec, every=2)
    whole = demonstrations(home / "dataset", ARM_SPEC).episode(0)
    np.testing.assert_array_equal(expert.episode(0).actions, whole.actions[[1, 2]])  # not the action of "grasp"
    np.testing.assert_array_equal(expert.episode(1).actions, whole.actions[[4, 6, 8, 10, 11]])
    for seen, step in zip(expert.episode(1).observations, range(3, 12, 2), strict=True):
        np.testing.assert_array_equal(seen.rgb["front"], whole.observations[step].rgb["front"])


def test_a_task_that_is_nowhere_is_named(home: Path, tmp_path: Path) -> None:
    dataset = relabelled(home, tmp_path, lambda table: [7] * len(table))
    with pytest.raises(ValueError, match=r"tasks\.parquet lacks task 7, which episode 0 has: correct the dataset"):
        demonstrations(dataset, ARM_SPEC)


def test_tasks_may_have_further_columns(home: Path, tmp_path: Path) -> None:
    dataset = copied(home, tmp_path / "dataset")
    path = dataset / "meta/tasks.parquet"
    tasks = pq.read_table(path)
    more = tasks.append_column("by", pa.array(["me"] * len(tasks))).append_column("n", pa.array([1] * len(tasks)))
    pq.write_table(more, path)
    imported(dataset, tmp_path / "store")
    assert content(tmp_path / "store") == content(home / "imported")
    pq.write_table(more.rename_columns([name if name != "task" else "text" for name in more.column_names]), path)
    with pytest.raises(ValueError, match=r"has the columns task_index, text, by, n, none of them task with texts"):
        demonstrations(dataset, ARM_SPEC)


@pytest.mark.parametrize(("begin", "kind"), [(3.4, pa.float32()), (1.7e9, pa.float64())], ids=["later", "clock"])
def test_time_stamps_may_begin_anywhere(home: Path, tmp_path: Path, begin: float, kind: pa.DataType) -> None:
    dataset = copied(home, tmp_path / "dataset")
    changed_table(
        dataset / ROWS,
        "timestamp",
        lambda table: pa.array(np.array(table["timestamp"], float) + begin, pa.float64()).cast(kind, safe=False),
    )
    imported(dataset, tmp_path / "store")
    assert content(tmp_path / "store") == content(home / "imported")


def test_images_of_cut_steps_stay_with_the_steps_that_are_left(home: Path, tmp_path: Path) -> None:
    dataset = changed_info(home, tmp_path, lambda info: info.update(total_frames=0))
    rows, metadata = pq.read_table(dataset / ROWS), pq.read_table(dataset / EPISODES).to_pylist()
    kept = (np.array(rows["frame_index"]) >= 2) | (np.array(rows["episode_index"]) != 1)
    pq.write_table(rows.filter(pa.array(kept)), dataset / ROWS)  # the videos, and their times, stay as they are
    metadata[1]["dataset_to_index"] -= 2
    pq.write_table(pa.Table.from_pylist(metadata), dataset / EPISODES)
    found, whole = imported(dataset, tmp_path / "store"), EpisodeStore(home / "imported")
    for name in ("rgb_front", "action"):
        expected = whole.read(whole.episodes[1])[name][2:]
        np.testing.assert_array_equal(found.read(found.episodes[1])[name], expected)


def stamped(home: Path, folder: Path, times: Callable[[np.ndarray], np.ndarray]) -> Path:
    """A copy with other time stamps in the second episode."""
    dataset = copied(home, folder)

    def changed(table: pa.Table) -> pa.Array:
        stamps = np.array(table["timestamp"])
        second = np.array(table["episode_index"]) == 1
        stamps[second] = times(stamps[second])
        return pa.array(stamps, pa.float32())

    changed_table(dataset / ROWS, "timestamp", changed)
    return dataset


def test_time_stamps_follow_the_rate_that_cameras_have(home: Path, tmp_path: Path) -> None:
    imported(stamped(home, tmp_path / "nearly", lambda times: times * 1.001), tmp_path / "store")  # 29.97 for 30 Hz
    assert content(tmp_path / "store") == content(home / "imported")
    for number, (change, says) in enumerate({
        r"step 3 of episode 1 comes 0\.36 s after its first one, but at 10 Hz, .* it is 0\.3 s: correct fps":
            lambda times: times * 1.2,
        r"step 3 of episode 1 comes 0\.5 s after its first one, but at 10 Hz, .* it is 0\.3 s":
            lambda times: times + 0.2 * (times > 0.25),
        r"timestamp is nan at index 0 in episode 1, step 2: correct the numbers, or delete the episodes":
            lambda times: np.where(np.arange(len(times)) == 2, np.nan, times),
    }.items()):  # fmt: skip
        with pytest.raises(ValueError, match=change) as caught:
            demonstrations(stamped(home, tmp_path / str(number), says), ARM_SPEC)
        assert "copy the dataset" not in str(caught.value)


def test_a_task_of_nearly_the_same_rate_takes_the_dataset(home: Path) -> None:
    spec = ARM_SPEC.from_dict({**ARM_SPEC.to_dict(), "control_hz": 9.99}, "test")
    assert len(demonstrations(home / "dataset", spec)) == 3


def test_the_rate_of_a_video_is_that_of_the_video(home: Path, tmp_path: Path) -> None:
    def rounded(info: Any) -> None:  # as LeRobot does: it notes 29 for 29.97
        info["features"][FRONT]["info"]["video.fps"] = 9

    imported(changed_info(home, tmp_path, rounded), tmp_path / "store")
    assert content(tmp_path / "store") == content(home / "imported")


def test_images_that_drift_away_from_their_steps_are_refused(tmp_path: Path) -> None:
    clip = np.repeat(np.arange(0, 240, 4, dtype=np.uint8), 16 * 16 * 3).reshape(60, 16, 16, 3)
    encode(tmp_path / "video.mp4", [clip], (16, 16), Fraction(999, 100), 5)
    for fps, count in ((Fraction(10), 60), (Fraction(999, 100), 60), (Fraction(99, 10), 40)):
        require_video(tmp_path / "video.mp4", (16, 16), fps, count)
        found = np.stack([*decode(tmp_path / "video.mp4", 0.0, count, fps, (16, 16))])
        assert np.abs(found.astype(int) - clip[:count]).max() <= 3
    with pytest.raises(
        ValueError, match=r"has 9\.99 images per second, the dataset 9\.9: encode .* or write its own as f"
    ):
        require_video(tmp_path / "video.mp4", (16, 16), Fraction(99, 10), 60)
    with pytest.raises(ValueError, match=r"has 9\.99 images per second, the dataset 20"):
        require_video(tmp_path / "video.mp4", (16, 16), Fraction(20), 10)


def test_a_number_that_is_none_is_named_by_episode_and_step(home: Path, tmp_path: Path) -> None:
    dataset = copied(home, tmp_path / "dataset")

    def broken(table: pa.Table) -> pa.Array:
        values, owner = table["action"].to_pylist(), np.array(table["episode_index"])
        first = int(np.argmax(owner == 1))
        values[first + 3][1] = float("nan")
        values[first + 4][2] = None
        return pa.array(values, pa.list_(pa.float32()))

    changed_table(dataset / ROWS, "action", broken)
    for build in (lambda: demonstrations(dataset, ARM_SPEC), lambda: recording(dataset)):
        with pytest.raises(
            ValueError, match=r"action is nan at index 1 in episode 1, step 3, as in 1 other steps: correct the numbers"
        ) as caught:
            build()
        assert "copy the dataset" not in str(caught.value)


@pytest.mark.parametrize(
    ("packed", "channels", "mode"),
    [
        (lambda image: as_file(image, "JPEG", quality=95, subsampling=0), 3, "RGB"),
        (lambda image: as_file(image, "WEBP", lossless=True), 3, "RGB"),
        (lambda image: png(image.convert("RGBA")), 4, "RGB"),
        (lambda image: png(image.convert("L")), 1, "L"),
        (lambda image: as_file(image.convert("L"), "JPEG", quality=95), 1, "L"),
    ],
    ids=["jpeg", "webp", "rgba", "grey", "grey_jpeg"],
)
def test_images_in_tables_are_of_many_kinds(
    home: Path, tmp_path: Path, packed: Callable[[Image.Image], bytes], channels: int, mode: str
) -> None:
    found = demonstrations(as_pictures(home, tmp_path / "dataset", packed, channels), ARM_SPEC).episode(1)
    store = EpisodeStore(home / "store")
    for seen, there in zip(found.observations, store.read(store.episodes[1])["rgb_front"], strict=True):
        expected = np.asarray(Image.fromarray(there).convert(mode).convert("RGB"))
        assert np.abs(seen.rgb["front"].astype(int) - expected).mean() < (3 if "JPEG" in str(packed) else 6)


def test_images_beside_the_tables_are_read_within_the_dataset_only(home: Path, tmp_path: Path) -> None:
    dataset = as_pictures(home, tmp_path / "dataset")
    images = pq.read_table(dataset / ROWS)[FRONT].to_pylist()
    (dataset / "images").mkdir()
    for number, image in enumerate(images):
        (dataset / f"images/{number}.png").write_bytes(image["bytes"])
    paths = [{"bytes": None, "path": f"images/{number}.png"} for number in range(len(images))]
    changed_table(dataset / ROWS, FRONT, lambda table: pa.array(paths, PICTURE))
    found, store = demonstrations(dataset, ARM_SPEC).episode(2), EpisodeStore(home / "store")
    expected = store.read(store.episodes[2])["rgb_front"]
    np.testing.assert_array_equal(np.stack([seen.rgb["front"] for seen in found.observations]), expected)
    shutil.move(dataset / "images/0.png", tmp_path / "0.png")
    for target in ("images/0.png", "../0.png", str(tmp_path / "0.png")):
        paths[0]["path"] = target
        changed_table(dataset / ROWS, FRONT, lambda table: pa.array(paths, PICTURE))
        with pytest.raises(ValueError, match=rf"of episode 0, step 0: the table has no image but the path '{target}'"):
            demonstrations(dataset, ARM_SPEC)
        (dataset / "images/0.png").unlink(missing_ok=True)
        (dataset / "images/0.png").symlink_to(tmp_path / "0.png")  # which leads out of the dataset


def test_info_of_another_kind_is_not_to_be_copied_again(home: Path, tmp_path: Path) -> None:
    wrong = changed_info(home, tmp_path / "wrong", lambda info: info.update(fps=0))
    with pytest.raises(ValueError, match=r"fps: Input should be greater than 0") as caught:
        demonstrations(wrong, ARM_SPEC)
    assert "copy the dataset" not in str(caught.value)
    (wrong / "meta/info.json").write_text(json.dumps({"codebase_version": "v3.0"})[:-3])
    with pytest.raises(ValueError, match=r"copy the dataset again"):
        demonstrations(wrong, ARM_SPEC)
    short = copied(home, tmp_path / "short")
    (short / f"{VIDEO}chunk-000/file-000.mp4").unlink()
    with pytest.raises(ValueError, match=rf"lacks {VIDEO}chunk-000/file-000\.mp4: copy the dataset again"):
        demonstrations(short, ARM_SPEC)
