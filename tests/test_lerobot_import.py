"""LeRobot datasets become episodes to learn from, or one sentence says why they do not fit."""

from __future__ import annotations

import os
import shutil
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from defaults import defaults_of
from exporting import exporter, stored
from lerobot_files import (
    EPISODES,
    PICTURE,
    ROWS,
    VIDEO,
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
from toy import ARM, ARM_SPEC, make_arm
from toy_episodes import content

from vla.config.experiment import make_agent
from vla.data.episodes import EpisodeStore
from vla.data.formats import lerobot_tables as tables
from vla.data.formats.video import encode
from vla.spec import Spec

OTHER = replace(ARM_SPEC, state=("north", "south"), state_units=("m", "m"), robot=None)


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """See `made`."""
    return made(tmp_path_factory.mktemp("home"))


def test_what_was_exported_comes_back(home: Path, tmp_path: Path) -> None:
    before, after = EpisodeStore(home / "store"), imported(home / "dataset", tmp_path / "store")
    assert after.spec == replace(ARM_SPEC, truth=()) and "truth" not in after.fields
    for there, here in zip(before.episodes, after.episodes, strict=True):
        assert here.instruction == there.instruction
        expected, rows = before.read(there), after.read(here)
        for name in ("state", "action", "executed"):
            np.testing.assert_array_equal(rows[name], expected[name])
        for camera in ARM_SPEC.cameras:
            assert np.abs(rows[f"rgb_{camera}"].astype(float) - expected[f"rgb_{camera}"]).mean() < 10
            assert not rows[f"depth_{camera}"].any()
        assert here.draws == {"recorded": {"episode": here.seed, "lacks": ["depth"], "first_step": 0}}


def test_depth_comes_back_bit_for_bit_if_it_was_exported(home: Path, tmp_path: Path) -> None:
    before = EpisodeStore(home / "store")
    after = imported(exporter("lerobot", tmp_path / "dataset", "export.depth=true").export(before), tmp_path / "store")
    for there, here in zip(before.episodes, after.episodes, strict=True):
        expected, rows = before.read(there), after.read(here)
        for camera in ARM_SPEC.cameras:
            np.testing.assert_array_equal(rows[f"depth_{camera}"], expected[f"depth_{camera}"])
        assert here.draws["recorded"]["lacks"] == []


def test_an_import_goes_on_where_it_was(home: Path, tmp_path: Path) -> None:
    imported(home / "dataset", tmp_path / "store", episodes=1)
    imported(home / "dataset", tmp_path / "store")
    imported(home / "dataset", tmp_path / "whole")
    assert content(tmp_path / "store") == content(tmp_path / "whole")
    with pytest.raises(ValueError, match=r"only 3 recorded episodes: set collect\.episodes=3"):
        imported(home / "dataset", tmp_path / "store", episodes=4)
    other = exporter("lerobot", tmp_path / "other").export(stored(tmp_path / "another", seeds=range(4, 7))[0])
    with pytest.raises(ValueError, match=r"holds other episodes than these: choose another collect\.folder"):
        imported(other, tmp_path / "store")


def test_what_other_people_leave_out_is_made_up_and_said(home: Path, tmp_path: Path) -> None:
    def change(info: Any) -> None:
        features = info["features"]
        del features["executed"], features["velocities"]
        features["action"]["names"] = None  # anonymous components count as ours
        features["observation.state"]["names"] = {"motors": [*ARM.joints, "gripper"]}
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
    velocities = rows["state"][:, 7:14]
    np.testing.assert_allclose(velocities[1:], np.diff(rows["state"][:, :7], axis=0) * 10, rtol=1e-6)
    assert not velocities[0].any()


def test_more_components_than_memory_holds_are_refused(home: Path, tmp_path: Path) -> None:
    dataset = changed_info(home, tmp_path, lambda info: info["features"]["action"].update(shape=[10**9]))
    with pytest.raises(ValueError, match="1000000000 components in action, the limit is 10000"):
        demonstrations(str(dataset), ARM_SPEC)


@pytest.mark.parametrize(
    ("spec", "says"),
    [
        (replace(ARM_SPEC, control_hz=20.0), r"a rate of 10 Hz, the task has 20 Hz"),
        (
            replace(ARM_SPEC, cameras=("side", "top"), depth=()),
            r"no images of side and top, it has front, wrist",
        ),
        (OTHER, r"state of 15 numbers \(joint1, .*\), the task has 2 \(north, south\)"),
        (replace(ARM_SPEC, action=("x", "z", "gripper")), r"action of 3 numbers \(x, y, .*has 3 \(x, z, gripper\)"),
        (
            replace(ARM_SPEC, high=(0.01, 0.01, 0.5)),
            r"x in action from .* 0\.01 m, beyond which are \d+% \(other units, or absolute\?\); y .*; "
            r"gripper .* has 0 to 0\.5, beyond which are \d+% \(other units",
        ),
    ],
    ids=["rate", "camera", "joints", "names", "units"],
)
def test_differences_from_the_task_are_named(home: Path, spec: Spec, says: str) -> None:
    with pytest.raises(ValueError, match=rf"dataset does not match the task: .*{says}"):
        demonstrations(str(home / "dataset"), spec)


def test_all_differences_are_named_at_once(home: Path, tmp_path: Path) -> None:
    other = replace(OTHER, control_hz=20.0, cameras=("side",), depth=(), action=("a", "b", "c"))
    with pytest.raises(ValueError) as caught:
        demonstrations(str(home / "dataset"), other)
    assert [difference.split(" ")[0] for difference in str(caught.value).split(": ", 1)[1].split("; ")] == [
        "a", "no", "state", "action"
    ]  # fmt: skip

    def foreign(info: Any) -> None:
        del info["features"]["observation.images.front"], info["features"]["observation.images.wrist"]
        info["features"]["action"] = {"dtype": "float32", "shape": [6], "names": None}

    with pytest.raises(
        ValueError, match=r"it has none at all; action of 6 numbers \(action_0, .*, the task has 3 \(x, y, grip"
    ):
        demonstrations(str(changed_info(home, tmp_path, foreign)), ARM_SPEC)


def test_pictures_in_the_table_come_back_bit_for_bit(home: Path, tmp_path: Path) -> None:
    before, after = EpisodeStore(home / "store"), imported(as_pictures(home, tmp_path / "data"), tmp_path / "store")
    for there, here in zip(before.episodes, after.episodes, strict=True):
        expected, rows = before.read(there), after.read(here)
        for camera in ARM_SPEC.cameras:
            np.testing.assert_array_equal(rows[f"rgb_{camera}"], expected[f"rgb_{camera}"])


def test_pictures_of_another_kind_are_refused_by_name(home: Path, tmp_path: Path) -> None:
    path, key = "data/chunk-000/file-000.parquet", "observation.images.front"
    with pytest.raises(ValueError, match=rf"{key} of episode 0, step 0: the image is 300 x 400 pixels of RGB, not 16"):
        demonstrations(as_pictures(home, tmp_path / "large", lambda image: png(image.resize((400, 300)))), ARM_SPEC)
    deep = as_pictures(home, tmp_path / "deep", lambda image: png(image.convert("I;16")))
    with pytest.raises(ValueError, match=r"16 x 16 pixels of I;16, not 16 x 16 of RGB, RGBA, L, LA, P"):
        demonstrations(deep, ARM_SPEC)
    cells: dict[str, Any] = {
        "there is no image: correct the dataset": {"bytes": None, "path": None},
        r"no image but the path 'a\.png', which is no file in the folder of the dataset": {"path": "a.png"},
        r"no image but the path '\.\./a\.png'": {"path": "../a.png"},
        r"no image but the path 'a{200}', which is no file": {"path": "a" * 5000},
        r"cannot be decoded: it is not PNG or JPEG or WEBP$": {"bytes": b"GIF89a"},
        r"cannot be decoded \(": {"bytes": png(Image.new("RGB", (16, 16)))[:45]},
    }
    (tmp_path / "a.png").write_bytes(png(Image.new("RGB", (16, 16))))
    dataset = as_pictures(home, tmp_path / "data")
    for says, cell in cells.items():
        changed_table(dataset / path, key, lambda table, cell=cell: pa.array([cell] * len(table), PICTURE))
        with pytest.raises(ValueError, match=rf"{key} of episode 0, step 0: .*{says}") as caught:
            demonstrations(dataset, ARM_SPEC)
        assert "copy the dataset" not in str(caught.value)
    changed_table(dataset / path, key, lambda table: pa.array(["a.png"] * len(table)))
    with pytest.raises(ValueError, match=rf"{path}: {key} does not hold images"):
        demonstrations(dataset, ARM_SPEC)


def test_a_whole_picture_does_not_become_a_part_of_one(home: Path) -> None:
    cut = replace(ARM_SPEC, cut=("wrist",))
    assert len(demonstrations(str(home / "dataset"), cut)) == 3  # of the size of the task: it was cut
    with pytest.raises(
        ValueError, match=r"wrist of \S+ has 16 by 16 pixels, but wrist shows a part of a larger picture"
    ):
        demonstrations(str(home / "dataset"), replace(cut, image_size=(8, 8)))


def test_a_recording_does_not_act(home: Path) -> None:
    options = defaults_of("expert/lerobot", folder=str(home / "dataset"))
    node = {"_target_": "vla.data.formats.lerobot_import.LeRobotDemonstrations", **options}
    with pytest.raises(ValueError, match="cannot act: this job needs the expert of a world that can be played"):
        make_agent(node, "expert", make_arm())


def test_what_cannot_be_read_is_named(home: Path, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"expert\.folder=DIR"):
        demonstrations(None, ARM_SPEC)
    with pytest.raises(ValueError, match=r"no LeRobot dataset in .*nowhere"):
        demonstrations(str(tmp_path / "nowhere"), ARM_SPEC)
    for number, (version, says) in enumerate({
        "v2.1": r"has version v2\.1: convert the dataset to v3\.0 with lerobot",
        "v3.1": r"has version v3\.1, newer than v3\.0, which is read here: look for a newer vla",
        "v10.0": r"has version v10\.0, newer than v3\.0",
        None: r"has no version, but None: write or convert the dataset to v3\.0",
    }.items()):  # fmt: skip
        other = changed_info(home, tmp_path / str(number), lambda info, new=version: info.update(codebase_version=new))
        with pytest.raises(ValueError, match=rf"info\.json {says}"):
            demonstrations(str(other), ARM_SPEC)
    with pytest.raises(ValueError, match=r"info\.json is damaged or of another kind: features: Field required"):
        demonstrations(str(changed_info(home, tmp_path / "bare", lambda info: info.pop("features"))), spec=ARM_SPEC)
    for name, says in {
        "data/chunk-000/file-000.parquet": "cannot be read",
        "meta/episodes/chunk-000/file-000.parquet": "cannot be read",
        "meta/tasks.parquet": "cannot be read",
        "videos/observation.images.wrist/chunk-000/file-000.mp4": "cannot be read as a video",
    }.items():
        dataset = copied(home, tmp_path / name.replace("/", "_"))
        (dataset / name).write_bytes((dataset / name).read_bytes()[:100])
        with pytest.raises(ValueError, match=says):
            demonstrations(str(dataset), ARM_SPEC)


@pytest.mark.parametrize(
    "name",
    [
        *("meta/info.json", "meta/tasks.parquet", "meta/episodes/chunk-000/file-000.parquet"),
        *("data/chunk-000/file-000.parquet", "videos/observation.images.wrist/chunk-000/file-000.mp4"),
    ],
)
def test_a_pipe_is_not_read(home: Path, tmp_path: Path, name: str) -> None:
    dataset = copied(home, tmp_path / "dataset")
    (dataset / name).unlink()
    os.mkfifo(dataset / name)
    with pytest.raises(ValueError, match=rf"{name} is a folder, a pipe or a device, not a file"):
        demonstrations(str(dataset), ARM_SPEC).episode(0)


def test_an_episode_that_the_data_does_not_hold_is_refused(home: Path, tmp_path: Path) -> None:
    dataset = copied(home, tmp_path / "dataset")
    rows = pq.read_table(dataset / ROWS)
    steps = int(np.sum(np.array(rows["episode_index"]) == 2))
    pq.write_table(rows.slice(0, len(rows) - 1), dataset / ROWS)
    with pytest.raises(ValueError, match=rf"holds {steps - 1} of the {steps} steps of episode 2: copy the dataset aga"):
        demonstrations(str(dataset), ARM_SPEC)
    pq.write_table(pa.concat_tables([rows, rows.slice(0, 1)]), dataset / ROWS)
    with pytest.raises(
        ValueError, match=r"steps of episode 0, for which meta/episodes counts \d+: correct the dataset"
    ):
        demonstrations(str(dataset), ARM_SPEC)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"fps": 0}, r"fps: Input should be greater than 0"),
        ({"fps": float("nan")}, r"fps: Input should be a finite number"),
        ({"features": []}, r"features: Input should be an object"),
        ({"features": {"action": {"dtype": "float32", "shape": "x"}}}, r"features\.action\.shape: Input should be"),
        ({"features": {"action": {"dtype": "float32", "shape": [-1]}}}, r"greater than or equal to 1"),
        (
            {"features": {"action": {"dtype": "float32", "shape": [3], "names": [5]}}},
            r"no vector observation\.state, it has act",
        ),
        (
            {"features": {"a" * 10_000: {"dtype": "float32", "shape": [3]}}},
            r"no vector observation\.state, it has a{500}$",
        ),
        ({"codebase_version": ["v3.0"] * 1000}, r"has no version, but \['v3\.0', .{1,12}: write or convert"),
        ({"total_frames": -1}, r"total_frames: Input should be greater than or equal to 0"),
    ],
)
def test_nonsense_in_the_description_is_refused_by_name(
    home: Path, tmp_path: Path, change: dict[str, Any], says: str
) -> None:
    with pytest.raises(ValueError, match=says) as caught:
        demonstrations(str(changed_info(home, tmp_path, lambda info: info.update(change))), ARM_SPEC)
    assert str(tmp_path) in str(caught.value) and len(str(caught.value)) < 2000


def test_a_description_nested_without_end_is_refused(home: Path, tmp_path: Path) -> None:
    dataset = copied(home, tmp_path / "dataset")
    (dataset / "meta/info.json").write_text('{"codebase_version": "v3.0", "features": ' + "[" * 100_000)
    with pytest.raises(ValueError, match=r"info\.json is damaged or of another kind"):
        demonstrations(str(dataset), ARM_SPEC)


@pytest.mark.parametrize(
    ("file", "column", "value", "says"),
    [
        (EPISODES, f"{VIDEO}chunk_index", None, "integers from 0 on"),
        (EPISODES, f"{VIDEO}chunk_index", "../../x", "integers from 0 on"),
        (EPISODES, f"{VIDEO}file_index", -1, "integers from 0 on"),
        (EPISODES, "episode_index", 1.5, "integers from 0 on"),
        (EPISODES, "episode_index", 0, "lists episode 0 more than once"),
        (EPISODES, "dataset_to_index", 2**62, "integers from 0 on"),
        (EPISODES, f"{VIDEO}from_timestamp", float("nan"), "seconds"),
        (EPISODES, f"{VIDEO}from_timestamp", float("inf"), "seconds"),
        (EPISODES, f"{VIDEO}from_timestamp", -1e18, "seconds"),
        (EPISODES, f"{VIDEO}from_timestamp", "0", "seconds"),
        (ROWS, "action", "push", "lists of numbers"),
        (ROWS, "action", ["a", "b", "c"], "lists of numbers"),
        (ROWS, "action", [0.0, 0.0], r"without the 3 numbers that meta/info\.json states"),
        (ROWS, "action", [], r"without the 3 numbers|lists of numbers"),
        (ROWS, "episode_index", None, "integers from 0 on"),
        ("meta/tasks.parquet", "task", None, "text"),
        ("meta/tasks.parquet", "task", "a" * 1001, "tasks of more than 1000 characters: 0"),
        ("meta/tasks.parquet", "task_index", "0", "columns task_index, task|does not hold integers"),
    ],
)
def test_nonsense_in_a_table_is_refused_by_name(
    home: Path, tmp_path: Path, file: str, column: str, value: Any, says: str
) -> None:
    dataset = copied(home, tmp_path / "dataset")
    changed_table(dataset / file, column, lambda table: pa.array([value] * len(table)))
    with pytest.raises(ValueError, match=rf"{file.split('/chunk')[0]}.*{says}") as caught:
        demonstrations(str(dataset), ARM_SPEC)
    assert "copy the dataset" not in str(caught.value)  # which would not help


@pytest.mark.parametrize(
    ("limit", "says"), [("MOST_ROWS", r"has \d+ rows, more than the 5"), ("MOST_BYTES", r"unpacks to .* GB, more than")]
)
def test_a_table_that_unpacks_without_end_is_not_read(
    home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, limit: str, says: str
) -> None:
    monkeypatch.setattr(f"vla.data.formats.lerobot_tables.{limit}", 5)
    with pytest.raises(ValueError, match=rf"file-000\.parquet {says}"):
        demonstrations(str(copied(home, tmp_path / "dataset")), ARM_SPEC)


def test_the_size_of_a_column_does_not_depend_on_its_name(tmp_path: Path) -> None:
    values = pa.array(np.ones((50, 6), np.float32).tolist())
    pq.write_table(pa.table({"action": values, "observation.state": values}), tmp_path / "table.parquet")
    sizes = [
        tables._unpacked_size(tmp_path / "table.parquet", [name], False) for name in ("action", "observation.state")
    ]
    assert sizes[0] == sizes[1] >= 50 * 6 * 8


def test_rows_of_different_lengths_are_no_matrix() -> None:
    ragged = pa.chunked_array([pa.array([[1.0] * 5, [2.0] * 7])])
    assert tables.matrix(ragged, 6) is None
    whole = tables.matrix(pa.chunked_array([pa.array([[1.0] * 6, [2.0] * 6])]), 6)
    assert whole is not None and whole.tolist() == [[1.0] * 6, [2.0] * 6]
    assert tables.lists_have(pa.chunked_array([pa.array([[[1, 2], [3, 4]]])]), 2, 2)
    assert not tables.lists_have(pa.chunked_array([pa.array([[[1], [2, 3, 4]]])]), 2, 2)


def test_a_video_of_another_size_is_not_decoded(home: Path, tmp_path: Path) -> None:
    dataset = copied(home, tmp_path / "dataset")
    path = dataset / "videos/observation.images.wrist/chunk-000/file-000.mp4"
    encode(path, [np.zeros((20, 64, 64, 3), np.uint8)], (64, 64), Fraction(10), 50)
    with pytest.raises(ValueError, match=r"file-000\.mp4 has images of 64 x 64 pixels, not 16 x 16"):
        demonstrations(str(dataset), ARM_SPEC).episode(0)


def test_no_flipped_bit_is_imported(home: Path, tmp_path: Path) -> None:
    dataset = Path(shutil.copytree(home / "dataset", tmp_path / "dataset"))
    random = np.random.default_rng(0)
    for path in sorted(path for path in dataset.rglob("*") if path.is_file()):
        whole = path.read_bytes()
        for place in random.integers(len(whole), size=6).tolist():
            path.write_bytes(whole[:place] + bytes([whole[place] ^ 1 << place % 8]) + whole[place + 1 :])
            with pytest.raises(ValueError, match=r"dataset.*copy the dataset again from where it is whole"):
                demonstrations(str(dataset), ARM_SPEC)
        path.write_bytes(whole)
    assert len(demonstrations(str(dataset), ARM_SPEC)) == 3


def test_a_page_of_a_table_that_was_changed_is_not_imported(home: Path, tmp_path: Path) -> None:
    dataset = copied(home, tmp_path / "dataset")
    path = dataset / ROWS
    data = bytearray(path.read_bytes())
    with pq.ParquetFile(path) as file:
        column = file.metadata.row_group(0).column(0)
    data[column.data_page_offset + column.total_compressed_size - 3] ^= 1
    path.write_bytes(data)
    with pytest.raises(ValueError, match=r"file-000\.parquet cannot be read \(.*CRC"):
        demonstrations(str(dataset), ARM_SPEC)
