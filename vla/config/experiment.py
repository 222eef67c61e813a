"""A composed config as plain values, and factories of environment, expert, model, policy and data."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from functools import cached_property, partial, reduce
from operator import getitem
from pathlib import Path
from typing import TYPE_CHECKING, Any

from omegaconf import DictConfig, OmegaConf

from vla.config.annotations import locate
from vla.config.build import build, require_no_paths
from vla.config.check import with_changes
from vla.config.differences import ABSENT, at, differences
from vla.config.origin import SECRET, Origin, find_origin
from vla.config.packages import trusted, with_trust
from vla.io.errors import UserError
from vla.parallel.processes import without_triton
from vla.spec import Spec, SpecOnly

if TYPE_CHECKING:
    from vla.data.datamodule import WindowDataModule
    from vla.data.episodes import EpisodeStore
    from vla.data.header import Codec
    from vla.models.learner import Learner
    from vla.models.model import Model
    from vla.models.policy_folder import SavedPolicy
    from vla.models.tokenizers.tokenizer import ActionTokenizer
    from vla.parallel.pool import Cluster
    from vla.policy import Policy
    from vla.spec import Agent, Environment, Recorder

Node = dict[str, Any]


@dataclass(frozen=True)
class Experiment:
    """A checked config as plain values, with a factory per part.

    Factories for worker processes hold only plain values, so they can be pickled, and the list of trusted packages.
    """

    nodes: Node  # resolved
    changes: list[Node] = field(default_factory=list)  # key, value and default of differences from the default, to show

    @classmethod
    def of(cls, cfg: DictConfig, default: DictConfig | None = None) -> Experiment:
        """Create the experiment of a composed config; `default` is the config without overrides."""
        if default is None:
            return cls(plain(cfg))
        chosen, standard = (OmegaConf.to_container(each, resolve=False) for each in (cfg, default))
        here, there = plain(cfg), plain(default)
        changes = [
            {"key": key, "here": at(here, key, value), "default": at(there, key, before)}
            for key, value, before in differences(chosen, standard)
            if not at(here, key) == at(there, key) != ABSENT  # else one is an interpolation of the same value
            and key.rpartition(".")[2] != SECRET
            and not key.startswith("chosen.")  # names of options, whose values are compared
        ]
        return cls(here, _without_secrets(changes))

    @cached_property
    def config(self) -> Node:
        """The nodes without secrets, for reports, checkpoints and all other files."""
        return _without_secrets(self.nodes)

    @cached_property
    def origin(self) -> Origin:
        """Where its results come from, found when it is first asked for."""
        return find_origin()

    def __getitem__(self, key: str) -> Any:
        """Return a top-level node or value."""
        return self.nodes[key]

    def with_values(self, values: Mapping[str, Any]) -> Experiment:
        """Return a copy with other values at dotted keys."""
        nodes = copy.deepcopy(self.nodes)
        for key, value in values.items():
            *path, name = key.split(".")
            node: Any = reduce(getitem, path, nodes)
            node[name] = value
        return replace(self, nodes=nodes)

    @property
    def output(self) -> Path:
        """Folder of the results, created if missing."""
        folder = Path(self["output"])
        folder.mkdir(parents=True, exist_ok=True)
        return folder

    @property
    def playable(self) -> bool:
        """True if agents can act in the world of the task; else it is known from recordings only."""
        return not issubclass(locate("task._target_", self["task"]["_target_"]), SpecOnly)

    def world(self) -> Environment | SpecOnly:
        """Build the world of the task and close it: only its description is used, such as spec and tasks."""
        if not self.playable:
            return build(self["task"], "task")
        environment = self.make_environment()()
        environment.close()
        return environment

    @property
    def checkpoint(self) -> Path | None:
        """Folder of the policy that the job uses, if given; a UserError if there is none."""
        return _policy_folder(self["checkpoint"])

    @property
    def source(self) -> Node:
        """The nodes that determine the demonstrations."""
        return {"task": self["task"], "expert": self["expert"]}

    @property
    def codec(self) -> Codec | None:
        """Codec of the images of new stores; None: the one that suits their size."""
        from vla.data.header import Codec

        images, quality = self["collect"]["images"], self["collect"]["quality"]
        return images and Codec(images, quality if images == "jpeg" else None)

    def make_environment(self, changes: Node | None = None) -> Callable[[], Environment]:
        """Return the factory of the environment, with the `changes` of a condition."""
        return partial(with_trust, trusted(), make_environment, with_changes(self["task"], changes or {}))

    def make_expert(self) -> Callable[[Environment], Agent]:
        """Return the factory of the expert for an environment."""
        return partial(with_trust, trusted(), make_expert, self["expert"])

    def make_policy(self, checkpoint: Path | None = None) -> Callable[..., Policy]:
        """Return the factory of the policy in a folder, by default `checkpoint` of the config.

        Raises:
            UserError: no policy is given.
        """
        checkpoint = checkpoint or self.checkpoint
        if checkpoint is None:
            raise UserError("this needs a trained policy: checkpoint=RUN")
        return partial(with_trust, trusted(), make_policy, self["policy"], checkpoint, own=True)

    def make_agent(self) -> Callable[[Environment], Agent] | None:
        """Return the factory of the agent that acts in place of a checkpoint, or None."""
        if not self["agent"]:
            return None
        return partial(with_trust, trusted(), make_agent, self["agent"])

    def make_recorder(self, folder: Path) -> Callable[[], Recorder] | None:
        """Return the factory of the recorder that writes into a folder, or None without a recorder."""
        if not self["recorder"]:
            return None
        return partial(with_trust, trusted(), build, self["recorder"], "recorder", folder=folder)

    def cluster(self) -> Cluster:
        """Build the cluster."""
        return build(self["cluster"], "cluster")

    def learner(self, spec: Spec, origin: Path | None = None) -> Learner:
        """Build the learner; without `origin`, fit its tokenizer afterwards with `fit_tokenizer`.

        Args:
            spec: of the demonstrations.
            origin: folder of the policy with the initial weights.

        Raises:
            UserError: `origin` is no policy, or has another spec.
        """
        from vla.models.policy_folder import read_policy

        node = self["model"]
        saved = read_policy(origin) if origin else None
        if saved:
            saved.spec.require_input(spec, f"the policy {origin}", "the demonstrations")
            layout = {"robot": saved.spec.robot, "image_size": saved.spec.image_size}
            spec, node = replace(spec, **layout), _without_pretraining(node)
        model = _model(node, spec, build(self["tokenizer"], "tokenizer", spec=spec), saved)
        if saved:
            saved.initialize(model)
        return build(self["learner"], "learner", model=model, spec=spec, config=self.config)

    def resumed_learner(self, spec: Spec, checkpoint: Path) -> Learner:
        """Build the learner that Lightning's checkpoint of this training continues; a UserError if it is damaged."""
        from vla.models.checkpoint import read_content, weights_of

        content = read_content(checkpoint)
        begun = Spec.from_dict(content["spec"], str(checkpoint))  # perhaps as that of `pretrained`
        spec = replace(spec, robot=begun.robot, image_size=begun.image_size)
        tokenizer = build(self["tokenizer"], "tokenizer", spec=spec)
        model = _model(_without_pretraining(self["model"]), spec, tokenizer, None)
        # Before Lightning does, because a sharded model cannot load what modules keep besides their weights.
        model.load_state_dict(weights_of(content))
        return build(self["learner"], "learner", model=model, spec=spec, config=self.config)

    def fit_tokenizer(self, tokenizer: ActionTokenizer, store: EpisodeStore) -> None:
        """Fit a tokenizer to a store's actions."""
        fitted = build(self["tokenizer"], "tokenizer", spec=store.spec, statistics=store.statistics)
        tokenizer.load_state_dict(fitted.state_dict())

    @property
    def pretrained(self) -> Path | None:
        """Folder of the policy with the initial weights of a training, if given; a UserError if there is none."""
        return _policy_folder(self["pretrained"])

    def fitted_learner(self, store: EpisodeStore) -> Learner:
        """Build the learner of a new training, of the weights of `pretrained` or `checkpoint` if one is given.

        Without initial weights, the tokenizer is fitted to the store's actions.
        """
        origin = self.pretrained or self.checkpoint
        learner = self.learner(store.spec, origin)
        if origin is None:
            self.fit_tokenizer(learner.model.tokenizer, store)
        return learner

    def data(
        self, store: EpisodeStore, history: int, chunk: int, tokenize: Callable[[list[str]], Any] | None = None
    ) -> WindowDataModule:
        """Build windows of `history` frames and `chunk` actions from the episodes that `collect` names.

        `tokenize` is that of a text encoder.
        """
        return build(
            self["data"],
            "data",
            folder=store.folder,
            spec=store.spec,
            history=history,
            chunk=chunk,
            tokenize=tokenize,
            episodes=self["collect"]["episodes"],
            more=self["collect"]["more"] or (),
        )


def _without_secrets(values: Any) -> Any:
    if isinstance(values, dict):
        return {name: None if name == SECRET else _without_secrets(value) for name, value in values.items()}
    return [_without_secrets(value) for value in values] if isinstance(values, list) else values


def plain(node: DictConfig) -> Node:
    """Convert a composed node to dicts and lists."""
    plain = OmegaConf.to_container(node, resolve=True)
    assert isinstance(plain, dict)
    return {str(key): value for key, value in plain.items()}


def make_environment(task: Node) -> Environment:
    """Build the environment of a task node.

    Raises:
        UserError: nothing can act in the world.
    """
    without_triton()
    environment = build(task, "task")
    if isinstance(environment, SpecOnly):
        raise UserError(
            "the task has no simulator, only recordings, so nothing can be played in it: job=collect, train, evaluate, "
            "export and inspect work with recordings, and so do deploy=server and deploy=ros2"
        )
    Spec.from_dict(environment.spec.to_dict(), f"the spec of {type(environment).__name__}")
    return environment


def make_expert(expert: Node, environment: Environment) -> Agent:
    """Build the expert for an environment.

    Raises:
        UserError: the expert is a recording, which cannot act.
    """
    from vla.data.formats.imported_demonstrations import ImportedDemonstrations

    agent: Agent = build(expert, "expert", spec=environment.spec)
    if isinstance(agent, ImportedDemonstrations):
        raise UserError("recorded demonstrations cannot act: this job needs the expert of a world that can be played")
    return agent


def make_agent(agent: Node, environment: Environment) -> Agent:
    """Build an agent for an environment."""
    return build(agent, "agent", spec=environment.spec)


def make_policy(policy: Node, checkpoint: Path, environment: Environment | None = None, *, own: bool = False) -> Policy:
    """Build the policy in a folder with the options of a policy node.

    Args:
        policy: the node.
        checkpoint: the folder.
        environment: that the policy is to act in.
        own: the policy may name paths and addresses, because it is of this run, or was looked through before.

    Raises:
        UserError: there is no policy, its spec differs from the environment's, or it names what it may not.
    """
    from vla.models.policy_folder import read_policy

    saved = read_policy(checkpoint)
    if environment is not None:
        saved.spec.require_input(environment.spec, f"the policy {checkpoint}", "the task")
    nodes = {"tokenizer": saved.config["tokenizer"], "model": _without_pretraining(saved.config["model"])}
    if not own:
        require_no_paths(nodes, nodes, checkpoint)
    tokenizer = build(nodes["tokenizer"], "tokenizer", spec=saved.spec)
    model = _model(nodes["model"], saved.spec, tokenizer, saved)
    saved.restore(model)
    try:
        return build(policy, "policy", model=model, spec=saved.spec)
    except RuntimeError as error:  # torch.OutOfMemoryError, or one of CUDA itself
        if "out of memory" not in str(error):
            raise
        raise UserError(
            "the GPU has too little memory for a policy in every process: lower cluster.workers, as in "
            "cluster.workers=8, or set policy.device=cpu"
        ) from error


def training_policy(precision: str, model: Model) -> Policy:
    """Build the policy of a model in training, on the model's device and without a second compilation or an export."""
    here = {"device": next(model.parameters()).device.type, "precision": precision, "compile": False, "lanes": 1}
    return build({"_target_": "vla.policy.Policy", **here}, "policy", model=model, spec=model.spec)


def _policy_folder(name: str | None) -> Path | None:
    from vla.models.policy_folder import policy_folder  # imports PyTorch

    return policy_folder(name) if name else None


def _model(node: Node, spec: Spec, tokenizer: ActionTokenizer, saved: SavedPolicy | None) -> Model:
    """Build the model of a node; of a saved policy, refuse a model larger than its weights."""
    with saved.budget() if saved else nullcontext():
        model: Model = build(node, "model", spec=spec, tokenizer=tokenizer)
    return model


def _without_pretraining(model: Node) -> Node:
    """Return a model node without the initial weights of its image encoders, which lie in the policy."""
    parts = {
        part: {**node, "pretrained": False}
        for part in ("image", "context")
        if isinstance(node := model.get(part), dict) and "pretrained" in node
    }
    context = model.get("context")
    if isinstance(context, dict) and isinstance(image := context.get("image"), dict) and "pretrained" in image:
        parts["context"] = {**parts.get("context", context), "image": {**image, "pretrained": False}}
    return {**model, **parts}
