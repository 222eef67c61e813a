"""Control steps per second of collection, where their time goes, and of robosuite beside it."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from omegaconf import DictConfig

from vla.benchmark.measure import Measure, measure, timed
from vla.peers.peer import PATIENCE, peer
from vla.workers import cores

if TYPE_CHECKING:
    from vla.data.episodes import EpisodeStore
    from vla.spec import Episode


def measures(config: DictConfig) -> dict[str, Measure]:
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
    episodes, full = timed(lambda: [rollout(environment, expert, seed) for seed in seeds])
    steps = sum(len(episode.actions) for episode in episodes)
    bound, render = environment.task.bound, environment.renderer.render
    substeps, views = (
        environment.task.substeps,
        [bound.cameras[c] for c in environment.spec.cameras],
    )
    _, physics = timed(lambda: [mujoco.mj_step(bound.model, bound.data, substeps) for _ in range(steps)])
    _, rendering = timed(lambda: [render(bound.data, view) for _ in range(steps) for view in views])
    with environment.blind():
        _, blind = timed(lambda: [rollout(environment, expert, seed) for seed in seeds])
        _, replaying = timed(lambda: [replay(environment, episode) for episode in episodes])
    with TemporaryDirectory() as folder:
        store = EpisodeStore.create_or_open(folder, environment.spec, {})
        with store.writing():
            _, storing = timed(partial(_keep, store, episodes))
    environment.close()
    stages = {
        "physics": physics,
        "rendering": rendering,
        "expert, controller, judge": blind - physics,
        "images into arrays": full - blind - rendering,
        "replay": replaying,
        "storing": storing,
    }
    found = {"collect": measure(steps / full, "control steps/s", steps, steps / (physics + rendering))}
    whole = 1000 * (full + replaying + storing) / steps
    for name, seconds in stages.items():
        found[f"collect: {name}"] = measure(1000 * seconds / steps, "ms/step", steps, whole)
    alone, together = (_attempts(partial(Demonstrator, *makers), count, config) for count in (1, cores()))
    found[f"collect: {cores()} processes"] = measure(*together, cores() * alone[0])
    if config.benchmark.robosuite is not None:
        size = environment.spec.image_size
        for count, (rate, unit, n) in ((1, alone), (cores(), together)):
            rival = peer("robosuite", config.benchmark.robosuite, "robosuite_lift.py", (*size, PATIENCE), count)
            if count == 1:  # which verifies nothing: the same work is an episode played and seen once
                found["collect, against robosuite"] = measure(steps / full, unit, steps, rival)
            found[f"collect: verified, against {count} of robosuite"] = measure(rate, unit, n, rival)
    return found


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
        episodes, seconds = timed(lambda: [wait() for wait in [team.submit(seed) for seed in seeds]])
    steps = sum(len(episode.actions) for episode in episodes)
    return steps / seconds, "control steps/s", steps
