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

VIDEO, EPISODES, ROWS = (
    "videos/observation.images.front/",
    "meta/episodes/chunk-000/file-000.parquet",
    "data/chunk-000/file-000.parquet",
)
PICTURE = pa.struct({"bytes": pa.binary(), "path": pa.string()})


def made(home: Path) -> Path:
    """A `store` of three episodes in a folder, and the `dataset` made of it."""
    exporter("lerobot", home / "dataset", "export.crf=5").export(stored(home / "store", seeds=range(3))[0])
    return home


def demonstrations(folder: Path | str | None, spec: Spec, **options: Any) -> LeRobotDemonstrations:
    return LeRobotDemonstrations(**defaults_of("expert/lerobot", folder=folder, **options), spec=spec)


def imported(dataset: Path, folder: Path, episodes: int = 3) -> EpisodeStore:
    expert = demonstrations(str(dataset), ARM_SPEC)
    store = EpisodeStore.create_or_open(folder, expert.spec, {})
    expert.fill(store, episodes)
    return store


def copied(home: Path, folder: Path) -> Path:
    """A copy of the dataset as others would write it, without checksums."""
    dataset = Path(shutil.copytree(home / "dataset", folder))
    (dataset / "meta/checksums.json").unlink()
    return dataset


def changed_info(home: Path, tmp_path: Path, change: Callable[[Any], None]) -> Path:
    """A copy of the dataset whose description was changed."""
    dataset = copied(home, tmp_path / "dataset")
    info = json.loads((dataset / "meta/info.json").read_text())
    change(info)
    (dataset / "meta/info.json").write_text(json.dumps(info))
    return dataset


def changed_table(path: Path, name: str, values: Callable[[pa.Table], pa.Array]) -> None:
    """Replace a column of a table."""
    table = pq.read_table(path)
    pq.write_table(table.set_column(table.column_names.index(name), name, values(table)), path)


def png(image: Image.Image) -> bytes:
    """As LeRobot writes images."""
    return as_file(image, "PNG")


def as_file(image: Image.Image, format: str, **options: Any) -> bytes:
    """The file of an image."""
    file = io.BytesIO()
    image.save(file, format, **options)
    return file.getvalue()


def as_pictures(home: Path, folder: Path, packed: Callable[[Image.Image], bytes] = png, channels: int = 3) -> Path:
    """The dataset of `home` with its images within the table, as LeRobot writes it with `use_videos=False`."""
    dataset, store = copied(home, folder), EpisodeStore(home / "store")
    shutil.rmtree(dataset / "videos")
    info = json.loads((dataset / "meta/info.json").read_text())
    path = dataset / "data/chunk-000/file-000.parquet"
    table = pq.read_table(path)
    for camera in ARM_SPEC.cameras:
        key = f"observation.images.{camera}"
        info["features"][key] = {
            "dtype": "image",
            "shape": [channels, 16, 16],
            "names": ["channels", "height", "width"],
        }
        images = [Image.fromarray(image) for image in np.asarray(store.rows(f"rgb_{camera}"))]
        cells = [{"bytes": packed(image), "path": f"../../frame-{step:06d}.png"} for step, image in enumerate(images)]
        table = table.append_column(key, pa.array(cells, PICTURE))
    pq.write_table(table, path)
    (dataset / "meta/info.json").write_text(json.dumps(info))
    path = dataset / "meta/episodes/chunk-000/file-000.parquet"
    table = pq.read_table(path)
    pq.write_table(table.drop_columns([name for name in table.column_names if name.startswith("videos/")]), path)
    return dataset
