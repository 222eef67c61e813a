"""Validation of a composed config before any work: nodes against signatures, options against types."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal, cast

from annotated_types import Ge, MinLen
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from vla.config.annotations import fits, locate
from vla.config.build import GROUPS, arguments, check_node, check_value, makes, require_known
from vla.config.conditions import conditions
from vla.io.types import Count, Natural, Seed, Shift, Text
from vla.spec import FIRST_SEED

UnseenSeed = Annotated[Seed, Ge(FIRST_SEED)]


@dataclass(frozen=True)
class Job:
    """Requirements of a job; its module in `vla.jobs` has the same name."""

    groups: tuple[str, ...]  # config groups that it builds from; only these are checked and imported
    options: dict[str, Any] | None = None  # name → type, in the config node of the same name


TRAINING = ("task", "expert", "cluster", "data", "tokenizer", "model", "learner", "trainer", "logger")
EVALUATION = ("task", "cluster", "tokenizer", "model", "policy", "recorder")  # of a checkpoint, without training
JOBS = {
    "preview": Job(("task", "expert"), {"episodes": Count, "seed": Seed}),
    "collect": Job(("task", "expert", "cluster"), {"episodes": Count, "seed": Seed, "folder": Text}),
    "train": Job(TRAINING),
    "evaluate": Job(
        (*TRAINING, "policy", "recorder"),
        {
            "episodes": Count,
            "seed": UnseenSeed,
            "recordings": Natural | None,
            "conditions": dict[str, dict[str, object]],
            "one_by_one": dict[str, dict[str, dict[str, object]]],
        },
    ),
    "export": Job(("task", "expert", "cluster", "tokenizer", "model", "policy", "export")),
    "deploy": Job(("tokenizer", "model", "policy", "deploy")),
    "benchmark": Job(
        (*TRAINING, "policy"),
        {
            "names": Annotated[list[Literal["collect", "loader", "train", "policy", "deploy", "serve"]], MinLen(1)],
            "episodes": Count,
            "batches": Count,
            "steps": Count,
            "rounds": Count,
            "precisions": list[Literal["fp32", "bf16"]] | None,
            "compile": list[bool],
            "robosuite": str | None,
            "lerobot": str | None,
        },
    ),
    "inspect": Job(
        (),
        {
            "folder": Text,
            "stores": Annotated[list[Text], MinLen(1)] | None,
            "where": dict[str, Any] | None,
            "repair": bool,
            "into": Text | None,
            "episode": Natural | None,
        },
    ),
    "report": Job((), {"runs": list[Text]}),
}

# Nodes without a class.
PLAIN: dict[str, Any] = {
    "job": Literal[tuple(JOBS)],  # type: ignore[invalid-literal]
    "seed": Seed,
    "shift": Shift,
    "checkpoint": Text | None,
    "pretrained": Text | None,
    "resume": Text | None,
    "trust": list[str],
    "output": Text,
    "chosen": dict[str, str | None],
    "validate": {"episodes": Natural, "seed": UnseenSeed, "changes": dict[str, object]},
    **{name: job.options for name, job in JOBS.items() if job.options},
}


def check(cfg: DictConfig) -> None:
    """Check every node that the job of `cfg` will build against the signature of its class.

    Raises:
        ValueError: an unknown, missing or ill-typed key, with its dotted name and the allowed values.
    """
    for name in cfg:
        require_known("", str(name), (*PLAIN, *GROUPS), "the config")
    for name, annotation in PLAIN.items():
        node = OmegaConf.to_container(cfg[name], resolve=True) if OmegaConf.is_config(cfg[name]) else cfg[name]
        _check_plain(name, node, annotation)
    _require_apart(cfg)
    job = JOBS[cfg.job]
    groups = EVALUATION if cfg.job == "evaluate" and cfg.checkpoint is not None else job.groups
    for name in groups:
        group = GROUPS[name]
        if cfg.get(name) is not None:
            node = OmegaConf.to_container(cfg[name], resolve=True, throw_on_missing=True)
            assert isinstance(node, dict)
            nodes = {f"{name}.{each!s}": part for each, part in node.items()} if group.several else {name: node}
            for key, each in nodes.items():
                check_node(key, each, makes(name), group.runtime)
        elif not group.optional:
            raise ValueError(f"job={cfg.job} needs {name}=OPTION; --help lists the options")
    if "model" in groups:
        _require_together(*(locate(f"{group}._target_", cfg[group]._target_) for group in ("tokenizer", "model")))
    _check_changes(cfg, training="learner" in groups)


def _check_changes(cfg: DictConfig, training: bool) -> None:
    """Check the task node under every condition of an evaluation, and with the changes of validation."""
    task, evaluate, validate = (
        cast("dict[str, Any]", OmegaConf.to_container(cfg[name], resolve=True))
        for name in ("task", "evaluate", "validate")
    )
    changed = {}
    if cfg.job == "evaluate":
        changed = {f"evaluate.conditions.{name}": changes for name, changes in conditions(evaluate).items()}
    if training and validate["changes"]:
        changed["validate.changes"] = validate["changes"]
    for name, changes in changed.items():
        check_node(f"task ({name})", with_changes(task, changes), makes("task"))


def with_changes(node: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return a node merged with changes, key by key; a mapping that names a class replaces the old one."""
    merged = dict(node)
    for name, change in changes.items():
        old = merged.get(name)
        if isinstance(old, Mapping) and isinstance(change, Mapping) and "_target_" not in change:
            change = with_changes(old, change)
        merged[name] = change
    return merged


def _require_apart(cfg: DictConfig) -> None:
    names = ("validate", "evaluate")
    one, other = (range(cfg[name].seed, cfg[name].seed + cfg[name].episodes) for name in names)
    if range(max(one.start, other.start), min(one.stop, other.stop)):
        raise ValueError(
            f"validate.seed={one.start} and evaluate.seed={other.start} share episodes, but episodes that select the "
            "weights must not evaluate them: change one of the two"
        )


def _require_together(tokenizer: type, model: type) -> None:
    if not fits(tokenizer, arguments(model)["tokenizer"].annotation):
        raise ValueError(
            f"{model.__name__} predicts one token per component, which {tokenizer.__name__} does not have: choose "
            "another tokenizer, such as uniform, or model=decoder, which goes with all"
        )


def digest(*keys: str, _root_: DictConfig) -> str:
    """Resolve `${digest:task,expert,collect.seed}`: twelve hexadecimal digits of the values at dotted `keys`.

    The order of mappings matters, because randomisation axes are applied in order. Null equals an absent key, and 10
    equals 10.0.
    """
    values = [OmegaConf.select(_root_, key, throw_on_missing=True) for key in keys]
    plain = [OmegaConf.to_container(value, resolve=True) if OmegaConf.is_config(value) else value for value in values]
    return hashlib.sha256(json.dumps(_canonical(plain)).encode()).hexdigest()[:12]


def chosen(group: str, *, _root_: DictConfig) -> str | None:
    """Resolve `${chosen:task/randomize}`: the chosen option of a group, or None outside of Hydra."""
    if "hydra" in _root_:
        return _root_.hydra.runtime.choices.get(group)
    return HydraConfig.get().runtime.choices.get(group) if HydraConfig.initialized() else None


def _canonical(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _canonical(item) for name, item in value.items() if item is not None}
    if isinstance(value, list):
        return [_canonical(item) for item in value]
    return int(value) if isinstance(value, float) and value.is_integer() else value


def _check_plain(key: str, value: Any, annotation: Any) -> None:
    if not isinstance(annotation, dict):
        return check_value(key, value, annotation)
    if not isinstance(value, dict):
        raise ValueError(f"{key} must hold {', '.join(annotation)}, got {value!r}")
    for name in value:
        require_known(key, name, annotation, key)
    for name in annotation:
        if name not in value:
            raise ValueError(f"{key}.{name} is missing")
        check_value(f"{key}.{name}", value[name], annotation[name])
    return None


OmegaConf.register_new_resolver("digest", digest, replace=True)
OmegaConf.register_new_resolver("chosen", chosen, replace=True)
