"""Datasets, bags and runs that are damaged, or that somebody made to do harm."""

from __future__ import annotations

import os
import random
import shutil
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from bags import write as write_bag
from lerobot_files import EPISODES as OF_EPISODES
from lerobot_files import FRONT, INFO, PICTURE, ROWS, TASKS, Change, column, info
from lerobot_files import png as packed
from PIL import Image
from test_lerobot_import import REFUSED, told
from trials import CHECKPOINT, SMALL, Trials, digest, last, run

EPISODES = 4
COLLECTED = (*SMALL[:2], f"collect.episodes={EPISODES}", "output=wrong")
IMPORT = ("job=collect", "expert=lerobot", "expert.folder=hurt", "collect.folder=imported", *COLLECTED)
VIDEO = f"videos/{FRONT}/chunk-000/file-000.mp4"
BAG = (
    *("task.joints=all", "task.units=rad", "task.image_size=[8,8]", "expert.robot.fingers=[left,right]"),
    *(
        "expert.topics.joint_states=/joint_states",
        "expert.topics.instruction=/words",
        "expert.topics.commands=/commands",
    ),
    *("expert.topics.images={front: /front, wrist: /wrist}", "collect.folder=lessons", "output=wrong"),
)


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


def damages(name: str, times: int, chance: random.Random) -> dict[str, Change]:
    """Damage a file of a folder in all ways, so many times each."""
    return {
        f"{damage.__name__} {name} {number}": lambda folder, damage=damage: damage(folder / name, chance)
        for damage in DAMAGES
        for number in range(times)
    }


def instead(name: str, put: Callable[[Path], object] = lambda path: None) -> Change:
    """Put something, by default nothing, in the place of a file."""

    def change(folder: Path) -> None:
        (folder / name).unlink()
        put(folder / name)

    return change


def written(name: str, data: bytes) -> Change:
    """Put other contents in the place of a file."""
    return lambda folder: (folder / name).write_bytes(data)


def unreadable(name: str) -> dict[str, Change]:
    """Put what nobody can read to its end in the place of a file."""
    return {
        f"endless {name}": instead(name, lambda path: path.symlink_to("/dev/zero")),
        f"pipe {name}": instead(name, os.mkfifo),
        f"a folder {name}": instead(name, Path.mkdir),
    }


def feature(key: str, **values: Any) -> Change:
    """Change what `info.json` says of a feature."""
    return info(lambda content: content["features"].update({key: values}))


def repeated(file: str, name: str, value: Any, rows: int) -> Change:
    """Let a table have so many rows, all alike, with one value in a column."""

    def change(folder: Path) -> None:
        table = pq.read_table(folder / file)
        pq.write_table(table.take(pa.array(np.zeros(rows, np.int64))), folder / file)
        column(file, name, lambda table: pa.array([value]).take(pa.array(np.zeros(rows, np.int64))))(folder)

    return change


def bomb(height: int, width: int) -> bytes:
    """A PNG that says so of its size and unpacks to a gigabyte."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    packer = zlib.compressobj(9)
    packed = b"".join(packer.compress(bytes(1 << 20)) for _ in range(1024)) + packer.flush()
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", packed) + chunk(b"IEND", b"")


def pictures(content: bytes | None) -> Change:
    """Let a camera's images be files in the table, all of them the same."""

    def change(folder: Path) -> None:
        table = pq.read_table(folder / ROWS)
        images = pa.array([{"bytes": content, "path": "../../../etc/passwd"}] * len(table), PICTURE)
        pq.write_table(table.append_column(FRONT, images), folder / ROWS)
        feature(FRONT, dtype="image", shape=[32, 32, 3], names=None)(folder)

    return change


def plain(height: int, width: int) -> bytes:
    """A black PNG."""
    return packed(Image.new("RGB", (width, height)))


TRAILING = "an image bomb that says 32 x 32"
# What is done to a dataset, beside what tests refuse; the large images take seconds to make, so not before they are
# wanted.
HOSTILE: dict[str, Change] = {
    **{f"{number}: {says}": change for number, (change, says) in enumerate(REFUSED)},
    **{f"fps {value!r}": told(fps=value) for value in (20, 1e308, None)},
    **{f"image shape {value}": feature(FRONT, dtype="video", shape=value)
       for value in ([32, 32], [10**12, 10**12, 3], ["32", 32, 3])},
    **{f"action names {value}": feature("action", dtype="float32", shape=[7], names=value)
       for value in (["a"] * 7, {"x": 1})},
    "image dtype": feature(FRONT, dtype="object", shape=[32, 32, 3]),
    "action dtype": feature("action", dtype="string", shape=[10**9]),
    "counts of totals": told(total_episodes=10**18, total_frames=-1, chunks_size=0),
    "paths in info": told(data_path="../../{chunk_index}.parquet", video_path="/etc/passwd"),
    "info large": written(INFO, b" " * (40 << 20) + b"{}"),
    "info not text": written(INFO, bytes(range(256))),
    "info twice": lambda folder: (folder / INFO).write_text((folder / INFO).read_text()[:-2] + ',"fps":20}'),
    **{name: change for file in (INFO, TASKS, ROWS, OF_EPISODES, VIDEO) for name, change in unreadable(file).items()},
    "endless checksums": lambda folder: (folder / "meta/checksums.json").symlink_to("/dev/zero"),
    "checksums elsewhere": written("meta/checksums.json", b'{"../../../../etc/passwd": 1}'),
    "folder in a circle": lambda folder: (folder / "data/chunk-001").symlink_to("..", True),
    "video of files": written(VIDEO, b"ffconcat version 1.0\nfile '/etc/passwd'\n"),
    "video of addresses": written(VIDEO, b"#EXTM3U\n#EXTINF:1,\nhttp://127.0.0.1:9/x.ts\n#EXT-X-ENDLIST\n"),
    "video an image": written(VIDEO, plain(32, 32)),
    "video of another size": lambda folder: written(VIDEO, plain(20_000, 20_000))(folder),
    "videos gone": lambda folder: shutil.rmtree(folder / "videos"),
    **{f"{of.rpartition('/')[2]} {value!r}": column(OF_EPISODES, of, value) for of, value in (
        (f"videos/{FRONT}/chunk_index", 2**40), (f"videos/{FRONT}/from_timestamp", 9e5), ("dataset_from_index", -5),
        ("dataset_to_index", 2**62), ("dataset_to_index", 3), ("data/file_index", None), ("episode_index", "0"))},
    **{f"{of} {str(value)[:20]}": column(ROWS, of, value) for of, value in (
        ("action", [float("nan")] * 7), ("action", [1e30] * 7), ("action", None), ("observation.state", [["a"]]),
        ("episode_index", 2), ("task_index", 1.5))},
    **{f"task {str(value)[:9]}": column(TASKS, "task", value) for value in (3, "x" * 10**8)},
    "many rows": repeated(ROWS, "episode_index", 0, 200_000),
    "many episodes": repeated(OF_EPISODES, "episode_index", 0, 2_000),
    "long rows": column(ROWS, "action", [0.0] * 300_000),
    "long texts": repeated(TASKS, "task", "x" * 10**4, 20_000),
    "images of a path only": pictures(None),
    "images that are none": pictures(b"\x89PNG"),
    "images of another size": pictures(plain(64, 64)),
    "an image bomb": lambda folder: pictures(bomb(30_000, 12_000))(folder),
    TRAILING: lambda folder: pictures(bomb(32, 32))(folder),
}  # fmt: skip


def exported(root: Path, kind: str, folder: str) -> None:
    """Export the episodes of the store, once."""
    if not (root / folder).exists():
        made = ("job=export", f"export={kind}", f"export.folder={folder}", "collect.folder=store")
        how, printed = run(root, *made, *COLLECTED)
        assert how == "done", printed


def datasets(root: Path) -> Trials:
    """LeRobot datasets: imported as they were, or refused in a sentence."""
    exported(root, "lerobot", "dataset")
    expected = imported(root, lambda folder: None, checksums=True)[2]
    assert expected and imported(root, lambda folder: None, checksums=False)[2] == expected
    # What follows the pixels of an image is not unpacked.
    black = imported(root, pictures(plain(32, 32)), checksums=False)[2]
    for attack, change in HOSTILE.items():
        how, printed, found = imported(root, change, checksums=False)
        right = black if attack == TRAILING else expected
        yield attack, how == "sentence" or (how == "done" and found == right), f"{how}: {last(printed)}"
    files, chance = [path for path in (root / "dataset").rglob("*") if path.is_file()], random.Random(0)
    for name in sorted(str(path.relative_to(root / "dataset")) for path in files):
        checksums = name.endswith((".mp4", "checksums.json"))  # nothing but a checksum says what these held
        for attack, change in damages(name, 1, chance).items():
            how, printed, found = imported(root, change, checksums)
            held = how == "sentence" or (not checksums and how == "done" and found == expected)
            yield attack, held, f"{how}: {last(printed)}"


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
    chance, changes = random.Random(0), dict[str, Change]()
    for name, times in (("bag_whole.mcap", 4), ("metadata.yaml", 2)):
        changes |= {**damages(name, times, chance), **unreadable(name)}
        changes |= {f"no {name}": instead(name), f"empty {name}": written(name, b"")}
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
    chance, changes = random.Random(0), dict[str, Change]()
    for name in (name for name in files if (root / "evaluated" / name).exists()):
        changes |= {**damages(name, 1, chance), **unreadable(name)}
        changes |= {f"nested {name}": written(name, b"[" * 10**5), f"zeros {name}": written(name, bytes(4096))}
    for attack, change in changes.items():
        for name in ("hurt_run", "wrong"):
            shutil.rmtree(root / name, ignore_errors=True)
        shutil.copytree(root / "evaluated", root / "hurt_run")
        change(root / "hurt_run")
        how, printed = run(root, "job=report", "report.runs=[hurt_run,evaluated]", "output=wrong")
        page = (root / "wrong/comparison.html").exists()
        yield attack, (how, page) in (("sentence", False), ("done", True)), f"{how}, page {page}: {last(printed)}"
