"""A small LeRobot dataset, changed copies of it, and their import."""

from __future__ import annotations

import io
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from defaults import defaults_of
from exporting import exporter, stored
from PIL import Image
from toy import ARM_SPEC

from vla.data.episodes import EpisodeStore
from vla.data.formats.lerobot_import import LeRobotDemonstrations
from vla.spec import Spec

FRONT = "observation.images.front"
VIDEO, INFO, TASKS = f"videos/{FRONT}/", "meta/info.json", "meta/tasks.parquet"
EPISODES, ROWS = "meta/episodes/chunk-000/file-000.parquet", "data/chunk-000/file-000.parquet"
PICTURE = pa.struct({"bytes": pa.binary(), "path": pa.string()})

Change = Callable[[Path], object]  # does something to the dataset in a folder


def made(home: Path) -> Path:
    """A `store` of three episodes in a folder, and the `dataset` made of it."""
    exporter("lerobot", home / "dataset", "export.crf=5").export(stored(home / "store", seeds=range(3))[0])
    return home


def demonstrations(folder: Path | None, spec: Spec, **options: Any) -> LeRobotDemonstrations:
    return LeRobotDemonstrations(**defaults_of("expert/lerobot", folder=folder, **options), spec=spec)


def imported(dataset: Path, folder: Path, episodes: int = 3) -> EpisodeStore:
    expert = demonstrations(dataset, ARM_SPEC)
    store = EpisodeStore.create_or_open(folder, expert.spec, {})
    expert.fill(store, episodes)
    return store


def changed(home: Path, folder: Path, *changes: Change) -> Path:
    """A changed copy of the dataset as others would write it, without checksums."""
    dataset = Path(shutil.copytree(home / "dataset", folder))
    (dataset / "meta/checksums.json").unlink()
    for change in changes:
        change(dataset)
    return dataset


def info(change: Callable[[Any], object]) -> Change:
    def apply(dataset: Path) -> None:
        content = json.loads((dataset / INFO).read_text())
        change(content)
        (dataset / INFO).write_text(json.dumps(content))

    return apply


def rows(change: Callable[[pa.Table], pa.Table]) -> Change:
    return lambda dataset: pq.write_table(change(pq.read_table(dataset / ROWS)), dataset / ROWS)


def column(file: str, name: str, value: Any) -> Change:
    """Replace a column of a table by one value, or by what a function makes of the table."""

    def apply(dataset: Path) -> None:
        table = pq.read_table(dataset / file)
        values = value(table) if callable(value) else pa.array([value] * len(table))
        pq.write_table(table.set_column(table.column_names.index(name), name, values), dataset / file)

    return apply


def png(image: Image.Image) -> bytes:
    """As LeRobot writes images."""
    return as_file(image, "PNG")


def as_file(image: Image.Image, format: str, **options: Any) -> bytes:
    file = io.BytesIO()
    image.save(file, format, **options)
    return file.getvalue()


def as_pictures(home: Path, folder: Path, packed: Callable[[Image.Image], bytes] = png, channels: int = 3) -> Path:
    """The dataset of `home` with its images within the table, as LeRobot writes it with `use_videos=False`."""
    dataset, store = changed(home, folder), EpisodeStore(home / "store")
    shutil.rmtree(dataset / "videos")
    table = pq.read_table(dataset / ROWS)
    for camera in ARM_SPEC.cameras:
        key = f"observation.images.{camera}"
        names = ["channels", "height", "width"]
        image = {"dtype": "image", "shape": [channels, 16, 16], "names": names}
        info(lambda content, key=key, image=image: content["features"].update({key: image}))(dataset)
        images = [Image.fromarray(image) for image in np.asarray(store.rows(f"rgb_{camera}"))]
        cells = [{"bytes": packed(image), "path": f"../../frame-{step:06d}.png"} for step, image in enumerate(images)]
        table = table.append_column(key, pa.array(cells, PICTURE))
    pq.write_table(table, dataset / ROWS)
    episodes = pq.read_table(dataset / EPISODES)
    kept = [name for name in episodes.column_names if not name.startswith("videos/")]
    pq.write_table(episodes.select(kept), dataset / EPISODES)
    return dataset
