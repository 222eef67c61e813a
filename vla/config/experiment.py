"""A checked config as plain values and typed nodes, and factories of world, expert, policy, model and data."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import dataclass, fields, replace
from functools import cached_property, partial, reduce
from operator import getitem
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from omegaconf import DictConfig, OmegaConf

from vla.config.annotations import is_node, locate, mismatch
from vla.config.build import GROUPS, Group, arguments, build, require_no_paths
from vla.config.differences import ABSENT, differences, value_at
from vla.config.nodes import Collection, Evaluation, Settings, Validation, with_changes
from vla.config.origin import SECRET, Origin, find_origin
from vla.io.errors import UserError
from vla.parallel.processes import without_triton
from vla.spec import Spec, SpecOnly

if TYPE_CHECKING:
    from vla.data.datamodule import WindowDataModule
    from vla.data.episodes import EpisodeStore
    from vla.models.learner import Learner
    from vla.models.model import Model
    from vla.models.policy_folder import SavedPolicy
    from vla.models.tokenizers.tokenizer import ActionTokenizer
    from vla.policy import Policy
    from vla.spec import Agent, Environment, Recorder

Node = dict[str, Any]
T = TypeVar("T")


@dataclass(frozen=True)
class Experiment:
    """A checked config. Its factories can be sent to worker processes, which inherit what is trusted."""

    nodes: Node  # plain, resolved
    find_changes: Callable[[], list[Node]] = list

    @classmethod
    def from_config(cls, cfg: DictConfig, make_default: Callable[[], DictConfig] | None = None) -> Experiment:
        """Create the experiment of a composed config; `make_default` composes the config without overrides."""
        nodes = {group.name: None for group in GROUPS.values() if group.optional} | to_plain(cfg)
        return cls(nodes, partial(_changes, cfg, nodes, make_default) if make_default else list)

    @cached_property
    def changes(self) -> list[Node]:
        """Differences from the default config, to show; composed on first access, which takes a third of a second."""
        return self.find_changes()

    @cached_property
    def config(self) -> Node:
        """The nodes without secrets, for reports, checkpoints and all other files."""
        return _without_secrets(self.nodes)

    @cached_property
    def origin(self) -> Origin:
        """Origin of the results, determined on first access."""
        return find_origin()

    @cached_property
    def settings(self) -> Settings:
        """The values at the top level of the config."""
        return Settings(**{setting.name: self.nodes[setting.name] for setting in fields(Settings)})

    @cached_property
    def collect(self) -> Collection:
        """Number, seeds and store of the demonstrations."""
        return self.build("collect")

    @cached_property
    def validate(self) -> Validation:
        """Episodes that select the weights."""
        return self.build("validate")

    @cached_property
    def evaluate(self) -> Evaluation:
        """Episodes and conditions of an evaluation."""
        return self.build("evaluate")

    def options(self, kind: type[T]) -> T:
        """Build the node of the job itself, of class `kind`."""
        name = self.settings.job.rpartition(".")[2]
        return build(self.nodes[name], Group(name, (f"{kind.__module__}.{kind.__name__}",), plain=True))

    def build(self, group: str, **runtime: Any) -> Any:
        """Build the node of a group, see `vla.config.build.build`."""
        return build(self.nodes[group], group, **runtime)

    def kind(self, group: str) -> type:
        """Return the class of the node of a group."""
        return locate(f"{group}._target_", self.nodes[group]["_target_"])

    def __getitem__(self, key: str) -> Any:
        """Return a plain node of a group."""
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
        folder = Path(self.settings.output)
        folder.mkdir(parents=True, exist_ok=True)
        return folder

    @property
    def source(self) -> Node:
        """The nodes that determine the demonstrations."""
        return {name: self.nodes[name] for name in ("task", "expert")}

    @property
    def playable(self) -> bool:
        """True if agents can act in the world of the task; else it is known from recordings only."""
        return not issubclass(self.kind("task"), SpecOnly)

    @property
    def has_expert(self) -> bool:
        """True if the expert acts in the world of the task; else there are recorded demonstrations."""
        return self.playable and hasattr(self.kind("expert"), "act")

    def world(self) -> Environment | SpecOnly:
        """Build the world of the task and close it: only its description is used, such as spec and tasks."""
        if not self.playable:
            return self.build("task")
        environment = self.make_environment()()
        environment.close()
        return environment

    def make_environment(self, changes: Mapping[str, Any] | None = None) -> Callable[[], Environment]:
        """Return the factory of the environment, with the `changes` of a condition."""
        return partial(make_environment, with_changes(self.nodes["task"], changes or {}))

    def make_expert(self) -> Callable[[Environment], Agent]:
        """Return the factory of the expert for an environment."""
        return partial(make_agent, self.nodes["expert"], "expert")

    def make_agent(self) -> Callable[[Environment], Agent] | None:
        """Return the factory of the agent that acts in place of a policy, or None."""
        if not (node := self.nodes["agent"]):
            return None
        # Workers may be in another folder.
        place = {"folder": str(Path(folder).resolve())} if (folder := node.get("folder")) else {}
        return partial(make_agent, {**node, **place}, "agent")

    def make_policy(self, checkpoint: Path | None = None) -> Callable[..., Policy]:
        """Return the factory of the policy in a folder, by default `checkpoint`; raise a UserError if there is none."""
        checkpoint = checkpoint or self.checkpoint
        if checkpoint is None:
            raise UserError("this job needs a trained policy: add checkpoint=RUN")
        return partial(make_policy, self.nodes["policy"], checkpoint, is_own=True)

    def make_recorder(self, folder: Path) -> Callable[[], Recorder] | None:
        """Return the factory of the recorder that writes into a folder, or None without a recorder."""
        node = self.nodes["recorder"]
        return partial(build, node, "recorder", folder=folder) if node else None

    @property
    def checkpoint(self) -> Path | None:
        """Folder of the policy that the job uses, if given; raises a UserError if there is none."""
        return _policy_folder(self.settings.checkpoint)

    @property
    def pretrained(self) -> Path | None:
        """Folder of the policy that initialises a training, if given; raises a UserError if there is none."""
        return _policy_folder(self.settings.pretrained)

    def learner(self, spec: Spec, origin: Path | None = None, last_checkpoint: Path | None = None) -> Learner:
        """Build the learner for demonstrations of a spec; without initial weights, the caller then fits the tokenizer.

        The weights are those of the policy in the folder `origin`, or of Lightning's `last_checkpoint` of the training.
        Raises a UserError if either is damaged, or the policy has another spec.
        """
        from vla.models.checkpoint import read_content, weights_of
        from vla.models.policy_folder import read_policy
        from vla.models.trunk import Source

        saved = read_policy(origin) if origin else None
        content = read_content(last_checkpoint) if last_checkpoint else None
        initial_spec = spec
        if saved:
            saved.spec.require_input(spec, f"the policy {origin}", "the demonstrations")
            initial_spec = saved.spec
        elif content:
            initial_spec = Spec.from_dict(content["spec"], str(last_checkpoint))
        spec = replace(spec, robot=initial_spec.robot, image_size=initial_spec.image_size)
        model = _model(self.nodes, spec, saved, weights=bool(origin or last_checkpoint))
        if saved:
            saved.initialize(model)
        for name, source in content.get("trunks", {}).items() if content else ():
            model.get_submodule(name).source = Source(**source)  # type: ignore[assignment]
        learner: Learner = self.build("learner", model=model, spec=spec, config=self.config)
        if content:
            # Before Lightning does, because a sharded model cannot load what modules keep besides their weights.
            learner.model.load_state_dict(weights_of(content))
        return learner

    def fit_tokenizer(self, tokenizer: ActionTokenizer, store: EpisodeStore) -> None:
        """Fit a tokenizer to a store's actions."""
        fitted = self.build("tokenizer", spec=store.spec, statistics=store.statistics)
        tokenizer.load_state_dict(fitted.state_dict())

    def fitted_learner(self, store: EpisodeStore) -> Learner:
        """Build the learner of a new training, with the weights of `pretrained` or `checkpoint` if one is given.

        Without initial weights, the tokenizer is fitted to the store's actions.
        """
        origin = self.pretrained or self.checkpoint
        learner = self.learner(store.spec, origin)
        if origin is None:
            self.fit_tokenizer(learner.model.tokenizer, store)
        learner.model.fit(store.numbers("state"), store.numbers("action"))
        return learner

    def data(self, store: EpisodeStore, history: int, chunk: int, model: Model | None = None) -> WindowDataModule:
        """Build windows of `history` frames and `chunk` actions from the episodes that `collect` names.

        With a `model`, they match its spec and contain the tokens of its instructions.
        """
        windows = {"history": history, "chunk": chunk, "tokenize": model.text.tokenize if model else None}
        episodes = {"episodes": self.collect.episodes, "more": self.collect.more or ()}
        spec = model.spec if model else store.spec
        return self.build("data", folder=store.folder, spec=spec, **windows, **episodes)


def _changes(cfg: DictConfig, nodes: Node, make_default: Callable[[], DictConfig]) -> list[Node]:
    """Return the differences of a config, with these plain nodes, from the default one."""
    default, changes = make_default(), list[Node]()
    default_nodes = to_plain(default)
    # Unresolved, so that a value is one difference and not one in each place that refers to it.
    unresolved, default_unresolved = (OmegaConf.to_container(config, resolve=False) for config in (cfg, default))
    for key, raw, default_raw in differences(unresolved, default_unresolved):
        if key.rpartition(".")[2] == SECRET or key.startswith("chosen."):  # the values of options are compared
            continue
        target = f"{key.rpartition('.')[0]}._target_"
        if raw == ABSENT and value_at(nodes, target) != value_at(default_nodes, target):  # of the default's class
            continue
        value, standard = value_at(nodes, key), value_at(default_nodes, key)
        if value != standard or value == ABSENT:  # else a reference and a literal have the same value
            own_value, default_value = value_at(nodes, key, raw), value_at(default_nodes, key, default_raw)
            changes.append({"key": key, "here": own_value, "default": default_value})
    return _without_secrets(changes)


def _without_secrets(values: Any) -> Any:
    if isinstance(values, dict):
        return {name: None if name == SECRET else _without_secrets(value) for name, value in values.items()}
    return [_without_secrets(value) for value in values] if isinstance(values, list) else values


def to_plain(node: DictConfig) -> Node:
    """Convert a composed node to dicts and lists."""
    container = OmegaConf.to_container(node, resolve=True)
    assert isinstance(container, dict)
    return {str(key): value for key, value in container.items()}


def make_environment(task: Node) -> Environment:
    """Build the environment of a task node; raise a UserError if nothing can act in it."""
    without_triton()
    environment = build(task, "task")
    if isinstance(environment, SpecOnly):
        raise UserError(
            "the task has no simulator, only recordings, so nothing can be played in it: job=collect, train, evaluate, "
            "export and inspect work with recordings, and so do deploy=server and deploy=ros2"
        )
    Spec.from_dict(environment.spec.to_dict(), f"the spec of {type(environment).__name__}")
    return environment


def make_agent(node: Node, group: str, environment: Environment) -> Agent:
    """Build the expert, or the agent, for an environment; raise a UserError if it is a recording, which cannot act."""
    agent: Agent = build(node, group, spec=environment.spec)
    if not hasattr(agent, "act"):
        raise UserError("recorded demonstrations cannot act: choose an expert that can, such as expert=waypoint")
    return agent


def make_policy(
    policy: Node, checkpoint: Path, environment: Environment | None = None, *, is_own: bool = False
) -> Policy:
    """Build the policy in the folder `checkpoint` with the options of a node, to act in `environment` if that is given.

    Raises a UserError without a policy, if its spec does not fit, or if it names a path, address or untrusted class;
    one that `is_own` may name paths and addresses, because it is of this run, or was checked before.
    """
    from vla.models.policy_folder import read_policy

    saved = read_policy(checkpoint)
    if environment is not None:
        saved.spec.require_input(environment.spec, f"the policy {checkpoint}", "the task")
    if not is_own:
        model_node = _model_node(saved.config, saved, weights=True)
        require_no_paths({**saved.config, "model": model_node}, ("tokenizer", "model"), checkpoint)
    model = _model(saved.config, saved.spec, saved, weights=True)
    saved.restore(model)
    try:
        return build(policy, "policy", model=model, spec=saved.spec)
    except RuntimeError as error:  # torch.OutOfMemoryError, or one of CUDA itself
        if "out of memory" not in str(error):
            raise
        raise UserError(
            "the GPU has too little memory for a policy in every process: lower cluster.workers, as in "
            "cluster.workers=8, share one with cluster.policy=here, or set policy.device=cpu"
        ) from error


def training_policy(precision: str, lanes: int, model: Model) -> Policy:
    """Build the policy of a model in training, on the model's device and without a second compilation or an export."""
    device = next(model.parameters()).device
    if device.type == "cuda":  # make it the current one, also in a worker process
        import torch

        torch.cuda.set_device(device)
    options = {"device": device.type, "precision": precision, "compile": False, "lanes": lanes}
    return build({"_target_": "vla.policy.Policy", **options}, "policy", model=model, spec=model.spec)


def _policy_folder(name: str | None) -> Path | None:
    from vla.models.policy_folder import policy_folder  # imports PyTorch

    return policy_folder(name) if name else None


def _model(nodes: Node, spec: Spec, saved: SavedPolicy | None = None, weights: bool = False) -> Model:
    """Build the model of a config, with its tokenizer; pretrained weights are skipped if `weights` will replace them.

    A model that is larger than the weights of the `saved` policy is refused.
    """
    tokenizer = build(nodes["tokenizer"], "tokenizer", spec=spec)
    with saved.budget() if saved else nullcontext():
        model: Model = build(_model_node(nodes, saved, weights), "model", spec=spec, tokenizer=tokenizer)
    return model


def _model_node(nodes: Node, saved: SavedPolicy | None, weights: bool) -> Node:
    """Return the node of a model that gets `weights`: without pretrained ones, unless the saved policy needs those."""
    has_trunks = saved is not None and bool(saved.training.trunks)  # whose weights are not in its folder
    return _without_weights(nodes["model"]) if weights and not has_trunks else nodes["model"]


def _without_weights(model: Node) -> Node:
    """Return a model node without pretrained weights, also of its parts: the policy contains the trained ones."""
    changes: Node = {name: _without_weights(node) for name, node in model.items() if is_node(node)}
    if is_node(model) and (names := [name for name in ("pretrained", "trunk") if name in model]):
        parameters = arguments(locate("model._target_", model["_target_"]))
        for name in names:  # each class has its own value for none
            annotation = parameters[name].annotation if name in parameters else object
            fitting = [value for value in (False, None) if not mismatch(name, value, annotation)]
            changes |= {name: fitting[0]} if fitting else {}
    return model | changes
