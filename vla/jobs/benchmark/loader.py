"""Throughput of the loader, and of LeRobot's loader."""

from __future__ import annotations

from itertools import cycle
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import numpy as np

from vla.config.build import build
from vla.config.compose import compose
from vla.config.experiment import Experiment, plain
from vla.data.episodes import EpisodeStore
from vla.data.window_batches import aligned_empty
from vla.jobs.benchmark.baselines.peer import DURATION, peer
from vla.jobs.benchmark.measure import Measure, measure, timed
from vla.jobs.collect import demonstrations

if TYPE_CHECKING:
    from vla.data.datamodule import WindowDataModule

ROUNDS = 5  # of the loader and of its floor, in turns; the fastest counts
PEER_EPISODES = 50  # maximum number of episodes for LeRobot's loader


def measures(experiment: Experiment) -> dict[str, Measure]:
    """Measure training windows per second, with the history of the model and with other ones.

    The floor is a bare gather of the same images. If `benchmark.lerobot` names a Python interpreter, the floor of two
    further measures is LeRobot's loader on the same episodes.
    """
    asked = experiment["benchmark"]
    store = demonstrations(experiment)
    model = experiment.fitted_learner(store).model
    alone = experiment.with_values({"collect.more": None})  # the floor reads one store
    names = {1: "loader: 1 frame", 6: "loader: 6 frames"}
    found = {
        name: _loading(alone.data(store, frames, model.chunk), store, frames, asked["batches"])
        for frames, name in [(model.history, "loader"), *names.items()]
    }
    if asked["lerobot"] is not None:
        some = EpisodeStore(store.folder, min(experiment["collect"]["episodes"], PEER_EPISODES))
        with TemporaryDirectory() as folder:
            export = plain(compose("export=lerobot", f"output={folder}").export)
            dataset = build(export, "export").export(some, experiment.cluster())
            for frames, name in names.items():
                rival = peer("lerobot", asked["lerobot"], "lerobot_windows.py", (dataset, frames, DURATION))
                own = found[name]
                found[f"{name}, against LeRobot"] = measure(own["value"], own["unit"], own["n"], rival)
    return found


def _loading(data: WindowDataModule, store: EpisodeStore, history: int, batches: int) -> Measure:
    data.setup("fit")
    images = [store.rows(f"rgb_{camera}") for camera in store.spec.cameras]
    starts = np.array([entry.start for entry in store.episodes])
    rows = []
    for windows in map(data.order, range(batches)):
        first = starts[np.searchsorted(starts, windows, side="right") - 1]
        rows.append(np.maximum(windows[:, None] + np.arange(1 - history, 1), first[:, None]))  # (B, T)

    # Into two batches by turns, because one is in use while the next is made: a single one would stay in the cache.
    buffers = [[aligned_empty((*rows[0].shape, *image.shape[1:]), image.dtype) for image in images] for _ in range(2)]

    def bare() -> None:
        for index, arrays in zip(rows, cycle(buffers)):
            for image, array in zip(images, arrays, strict=True):
                image.take(index, axis=0, out=array, mode="clip")  # "clip" writes into `out` without a buffer

    def load() -> None:
        stream = iter(data.train_dataloader())
        for _ in range(batches):
            next(stream)

    bare()  # warm-up: reads the images from the disk
    floor, own = np.min([(timed(bare)[1], timed(load)[1]) for _ in range(ROUNDS)], axis=0)
    count = batches * data.batch_size
    return measure(count / own, "windows/s", count, count / floor)
