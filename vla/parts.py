"""What a composed configuration describes, built: environment, expert, episodes, model, policy."""

from __future__ import annotations

import logging
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from omegaconf import DictConfig, OmegaConf

from vla.check import build
from vla.spec import FIRST_SEED

if TYPE_CHECKING:
    from vla.data.episodes import EpisodeStore
    from vla.data.windows import Windows
    from vla.models.learner import Learner
    from vla.policy import Policy
    from vla.spec import Agent, Environment, Recorder, Spec
    from vla.tasks.tabletop import Tabletop

log = logging.getLogger(__name__)

Node = dict[str, Any]


def plain(node: DictConfig) -> Node:
    """A node as dicts and lists, which travel to other processes and into files."""
    plain = OmegaConf.to_container(node, resolve=True)
    assert isinstance(plain, dict)
    return {str(key): value for key, value in plain.items()}


def make_environment(task: Node) -> Tabletop:
    """The environment that a task node describes, with a renderer that works on this machine."""
    from vla.tasks.backend import choose_backend

    choose_backend()
    environment: Tabletop = build(task)
    return environment


def make_expert(expert: Node, environment: Environment) -> Agent:
    """The expert for an environment.

    Raises:
        ValueError: the expert is a recording, which cannot act.
    """
    from vla.data.recorded import Recorded

    agent: Agent = build(expert, spec=environment.spec)
    if isinstance(agent, Recorded):
        raise ValueError("recorded demonstrations cannot act: this job needs another expert, such as expert=waypoint")
    return agent


def make_recorder(recorder: Node, folder: Path) -> Recorder:
    """A recorder that writes into a folder."""
    made: Recorder = build(recorder, folder=folder)
    return made


def make_policy(policy: Node, checkpoint: Path, environment: Environment | None = None) -> Policy:
    """The policy in a checkpoint, computing as a policy node says.

    Raises:
        ValueError: no checkpoint is there, or it was trained for another kind of step than the environment has.
    """
    from vla.policy import read_checkpoint

    saved = read_checkpoint(checkpoint)
    if environment is not None:
        saved.spec.perceived.require(environment.spec.perceived, f"the checkpoint {checkpoint}", "the task")
    tokenizer = build(saved.config["tokenizer"], spec=saved.spec)
    # What the saved weights are, the pretrained ones would only be overwritten by.
    model = build(_without_pretraining(saved.config["model"]), spec=saved.spec, tokenizer=tokenizer)
    saved.restore(model)
    made: Policy = build(policy, model=model, spec=saved.spec)
    return made


def _without_pretraining(model: Node) -> Node:
    image = model.get("image") or {}
    return {**model, "image": {**image, "pretrained": False}} if "pretrained" in image else model


def collected(config: DictConfig) -> EpisodeStore:
    """The episode store of this configuration, with at least as many episodes as asked for."""
    from vla.collect import collect
    from vla.data.episodes import EpisodeStore
    from vla.data.recorded import Recorded

    if config.collect.seed + config.collect.episodes > FIRST_SEED:
        raise ValueError(f"collect.seed={config.collect.seed}: seeds from {FIRST_SEED} on are kept for evaluation")
    cluster = build(config.cluster)
    environment = make_environment(plain(config.task))
    spec = environment.spec
    environment.close()
    source = {"task": plain(config.task), "expert": plain(config.expert)}
    recorded = build(config.expert, spec=spec)
    if isinstance(recorded, Recorded):
        store = EpisodeStore.create_or_open(Path(config.collect.folder), recorded.spec, source)
        added = recorded.fill(store, config.collect.episodes)
        log.info("%s: %d recorded episodes, %d of them new", store.folder, len(store.episodes), added)
        return store
    store = EpisodeStore.create_or_open(Path(config.collect.folder), spec, source)
    summary = collect(
        store,
        partial(make_environment, source["task"]),
        partial(make_expert, source["expert"]),
        config.collect.episodes,
        cluster,
        config.collect.seed,
    )
    failures = ", ".join(f"{count} {cause}" for cause, count in summary.failures.items()) or "none"
    log.info(
        "%s: %d episodes, %d of them new in %.0f s; expert success %.1f %%, failures: %s",
        store.folder,
        summary.episodes,
        summary.added,
        summary.seconds,
        100 * summary.success_rate,
        failures,
    )
    return store


def make_learner(config: DictConfig, store: EpisodeStore) -> Learner:
    """The learner of a configuration's model, with a tokenizer fitted on the store's actions."""
    spec: Spec = store.spec
    tokenizer = build(config.tokenizer, spec=spec, statistics=store.statistics)
    model = build(config.model, spec=spec, tokenizer=tokenizer)
    learner: Learner = build(config.learner, model=model, spec=spec, config=plain(config))
    return learner


def make_data(config: DictConfig, store: EpisodeStore, model: Any) -> Windows:
    """The windows that a model wants of a store: the first `collect.episodes`, whatever else it holds."""
    windows: Windows = build(
        config.data,
        folder=store.folder,
        spec=store.spec,
        history=model.history,
        chunk=model.chunk,
        episodes=config.collect.episodes,
    )
    return windows
