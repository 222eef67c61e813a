"""Merging of a composed config with the policy or run that it names.

`checkpoint=RUN` takes task, tokenizer and model from a policy, `pretrained=RUN` takes tokenizer, model and data for a
new training (with job=improve also task, expert and learner), `resume=RUN` takes all of a run. Overrides go on top.
"""

from __future__ import annotations

import copy
import logging
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from omegaconf import DictConfig, OmegaConf, open_dict

from vla.config.build import GROUPS, require_no_paths, require_trust, without_paths
from vla.config.differences import ABSENT, differences, value_at
from vla.io.documents import read_yaml, resolve_config
from vla.io.errors import UserError
from vla.models.checkpoint import read_header
from vla.models.policy_folder import POLICY, REQUIRED_NODES, read_policy, with_absolute_paths
from vla.models.trunk_folder import is_trunk

log = logging.getLogger(__name__)

LAST_CHECKPOINT = Path("checkpoints/last.ckpt")  # in the folder of a training
# How a policy was trained, besides task, tokenizer and model: rounds of DAgger keep these, and reports show them.
TRAINING_KEYS = ("expert", "data", "learner", "validate", "collect.episodes", "collect.seed")
SCHEDULE = ("val_check_interval", "accumulate_grad_batches", "gradient_clip_val", "precision")  # of the trainer
REPORTED_KEYS = (*TRAINING_KEYS, "seed", "trainer.max_steps", *(f"trainer.{name}" for name in SCHEDULE))
NEUTRAL_KEYS = ("seed", "data", "learner", "trainer", "logger", "validate")  # keys that do not change a trained policy
MACHINES = ("accelerator", "devices", "num_nodes", "strategy")  # keys that trainer=OPTION changes in a resumed run
# A resumed run with other values of these keys would be a different training.
IDENTITY = (
    *(group.name for group in GROUPS.values() if group.training == "part"),
    *("collect.episodes", "collect.seed", "collect.folder", "collect.more", "validate", "seed", "pretrained"),
    *(f"trainer.{name}" for name in (*SCHEDULE, "gradient_clip_algorithm", "sync_batchnorm", "devices", "num_nodes")),
)


def adopt(cfg: DictConfig, overrides: Sequence[str]) -> DictConfig:
    """Return `cfg` with task, tokenizer and model of `cfg.checkpoint`; for job=evaluate also its training settings.

    A path or address in these three nodes is an error; in the saved expert it becomes null. Raises a UserError if there
    is no such policy, or an override contradicts its weights.
    """
    parsed = _parse(overrides, ("tokenizer", "model", "experiment"))
    saved_config = read_policy(cfg.checkpoint).config
    require_no_paths(saved_config, REQUIRED_NODES, cfg.checkpoint, _replaced_paths(parsed))
    values = _values(saved_config, REQUIRED_NODES)
    if cfg.job == "evaluate":
        if ignored := [override for override in parsed if _path(override).partition(".")[0] in NEUTRAL_KEYS]:
            text = "ignored: %s, because checkpoint= evaluates a policy as it is; pretrained= trains it further"
            log.warning(text, ", ".join(str(override.input_line) for override in ignored))
        parsed = [override for override in parsed if override not in ignored]  # a report shows the training as it was
        values |= _values(saved_config, REPORTED_KEYS)
        # The only one of them that is ever built, in an open-loop evaluation.
        values |= {"expert": without_paths(saved_config, "expert")} if "expert" in saved_config else {}
    return _merge(cfg, values | _chosen_options(saved_config, "experiment", "model"), parsed)


def finetune(cfg: DictConfig, overrides: Sequence[str]) -> DictConfig:
    """Return `cfg` with tokenizer, model and data of the policy `cfg.pretrained`, whose weights initialise a training.

    Rounds of DAgger continue the training of that policy: job=improve also takes task, expert, learner, validation, and
    number and seed of the demonstrations. Raises a UserError if there is no such policy, the job does not train, or an
    override contradicts the weights.
    """
    if cfg.checkpoint is not None or cfg.job not in ("train", "evaluate", "improve"):
        raise UserError(
            f"pretrained={cfg.pretrained} initialises a new training: use it with job=train, evaluate or improve, and "
            "without checkpoint=, which evaluates a policy"
        )
    if is_trunk(cfg.pretrained):
        return _with_trunk(cfg)
    policy, in_rounds = read_policy(cfg.pretrained), cfg.job == "improve"  # first, to report a wrong path
    saved_config = policy.config
    parsed = _parse(overrides, ("tokenizer", "model", "experiment"))
    parts = (*REQUIRED_NODES, *TRAINING_KEYS) if in_rounds else ("tokenizer", "model", "data")
    require_no_paths(saved_config, parts, cfg.pretrained, _replaced_paths(parsed) if in_rounds else None)
    values = _values(saved_config, parts)
    if "seed" in values.get("data", {}):
        values["data"] = {**values["data"], "seed": "${seed}"}  # of the new training: it orders the windows
    config = _merge(cfg, values | _chosen_options(saved_config, "model"), parsed)
    derived = [
        name for name in ("low", "high") if name in config.task and OmegaConf.is_interpolation(config.task, name)
    ]
    if derived and len(config.task.action) == len(policy.spec.action):
        # Bounds that follow from another recording would not be those of the weights.
        config.task.update({name: list(getattr(policy.spec, name)) for name in derived})
    return config


def _with_trunk(cfg: DictConfig) -> DictConfig:
    """Return `cfg` with published weights, `cfg.pretrained`, as `model.trunk`; a UserError if the model has none."""
    if "trunk" not in cfg.model:
        raise UserError(
            f"pretrained={cfg.pretrained} has weights of another project: choose their model, as in model=smolvla"
        )
    config = copy.deepcopy(cfg)
    config.model.trunk, config.pretrained = cfg.pretrained, None
    return config


def resume(cfg: DictConfig, run: Path, overrides: Sequence[str]) -> DictConfig:
    """Return the config of `run`, to continue it in its folder.

    The command line overrides the saved config. Of a `trainer` option that it chooses, only the keys in `MACHINES` are
    taken. `require_identity` refuses a change of a key in `IDENTITY` when training starts. Raises a UserError if the
    folder has no training, is not one of the user's own runs, or `cfg` names another policy or another folder.
    """
    if cfg.checkpoint is not None or cfg.pretrained is not None:
        raise UserError(f"resume={cfg.resume} continues a run unchanged: omit checkpoint= and pretrained=")
    file, saved_config = _read_config(run)
    output = Path(cfg.output).resolve()
    if run.resolve().parent != output.parent and run.resolve() != output:
        raise UserError(
            f"resume={run} is not among your runs in {output.parent}, and a stranger's config could name any file: "
            f"add output={run} if the run is yours, or train from its weights with pretrained={run}"
        )
    if cfg.job == "improve" != saved_config.get("job"):
        raise UserError(f"resume={run} is a training without rounds: job=improve pretrained={run} improves it")
    job = str(saved_config.get("job")).rpartition(".")[2]  # a job has a node of its own
    parsed, names = _parse(overrides, ("experiment",)), {*map(str, cfg), job} - {"output", "resume", "trust"}
    if run.resolve() != output and any(_path(override) == "output" for override in parsed):
        raise UserError(f"resume={run} continues in its own folder: omit output={cfg.output}")
    nodes = {name: node for name, node in saved_config.items() if name in names}
    require_trust(nodes, nodes, file)
    if "trainer" in _replaced_paths(parsed):
        trainer = {name: value for name, value in saved_config.get("trainer", {}).items() if name not in MACHINES}
        nodes["trainer"] = trainer | {name: cfg.trainer[name] for name in MACHINES if name in cfg.trainer}
        parsed = [override for override in parsed if _path(override) != "trainer" or not _replaces(override)]
    config = _merge(cfg, nodes, parsed)
    # Paths of rounds begin with the folder as it was written in the first command.
    in_place = isinstance(saved_config.get("output"), str) and Path(saved_config["output"]).resolve() == run.resolve()
    config.output, config.resume = saved_config["output"] if in_place else str(run), str(run)
    return config


def _read_config(run: Path) -> tuple[Path, Mapping[str, Any]]:
    """Return the file with the config of a run, its last checkpoint or config.yaml for rounds, and that config."""
    if (run / LAST_CHECKPOINT).is_file():
        return run / LAST_CHECKPOINT, read_header(run / LAST_CHECKPOINT).config
    file = run / "config.yaml"
    if file.is_file() and (config := read_yaml(file, dict[str, Any])).get("job") == "improve":
        return file, resolve_config(config, str(file))
    raise UserError(f"resume={run} has no training to continue: there is no {run / LAST_CHECKPOINT}")


def _values(config: Mapping[str, Any], keys: Iterable[str]) -> dict[str, Any]:
    """Return dotted key → saved value, without keys that the saved config lacks."""
    return {key: value for key in keys if (value := value_at(config, key)) != ABSENT}


def _chosen_options(config: Mapping[str, Any], *groups: str) -> dict[str, Any]:
    return {f"chosen.{group}": value_at(config, f"chosen.{group}", None) for group in groups}


def require_identity(
    saved_config: Mapping[str, Any], config: Mapping[str, Any], folder: Path, further_keys: Sequence[str] = ()
) -> None:
    """Raise a UserError unless `config` describes the training in a run's `folder`, whose config is `saved_config`.

    The dotted keys of `IDENTITY`, and `further_keys`, must have equal values. Paths may be relative in one of them, and
    those of other rounds may be where the folder was before it was moved with them.
    """
    defaults = {"trainer.num_nodes": 1}  # the default of trainers that omit it
    old, new = (
        {key: value_at(node, key, defaults.get(key)) for key in (*IDENTITY, *further_keys)}
        for node in (_with_absolute_model(saved_config), _with_absolute_model(config))
    )
    if isinstance(before := saved_config.get("output"), str):
        for key in ("pretrained", "collect.more"):
            if _moved(old[key], Path(before).parent, folder.parent) == new[key]:
                old[key] = new[key]
    keys = [key for key, _, _ in differences(old, new)]
    if keys:
        weights = f"; pretrained={folder} starts another from its weights" if (folder / POLICY).exists() else ""
        way_out = (
            "choose another output=DIR (hydra.sweep.dir=DIR of a sweep), or continue it with "
            f"resume={folder} output={folder}"
        )
        raise UserError(
            f"{folder} holds a training that differs in {', '.join(keys[:3])}{', …' if keys[3:] else ''}: "
            f"{'omit that to continue it' if config.get('resume') else way_out}{weights}"
        )


def _with_absolute_model(config: Mapping[str, Any]) -> Mapping[str, Any]:
    model = config.get("model")
    return {**config, "model": with_absolute_paths(model)} if isinstance(model, dict) else config


def _moved(value: Any, before: Path, now: Path) -> Any:
    """Return a path, or a list of paths, as they are after the folder `before` was moved to `now`."""
    if isinstance(value, list):
        return [_moved(item, before, now) for item in value]
    if isinstance(value, str) and Path(value).is_relative_to(before):
        return str(now / Path(value).relative_to(before))
    return value


def _parse(overrides: Sequence[str], fixed: Sequence[str]) -> list[Override]:
    """Parse overrides; raise a UserError if one changes a group that is `fixed` by the weights."""
    parsed = OverridesParser.create().parse_overrides(list(overrides))
    for override in parsed:
        group = _path(override).partition(".")[0]
        if group in fixed:
            raise UserError(
                f"{override.input_line} cannot be combined with saved weights, which belong to the {group} they were "
                "trained with: omit one of the two; other groups, such as task, can be combined"
            )
    return parsed


def _replaced_paths(parsed: Iterable[Override]) -> list[str]:
    return [_path(override) for override in parsed if _replaces(override)]


def _replaces(override: Override) -> bool:
    """Return whether an override replaces a whole value; Hydra merges a mapping into the existing one instead."""
    return not override.is_delete() and not isinstance(override.value(), dict)


def _path(override: Override) -> str:
    """Return the dotted path that an override changes: its package, as in group@package=option, or else its key."""
    package = override.package
    return package if package and not package.startswith("_") else override.key_or_group.replace("/", ".")


def _merge(cfg: DictConfig, values: Mapping[str, Any], parsed: Sequence[Override]) -> DictConfig:
    """Return `cfg` with saved values at dotted keys, and the command line's overrides on top of these."""
    config = copy.deepcopy(cfg)
    groups = {key.partition(".")[0] for key in values}
    with open_dict(config):
        for key, value in values.items():
            OmegaConf.update(config, key, value, merge=False, force_add=True)
        for override in parsed:
            path = _path(override)
            if path.partition(".")[0] not in groups:
                continue
            if override.is_delete():
                parent, _, name = path.rpartition(".")
                node = OmegaConf.select(config, parent)
                if not isinstance(node, DictConfig):
                    raise UserError(f"{override.input_line} removes nothing, the saved config has no {parent}: omit it")
                node.pop(name, None)
            elif _replaces(override):
                OmegaConf.update(config, path, OmegaConf.select(cfg, path), merge=False, force_add=True)
            else:
                OmegaConf.update(config, path, override.value(), merge=True, force_add=True)
    return config
