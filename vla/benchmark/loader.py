"""Training windows per second, of the loader and of LeRobot's beside it."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import TYPE_CHECKING

import numpy as np
from omegaconf import DictConfig

from vla.benchmark.measure import Measure, measure, timed
from vla.peers.peer import PATIENCE, peer

if TYPE_CHECKING:
    from vla.data.episodes import EpisodeStore
    from vla.data.windows import Windows

ROUNDS = 5  # of the loader and of its floor
PEER_EPISODES = 50  # that another project's loader gets


def measures(config: DictConfig) -> dict[str, Measure]:
    """Training windows through the loader, against a bare gather of the same images; as the model wants them, and more.

    The best of a few rounds, in turns, on pages that are in memory. Where `config.benchmark.lerobot` names a Python,
    the floor of two more measures is LeRobot's loader on the same episodes.
    """
    from vla.data.episodes import EpisodeStore
    from vla.data.lerobot import LeRobot
    from vla.parts import collected, make_data, make_learner

    store = collected(config)
    model = make_learner(config, store).model
    found = {"loader": _loading(make_data(config, store, model), store, model.history, config.benchmark.batches)}
    names = {1: "loader: 1 frame", 6: "loader: 6 frames"}
    for frames, name in names.items():
        data = make_data(config, store, SimpleNamespace(history=frames, chunk=model.chunk))
        found[name] = _loading(data, store, frames, config.benchmark.batches)
    if config.benchmark.lerobot is not None:
        some = EpisodeStore(store.folder, min(config.collect.episodes, PEER_EPISODES))
        with TemporaryDirectory() as folder:
            dataset = LeRobot(Path(folder) / "dataset").export(some)
            for frames, name in names.items():
                arguments = (dataset, frames, PATIENCE)
                rival = peer("lerobot", config.benchmark.lerobot, "lerobot_windows.py", arguments)
                own = found[name]
                found[f"{name}, against LeRobot"] = measure(own["value"], own["unit"], own["n"], rival)
    return found


def _loading(data: Windows, store: EpisodeStore, history: int, batches: int) -> Measure:
    data.setup("fit")
    images = [store.rows(f"rgb_{camera}") for camera in store.spec.cameras]
    starts = np.array([entry.start for entry in store.episodes])
    rows = []
    for windows in map(data.order, range(batches)):
        first = starts[np.searchsorted(starts, windows, side="right") - 1]
        rows.append(np.maximum(windows[:, None] + np.arange(1 - history, 1), first[:, None]))  # (B, T)

    def bare() -> None:
        for index in rows:
            for image in images:
                image.take(index, axis=0)

    def load() -> None:
        stream = iter(data.train_dataloader())
        for _ in range(batches):
            next(stream)

    bare()  # the disk has nothing to do with either
    floor, own = np.min([(timed(bare)[1], timed(load)[1]) for _ in range(ROUNDS)], axis=0)
    count = batches * data.batch_size
    return measure(count / own, "windows/s", count, count / floor)
