"""LeRobot datasets, also merged, cut or relabelled ones, become episodes, or one sentence says why they do not fit."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from collecting import content
from defaults import defaults_of
from lerobot_files import (
    EPISODES,
    FRONT,
    INFO,
    PICTURE,
    ROWS,
    TASKS,
    VIDEO,
    Change,
    as_file,
    as_pictures,
    changed,
    column,
    demonstrations,
    imported,
    info,
    made,
    png,
    rows,
)
from PIL import Image
from toy import ARM, ARM_SPEC, make_arm

from vla.config.experiment import make_agent
from vla.data.datamodule import is_held_out
from vla.data.episodes import EpisodeStore
from vla.data.formats import lerobot_layout as layout
from vla.data.formats import lerobot_tables as tables
from vla.data.formats.lerobot_dataset import LeRobotDataset
from vla.data.formats.lerobot_images import decode, encode, require_video
from vla.data.formats.lerobot_import import LeRobotDemonstrations
from vla.data.index import recording_of
from vla.io.errors import UserError
from vla.io.parts import Part
from vla.spec import Spec

NAN = float("nan")
OTHER = replace(ARM_SPEC, state=("north", "south"), state_units=("m", "m"), robot=None)
SLOW = replace(ARM_SPEC, control_hz=5.0)


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """See `made`, with the `imported` store of the dataset."""
    home = made(tmp_path_factory.mktemp("home"))
    imported(home / "dataset", home / "imported")
    return home


def test_what_was_exported_comes_back(home: Path) -> None:
    before = EpisodeStore(home / "store")
    after = EpisodeStore(home / "imported")
    assert after.spec == ARM_SPEC.without_truth and "truth" not in after.fields
    for there, here in zip(before.episodes, after.episodes, strict=True):
        expected, found = before.read(there), after.read(here)
        assert here.instruction == there.instruction
        assert here.draws == {"recorded": {"episode": here.seed, "lacks": ["depth"], "first_step": 0}}
        for name in ("state", "action", "executed"):
            np.testing.assert_array_equal(found[name], expected[name])
        for camera in ARM_SPEC.cameras:
            assert np.abs(found[f"rgb_{camera}"].astype(float) - expected[f"rgb_{camera}"]).mean() < 10
            assert not found[f"depth_{camera}"].any()


def test_an_import_goes_on_where_it_was(home: Path, tmp_path: Path) -> None:
    imported(home / "dataset", tmp_path / "store", episodes=1)
    imported(home / "dataset", tmp_path / "store")
    assert content(tmp_path / "store") == content(home / "imported")
    with pytest.raises(ValueError, match=r"only 3 recorded episodes: set collect\.episodes=3"):
        imported(home / "dataset", tmp_path / "store", episodes=4)


class InDoubles(LeRobotDemonstrations):
    """A recording whose states have more digits than a store keeps."""

    def numbers(self, number: int) -> tuple[str, np.ndarray, np.ndarray]:
        instruction, state, actions = super().numbers(number)
        return instruction, state + np.float64(1e-9), actions


def test_a_recording_of_more_digits_is_the_stored_one(home: Path, tmp_path: Path) -> None:
    expert = InDoubles(**defaults_of("expert/lerobot", folder=home / "dataset"), spec=ARM_SPEC)
    store = EpisodeStore.create_or_open(tmp_path, expert.spec, {})
    assert [expert.fill(store, episodes) for episodes in (1, 3)] == [1, 2]


def test_an_edited_dataset_is_not_taken_for_what_was_imported(home: Path, tmp_path: Path) -> None:
    store = Path(shutil.copytree(home / "imported", tmp_path / "store"))
    edited = changed(home, tmp_path / "edited")
    imported(edited, store)  # it is the same without checksums
    column(TASKS, "task", lambda table: pa.array([text.upper() for text in table["task"].to_pylist()]))(edited)
    with pytest.raises(
        ValueError, match=r"differs from the recording, first in episode 0: delete it .* another collect\.folder"
    ):
        imported(edited, store)


def test_what_was_executed_is_that_of_the_components(home: Path) -> None:
    order, names = [2, 0], ("action", "units", "low", "high")
    parts: dict[str, Any] = {name: tuple(np.array(getattr(ARM_SPEC, name))[order].tolist()) for name in names}
    found = demonstrations(home / "dataset", replace(ARM_SPEC, **parts, robot=None)).episode(0)
    expected = EpisodeStore(home / "store").read(EpisodeStore(home / "store").episodes[0])
    assert not np.array_equal(found.executed, found.actions)
    np.testing.assert_array_equal(found.executed, expected["executed"][:, order])


def spread(dataset: Path) -> None:
    """Move the first two episodes into a file after that of the third one; the metadata stay as they are."""
    table = pq.read_table(dataset / ROWS)
    third = np.array(table["episode_index"]) == 2
    pq.write_table(table.filter(pa.array(third)), dataset / ROWS)
    pq.write_table(table.filter(pa.array(~third)), dataset / ROWS.replace("file-000", "file-001"))


def stamped(change: Callable[[np.ndarray], np.ndarray], kind: pa.DataType | None = None) -> Change:
    """Change the time stamps of the second episode, or with a type those of all."""

    def values(table: pa.Table) -> pa.Array:
        stamps = np.array(table["timestamp"], float)
        which = np.array(table["episode_index"]) == 1 if kind is None else slice(None)
        stamps[which] = change(stamps[which])
        return pa.array(stamps).cast(kind or pa.float32(), safe=False)

    return column(ROWS, "timestamp", values)


def more_columns(dataset: Path) -> None:
    tasks = pq.read_table(dataset / TASKS)
    tasks = tasks.append_column("by", pa.array(["me"] * len(tasks))).append_column("n", pa.array([1] * len(tasks)))
    pq.write_table(tasks, dataset / TASKS)


# What others write differently, and means the same.
EQUAL: dict[str, Change] = {
    "rows in other files": lambda dataset: (spread(dataset), column(EPISODES, "data/file_index", 7)(dataset)),
    "further columns of tasks": more_columns,
    "stamps of a clock": stamped(lambda times: times + 1.7e9, pa.float64()),
    "29.97 for 30 Hz": stamped(lambda times: times * 1.001),
    "a rounded rate of a video": info(lambda info: info["features"][FRONT]["info"].update({"video.fps": 9})),
}


@pytest.mark.parametrize("name", EQUAL)
def test_what_others_write_differently_is_the_same_store(home: Path, tmp_path: Path, name: str) -> None:
    imported(changed(home, tmp_path / "dataset", EQUAL[name]), tmp_path / "store")
    assert content(tmp_path / "store") == content(home / "imported")


def test_images_in_tables_are_those_of_the_steps_wherever_the_rows_are(home: Path, tmp_path: Path) -> None:
    before = EpisodeStore(home / "store")
    dataset = as_pictures(home, tmp_path / "dataset")
    spread(dataset)
    after = imported(dataset, tmp_path / "store")
    for there, here in zip(before.episodes, after.episodes, strict=True):
        for name in ("state", "action", "rgb_front", "rgb_wrist"):
            np.testing.assert_array_equal(after.read(here)[name], before.read(there)[name])
    second = dataset / ROWS.replace("file-000", "file-001")
    pq.write_table(pq.read_table(second).drop_columns([FRONT]), second)
    with pytest.raises(ValueError, match=rf"file-001\.parquet lacks the columns {FRONT}, or has them twice: correct"):
        demonstrations(dataset, ARM_SPEC)


@pytest.mark.parametrize(
    ("packed", "channels", "mode"),
    [
        (lambda image: as_file(image, "JPEG", quality=95, subsampling=0), 3, "RGB"),
        (lambda image: as_file(image, "WEBP", lossless=True), 3, "RGB"),
        (lambda image: png(image.convert("RGBA")), 4, "RGB"),
        (lambda image: as_file(image.convert("L"), "JPEG", quality=95), 1, "L"),
    ],
    ids=["jpeg", "webp", "rgba", "grey"],
)
def test_images_in_tables_are_of_many_kinds(
    home: Path, tmp_path: Path, packed: Callable[[Image.Image], bytes], channels: int, mode: str
) -> None:
    found = demonstrations(as_pictures(home, tmp_path / "dataset", packed, channels), ARM_SPEC).episode(1)
    store = EpisodeStore(home / "store")
    for seen, there in zip(found.observations, store.read(store.episodes[1])["rgb_front"], strict=True):
        expected = np.asarray(Image.fromarray(there).convert(mode).convert("RGB"))
        assert np.abs(seen.rgb["front"].astype(int) - expected).mean() < 6


def test_images_beside_the_tables_are_read_within_the_dataset_only(home: Path, tmp_path: Path) -> None:
    dataset = as_pictures(home, tmp_path / "dataset")
    images = pq.read_table(dataset / ROWS)[FRONT].to_pylist()
    (dataset / "images").mkdir()
    for number, image in enumerate(images):
        (dataset / f"images/{number}.png").write_bytes(image["bytes"])
    paths = [{"bytes": None, "path": f"images/{number}.png"} for number in range(len(images))]
    store = EpisodeStore(home / "store")
    expected = store.read(store.episodes[2])["rgb_front"]
    for kind in (PICTURE, None):  # None: the type of nothing but nulls
        column(ROWS, FRONT, lambda table, kind=kind: pa.array(paths, kind))(dataset)
        found = demonstrations(dataset, ARM_SPEC).episode(2)
        np.testing.assert_array_equal(np.stack([seen.rgb["front"] for seen in found.observations]), expected)
    shutil.move(dataset / "images/0.png", tmp_path / "0.png")
    (dataset / "images/0.png").symlink_to(tmp_path / "0.png")  # which leads out of the dataset
    for target in ("images/0.png", "../0.png", str(tmp_path / "0.png")):
        paths[0]["path"] = target
        column(ROWS, FRONT, lambda table: pa.array(paths, PICTURE))(dataset)
        with pytest.raises(ValueError, match=rf"of episode 0, step 0: the table has no image but the path '{target}'"):
            demonstrations(dataset, ARM_SPEC)


CELLS: dict[str, dict[str, Any]] = {
    "there is no image: correct the dataset": {"bytes": None, "path": None},
    r"no image but the path 'ab', which is no file": {"path": "a\0b"},
    r"no image but the path 'a{200}', which is no file": {"path": "a" * 5000},
    r"cannot be decoded: it is not PNG or JPEG or WEBP$": {"bytes": b"GIF89a"},
    r"cannot be decoded \(": {"bytes": png(Image.new("RGB", (16, 16)))[:45]},
    r"the image is 300 x 400 pixels of RGB, and must be 16 x 16, at most 16777216, of RGB": {
        "bytes": png(Image.new("RGB", (400, 300)))
    },
    r"16 x 16 pixels of I;16, and must be 16 x 16, .* of RGB, RGBA, L, LA, P": {
        "bytes": png(Image.new("I;16", (16, 16)))
    },
}


def test_images_of_another_kind_are_refused_by_name(home: Path, tmp_path: Path) -> None:
    dataset = as_pictures(home, tmp_path / "data")
    for says, cell in CELLS.items():
        column(ROWS, FRONT, lambda table, cell=cell: pa.array([cell] * len(table), PICTURE))(dataset)
        with pytest.raises(ValueError, match=rf"{FRONT} of episode 0, step 0: .*{says}") as caught:
            demonstrations(dataset, ARM_SPEC)
        assert "copy the dataset" not in str(caught.value)
    twice = [pa.field("bytes", pa.binary())] * 2

    def doubled(table: pa.Table) -> pa.Array:
        return pa.StructArray.from_arrays([pa.array([b""] * len(table))] * 2, fields=twice)

    for other in ("a.png", {"bytes": 5, "path": "a.png"}, doubled):
        column(ROWS, FRONT, other)(dataset)
        with pytest.raises(ValueError, match=rf"{ROWS}: {FRONT} does not hold images"):
            demonstrations(dataset, ARM_SPEC)


def test_what_other_people_leave_out_is_made_up_and_said(home: Path, tmp_path: Path) -> None:
    def change(info: Any) -> None:
        features = info["features"]
        del features["executed"], features["velocities"]
        features["action"]["names"] = None  # anonymous components count as ours
        features["observation.state"]["names"] = {"motors": [*ARM.joints, "gripper"]}
        features[FRONT] |= {"shape": [3, 16, 16], "names": ["channels", "height", "width"]}

    dataset = changed(home, tmp_path / "dataset", info(change))
    tasks = pq.read_table(dataset / TASKS)  # as pandas writes an index without a name
    index = pa.schema([("task_index", pa.int64()), ("__index_level_0__", pa.large_string())])
    pq.write_table(tasks.rename_columns(index.names).cast(index), dataset / TASKS)
    store = imported(dataset, tmp_path / "store")
    assert store.episodes[0].draws["recorded"]["lacks"] == ["depth", "executed", "velocities"]
    found = store.read(store.episodes[0])
    np.testing.assert_array_equal(found["executed"], found["action"])
    velocities = found["state"][:, 7:14]
    np.testing.assert_allclose(velocities[1:], np.diff(found["state"][:, :7], axis=0) * 10, rtol=1e-6)
    assert not velocities[0].any()


def relabelled(home: Path, folder: Path, tasks: Callable[[pa.Table], Any]) -> Path:
    """A copy whose steps have the tasks "reach", 0, and "grasp", 1, and no velocities."""
    dataset = changed(home, folder, info(lambda info: info["features"].pop("velocities")))
    pq.write_table(pa.table({"task_index": [0, 1], "task": ["reach", "grasp"]}), dataset / TASKS)
    column(ROWS, "task_index", lambda table: pa.array(np.array(tasks(table)).astype(int)))(dataset)
    return dataset


def recording(dataset: Path, **options: Any) -> Any:
    return LeRobotDemonstrations.recording(**defaults_of("expert/lerobot", folder=dataset, **options))


def test_actions_can_have_other_units_and_steps_another_rate(home: Path) -> None:
    plain, other = (recording(home / "dataset", **options) for options in ({}, {"scale": {"y": -2.0}, "control_hz": 7}))
    assert (plain.control_hz, other.control_hz) == (10, 7)
    assert other.bounds == plain.bounds | {"y": (-2 * plain.bounds["y"][1], -2 * plain.bounds["y"][0])}
    with pytest.raises(UserError, match=r"expert\.scale names z, the actions are x, y, gripper"):
        demonstrations(home / "dataset", ARM_SPEC, scale={"z": 2.0})


def test_a_dataset_without_images_is_refused_as_such(home: Path, tmp_path: Path) -> None:
    def without_images(content: Any) -> None:
        features = content["features"].items()
        content["features"] = {name: each for name, each in features if each["dtype"] not in ("image", "video")}

    dataset = changed(home, tmp_path / "dataset", info(without_images))
    with pytest.raises(UserError, match=r"dataset has no images, which policies need: record it with a camera"):
        recording(dataset)


def test_every_step_has_the_instruction_of_its_task(home: Path, tmp_path: Path, caplog: Any) -> None:
    def from_fourth(table: pa.Table) -> Any:
        return (np.array(table["frame_index"]) >= 4) & (np.array(table["episode_index"]) < 2)

    dataset, whole = relabelled(home, tmp_path / "dataset", from_fourth), EpisodeStore(home / "imported")
    assert recording(dataset).episodes == 5
    caplog.set_level("INFO")
    found = imported(dataset, tmp_path / "store", 5)
    assert "episodes: 3 become 5" in caplog.text
    assert [entry.instruction for entry in found.episodes] == ["reach", "grasp", "reach", "grasp", "reach"]
    assert [recording_of(entry) for entry in found.episodes] == [0, 0, 1, 1, 2]
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
        sides = [is_held_out(recording_of(entry), fraction) for entry in found.episodes]
        assert sides[0] == sides[1] and sides[2] == sides[3]


def test_kept_frames_begin_anew_where_the_task_changes(home: Path, tmp_path: Path) -> None:
    dataset = relabelled(home, tmp_path / "dataset", lambda table: np.array(table["frame_index"]) >= 3)
    expert = demonstrations(dataset, SLOW, every=2)
    whole = demonstrations(home / "dataset", ARM_SPEC).episode(0)
    np.testing.assert_array_equal(expert.episode(0).actions, whole.actions[[1, 2]])  # not the action of "grasp"
    np.testing.assert_array_equal(expert.episode(1).actions, whole.actions[[4, 6, 8, 10, 11]])
    for seen, step in zip(expert.episode(1).observations, range(3, 12, 2), strict=True):
        np.testing.assert_array_equal(seen.rgb["front"], whole.observations[step].rgb["front"])


def without_second(dataset: Path) -> None:
    """Leave out the second episode as a person does by hand."""
    for path in (dataset / EPISODES, dataset / ROWS):
        table = pq.read_table(path)
        pq.write_table(table.filter(pa.array(np.array(table["episode_index"]) != 1)), path)


def test_numbers_of_episodes_may_have_holes(home: Path, tmp_path: Path) -> None:
    fewer = info(lambda info: info.update(total_episodes=2, total_frames=2))
    dataset = changed(home, tmp_path / "dataset", without_second, fewer)
    found, whole = imported(dataset, tmp_path / "store", 2), EpisodeStore(home / "imported")
    assert [(entry.seed, recording_of(entry)) for entry in found.episodes] == [(0, 0), (1, 2)]
    for name, values in found.read(found.episodes[1]).items():
        np.testing.assert_array_equal(values, whole.read(whole.episodes[2])[name])


def test_images_of_cut_steps_stay_with_the_steps_that_are_left(home: Path, tmp_path: Path) -> None:
    dataset = changed(home, tmp_path / "dataset", info(lambda info: info.update(total_frames=0)))
    table, metadata = pq.read_table(dataset / ROWS), pq.read_table(dataset / EPISODES).to_pylist()
    kept = (np.array(table["frame_index"]) >= 2) | (np.array(table["episode_index"]) != 1)
    pq.write_table(table.filter(pa.array(kept)), dataset / ROWS)  # the videos, and their times, stay as they are
    metadata[1]["dataset_to_index"] -= 2
    pq.write_table(pa.Table.from_pylist(metadata), dataset / EPISODES)
    found, whole = imported(dataset, tmp_path / "store"), EpisodeStore(home / "imported")
    for name in ("rgb_front", "action"):
        expected = whole.read(whole.episodes[1])[name][2:]
        np.testing.assert_array_equal(found.read(found.episodes[1])[name], expected)


@pytest.mark.parametrize(
    ("spec", "says"),
    [
        (replace(ARM_SPEC, control_hz=20.0), r"its rate is 10 Hz \(expert\.every=1\), the task's 20 Hz"),
        (
            replace(ARM_SPEC, cameras=("side", "top"), depth=()),
            r"no key for side and top, and there are images of front, wrist",
        ),
        (OTHER, r"state has 15 numbers \(joint1, .*\), that of the task 2 \(north, south\)"),
        (replace(ARM_SPEC, action=("x", "z", "gripper")), r"action has 3 numbers \(x, y, .*task 3 \(x, z, gripper\)"),
        (
            replace(ARM_SPEC, high=(0.01, 0.01, 0.5)),
            r"action x is from .*, \d+% of it beyond the bounds of the task, .*0\.01 m \(other units, or abso.*; "
            r"its action y .*; its action gripper .* of the task, 0 to 0\.5 \(other units",
        ),
        (
            replace(OTHER, control_hz=20.0, cameras=("side",), depth=(), action=("a", "b", "c")),
            r"task: its rate .*; .* no key for .*; its state .*; its action [^;]*$",  # all differences at once
        ),
    ],
    ids=["rate", "camera", "joints", "names", "units", "all"],
)
def test_differences_from_the_task_are_named(home: Path, spec: Spec, says: str) -> None:
    with pytest.raises(ValueError, match=rf"dataset does not match the task: .*{says}|does not match the {says}"):
        demonstrations(home / "dataset", spec)


def test_components_of_other_names_are_taken_in_their_order_if_asked(home: Path) -> None:
    spec = replace(ARM_SPEC, action=("east", "north", "grip"))
    with pytest.raises(UserError, match=r"that of the task 3 \(east, north, grip\): expert\.in_order=true takes them"):
        demonstrations(home / "dataset", spec)
    plain, renamed = demonstrations(home / "dataset", ARM_SPEC), demonstrations(home / "dataset", spec, in_order=True)
    np.testing.assert_array_equal(renamed.numbers(1)[2], plain.numbers(1)[2])


def test_velocities_too_are_taken_in_their_order_if_asked(home: Path) -> None:
    order = [*range(7), 14, *range(7, 14)]  # in the dataset: joints and fingers, then velocities
    units = tuple(ARM_SPEC.state_units[index] for index in order)
    spec = replace(ARM_SPEC, state=tuple("abcdefghijklmno"), state_units=units, robot=None)
    keys = ["observation.state", layout.RATES]
    with pytest.raises(UserError, match=r"that of the task 15 \(a, b, .*\): expert\.in_order=true takes them"):
        demonstrations(home / "dataset", spec, state=keys)
    renamed = demonstrations(home / "dataset", spec, state=keys, in_order=True)
    plain = demonstrations(home / "dataset", ARM_SPEC)
    np.testing.assert_array_equal(renamed.numbers(1)[1], plain.numbers(1)[1][:, order])


def test_a_vector_of_one_component_is_written_as_lerobot_reads_it(tmp_path: Path) -> None:
    columns = {"action": np.array([[1], [2]], np.float32), "observation.state": np.array([[1, 2], [3, 4]], np.float32)}
    tables.write_rows(tmp_path / "rows.parquet", [columns])
    written = pq.read_table(tmp_path / "rows.parquet")
    assert written.schema.field("action").type == pa.float32()
    for name, values in columns.items():
        np.testing.assert_array_equal(tables.vectors(written[name], values.shape[1]), values)


def test_what_fits_the_task_nearly_is_taken_and_a_whole_picture_is_no_part_of_one(home: Path) -> None:
    cut = replace(ARM_SPEC, parts=(Part("wrist"),))
    for spec in (replace(ARM_SPEC, control_hz=9.99), cut):  # images of the size of the task were cut
        assert len(demonstrations(home / "dataset", spec)) == 3
    with pytest.raises(ValueError, match=r"wrist of \S+ has 16 by 16 pixels, but wrist shows a part of a larger pict"):
        demonstrations(home / "dataset", replace(cut, image_size=(8, 8)))


def test_a_recording_does_not_act(home: Path) -> None:
    options = defaults_of("expert/lerobot", folder=str(home / "dataset"))
    node = {"_target_": "vla.data.formats.lerobot_import.LeRobotDemonstrations", **options}
    with pytest.raises(ValueError, match="cannot act: choose an expert that can, such as expert=waypoint"):
        make_agent(node, "expert", make_arm())


def drop(info: dict[str, Any]) -> None:
    del info["features"][FRONT], info["features"][FRONT.replace("front", "wrist")]
    info["features"]["action"] = {"dtype": "float32", "shape": [6], "names": None}


def not_finite(table: pa.Table) -> pa.Array:
    values, owner = table["action"].to_pylist(), np.array(table["episode_index"])
    first = int(np.argmax(owner == 1))
    values[first + 3][1], values[first + 4][2] = NAN, None
    return pa.array(values, pa.list_(pa.float32()))


def told(**values: Any) -> Change:
    """Change values of `info.json`."""
    return info(lambda info: info.update(values))


def feature(name: str, shape: Any, names: Any = None) -> dict[str, Any]:
    return {name: {"dtype": "float32", "shape": shape, "names": names}}


def cut_off(name: str) -> Change:
    return lambda dataset: (dataset / name).write_bytes((dataset / name).read_bytes()[:100])


def without(name: str) -> Change:
    return lambda dataset: (dataset / name).unlink()


def pipe(name: str) -> Change:
    return lambda dataset: ((dataset / name).unlink(), os.mkfifo(dataset / name))


def listing(dataset: Path) -> None:
    """Put a list of videos in the place of one."""
    (dataset / MP4).rename((dataset / MP4).with_name("other.mp4"))
    (dataset / MP4).write_text("ffconcat version 1.0\nfile other.mp4\n")


def film(images: int, size: int, fps: int) -> Change:
    """Put another video in the place of one."""
    clip = np.zeros((images, size, size, 3), np.uint8)
    return lambda dataset: encode(dataset / f"{VIDEO}chunk-000/file-000.mp4", [clip], (size, size), Fraction(fps), 50)


COUNT, NUMBERS = "does not hold integers from 0 on: correct", "does not hold lists of numbers: correct"
NO_NUMBERS = r"without the 3 numbers that meta/info\.json states: correct"
MP4 = f"{VIDEO}chunk-000/file-000.mp4"
# What is wrong with a dataset, and what is said of it; where a copy would not help, none is advised.
REFUSED: list[tuple[Change, str]] = [
    (lambda dataset: shutil.rmtree(dataset), r"no LeRobot dataset in .*dataset \(no meta/info\.json\)"),
    (told(codebase_version="v2.1"), r"info\.json has version v2\.1, and v3\.0 is read here: convert an older dataset"),
    (told(codebase_version=["v3.0"] * 1000), r"has version \['v3\.0', .{1,12}, and v3\.0 is read here"),
    (
        info(lambda info: info["features"].update({"observation.front": info["features"][FRONT]})),
        r"two cameras would have one name in .*: name them, as in expert\.images=\{top: ",
    ),
    (info(lambda info: info.pop("features")), r"info\.json is damaged or of another kind: features: Field required"),
    (told(fps=0), r"fps: Input should be greater than 0"),
    (told(features=feature("action", [3], [5])), r"no vector observation\.state, it has act"),
    (info(lambda info: info["features"]["action"].update(shape=[10**9])), "1000000000 components in action, the limit"),
    (info(drop), r"no camera at all; its action has 6 numbers \(action_0, .*, that of the task 3 \(x, y, grip"),
    (lambda dataset: (dataset / INFO).write_text('{"features": ' + "[" * 100_000), r"json is damaged or of .*: copy"),
    (lambda dataset: (dataset / INFO).write_text('{"codebase_version": '), r"copy the dataset again"),
    (without_second, r"lists 2 of the 3 episodes that meta/info\.json counts: copy the dataset again .* or correct"),
    (told(total_frames=1000), r"lists \d+ of the 1000 frames that meta/info\.json counts: copy"),
    (
        rows(lambda table: table.slice(0, len(table) - 1)),
        r"holds 10 steps of episode 2, and meta/episodes counts 11: copy",
    ),
    (
        rows(lambda table: pa.concat_tables([table, table.slice(0, 1)])),
        r"holds 13 steps of episode 0, and meta/episodes counts 12: correct",
    ),
    (without(ROWS), r"data holds no tables: copy the dataset again"),
    (without(MP4), rf"lacks {MP4}: copy the dataset again"),
    *((cut_off(name), "cannot be read.*copy the dataset again") for name in (ROWS, EPISODES, TASKS)),
    (cut_off(MP4), "cannot be read as a video"),
    (listing, "cannot be read as a video"),
    (rows(lambda table: table.append_column("action", table["action"])), "the columns action, or has them twice"),
    *((pipe(name), f"{name} is a folder, a pipe or a device, not") for name in (INFO, TASKS, EPISODES, ROWS, MP4)),
    (film(40, 64, 10), r"file-000\.mp4 is 64 x 64 pixels, meta/info\.json has 16 x 16"),
    (film(80, 16, 20), r"mp4 has 20 images per second, the dataset 10: encode the video again"),
    (column(TASKS, "task", None), "but no column task of texts: correct"),
    (column(TASKS, "task", "a" * 1001), "shorten the tasks 0, of more than 1000 characters"),
    (column(ROWS, "task_index", 7), r"tasks\.parquet lacks task 7, which episode 0 has: correct the dataset"),
    (column(EPISODES, f"{VIDEO}chunk_index", "../../x"), COUNT),
    (column(EPISODES, "episode_index", 1.5), COUNT),
    (column(EPISODES, "episode_index", 0), "lists episode 0 more than once: correct"),
    *((column(EPISODES, f"{VIDEO}from_timestamp", value), "hold seconds") for value in (NAN, -1e18, "0")),
    (column(ROWS, "action", "push"), NUMBERS),
    (column(ROWS, "action", [0.0, 0.0]), NO_NUMBERS),
    (column(ROWS, "episode_index", None), COUNT),
    (
        column(ROWS, "action", not_finite),
        r"action is nan at index 1 in episode 1, step 3, the first of 2 such steps: correct",
    ),
    (
        stamped(lambda times: times * 1.2),
        r"step 3 of episode 1 comes 0\.36 s after its first one, but at 10 Hz, .* 0\.3",
    ),
    (stamped(lambda times: times + 0.2 * (times > 0.25)), r"step 3 of episode 1 comes 0\.5 s after its first one"),
    (stamped(lambda times: np.where(times > 0.15, NAN, times)), r"timestamp is nan at index 0 in episode 1, step 2"),
]


@pytest.mark.parametrize("number", range(len(REFUSED)), ids=lambda number: REFUSED[number][1][:40])
def test_what_is_wrong_with_a_dataset_is_said_before_anything_is_imported(
    home: Path, tmp_path: Path, number: int
) -> None:
    change, says = REFUSED[number]
    with pytest.raises(ValueError, match=says) as caught:
        demonstrations(changed(home, tmp_path / "dataset", change), ARM_SPEC)
    assert str(tmp_path) in str(caught.value) and len(str(caught.value)) < 2000
    assert "correct" not in says or "copy" in says or "copy the dataset" not in str(caught.value)


def test_images_are_found_whatever_the_clock_of_the_stamps(home: Path) -> None:
    dataset = LeRobotDataset(home / "dataset", None)
    far = replace(dataset.parts[1], time=1e308)
    near, same = (dataset.frames(part, "front", (16, 16), 1) for part in (dataset.parts[1], far))
    np.testing.assert_array_equal(near, same)


def test_images_that_drift_away_from_their_steps_are_refused(tmp_path: Path) -> None:
    clip = np.repeat(np.arange(0, 240, 4, dtype=np.uint8), 16 * 16 * 3).reshape(60, 16, 16, 3)
    encode(tmp_path / "video.mp4", [clip], (16, 16), Fraction(999, 100), 5)
    for fps, count in ((Fraction(10), 60), (Fraction(999, 100), 60), (Fraction(99, 10), 40)):
        require_video(tmp_path / "video.mp4", (16, 16), fps, count)
        found = np.stack([*decode(tmp_path / "video.mp4", 0.0, count, fps, (16, 16))])
        assert np.abs(found.astype(int) - clip[:count]).max() <= 3
    for fps, count in ((Fraction(99, 10), 60), (Fraction(20), 10)):
        with pytest.raises(
            ValueError, match=rf"has 9\.99 images per second, the dataset {float(fps):g}: encode .* or w"
        ):
            require_video(tmp_path / "video.mp4", (16, 16), fps, count)


@pytest.mark.parametrize(
    ("limit", "says"), [("MAX_ROWS", r"has \d+ rows, more than the 5"), ("MAX_BYTES", r"unpacks to .* GB, more than")]
)
def test_a_table_larger_than_recordings_are_is_not_read(
    home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, limit: str, says: str
) -> None:
    monkeypatch.setattr(tables, limit, 5)
    with pytest.raises(ValueError, match=rf"file-000\.parquet {says}"):
        demonstrations(changed(home, tmp_path / "dataset"), ARM_SPEC)


@pytest.mark.parametrize(
    ("rows", "size", "fits"),
    [
        ([[1.0] * 6, [2.0] * 6], 6, True),
        ([[1.0] * 5, [2.0] * 7], 6, False),
        ([[1, 2], None], 2, False),
        ([1.0, 2.0], 1, True),
    ],
)
def test_rows_of_other_lengths_are_no_vectors(rows: Any, size: int, fits: bool) -> None:
    found = tables.vectors(pa.chunked_array([pa.array(rows)]), size)
    assert (None if found is None else found.ravel().tolist()) == (np.ravel(rows).tolist() if fits else None)


def test_no_flipped_bit_is_imported(home: Path, tmp_path: Path) -> None:
    dataset = Path(shutil.copytree(home / "dataset", tmp_path / "dataset"))
    random = np.random.default_rng(0)
    for path in sorted(path for path in dataset.rglob("*") if path.is_file()):
        whole = path.read_bytes()
        for place in random.integers(len(whole), size=3).tolist():
            path.write_bytes(whole[:place] + bytes([whole[place] ^ 1 << place % 8]) + whole[place + 1 :])
            with pytest.raises(ValueError, match=r"dataset.*copy the dataset again from where it is whole"):
                demonstrations(dataset, ARM_SPEC)
        path.write_bytes(whole)
    assert len(demonstrations(dataset, ARM_SPEC)) == 3
    (dataset / "meta/checksums.json").unlink()  # which those of other programs lack; their tables have own ones
    data = bytearray((dataset / ROWS).read_bytes())
    with pq.ParquetFile(dataset / ROWS) as file:
        column = file.metadata.row_group(0).column(0)
    data[column.data_page_offset + column.total_compressed_size - 3] ^= 1
    (dataset / ROWS).write_bytes(data)
    with pytest.raises(ValueError, match=r"file-000\.parquet cannot be read \(.*CRC"):
        demonstrations(dataset, ARM_SPEC)
