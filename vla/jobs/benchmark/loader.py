"""Throughput of the loader, also of large images."""

from __future__ import annotations

from dataclasses import replace
from itertools import cycle
from tempfile import TemporaryDirectory

import numpy as np
import torch

from vla.config.experiment import Experiment
from vla.config.nodes import Benchmark
from vla.data.episodes import EpisodeStore
from vla.data.header import Codec
from vla.jobs.benchmark.measure import Measure, measure, timed
from vla.jobs.collect import demonstrations
from vla.rollouts.rollout import rollout
from vla.spec import Episode

ROUNDS = 5  # of the loader and of its floor, in turns; the fastest counts
LARGE = 224  # height and width of large images [px]
EPISODES, STEPS = 2500, 100  # of a store whose size is extrapolated


def loader(experiment: Experiment) -> dict[str, Measure]:
    """Measure windows per second with the history of the model and others; the floor is a bare gather of the images.

    If an expert can act in the task, and that has an option for the image size, also measure large images from three
    cameras in two codecs, and the size of their store; the floor of that size is the size of the raw images.
    """
    store = demonstrations(experiment)
    model = experiment.fitted_learner(store).model
    variant = experiment.with_values({"collect.more": None})  # the floor reads one store
    names = {"loader": model.history, "loader: 1 frame": 1, "loader: 6 frames": 6}
    measures = {name: _measure_loading(variant, store, frames, model.chunk) for name, frames in names.items()}
    if experiment.has_expert and isinstance(experiment["task"].get("image_size"), list):
        measures |= _measure_large_images(variant.with_values({"task.image_size": [LARGE, LARGE]}), model.chunk)
    return measures


def _measure_large_images(experiment: Experiment, chunk: int) -> dict[str, Measure]:
    environment, measures = experiment.make_environment()(), dict[str, Measure]()
    expert = experiment.make_expert()(environment)
    seeds = range(experiment.options(Benchmark).episodes)
    episodes = [_from_three_cameras(rollout(environment, expert, seed)) for seed in seeds]
    environment.close()
    spec = replace(environment.spec, cameras=tuple(episodes[0].observations[0].rgb), depth=(), parts=())
    variant = experiment.with_values({"collect.episodes": len(seeds), "data.validation_fraction": 0})
    for codec in (Codec.for_spec(spec), Codec("jpeg", experiment.collect.quality)):
        with TemporaryDirectory() as folder:
            store = EpisodeStore.create_or_open(folder, spec, {}, codec)
            with store.writing():
                for episode in episodes:
                    store.append(episode)
            name, steps = f"loader: 3 x {LARGE} px, {codec.images}", store.episodes[-1].end
            measures[name] = _measure_loading(variant, store, 1, chunk)
            size = sum(store.size(field, entry) for field in store.fields for entry in store.episodes) / steps
            total = measure(EPISODES * STEPS * size / 1e9, "GB", steps, EPISODES * STEPS * store.row_size / 1e9)
            measures[f"{name}, {EPISODES} x {STEPS} steps"] = total
    return measures


def _from_three_cameras(episode: Episode) -> Episode:
    """Return an episode, whatever its outcome, with the images of two cameras and mirrored ones of the first."""
    observations = []
    for observation in episode.observations:
        images = [*observation.rgb.values()]
        rgb = {"first": images[0], "last": images[-1], "mirrored": images[0][:, ::-1]}
        observations.append(replace(observation, rgb=rgb, depth={}, instruction=episode.instruction))
    return replace(episode, outcome="success", observations=observations)


def _measure_loading(experiment: Experiment, store: EpisodeStore, history: int, chunk: int) -> Measure:
    data, batches = experiment.data(store, history, chunk), experiment.options(Benchmark).batches
    data.setup("fit")
    images = [store.rows(f"rgb_{camera}")[:] for camera in store.spec.cameras]
    starts = np.array([entry.start for entry in store.episodes])
    rows = []
    for windows in map(data.order, range(batches)):
        first_rows = starts[np.searchsorted(starts, windows, side="right") - 1]
        rows.append(np.maximum(windows[:, None] + np.arange(1 - history, 1), first_rows[:, None]))  # (B, T)

    # Fill two batches in turns, as one is in use while the next is made: a single one would stay in the cache.
    shapes = [(*rows[0].shape, *image.shape[1:]) for image in images]
    buffers = [[torch.empty(shape, dtype=torch.uint8).numpy() for shape in shapes] for _ in range(2)]

    def bare() -> None:
        for index, arrays in zip(rows, cycle(buffers)):
            for image, array in zip(images, arrays, strict=True):
                image.take(index, axis=0, out=array, mode="clip")  # "clip" writes into `out` without a buffer

    def load() -> None:
        for _ in zip(range(batches), data.train_dataloader(), strict=False):
            pass

    bare()  # warm-up: reads the images from the disk
    bare_time, load_time = np.min([(timed(bare)[1], timed(load)[1]) for _ in range(ROUNDS)], axis=0)
    count = batches * data.batch_size
    return measure(count / load_time, "windows/s", count, count / bare_time)
