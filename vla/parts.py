"""What a composed configuration describes, built: environment, expert, episodes, model, policy."""

from __future__ import annotations

import logging
from contextlib import nullcontext
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hydra import compose
from omegaconf import DictConfig, OmegaConf

from vla.check import build
from vla.spec import FIRST_SEED

if TYPE_CHECKING:
    from vla.data.episodes import EpisodeStore
    from vla.data.recorded import Recorded
    from vla.data.windows import Windows
    from vla.models.action_tokenizer import ActionTokenizer
    from vla.models.learner import Learner
    from vla.models.model import Model
    from vla.policy import Checkpoint, Policy
    from vla.spec import Agent, Environment, Recorder, Spec
    from vla.tasks.tabletop import Tabletop

log = logging.getLogger(__name__)

Node = dict[str, Any]


def plain(node: DictConfig) -> Node:
    """A node as dicts and lists, which travel to other processes and into files."""
    plain = OmegaConf.to_container(node, resolve=True)
    assert isinstance(plain, dict)
    return {str(key): value for key, value in plain.items()}


def output_folder(config: DictConfig) -> Path:
    """Where the results of a run lie, made if it is not there."""
    folder = Path(config.output)
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def note_config(config: DictConfig) -> None:
    """Leave beside the results what they came from, and what of that is not as it would be without any choice."""
    from vla.results import differences, write_config

    chosen, default = OmegaConf.to_container(config, resolve=False), _defaults()
    changes = [
        {"key": key, "here": here, "default": by_default} for key, here, by_default in differences(chosen, default)
    ]
    write_config(output_folder(config), plain(config), changes)


@cache
def _defaults() -> Any:
    """What is configured without any choice."""
    return OmegaConf.to_container(compose("config"), resolve=False)


def make_environment(task: Node) -> Tabletop:
    """The environment that a task node describes, with a renderer that works on this machine."""
    from vla.tasks.backend import choose_backend

    choose_backend()
    environment: Tabletop = build(task, "task")
    return environment


def make_expert(expert: Node, environment: Environment) -> Agent:
    """The expert for an environment.

    Raises:
        ValueError: the expert is a recording, which cannot act.
    """
    from vla.data.recorded import Recorded

    agent: Agent = build(expert, "expert", spec=environment.spec)
    if isinstance(agent, Recorded):
        raise ValueError("recorded demonstrations cannot act: this job needs another expert, such as expert=waypoint")
    return agent


def make_recorder(recorder: Node, folder: Path) -> Recorder:
    """A recorder that writes into a folder."""
    made: Recorder = build(recorder, "recorder", folder=folder)
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
    tokenizer = build(saved.config["tokenizer"], "tokenizer", spec=saved.spec)
    model = _model(_without_pretraining(saved.config["model"]), saved.spec, tokenizer, saved)
    saved.restore(model)
    made: Policy = build(policy, "policy", model=model, spec=saved.spec)
    return made


def _model(node: Node, spec: Spec, tokenizer: ActionTokenizer, saved: Checkpoint | None) -> Model:
    """The model that a node describes; one whose weights come out of a checkpoint is no larger than that."""
    from vla.policy import Allowance

    with Allowance(saved.path) if saved else nullcontext():
        model: Model = build(node, "model", spec=spec, tokenizer=tokenizer)
    return model


def in_training(policy: Node, model: Model) -> Policy:
    """The policy of a model that is being trained, on its device, not compiled once more."""
    here = {**policy, "device": next(model.parameters()).device.type, "compile": False}
    made: Policy = build(here, "policy", model=model, spec=model.spec)
    return made


def _without_pretraining(model: Node) -> Node:
    """The node of a model whose weights all come out of a checkpoint, with none to be found or fetched before."""
    nowhere = {"image": "pretrained", "text": "name"}
    parts = {
        part: model[part] for part, key in nowhere.items() if isinstance(model.get(part), dict) and key in model[part]
    }
    return {**model, **{part: {**node, nowhere[part]: ""} for part, node in parts.items()}}


def demonstrated(config: DictConfig) -> Spec:
    """What a step of the demonstrations looks like, whether they have been collected or not."""
    return _source(config)[0]


def _source(config: DictConfig) -> tuple[Spec, Recorded | None]:
    """What a step looks like, and the recording that the demonstrations are taken from, if they are."""
    from vla.data.recorded import Recorded

    environment = make_environment(plain(config.task))
    environment.close()
    expert = build(config.expert, "expert", spec=environment.spec)
    return (expert.spec, expert) if isinstance(expert, Recorded) else (environment.spec, None)


def collected(config: DictConfig) -> EpisodeStore:
    """The episode store of this configuration, with as many episodes as asked for, whatever else it holds."""
    from vla.collect import collect
    from vla.data.episodes import EpisodeStore

    if config.collect.seed + config.collect.episodes > FIRST_SEED:
        raise ValueError(f"collect.seed={config.collect.seed}: seeds from {FIRST_SEED} on are kept for evaluation")
    cluster = build(config.cluster, "cluster")
    spec, recorded = _source(config)
    source = {"task": plain(config.task), "expert": plain(config.expert)}
    store = EpisodeStore.create_or_open(Path(config.collect.folder), spec, source)
    if recorded is not None:
        added = recorded.fill(store, config.collect.episodes)
        log.info("%s: %d recorded episodes, %d of them new", store.folder, len(store.episodes), added)
        return EpisodeStore(store.folder, config.collect.episodes)
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
    return EpisodeStore(store.folder, config.collect.episodes)


def make_learner(config: DictConfig, store: EpisodeStore) -> Learner:
    """The learner of a configuration's model, with a tokenizer fitted on the store's actions."""
    learner = unfitted_learner(config, store.spec)
    fit(learner.model.tokenizer, config, store)
    return learner


def unfitted_learner(config: DictConfig, spec: Spec) -> Learner:
    """The learner of a configuration's model, which needs no demonstrations; its tokenizer has yet to be fitted, unless
    all comes out of a checkpoint, of this training or of the one that it starts from.

    Raises:
        ValueError: that checkpoint is none, or of a policy for another kind of step.
    """
    from vla.policy import read_checkpoint

    origin, node = config.checkpoint or config.pretrained, plain(config.model)
    saved = read_checkpoint(origin) if origin else None
    if saved:
        saved.spec.perceived.require(spec.perceived, f"the checkpoint {origin}", "what it is to be trained on")
        spec, node = replace(spec, chain=saved.spec.chain), _without_pretraining(node)
    model = _model(node, spec, build(config.tokenizer, "tokenizer", spec=spec), saved)
    if saved:
        saved.start(model)
    learner: Learner = build(config.learner, "learner", model=model, spec=spec, config=plain(config))
    return learner


def fit(tokenizer: ActionTokenizer, config: DictConfig, store: EpisodeStore) -> None:
    """Give a configuration's tokenizer what it takes from a store's actions, unless a checkpoint has brought it."""
    if config.checkpoint or config.pretrained:
        return
    fitted = build(config.tokenizer, "tokenizer", spec=store.spec, statistics=store.statistics)
    tokenizer.load_state_dict(fitted.state_dict())


def make_data(config: DictConfig, store: EpisodeStore, model: Any) -> Windows:
    """The windows that a model wants of a store: the first `collect.episodes`, whatever else it holds."""
    windows: Windows = build(
        config.data,
        "data",
        folder=store.folder,
        spec=store.spec,
        history=model.history,
        chunk=model.chunk,
        episodes=config.collect.episodes,
    )
    return windows
