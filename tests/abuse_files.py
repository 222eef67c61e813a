"""Datasets, bags and runs that are damaged, or that somebody made to do harm."""

from __future__ import annotations

import io
import json
import os
import random
import shutil
import struct
import zlib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from bags import write as write_bag
from PIL import Image
from trials import CHECKPOINT, SMALL, Trials, digest, last, run

EPISODES = 4
IMPORT: tuple[str, ...] = (
    *SMALL[:2],
    "job=collect",
    "expert=lerobot",
    "expert.folder=hurt",
    f"collect.episodes={EPISODES}",
)
IMPORT = (*IMPORT, "collect.folder=imported", "output=wrong")
INFO, TASKS = "meta/info.json", "meta/tasks.parquet"
ROWS, OF_EPISODES = "data/chunk-000/file-000.parquet", "meta/episodes/chunk-000/file-000.parquet"
IMAGES = "observation.images.front"
VIDEO = f"videos/{IMAGES}/chunk-000/file-000.mp4"
BAG = (
    *("task.joints=all", "task.units=rad", "task.image_size=[8,8]", "expert.robot.fingers=[left,right]"),
    *(
        "expert.topics.joint_states=/joint_states",
        "expert.topics.instruction=/words",
        "expert.topics.commands=/commands",
    ),
    *("expert.topics.images={front: /front, wrist: /wrist}", "collect.folder=lessons", "output=wrong"),
)

Change = Callable[[Path], object]  # does something to the copy in a folder


def flipped(path: Path, chance: random.Random) -> None:
    """Flip one bit."""
    data = bytearray(path.read_bytes())
    data[chance.randrange(len(data))] ^= 1 << chance.randrange(8)
    path.write_bytes(data)


def cut(path: Path, chance: random.Random) -> None:
    """Cut the end off."""
    os.truncate(path, chance.randrange(path.stat().st_size))


def garbled(path: Path, chance: random.Random) -> None:
    """Let eight bytes be a huge number."""
    data = bytearray(path.read_bytes())
    place = chance.randrange(max(1, len(data) - 8))
    data[place : place + 8] = (1 << chance.randrange(20, 62)).to_bytes(8, "little")
    path.write_bytes(data)


DAMAGES = (flipped, cut, garbled)


def hurt(name: str, damage: Callable[[Path, random.Random], None], chance: random.Random, folder: Path) -> None:
    """Damage a file of a folder."""
    damage(folder / name, chance)


def linked(name: str, target: str) -> Change:
    """Put a link in the place of a file."""

    def change(folder: Path) -> None:
        (folder / name).unlink()
        (folder / name).symlink_to(target)

    return change


def piped(name: str) -> Change:
    """Put a pipe that nobody writes to in the place of a file."""

    def change(folder: Path) -> None:
        (folder / name).unlink()
        os.mkfifo(folder / name)

    return change


def emptied(name: str, folder: Path) -> None:
    """Put a folder in the place of a file."""
    (folder / name).unlink()
    (folder / name).mkdir()


def removed(name: str, folder: Path) -> None:
    """Remove a file."""
    (folder / name).unlink()


def written(name: str, data: bytes) -> Change:
    """Put other contents in the place of a file."""
    return lambda folder: (folder / name).write_bytes(data)


def told(**values: Any) -> Change:
    """Change what `info.json` says; a key with __ goes into what stands there."""

    def change(folder: Path) -> None:
        info = json.loads((folder / INFO).read_text())
        for key, value in values.items():
            *parents, name = key.split("__")
            holder = info
            for parent in parents:
                holder = holder[parent]
            holder[name.replace("IMAGES", IMAGES)] = value
        (folder / INFO).write_text(json.dumps(info))

    return change


def column(file: str, name: str, value: Any, rows: int | None = None) -> Change:
    """Let every row of a column be one value; with `rows`, let there be so many, all alike."""

    def change(folder: Path) -> None:
        table = pq.read_table(folder / file)
        if rows is not None:
            table = table.take(pa.array(np.zeros(rows, np.int64)))
        values = pa.array([value], size=1) if not isinstance(value, pa.Array) else value
        values = values.take(pa.array(np.zeros(len(table), np.int64)))
        pq.write_table(table.set_column(table.column_names.index(name), name, values), folder / file)

    return change


def png(height: int, width: int, bomb: bool = False) -> bytes:
    """A PNG of one colour; a `bomb` says so of its size and unpacks to a gigabyte."""
    if not bomb:
        file = io.BytesIO()
        Image.new("RGB", (width, height)).save(file, "PNG")
        return file.getvalue()

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    packer = zlib.compressobj(9)
    packed = b"".join(packer.compress(bytes(1 << 20)) for _ in range(1024)) + packer.flush()
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", packed) + chunk(b"IEND", b"")


def pictures(content: bytes | None, path: str = "../../../etc/passwd") -> Change:
    """Let a camera's images be PNG in the table, all of them the same."""

    def change(folder: Path) -> None:
        table = pq.read_table(folder / ROWS)
        kind = pa.struct({"bytes": pa.binary(), "path": pa.string()})
        images = pa.array([{"bytes": content, "path": path}], kind).take(pa.array(np.zeros(len(table), np.int64)))
        pq.write_table(table.append_column(IMAGES, images), folder / ROWS)
        told(features__IMAGES={"dtype": "image", "shape": [32, 32, 3], "names": None})(folder)

    return change


TRAILING = "an image bomb that says 32 x 32"
LONG = pa.array([[0.0] * 300_000], pa.list_(pa.float32()))
# What is done to a dataset; the large images take seconds to make, so not before they are wanted.
HOSTILE: dict[str, Change] = {
    **{f"fps {value!r}": told(fps=value) for value in (20, 1e308, None, float("nan"))},
    **{f"version {value!r}": told(codebase_version=value) for value in ("v2.1", None)},
    **{f"features {value!r}": told(features=value) for value in (None, dict[str, Any]())},
    **{f"image shape {value}": told(features__IMAGES={"dtype": "video", "shape": value}) for value in (
        [32, 32], [10**12, 10**12, 3], ["32", 32, 3])},
    **{f"action names {value}": told(features__action={"dtype": "float32", "shape": [7], "names": value})
       for value in (["a"] * 7, {"x": 1})},
    "image dtype": told(features__IMAGES={"dtype": "object", "shape": [32, 32, 3]}),
    "action dtype": told(features__action={"dtype": "string", "shape": [10**9]}),
    "counts of totals": told(total_episodes=10**18, total_frames=-1, chunks_size=0),
    "paths in info": told(data_path="../../{chunk_index}.parquet", video_path="/etc/passwd"),
    "info nested": written(INFO, b'{"codebase_version": "v3.0", "features": ' + b"[" * 10**5),
    "info large": written(INFO, b" " * (40 << 20) + b"{}"),
    "info not text": written(INFO, bytes(range(256))),
    "info twice": lambda folder: (folder / INFO).write_text((folder / INFO).read_text()[:-2] + ',"fps":20}'),
    **{f"endless {name}": linked(name, "/dev/zero") for name in (INFO, TASKS, ROWS, OF_EPISODES, VIDEO)},
    **{f"pipe {name}": piped(name) for name in (INFO, TASKS, ROWS, OF_EPISODES, VIDEO)},
    "endless checksums": lambda folder: (folder / "meta/checksums.json").symlink_to("/dev/zero"),
    "checksums elsewhere": written("meta/checksums.json", b'{"../../../../etc/passwd": 1}'),
    "folder in a circle": lambda folder: (folder / "data/chunk-001").symlink_to("..", True),
    "video of files": written(VIDEO, b"ffconcat version 1.0\nfile '/etc/passwd'\n"),
    "video of addresses": written(VIDEO, b"#EXTM3U\n#EXTINF:1,\nhttp://127.0.0.1:9/x.ts\n#EXT-X-ENDLIST\n"),
    "video an image": written(VIDEO, png(32, 32)),
    "video of another size": lambda folder: written(VIDEO, png(20_000, 20_000))(folder),
    "videos gone": lambda folder: shutil.rmtree(folder / "videos"),
    "a video a folder": partial(emptied, VIDEO),
    **{f"{of.rpartition('/')[2]} {value!r}": column(OF_EPISODES, of, value) for of, value in (
        (f"videos/{IMAGES}/chunk_index", "../../x"), (f"videos/{IMAGES}/chunk_index", 2**40),
        (f"videos/{IMAGES}/file_index", -1), (f"videos/{IMAGES}/from_timestamp", float("nan")),
        (f"videos/{IMAGES}/from_timestamp", -1e18), (f"videos/{IMAGES}/from_timestamp", 9e5),
        ("dataset_to_index", 2**62), ("dataset_from_index", -5), ("dataset_to_index", 3), ("episode_index", 0),
        ("data/file_index", None), ("episode_index", "0"))},
    **{f"{of} {str(value)[:20]}": column(ROWS, of, value) for of, value in (
        ("action", "push"), ("action", [0.0]), ("action", [float("nan")] * 7), ("action", [1e30] * 7),
        ("action", None), ("observation.state", [["a"]]), ("episode_index", 2), ("episode_index", None),
        ("task_index", 77), ("task_index", 1.5))},
    **{f"task {str(value)[:9]}": column(TASKS, "task", value) for value in (None, 3, "x" * 1001, "x" * 10**8)},
    "many rows": column(ROWS, "episode_index", 0, 200_000),
    "many episodes": column(OF_EPISODES, "episode_index", 0, 2_000),
    "long rows": column(ROWS, "action", LONG),
    "long texts": column(TASKS, "task", "x" * 10**4, 20_000),
    "images of a path only": pictures(None),
    "images that are none": pictures(b"\x89PNG"),
    "images of another size": pictures(png(64, 64)),
    "an image bomb": lambda folder: pictures(png(30_000, 12_000, bomb=True))(folder),
    TRAILING: lambda folder: pictures(png(32, 32, bomb=True))(folder),
}  # fmt: skip


def datasets(root: Path) -> Trials:
    """LeRobot datasets: imported as they were, or refused in a sentence."""
    if not (root / "dataset").exists():
        made = ("job=export", "export=lerobot", "export.folder=dataset", "collect.folder=store", "output=wrong")
        how, printed = run(root, *SMALL[:2], *made, f"collect.episodes={EPISODES}")
        assert how == "done", printed
    expected = imported(root, lambda folder: None, checksums=True)[2]
    assert expected and imported(root, lambda folder: None, checksums=False)[2] == expected
    chance = random.Random(0)
    files = [path for path in (root / "dataset").rglob("*") if path.is_file()]
    names = sorted(str(path.relative_to(root / "dataset")) for path in files)
    # What follows the pixels of an image is not unpacked.
    black = imported(root, pictures(png(32, 32)), checksums=False)[2]
    for attack, change in HOSTILE.items():
        how, printed, found = imported(root, change, checksums=False)
        right = black if attack == TRAILING else expected
        yield attack, how == "sentence" or (how == "done" and found == right), f"{how}: {last(printed)}"

    for name in names:
        for damage in DAMAGES:
            checksums = name.endswith((".mp4", "checksums.json"))  # nothing but a checksum says what these held
            how, printed, found = imported(root, partial(hurt, name, damage, chance), checksums)
            held = how == "sentence" or (not checksums and how == "done" and found == expected)
            yield (
                f"{damage.__name__} {name}, {'with' if checksums else 'without'} checksums",
                held,
                f"{how}: {last(printed)}",
            )


def imported(root: Path, change: Change, checksums: bool) -> tuple[str, str, dict[str, str]]:
    """How importing a changed copy of the dataset ended, what was printed, and the store's files."""
    shutil.rmtree(root / "imported", ignore_errors=True)
    shutil.rmtree(root / "hurt", ignore_errors=True)
    shutil.copytree(root / "dataset", root / "hurt")
    if not checksums:
        (root / "hurt/meta/checksums.json").unlink()
    change(root / "hurt")
    how, printed = run(root, *IMPORT)
    return how, printed, digest(root / "imported", ".bin", ".json", ".jsonl")


def bags(root: Path) -> Trials:
    """Bags that are imported, or refused in a sentence."""
    whole = root / "bag_whole"
    if not whole.exists():
        write_bag(whole)
    how, printed = learned(root, whole)
    assert how == "done", printed
    chance = random.Random(0)
    changes: dict[str, Change] = {
        f"{damage.__name__} {name} {number}": partial(hurt, name, damage, chance)
        for name, times in (("bag_whole.mcap", 4), ("metadata.yaml", 2))
        for damage in DAMAGES
        for number in range(times)
    }
    for name in ("bag_whole.mcap", "metadata.yaml"):
        changes |= {f"endless {name}": linked(name, "/dev/zero"), f"pipe {name}": piped(name)}
        changes |= {f"no {name}": partial(removed, name)}
        changes |= {f"empty {name}": written(name, b"")}
    changes["aliases"] = written("metadata.yaml", b"a: &a [x]\nb: [*a, *a]")
    changes["a file elsewhere"] = lambda folder: (folder / "metadata.yaml").write_text(
        (folder / "metadata.yaml").read_text().replace("bag_whole.mcap", "../../../../etc/passwd")
    )
    for attack, change in changes.items():
        shutil.rmtree(root / "bag", ignore_errors=True)
        shutil.copytree(whole, root / "bag")
        change(root / "bag")
        how, printed = learned(root, root / "bag")
        yield attack, how in ("sentence", "done"), f"{how}: {last(printed)}"


def learned(root: Path, folder: Path) -> tuple[str, str]:
    """How importing a bag ended, and what was printed."""
    shutil.rmtree(root / "lessons", ignore_errors=True)
    return run(root, "job=collect", "task=recorded", "expert=bag", f"expert.folder={folder}", *BAG)


def runs(root: Path) -> Trials:
    """Folders of runs that are compared: a page, or a sentence and no page."""
    if not (root / "evaluated/report.json").exists():
        how, printed = run(
            root, f"checkpoint={CHECKPOINT}", *("evaluate.episodes=2", "cluster.workers=1"), "output=evaluated"
        )
        assert how == "done", printed
        for name in ("training.json", "metrics.csv"):
            if (root / "run" / name).exists():
                shutil.copy(root / "run" / name, root / "evaluated")
    files = ("report.json", "config.yaml", "changes.yaml", "training.json", "metrics.csv", "rollouts.rrd")
    there = [name for name in files if (root / "evaluated" / name).exists()]
    chance = random.Random(0)
    changes: dict[str, Change] = {}
    for name in there:
        for number in range(1):
            changes |= {f"{damage.__name__} {name} {number}": partial(hurt, name, damage, chance) for damage in DAMAGES}
        changes |= {f"endless {name}": linked(name, "/dev/zero"), f"pipe {name}": piped(name)}
        changes |= {f"nested {name}": written(name, b"[" * 10**5), f"zeros {name}": written(name, bytes(4096))}
        changes |= {f"a folder {name}": partial(emptied, name)}
    for attack, change in changes.items():
        for name in ("hurt_run", "wrong"):
            shutil.rmtree(root / name, ignore_errors=True)
        shutil.copytree(root / "evaluated", root / "hurt_run")
        change(root / "hurt_run")
        how, printed = run(root, "job=report", "report.runs=[hurt_run,evaluated]", "output=wrong")
        page = (root / "wrong/comparison.html").exists()
        yield attack, (how, page) in (("sentence", False), ("done", True)), f"{how}, page {page}: {last(printed)}"
