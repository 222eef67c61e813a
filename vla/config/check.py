"""Validation of a composed config before any work: nodes against signatures, options against types."""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Mapping
from contextlib import nullcontext, suppress
from dataclasses import dataclass, field
from inspect import Parameter
from pathlib import Path
from typing import Annotated, Any, Literal, cast

from annotated_types import Ge, Gt, Lt, Predicate
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from vla.config.annotations import MissingLibrary, fits, locate
from vla.config.build import GROUPS, Group, arguments, check_node, check_value, makes, require_known
from vla.config.packages import config_folders
from vla.io.documents import canonical
from vla.io.errors import UserError
from vla.io.types import Count, Images, Natural, Quality, Seed, Text, unique
from vla.spec import FIRST_SEED, IN_DISTRIBUTION

UnseenSeed = Annotated[Seed, Ge(FIRST_SEED)]


@dataclass(frozen=True)
class Job:
    """Requirements of a job, which its module declares as `JOB`."""

    groups: tuple[str | Group, ...]  # that it builds from; only these are checked and imported; names in `GROUPS`
    options: Mapping[str, Any] = field(default_factory=dict)  # name → type, in the config node of the job's name
    adopts: bool = False  # takes checkpoint=RUN
    without_agent: tuple[str, ...] = ()  # groups also needed without agent=OPTION
    without_checkpoint: tuple[str, ...] = ()  # groups also needed without agent=OPTION and checkpoint=RUN
    stored: tuple[str, ...] = ()  # groups whose libraries may be missing: a complete episode store takes their place

    def needs(self, config: Any) -> dict[str, Group]:
        """Return name → group of everything that it builds from with a plain or composed config."""
        further = () if config["agent"] is not None else self.without_agent
        if config["agent"] is config["checkpoint"] is None:
            further += self.without_checkpoint
        groups = (GROUPS[name] if isinstance(name, str) else name for name in (*self.groups, *further))
        return {group.name: group for group in groups}


TRAINING = tuple(group.name for group in GROUPS.values() if group.training)
NEAREST = "nearest"  # condition of an evaluation in which a demonstration is replayed

CODEC = {"images": Images | None, "quality": Quality}

# Nodes without a class.
PLAIN: dict[str, Any] = {
    "job": Text,
    "seed": Seed,
    "checkpoint": Text | None,
    "pretrained": Text | None,
    "resume": Text | None,
    "trust": list[str],
    "output": Text,
    "chosen": dict[str, str | None],
    "collect": {"episodes": Count, "seed": Seed, "folder": Text, "more": list[Text] | None, **CODEC},
    "validate": {"episodes": Natural, "seed": UnseenSeed, "changes": dict[str, object]},
    "evaluate": {
        "episodes": Count,
        "seed": UnseenSeed,
        "until": Literal["decided"] | None,
        "bar": Annotated[float, Gt(0), Lt(1)] | None,
        "against": Text | None,
        "margin": Annotated[float, Gt(0), Lt(1)],
        "recordings": Literal["all", "failures"] | Natural,
        "conditions": dict[str, dict[str, object]],
        "one_by_one": dict[str, dict[str, dict[str, object]]],
        "without": Annotated[list[Literal["images", "instruction"]], Predicate(unique)],
        "nearest": Text | None,
        "networks": dict[str, object],
    },
}


def check(cfg: DictConfig, job: Job) -> None:
    """Check every node that the `job` of `cfg` will build against the signature of its class.

    Raises:
        UserError: an unknown, missing or ill-typed key, with its dotted name and the allowed values.
    """
    groups, plain = job.needs(cfg), dict(PLAIN)
    if job.options:
        plain[cfg.job.rpartition(".")[2]] = job.options
    files = (file for folder in config_folders() for file in (folder / "job").glob("*.yaml"))
    jobs = {file.stem for file in files}  # an experiment may have options of another job
    for name in cfg:
        if name not in jobs:
            require_known("", str(name), {**plain, **GROUPS, **groups}, "the config")
    for name, annotation in plain.items():
        node = OmegaConf.to_container(cfg[name], resolve=True) if OmegaConf.is_config(cfg[name]) else cfg[name]
        _check_plain(name, node, annotation)
    if cfg.checkpoint is None:  # else the seeds of its own training count
        _require_apart(cfg)
    _require_different_stores(cfg)
    if cfg.agent is not None and "agent" not in groups:
        raise UserError(f"job={cfg.job} takes no agent: agent=OPTION goes with job=evaluate and deploy")
    if cfg.agent is not None and cfg.checkpoint is not None:
        raise UserError("agent=OPTION and checkpoint=RUN are two policies: omit one of them")
    for name, group in groups.items():
        if cfg.get(name) is not None:
            node = OmegaConf.to_container(cfg[name], resolve=True, throw_on_missing=True)
            assert isinstance(node, dict)
            nodes = {f"{name}.{each!s}": part for each, part in node.items()} if group.several else {name: node}
            for key, each in nodes.items():
                with suppress(MissingLibrary) if name in job.stored else nullcontext():
                    check_node(key, each, makes(group), group.runtime)
        elif not group.optional:
            raise UserError(f"job={cfg.job} needs {name}=OPTION; --help lists the options")
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
    if cfg.job in ("evaluate", "improve"):
        changed = {f"evaluate.conditions.{name}": changes for name, changes in conditions(evaluate).items()}
    if training and validate["episodes"]:
        changed["validate.changes"] = validate["changes"]
    if cfg.job == "improve" and cfg.improve.changes:
        changed["improve.changes"] = cast("dict[str, Any]", OmegaConf.to_container(cfg.improve.changes, resolve=True))
    for name, changes in changed.items():
        check_node(f"task ({name})", with_changes(task, changes), makes(GROUPS["task"]))


def conditions(evaluate: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Return condition → overrides of the task node: `evaluate.conditions`, then each part of `evaluate.one_by_one`.

    A part at a level is named `part_level`, such as light_hard, or `part` if all levels are equal. A part that is null
    at every level is left out.

    Args:
        evaluate: the plain node, whose `one_by_one` is level → argument of the task → part → value.

    Raises:
        UserError: two conditions have one name, those of `without` and `networks` and the training condition included.
    """
    named: list[tuple[str, dict[str, Any]]] = [*evaluate["conditions"].items()]
    levels: dict[tuple[str, str], dict[str, Any]] = {}
    for level, overrides in evaluate["one_by_one"].items():
        for argument, parts in overrides.items():
            for part, value in parts.items():
                levels.setdefault((argument, part), {})[level] = value
    for (argument, part), values in levels.items():
        if all(value is None for value in values.values()):
            continue
        if len(values) > 1 and len({repr(value) for value in values.values()}) == 1:
            values = {"": next(iter(values.values()))}
        for level, value in values.items():
            named.append((f"{part}_{level}" if level else part, {argument: {part: value}}))
    others = [IN_DISTRIBUTION, *(f"without_{sense}" for sense in evaluate["without"]), *evaluate["networks"]]
    others += [NEAREST] if evaluate["nearest"] else []
    for name, count in Counter([*others, *(name for name, _ in named)]).items():
        if count > 1:
            raise UserError(f"evaluate has {count} conditions with the name {name}: rename one")
    return dict(named)


def devices(trainer: Mapping[str, Any]) -> int:
    """Return how many devices a trainer node asks for, on all of its machines."""
    asked, nodes = trainer.get("devices", "auto"), trainer.get("num_nodes", 1)
    if isinstance(asked, list):
        return len(asked) * nodes
    if str(asked) not in ("auto", "-1"):
        return (len(asked.rstrip(",").split(",")) if "," in str(asked) else int(asked)) * nodes
    if trainer.get("accelerator", "auto") == "cpu":
        return nodes
    from torch.cuda import device_count  # slow to import

    return max(device_count(), 1) * nodes


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
        raise UserError(
            f"validate.seed={one.start} and evaluate.seed={other.start} share episodes, but episodes that select the "
            "weights must not evaluate them: change one of the two"
        )


def _require_different_stores(cfg: DictConfig) -> None:
    folder = Path(cfg.collect.folder).resolve()
    if folder in (Path(more).resolve() for more in cfg.collect.more or ()):
        raise UserError(
            f"collect.folder and collect.more name the same store, {folder}: omit it in collect.more, which takes "
            "further stores only, several times if they are to count for more"
        )


def _require_together(tokenizer: type, model: type) -> None:
    taken = arguments(model).get("tokenizer")
    if taken is None:
        raise UserError(f"{model.__name__} does not name its arguments: end them with **inherited: Inherited")
    if taken.annotation not in (Any, Parameter.empty) and not fits(tokenizer, taken.annotation):
        raise UserError(
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
    return hashlib.sha256(json.dumps(canonical(plain)).encode()).hexdigest()[:12]


def chosen(group: str, *, _root_: DictConfig) -> str | None:
    """Resolve `${chosen:task/randomize}`: the chosen option of a group, or None outside of Hydra."""
    if "hydra" in _root_:
        return _root_.hydra.runtime.choices.get(group)
    return HydraConfig.get().runtime.choices.get(group) if HydraConfig.initialized() else None


def _check_plain(key: str, value: Any, annotation: Any) -> None:
    if not isinstance(annotation, Mapping):
        return check_value(key, value, annotation)
    if not isinstance(value, dict):
        raise UserError(f"{key} must hold {', '.join(annotation)}, got {value!r}")
    for name in value:
        require_known(key, name, annotation, key)
    for name in annotation:
        if name not in value:
            raise UserError(f"{key}.{name} is missing")
        check_value(f"{key}.{name}", value[name], annotation[name])
    return None


OmegaConf.register_new_resolver("digest", digest, replace=True)
OmegaConf.register_new_resolver("chosen", chosen, replace=True)
