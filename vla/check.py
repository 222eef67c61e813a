"""A composed config against the signatures of the classes it names, before any work, and the objects it describes.

The `__init__` of a class is the schema of its node: names, which of them are needed, types and allowed values.
"""

from __future__ import annotations

import hashlib
import inspect
import json
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from difflib import get_close_matches
from functools import cache
from importlib import import_module
from typing import Annotated, Any, Literal, cast, get_args, get_origin

from annotated_types import Ge, Gt, Le, MinLen
from hydra.core.hydra_config import HydraConfig
from hydra.errors import InstantiationException
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from vla.annotations import describe, fits, is_node, locate, matches, takes_path
from vla.documents import require_resolved
from vla.spec import FIRST_SEED
from vla.types import Count, Natural, NonNegative, Seed, Share, Text

# The groups that each job builds something from; only these are checked, so only their modules are imported.
TRAINING = ("task", "expert", "cluster", "data", "tokenizer", "model", "learner", "trainer", "logger")
JOBS: dict[str, tuple[str, ...]] = {
    "preview": ("task", "expert"),
    "collect": ("task", "expert", "cluster"),
    "train": TRAINING,
    "evaluate": (*TRAINING, "policy", "recorder"),
    "export": ("task", "expert", "cluster", "tokenizer", "model", "policy", "export"),
    "deploy": ("tokenizer", "model", "policy", "deploy"),
    "benchmark": (*TRAINING, "policy"),
    "inspect": (),
    "report": (),
}
EVALUATION = ("task", "tokenizer", "model", "policy", "recorder")  # of a checkpoint, with nothing to train
OPTIONAL = ("recorder", "logger")  # groups that a job can do without
SEVERAL = ("logger",)  # groups whose options are several nodes by name

# Constructor arguments that the jobs give, so that they never stand in YAML.
RUNTIME: dict[str, tuple[str, ...]] = {
    "expert": ("spec",),
    "data": ("folder", "spec", "history", "chunk", "episodes"),
    "tokenizer": ("spec", "statistics"),
    "model": ("spec", "tokenizer"),
    "learner": ("model", "spec", "config"),
    "trainer": ("callbacks", "logger"),
    "logger": ("save_dir",),
    "policy": ("model", "spec"),
    "recorder": ("folder",),
    "deploy": ("policy", "environment", "output"),
}

# Group → what its node makes, or the nodes in it.
MAKES = {
    "task": ("vla.spec.Environment",),
    "expert": ("vla.spec.Agent", "vla.data.recorded.Recorded"),
    "cluster": ("vla.cluster.Cluster",),
    "data": ("vla.data.windows.Windows",),
    "tokenizer": ("vla.models.action_tokenizer.ActionTokenizer",),
    "model": ("vla.models.model.Model",),
    "learner": ("vla.models.learner.Learner",),
    "trainer": ("lightning.Trainer",),
    "logger": ("lightning.pytorch.loggers.Logger",),
    "policy": ("vla.policy.Policy",),
    "recorder": ("vla.spec.Recorder",),
    "export": ("vla.spec.Exporter",),
    "deploy": ("vla.spec.Deployment",),
}

# Narrower than Lightning's own annotations: arguments with which its trainer fails late, or silently trains nothing.
NARROWER: dict[str, dict[str, Any]] = {
    "lightning.Trainer": {
        "max_steps": Literal[-1] | Count,
        "max_epochs": Literal[-1] | Count | None,
        "devices": Literal["auto", -1] | Count | Annotated[list[Natural], MinLen(1)] | Text,
        "num_nodes": Count,
        "accumulate_grad_batches": Count,
        "gradient_clip_val": NonNegative | None,
        "val_check_interval": Count | Annotated[float, Gt(0), Le(1)] | None,
        "limit_val_batches": Natural | Share | None,
        "limit_train_batches": Natural | Share | None,
        "log_every_n_steps": Count,
    }
}

UnseenSeed = Annotated[Seed, Ge(FIRST_SEED)]

# The nodes that name no class.
PLAIN: dict[str, Any] = {
    "job": Literal["preview", "collect", "train", "evaluate", "export", "deploy", "benchmark", "inspect", "report"],
    "seed": Seed,
    "checkpoint": Text | None,
    "pretrained": Text | None,
    "resume": bool,
    "output": Text,
    "chosen": dict[str, str | None],
    "collect": {"episodes": Count, "seed": Seed, "workers": Count | None, "folder": Text},
    "evaluate": {
        "episodes": Count,
        "seed": UnseenSeed,
        "workers": Count | None,
        "recordings": Natural | None,
        "conditions": dict[str, dict[str, object]],
    },
    "validate": {"episodes": Natural, "seed": UnseenSeed},
    "preview": {"episodes": Count, "seed": Seed},
    "benchmark": {
        "names": Annotated[list[Literal["collect", "loader", "train", "policy", "deploy"]], MinLen(1)],
        "episodes": Count,
        "batches": Count,
        "steps": Count,
        "rounds": Count,
        "precisions": list[Literal["fp32", "bf16"]] | None,
        "compile": list[bool],
        "robosuite": str | None,
        "lerobot": str | None,
    },
    "inspect": {
        "folder": Text,
        "stores": Annotated[list[Text], MinLen(1)] | None,
        "where": dict[str, Any] | None,
        "repair": bool,
        "into": Text | None,
        "episode": Natural | None,
    },
    "report": {"runs": list[Text]},
}
GROUPS = tuple(dict.fromkeys(group for groups in JOBS.values() for group in groups))

HYDRA_KEYS = ("_target_", "_partial_")


def build(node: DictConfig | Mapping[str, Any], group: str, **runtime: Any) -> Any:
    """The object that `node`, composed or plain, of a group such as "model" describes.

    Nested nodes are built first, and those with `_partial_: true` arrive as factories. What is checked is the very
    mapping that is built: references are resolved before, and any that is left is refused.

    Args:
        node: it names a class in `_target_`, and its arguments.
        group: what the node is one of; it decides of which kind the class has to be.
        runtime: the arguments that only the program knows.

    Raises:
        ValueError: a class that may not be built or is of another kind, wrong arguments, or what a constructor raises.
    """
    plain = OmegaConf.to_container(node, resolve=True) if isinstance(node, DictConfig) else node
    require_resolved(plain, group)
    check_node(group, plain, makes(group), tuple(runtime))
    try:
        factory = instantiate(plain, _convert_="all", _partial_=True)
    except InstantiationException as error:
        if isinstance(error.__cause__, ValueError):
            raise ValueError(str(error.__cause__)) from error
        raise
    return factory(**runtime)


def check(cfg: DictConfig) -> None:
    """Bind everything that the job of `cfg` is going to build to the signatures it names.

    Raises:
        ValueError: an unknown, missing or ill-typed key, with its dotted name and what is allowed in its place.
    """
    for name in cfg:
        _require_known("", str(name), (*PLAIN, *GROUPS), "the config")
    for name, annotation in PLAIN.items():
        node = OmegaConf.to_container(cfg[name], resolve=True) if OmegaConf.is_config(cfg[name]) else cfg[name]
        _check_plain(name, node, annotation)
    _require_apart(cfg)
    if cfg.resume and cfg.checkpoint is None:
        raise ValueError("resume=true goes on from a checkpoint: name one, or take checkpoint=last")
    trained = cfg.checkpoint is not None and not cfg.resume
    groups = EVALUATION if cfg.job == "evaluate" and trained else JOBS[cfg.job]
    for group in groups:
        if cfg.get(group) is not None:
            node = OmegaConf.to_container(cfg[group], resolve=True, throw_on_missing=True)
            assert isinstance(node, dict)
            nodes = {f"{group}.{name!s}": each for name, each in node.items()} if group in SEVERAL else {group: node}
            for key, each in nodes.items():
                check_node(key, each, makes(group), RUNTIME.get(group, ()))
        elif group not in OPTIONAL:
            raise ValueError(f"job={cfg.job} needs {group}=OPTION; --help lists the options")
    if "model" in groups:
        _require_together(*(locate(f"{group}._target_", cfg[group]._target_) for group in ("tokenizer", "model")))
    if cfg.job == "evaluate":
        task, conditions = (OmegaConf.to_container(node, resolve=True) for node in (cfg.task, cfg.evaluate.conditions))
        for name, changes in cast("dict[str, Any]", conditions).items():
            changed = with_changes(cast("dict[str, Any]", task), changes)
            check_node(f"task (evaluate.conditions.{name})", changed, makes("task"))


def with_changes(task: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """A task node with the changes of a condition: other arguments, axes at another level, or null: switched off."""
    axes = {**task["randomize"], **changes.get("randomize", {})}
    return {**task, **changes, "randomize": {axis: level for axis, level in axes.items() if level is not None}}


@cache
def makes(group: str) -> Any:
    """The class, protocol or union of the objects that a group describes."""
    classes = [getattr(import_module(module), name) for module, _, name in (p.rpartition(".") for p in MAKES[group])]
    return classes[0] if len(classes) == 1 else classes[0] | classes[1]


def _require_apart(cfg: DictConfig) -> None:
    names = ("validate", "evaluate")
    one, other = (range(cfg[name].seed, cfg[name].seed + cfg[name].episodes) for name in names)
    if range(max(one.start, other.start), min(one.stop, other.stop)):
        raise ValueError(
            f"validate.seed={one.start} and evaluate.seed={other.start} share episodes, but those that choose the "
            "weights must not judge them: move one of the two"
        )


def _require_together(tokenizer: type, model: type) -> None:
    if not fits(tokenizer, _hints(model).get("tokenizer", object)):
        raise ValueError(
            f"{model.__name__} predicts one token per component, which {tokenizer.__name__} does not have: choose "
            "another tokenizer, such as uniform, or model=decoder, which goes with all"
        )


def digest(*keys: str, _root_: DictConfig) -> str:
    """Twelve hexadecimal digits that name what stands at the dotted `keys`, as `${digest:task,expert,collect.seed}`.

    The order of a mapping counts, because randomisation axes are applied in it; 10 and 10.0 are the same number.
    """
    values = [OmegaConf.select(_root_, key, throw_on_missing=True) for key in keys]
    plain = [OmegaConf.to_container(value, resolve=True) if OmegaConf.is_config(value) else value for value in values]
    return hashlib.sha256(json.dumps(_canonical(plain)).encode()).hexdigest()[:12]


def chosen(group: str) -> str | None:
    """The option that was chosen of a group, as `${chosen:task/randomize}`; None where no command line was read."""
    return HydraConfig.get().runtime.choices.get(group) if HydraConfig.initialized() else None


def suggestion(name: str, known: Iterable[str]) -> str:
    """`, did you mean …?`, or nothing where no known name comes close."""
    close = get_close_matches(name, list(known), n=1)
    return f", did you mean {close[0]}?" if close else ""


def _canonical(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _canonical(item) for name, item in value.items()}
    if isinstance(value, list):
        return [_canonical(item) for item in value]
    return int(value) if isinstance(value, float) and value.is_integer() else value


def check_node(key: str, node: Any, expected: Any, runtime: Sequence[str] = ()) -> None:
    """Bind a plain node, called `key`, to the signature of the class it names; `runtime` arguments come later.

    Raises:
        ValueError: a class that is no `expected`, or an unknown, missing or ill-typed key, with its dotted name and
            what is allowed in its place.
    """
    if not is_node(node):
        raise ValueError(f"{key} must be a node with a _target_, got {_short(node)}")
    target = locate(f"{key}._target_", node["_target_"])
    if not fits(target, expected):
        raise ValueError(f"{key}._target_ must name a class of kind {describe(expected)}, got {node['_target_']}")
    parameters = inspect.signature(target).parameters
    several = [name for name, each in parameters.items() if each.kind is inspect.Parameter.VAR_KEYWORD]
    known = [name for name in parameters if name not in (*runtime, *several)]
    hints = {**_hints(target), **NARROWER.get(node["_target_"], {})}
    for name, value in node.items():
        if name in HYDRA_KEYS:
            continue
        if not several or str(name).startswith("_"):
            _require_known(key, name, known, target.__name__)
        _check_value(f"{key}.{name}", value, hints.get(name, Any))
    for name in () if node.get("_partial_") else known:
        if name not in node and parameters[name].default is inspect.Parameter.empty:
            raise ValueError(f"{key}.{name} is missing: {target.__name__} needs it")


def require_no_paths(config: Mapping[str, Any], names: Iterable[str], source: object) -> None:
    """Refuse nodes out of a file in which a class is given a file or folder to read or write.

    Args:
        config: plain, with the nodes `names`, as far as there are any.
        source: where it comes from, for the error.

    Raises:
        ValueError: with the dotted name of the first such argument, or a class that may not be built.
    """
    for key in (key for name in names for key in _paths_in(config.get(name), name)):
        raise ValueError(f"{source} names a path in {key}: paths are taken from your own runs and commands only")


def _paths_in(node: Any, key: str) -> Iterator[str]:
    """Dotted names of the arguments in a node, called `key`, that name a file or folder."""
    if is_node(node):
        hints = _hints(locate(f"{key}._target_", node["_target_"]))
        yield from (f"{key}.{name}" for name, value in node.items() if value and takes_path(hints.get(name, Any)))
    for name, part in node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ():
        yield from _paths_in(part, f"{key}.{name}")


def _check_plain(key: str, value: Any, annotation: Any) -> None:
    if not isinstance(annotation, dict):
        return _check_value(key, value, annotation)
    if not isinstance(value, dict):
        raise ValueError(f"{key} must hold {', '.join(annotation)}, got {value!r}")
    for name in value:
        _require_known(key, name, annotation, key)
    for name in annotation:
        if name not in value:
            raise ValueError(f"{key}.{name} is missing")
        _check_value(f"{key}.{name}", value[name], annotation[name])
    return None


def _check_value(key: str, value: Any, annotation: Any) -> None:
    _check_nodes(key, value)  # first: what is wrong in a node says more than that its place wants another
    if not matches(value, annotation):
        choices = [str(choice) for choice in get_args(annotation)] if get_origin(annotation) is Literal else []
        hint = suggestion(str(value), choices)
        raise ValueError(f"{key} must be {describe(annotation)}, got {_short(value)}{hint}")


def _check_nodes(key: str, value: Any) -> None:
    """Check the nodes in a value against their own signatures, wherever they stand."""
    if is_node(value):
        return check_node(key, value, object)
    children = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for name, child in children:
        _check_nodes(f"{key}.{name}" if isinstance(value, dict) else f"{key}[{name}]", child)
    return None


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 200 else f"{text[:200]}…"


def _require_known(key: str, name: str, known: Collection[str], owner: str) -> None:
    if name not in known:
        prefix = f"{key}." if key else ""
        hint = suggestion(name, known) or ":"
        raise ValueError(f"{prefix}{name} is unknown{hint} {owner} takes {', '.join(known)}")


def _hints(target: type) -> dict[str, Any]:
    init = inspect.unwrap(target.__init__)  # type: ignore[misc]
    hints = {}
    for name, annotation in init.__annotations__.items():
        with suppress(NameError):  # a name that exists for type checkers only
            hints[name] = eval(annotation, init.__globals__) if isinstance(annotation, str) else annotation
    return hints


OmegaConf.register_new_resolver("digest", digest, replace=True)
OmegaConf.register_new_resolver("chosen", chosen, replace=True)
