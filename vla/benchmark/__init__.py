"""How fast the stages run, each against a floor that was measured on the same work in the same run.

A floor is what the stage could not do without: a ratio of 1 would mean that everything around it costs nothing.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
from omegaconf import DictConfig

from vla.check import build
from vla.peers.peer import peer
from vla.workers import cores

if TYPE_CHECKING:
    from vla.data.episodes import EpisodeStore
    from vla.data.windows import Windows
    from vla.spec import Episode

Measure = dict[str, Any]  # value, unit, n, floor, ratio

ROUNDS = 5  # of the loader and of its floor
PATIENCE = 20.0  # with another project [s]
PEER_EPISODES = 50  # that another project's loader gets


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
    """Collection: of one process with all cameras against bare physics and rendering of as many steps, where its time
    goes, of all processes, and where `config.benchmark.robosuite` names a Python, of robosuite on the same work."""
    import mujoco

    from vla.collect import Demonstrator
    from vla.data.episodes import EpisodeStore
    from vla.jobs import make_environment, make_expert, plain
    from vla.rollout import replay, rollout

    makers = partial(make_environment, plain(config.task)), partial(make_expert, plain(config.expert))
    environment = makers[0]()
    expert = makers[1](environment)
    rollout(environment, expert, 0)  # the first one compiles shaders
    seeds = range(config.benchmark.episodes)
    episodes, full = _timed(lambda: [rollout(environment, expert, seed) for seed in seeds])
    steps = sum(len(episode.actions) for episode in episodes)
    bound, render = environment.task.bound, environment.renderer.render
    substeps, views = (
        environment.task.substeps,
        [bound.cameras[c] for c in environment.spec.cameras],
    )
    _, physics = _timed(lambda: [mujoco.mj_step(bound.model, bound.data, substeps) for _ in range(steps)])
    _, rendering = _timed(lambda: [render(bound.data, view) for _ in range(steps) for view in views])
    with environment.blind():
        _, blind = _timed(lambda: [rollout(environment, expert, seed) for seed in seeds])
        _, replaying = _timed(lambda: [replay(environment, episode) for episode in episodes])
    with TemporaryDirectory() as folder:
        store = EpisodeStore.create_or_open(folder, environment.spec, {})
        with store.writing():
            _, storing = _timed(partial(_keep, store, episodes))
    environment.close()
    stages = {
        "physics": physics,
        "rendering": rendering,
        "expert, controller, judge": blind - physics,
        "images into arrays": full - blind - rendering,
        "replay": replaying,
        "storing": storing,
    }
    measures = {"collect": _measure(steps / full, "control steps/s", steps, steps / (physics + rendering))}
    whole = 1000 * (full + replaying + storing) / steps
    for name, seconds in stages.items():
        measures[f"collect: {name}"] = _measure(1000 * seconds / steps, "ms/step", steps, whole)
    alone, together = (_attempts(partial(Demonstrator, *makers), count, config) for count in (1, cores()))
    measures[f"collect: {cores()} processes"] = _measure(*together, cores() * alone[0])
    if config.benchmark.robosuite is not None:
        size = environment.spec.image_size
        for count, (rate, unit, n) in ((1, alone), (cores(), together)):
            rival = peer("robosuite", config.benchmark.robosuite, "robosuite_lift.py", (*size, PATIENCE), count)
            if count == 1:  # which verifies nothing: the same work is an episode played and seen once
                measures["collect, against robosuite"] = _measure(steps / full, unit, steps, rival)
            measures[f"collect: verified, against {count} of robosuite"] = _measure(rate, unit, n, rival)
    return measures


def _timed(work: Callable[[], Any]) -> tuple[Any, float]:
    """What comes of some work, and how long it took [s]."""
    started = time.perf_counter()
    result = work()
    return result, time.perf_counter() - started


def _keep(store: EpisodeStore, episodes: list[Episode]) -> None:
    for episode in episodes:
        if episode.success:
            store.append(episode)
        else:
            store.fail(episode.seed, episode.outcome, episode.draws)


def _attempts(make: Callable[[], Any], processes: int, config: DictConfig) -> tuple[float, str, int]:
    """Verified control steps per second of so many processes side by side, once they are warm; unit; how many."""
    from vla.cluster import Local

    with Local(processes).team(make) as team:
        for wait in [team.submit(seed) for seed in range(2 * processes)]:
            wait()
        seeds = range(processes * config.benchmark.episodes)
        episodes, seconds = _timed(lambda: [wait() for wait in [team.submit(seed) for seed in seeds]])
    steps = sum(len(episode.actions) for episode in episodes)
    return steps / seconds, "control steps/s", steps


def loader(config: DictConfig) -> dict[str, Measure]:
    """Training windows through the loader, against a bare gather of the same images; as the model wants them, and more.

    The best of a few rounds, in turns, on pages that are in memory. Where `config.benchmark.lerobot` names a Python,
    the floor of two more measures is LeRobot's loader on the same episodes.
    """
    from vla.data.episodes import EpisodeStore
    from vla.data.lerobot import LeRobot
    from vla.parts import collected, make_data, make_learner

    store = collected(config)
    model = make_learner(config, store).model
    measures = {"loader": _loading(make_data(config, store, model), store, model.history, config.benchmark.batches)}
    names = {1: "loader: 1 frame", 6: "loader: 6 frames"}
    for frames, name in names.items():
        data = make_data(config, store, SimpleNamespace(history=frames, chunk=model.chunk))
        measures[name] = _loading(data, store, frames, config.benchmark.batches)
    if config.benchmark.lerobot is not None:
        some = EpisodeStore(store.folder, min(config.collect.episodes, PEER_EPISODES))
        with TemporaryDirectory() as folder:
            dataset = LeRobot(Path(folder) / "dataset").export(some)
            for frames, name in names.items():
                arguments = (dataset, frames, PATIENCE)
                rival = peer("lerobot", config.benchmark.lerobot, "lerobot_windows.py", arguments)
                own = measures[name]
                measures[f"{name}, against LeRobot"] = _measure(own["value"], own["unit"], own["n"], rival)
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

    from vla.parts import collected, make_data, make_learner
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
    """The time from an observation to an action, as `config.policy` computes it, against its network alone; and of
    the same network if it encoded every frame of its history anew, in 32 bits and uncompiled, against that time."""
    import torch

    from vla.parts import collected, make_environment, make_learner, plain

    environment = make_environment(plain(config.task))
    observation = environment.reset(0)
    environment.close()
    model = make_learner(config, collected(config)).model
    agent = build(config.policy, model=model, spec=environment.spec)
    for _ in range(model.history + 1):  # the first ones compile and allocate
        agent.act(observation)
    frame = agent.frame(observation)
    rgb = {camera: images.expand(1, model.history, -1, -1, -1) for camera, images in frame["rgb"].items()}
    frames = {name: frame[name].expand(1, model.history, *frame[name].shape[2:]) for name in ("proprio", "present")}
    whole = {"rgb": rgb, "text": frame["text"], **frames}
    steps = config.benchmark.steps
    acting = _median(lambda: agent.plan(observation), steps)
    with torch.inference_mode():
        network = _median(partial(model.predict, agent.window()), steps)
        naive = _median(partial(model.predict, whole), steps)
    return {
        "policy": _measure(acting, "ms", steps, network),
        "policy: every frame anew": _measure(naive, "ms", steps, acting),
    }


def _median(work: Callable[[], object], rounds: int) -> float:
    """Median time [ms] that `work` takes."""
    return 1000 * float(np.median([_timed(work)[1] for _ in range(rounds)]))


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
