"""How fast the stages run, each against a floor that was measured on the same work in the same run.

A floor is what the stage could not do without: a ratio of 1 would mean that everything around it costs nothing.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
from omegaconf import DictConfig

if TYPE_CHECKING:
    from vla.data.episodes import EpisodeStore
    from vla.data.windows import Windows

Measure = dict[str, Any]  # value, unit, n, floor, ratio

ROUNDS = 5  # of the loader and of its floor


def benchmark(config: DictConfig, output: Path) -> dict[str, Measure]:
    """Measure what `config.benchmark.names` lists, print a table, write `benchmark.json`; name → measure.

    Raises:
        ValueError: a name that is no stage.
    """
    unknown = sorted(set(config.benchmark.names) - set(STAGES))
    if unknown:
        raise ValueError(f"benchmark.names has {unknown}, the stages are {sorted(STAGES)}")
    measures: dict[str, Measure] = {}
    for name in config.benchmark.names:
        measures |= STAGES[name](config)
    draft = output / "benchmark.json.partial"
    draft.write_text(json.dumps(measures, indent=2), encoding="utf-8")
    os.replace(draft, output / "benchmark.json")
    _show(measures)
    return measures


def collection(config: DictConfig) -> dict[str, Measure]:
    """Control steps of the expert in one process with all cameras, against bare physics and rendering of as many."""
    import mujoco

    from vla.jobs import make_environment, make_expert, plain
    from vla.rollout import rollout

    environment = make_environment(plain(config.task))
    expert = make_expert(plain(config.expert), environment)
    rollout(environment, expert, 0)  # the first one compiles shaders
    started = time.perf_counter()
    steps = sum(len(rollout(environment, expert, seed).actions) for seed in range(config.benchmark.episodes))
    seconds = time.perf_counter() - started
    bound, render = environment.task.bound, environment.renderer.render
    substeps = environment.task.physics_steps_per_control_step
    started = time.perf_counter()
    for _ in range(steps):
        mujoco.mj_step(bound.model, bound.data, substeps)
        for camera in environment.spec.cameras:
            render(bound.data, bound.cameras[camera])
    floor = steps / (time.perf_counter() - started)
    environment.close()
    return {"collect": _measure(steps / seconds, "control steps/s", steps, floor)}


def loader(config: DictConfig) -> dict[str, Measure]:
    """Training windows through the loader, against a bare gather of the same images; as the model wants them, and more.

    The best of a few rounds, in turns, on pages that are in memory.
    """
    from vla.jobs import collected, make_data, make_learner

    store = collected(config)
    model = make_learner(config, store).model
    measures = {"loader": _loading(make_data(config, store, model), store, model.history, config.benchmark.batches)}
    for frames in (1, 6):
        data = make_data(config, store, SimpleNamespace(history=frames, chunk=model.chunk))
        name = f"loader: {frames} frame{'s' if frames > 1 else ''}"
        measures[name] = _loading(data, store, frames, config.benchmark.batches)
    return measures


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

    def seconds(work: Callable[[], None]) -> float:
        started = time.perf_counter()
        work()
        return time.perf_counter() - started

    bare()  # the disk has nothing to do with either
    floor, own = np.min([(seconds(bare), seconds(load)) for _ in range(ROUNDS)], axis=0)
    count = batches * data.batch_size
    return _measure(count / own, "windows/s", count, count / floor)


def training(config: DictConfig) -> dict[str, Measure]:
    """Samples through the trainer, against forward, backward and optimiser step alone on one resident batch."""
    import torch
    from lightning import Callback

    from vla.jobs import collected, make_data, make_learner
    from vla.training import make_trainer, quiet_lightning

    quiet_lightning()

    store = collected(config)
    steps = config.benchmark.steps
    short = config.copy()
    short.trainer.max_steps, short.trainer.limit_val_batches = 2 * steps, 0
    learner = make_learner(short, store)
    data = make_data(short, store, learner.model)
    clock: list[float] = []  # when each step ended

    class Clock(Callback):
        def on_train_batch_end(self, *_: Any) -> None:
            clock.append(time.perf_counter())

    trainer = make_trainer(short, None, Clock())
    trainer.fit(learner, datamodule=data)
    seconds = clock[-1] - clock[steps - 1]
    batch = learner.prepare(next(iter(data.train_dataloader())))
    optimizer = torch.optim.AdamW(learner.model.parameters())
    learner.model.train()
    started = time.perf_counter()
    for _ in range(steps):
        optimizer.zero_grad()
        learner.model.loss(batch)["loss"].backward()
        optimizer.step()
    floor = steps * data.batch_size / (time.perf_counter() - started)
    samples = steps * data.batch_size
    return {"train": _measure(samples / seconds, "samples/s", samples, floor)}


def policy(config: DictConfig) -> dict[str, Measure]:
    """Actions of the policy per second, batch of one, against its network's forward pass alone."""
    import torch

    from vla.jobs import collected, make_environment, make_learner, plain
    from vla.policy import Policy

    environment = make_environment(plain(config.task))
    observation = environment.reset(0)
    store = collected(config)
    model = make_learner(config, store).model.eval()
    agent = Policy(model, environment.spec)
    agent.reset(observation.instruction, 0)
    agent.act(observation)
    steps = config.benchmark.steps
    started = time.perf_counter()
    for _ in range(steps):
        agent.act(observation)
    rate = steps / (time.perf_counter() - started)
    batch = agent.window()
    with torch.inference_mode():
        started = time.perf_counter()
        for _ in range(steps):
            model(batch)
    floor = steps / (time.perf_counter() - started)
    environment.close()
    return {"policy": _measure(rate, "actions/s", steps, floor)}


def deployment(config: DictConfig) -> dict[str, Measure]:
    """The deployed loop over ROS 2 between processes, in real time: three measures.

    From taking an image to the command that follows, at the median, against inference alone; the time between commands
    at the 99th percentile, against what it should be; from a frozen simulator to a holding agent, at the median,
    against the age at which a joint state counts as lost.

    Raises:
        ValueError: no loop or no checkpoint is chosen.
    """
    from vla.jobs import deployed

    if not config.deploy or config.deploy._target_ != "vla.deploy.loop.Loop":
        raise ValueError("benchmark.names=[deploy] needs deploy=loop checkpoint=FILE")
    loop = deployed(config)
    with loop.playing() as person:
        for _ in range(loop.episodes):
            person.play()
        person.begin()
        reactions = [1000 * person.react() for _ in range(config.benchmark.episodes)]
        figures = {key: float(value) for key, value in person.status.items() if key.endswith("[ms]")}
    agent = config.deploy.agent
    image, inference = (figures[f"{name} p50 [ms]"] for name in ("image to command", "inference"))
    return {
        "deploy: image to command": _measure(image, "ms", loop.episodes, inference),
        "deploy: tick p99": _measure(figures["tick p99 [ms]"], "ms", loop.episodes, 1000 / agent.command_hz),
        "deploy: watchdog": _measure(float(np.median(reactions)), "ms", len(reactions), 1000 * agent.safety.joints_age),
    }


STAGES: dict[str, Callable[[DictConfig], dict[str, Measure]]] = {
    "collect": collection,
    "loader": loader,
    "train": training,
    "policy": policy,
    "deploy": deployment,
}


def _measure(value: float, unit: str, n: int, floor: float) -> Measure:
    return {"value": round(value, 2), "unit": unit, "n": n, "floor": round(floor, 2), "ratio": round(value / floor, 3)}


def _show(measures: dict[str, Measure]) -> None:
    from rich import print as show
    from rich.table import Table

    table = Table("stage", "value", "unit", "n", "floor", "ratio")
    for name, measure in measures.items():
        table.add_row(name, *(str(measure[key]) for key in ("value", "unit", "n", "floor", "ratio")))
    show(table)
