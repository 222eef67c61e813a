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
from importlib import import_module
from typing import Annotated, Any, Literal, get_args, get_origin

from hydra.core.hydra_config import HydraConfig
from hydra.errors import InstantiationException
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from vla.annotations import describe, matches
from vla.spec import FIRST_SEED

# What a `_target_` may name: configs also come out of checkpoints, which may come from anybody.
ALLOWED = ("vla.", "torch.", "lightning.", "dm_control.composer.variation.")

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

Count = Annotated[int, 1]
Seed = Annotated[int, 0]
UnseenSeed = Annotated[int, FIRST_SEED]

# The nodes that name no class.
PLAIN: dict[str, Any] = {
    "job": Literal["preview", "collect", "train", "evaluate", "export", "deploy", "benchmark", "inspect", "report"],
    "seed": Seed,
    "checkpoint": str | None,
    "pretrained": str | None,
    "resume": bool,
    "output": str,
    "chosen": dict[str, str | None],
    "collect": {"episodes": Count, "seed": Seed, "workers": Count | None, "folder": str},
    "evaluate": {
        "episodes": Count,
        "seed": UnseenSeed,
        "workers": Count | None,
        "recordings": Seed | None,
        "conditions": dict[str, dict[str, Any]],
    },
    "validate": {"episodes": Seed, "seed": UnseenSeed},
    "preview": {"episodes": Count, "seed": Seed},
    "benchmark": {
        "names": list[Literal["collect", "loader", "train", "policy", "deploy"]],
        "episodes": Count,
        "batches": Count,
        "steps": Count,
        "rounds": Count,
        "precisions": list[Literal["fp32", "bf16"]],
        "compile": list[bool],
        "robosuite": str | None,
        "lerobot": str | None,
    },
    "inspect": {
        "folder": str,
        "stores": list[str] | None,
        "where": dict[str, Any] | None,
        "repair": bool,
        "into": str | None,
        "episode": Seed | None,
    },
    "report": {"runs": list[str]},
}
GROUPS = tuple(dict.fromkeys(group for groups in JOBS.values() for group in groups))

HYDRA_KEYS = ("_target_", "_partial_", "_convert_", "_recursive_")


def build(node: DictConfig | Mapping[str, Any], **runtime: Any) -> Any:
    """The object that `node`, composed or plain, describes, given the arguments that only the program knows.

    Nested nodes are built first, and those with `_partial_: true` arrive as factories.

    Raises:
        ValueError: a `_target_` that is not allowed, or what the constructor of a nested node raises.
    """
    plain = OmegaConf.to_container(node) if isinstance(node, DictConfig) else node
    for key, target in _targets(plain):
        _locate(key, target)
    try:
        factory = instantiate(node, _convert_="all", _partial_=True)
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
                check_node(key, each, RUNTIME.get(group, ()))
        elif group not in OPTIONAL:
            raise ValueError(f"job={cfg.job} needs {group}=OPTION; --help lists the options")
    if "model" in groups:
        _require_together(*(_locate(f"{group}._target_", cfg[group]._target_) for group in ("tokenizer", "model")))


def _require_apart(cfg: DictConfig) -> None:
    names = ("validate", "evaluate")
    one, other = (range(cfg[name].seed, cfg[name].seed + cfg[name].episodes) for name in names)
    if range(max(one.start, other.start), min(one.stop, other.stop)):
        raise ValueError(
            f"validate.seed={one.start} and evaluate.seed={other.start} share episodes, but those that choose the "
            "weights must not judge them: move one of the two"
        )


def _require_together(tokenizer: type, model: type) -> None:
    if not issubclass(tokenizer, _hints(model).get("tokenizer", object)):
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


def _targets(node: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    if isinstance(node, dict):
        if "_target_" in node:
            yield f"{key}_target_", node["_target_"]
        for name, value in node.items():
            yield from _targets(value, f"{key}{name}.")
    elif isinstance(node, list):
        for index, value in enumerate(node):
            yield from _targets(value, f"{key}{index}.")


def _locate(key: str, target: Any) -> type:
    if not isinstance(target, str) or not target.startswith(ALLOWED):
        raise ValueError(f"{key} must begin with {' or '.join(ALLOWED)}, got {target!r}")
    try:
        module, _, name = target.rpartition(".")
        found = getattr(import_module(module), name)
    except (ImportError, AttributeError) as error:
        raise ValueError(f"{key} is {target}, which cannot be imported: {error}") from error
    # An allowed module may itself have imported something that is not, such as `os`.
    if not isinstance(found, type) or not found.__module__.startswith(ALLOWED):
        raise ValueError(f"{key} must name a class defined under {' or '.join(ALLOWED)}, got {target!r}")
    return found


def check_node(key: str, node: Any, runtime: Sequence[str] = ()) -> None:
    """Bind a plain node, called `key`, to the signature of the class it names; `runtime` arguments come later.

    Raises:
        ValueError: an unknown, missing or ill-typed key, with its dotted name and what is allowed in its place.
    """
    if not isinstance(node, dict) or "_target_" not in node:
        raise ValueError(f"{key} must be a node with a _target_, got {node!r}")
    target = _locate(f"{key}._target_", node["_target_"])
    parameters = inspect.signature(target).parameters
    kinds = {parameter.kind for parameter in parameters.values()}
    known = [name for name in parameters if name not in runtime]
    hints = _hints(target)
    for name, value in node.items():
        if name in HYDRA_KEYS:
            continue
        if inspect.Parameter.VAR_KEYWORD not in kinds:
            _require_known(key, name, known, target.__name__)
        _check_value(f"{key}.{name}", value, hints.get(name, Any))
    for name in () if node.get("_partial_") else known:
        parameter = parameters[name]
        variadic = parameter.kind in (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
        if name not in node and parameter.default is inspect.Parameter.empty and not variadic:
            raise ValueError(f"{key}.{name} is missing: {target.__name__} needs it")


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
    if not matches(value, annotation):
        choices = [str(choice) for choice in get_args(annotation)] if get_origin(annotation) is Literal else []
        hint = suggestion(str(value), choices)
        raise ValueError(f"{key} must be {describe(annotation)}, got {value!r}{hint}")
    if isinstance(value, dict) and "_target_" in value:
        return check_node(key, value)
    children = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for name, child in children:
        _check_value(f"{key}.{name}" if isinstance(value, dict) else f"{key}[{name}]", child, Any)
    return None


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
