"""Merge of a composed config with the policy or run that it names.

`checkpoint=RUN` takes task, tokenizer and model from a policy, `pretrained=RUN` tokenizer, model and data for a new
training (with job=improve also task, expert and learner), `resume=RUN` the whole config of a run. Overrides of these
nodes on the command line apply on top.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from omegaconf import DictConfig, OmegaConf, open_dict

from vla.config.build import GROUPS, require_no_paths, require_trust, without_paths
from vla.config.differences import at, differences
from vla.io.documents import read_yaml, resolved
from vla.io.errors import UserError
from vla.models.checkpoint import read_header
from vla.models.policy_folder import POLICY, REQUIRED_NODES, is_gone, read_policy

OF_MODEL = ("tokenizer", "model", "data")  # the batch size depends on the model
OF_TRAINING = (*OF_MODEL, "task", "expert", "learner", "validate")  # of job=improve pretrained=RUN
# Parts of a training that a report on its policy shows: whole nodes, which only an open-loop evaluation builds, and
# single values of other nodes.
REPORTED = ("expert", "data", "learner", "validate", "seed")
CHOSEN = ("experiment", "model")  # groups in `chosen`
SCHEDULE = ("max_steps", "val_check_interval", "accumulate_grad_batches", "gradient_clip_val")
REPORTED_VALUES = {"collect": ("episodes", "seed"), "trainer": (*SCHEDULE, "precision")}
LAST = Path("checkpoints/last.ckpt")  # in the folder of a training
OF_THIS_COMMAND = ("output", "resume", "trust")  # keys that are not taken from a resumed run
# Keys of the trainer that trainer=OPTION changes in a resumed run.
MACHINES = ("accelerator", "devices", "num_nodes", "strategy")
IDENTITY = (  # keys that must not change in a resumed run: with other values it is another training
    *(group.name for group in GROUPS.values() if group.training == "part"),
    *("collect.episodes", "collect.seed", "collect.folder", "collect.more", "validate", "seed", "pretrained"),
    *(f"trainer.{name}" for name in ("val_check_interval", "accumulate_grad_batches", "precision")),
    *(f"trainer.{name}" for name in ("gradient_clip_val", "gradient_clip_algorithm", "sync_batchnorm")),
    *(f"trainer.{name}" for name in ("devices", "num_nodes")),
)


def adopt(cfg: DictConfig, overrides: Sequence[str]) -> DictConfig:
    """Return `cfg` with task, tokenizer and model of `cfg.checkpoint`; for job=evaluate also its training settings.

    A path or address in these nodes is an error; in the training settings it becomes null. Devices are not taken over.

    Raises:
        UserError: there is no such policy, or an override contradicts its weights.
    """
    parsed = _parsed(overrides)
    _require_own_parts(parsed, ("tokenizer", "model", "experiment"))
    saved = read_policy(cfg.checkpoint).config
    given = [_path(override) for override in parsed if not override.is_delete()]
    require_no_paths(saved, REQUIRED_NODES, cfg.checkpoint, given)
    chosen = {group: saved.get("chosen", {}).get(group) for group in CHOSEN}
    reported = _reported(cfg, saved) if cfg.job == "evaluate" else {}
    return _on_top(cfg, {**{name: saved[name] for name in REQUIRED_NODES}, **reported, "chosen": chosen}, parsed)


def finetune(cfg: DictConfig, overrides: Sequence[str]) -> DictConfig:
    """Return `cfg` with tokenizer, model and data of the policy `cfg.pretrained`, the initial weights of a training.

    Rounds with the expert continue the training of that policy: of job=improve also task, expert, learner, validation,
    and number and seed of the demonstrations are that policy's.

    Raises:
        UserError: there is no such policy, the job does not train, or an override contradicts the weights.
    """
    if cfg.checkpoint is not None or cfg.job not in ("train", "evaluate", "improve"):
        raise UserError(
            f"pretrained={cfg.pretrained} initialises a new training: use it with job=train, evaluate or improve, and "
            "without checkpoint=, which evaluates a policy"
        )
    parsed = _parsed(overrides)
    _require_own_parts(parsed, ("tokenizer", "model", "experiment"))
    own = Path(cfg.output) / LAST  # of this training; `pretrained` may have been deleted since
    gone = own.exists() and is_gone(cfg.pretrained)
    saved = read_header(own).config if gone else read_policy(cfg.pretrained).config
    improved = cfg.job == "improve"
    parts = OF_TRAINING if improved else OF_MODEL
    given = [_path(override) for override in parsed if not override.is_delete()] if improved else None
    require_no_paths(saved, parts, cfg.pretrained, given)
    chosen = {**cfg.chosen, "model": saved.get("chosen", {}).get("model")}
    nodes = {name: saved[name] for name in parts if name in saved}
    if improved:
        nodes["collect"] = _with_values(cfg, saved, "collect")
    if "seed" in nodes.get("data", {}):
        nodes["data"] = {**nodes["data"], "seed": "${seed}"}  # of this training: it orders the windows
    return _on_top(cfg, {**nodes, "chosen": chosen}, parsed)


def resume(cfg: DictConfig, run: Path, overrides: Sequence[str]) -> DictConfig:
    """Return the config of `run`, to continue it in its folder.

    The command line overrides the saved config. From an option of `trainer` only the keys in `MACHINES` are taken; a
    change of a key in `IDENTITY` is refused by `require_identity` when training starts.

    Raises:
        UserError: the folder has no training, is not one of the user's own runs, or `cfg` names another policy.
    """
    if cfg.checkpoint is not None or cfg.pretrained is not None:
        raise UserError(f"resume={cfg.resume} continues a run unchanged: omit checkpoint= and pretrained=")
    file, saved = _saved(run)
    output = Path(cfg.output).resolve()
    if run.resolve().parent != output.parent and run.resolve() != output:
        raise UserError(
            f"resume={run} is not among your runs in {output.parent}: a run's config names files and folders, so only "
            f"your own are resumed. If it is yours, add output={run}; to use somebody else's weights: "
            f"pretrained={run}"
        )
    if cfg.job == "improve" != saved.get("job"):
        raise UserError(f"resume={run} is a training without rounds: job=improve pretrained={run} improves it")
    own = str(saved.get("job")).rpartition(".")[2]  # a job has a node of its own
    parsed, known = _parsed(overrides), {*map(str, cfg), own}
    _require_own_parts(parsed, ("experiment",))
    taken = {name: node for name, node in saved.items() if name in known and name not in OF_THIS_COMMAND}
    require_trust(taken, taken, file)
    if any(_path(override) == "trainer" for override in parsed):
        kept = {name: value for name, value in saved.get("trainer", {}).items() if name not in MACHINES}
        taken["trainer"] = kept | {name: cfg.trainer[name] for name in MACHINES if name in cfg.trainer}
        parsed = [override for override in parsed if _path(override) != "trainer"]
    resumed = _on_top(cfg, taken, parsed)
    # Paths of rounds begin with the folder as it was written in the first command.
    same = isinstance(saved.get("output"), str) and Path(saved["output"]).resolve() == run.resolve()
    resumed.output, resumed.resume = saved["output"] if same else str(run), str(run)
    return resumed


def _saved(run: Path) -> tuple[Path, Mapping[str, Any]]:
    """Return the config of a run and the file that has it: its last checkpoint, or config.yaml of one in rounds.

    Raises:
        UserError: there is neither.
    """
    if (run / LAST).is_file():
        return run / LAST, read_header(run / LAST).config
    file = run / "config.yaml"
    if file.is_file() and (config := read_yaml(file, dict[str, Any])).get("job") == "improve":
        return file, resolved(config, str(file))
    raise UserError(f"resume={run}: nothing was trained in that folder, there is no {run / LAST}")


def _reported(cfg: DictConfig, saved: Mapping[str, Any]) -> dict[str, Any]:
    """Return the training settings of a checkpoint for the report of `cfg`, without paths and addresses."""
    own = cast("dict[str, Any]", OmegaConf.to_container(cfg))
    nodes = {}
    for name in (name for name in REPORTED if name in saved):
        # Only texts can be paths, and those of this command are none of the author's: spare the import of Lightning.
        known = _texts(saved[name]) <= _texts(own.get(name))
        nodes[name] = saved[name] if known else without_paths(saved, name)
    return nodes | {name: _with_values(cfg, saved, name) for name in REPORTED_VALUES}


def _with_values(cfg: DictConfig, saved: Mapping[str, Any], name: str) -> dict[str, Any]:
    """Return the node `name` of `cfg` with those values of the saved one that `REPORTED_VALUES` lists."""
    own: Any = OmegaConf.to_container(cfg[name]) if cfg[name] else {}
    return {**own, **{key: value for key, value in saved.get(name, {}).items() if key in REPORTED_VALUES[name]}}


def _texts(node: Any) -> set[str]:
    """Return all strings in nested values."""
    if isinstance(node, dict | list):
        return set().union(*map(_texts, node.values() if isinstance(node, dict) else node))
    return {node} if isinstance(node, str) else set()


def require_identity(saved: Mapping[str, Any], config: Mapping[str, Any], folder: Path) -> None:
    """Raise a UserError unless `config` describes the training in a run's `folder`, which has the config `saved`."""
    before, now = ({key: at(each, key, None) for key in IDENTITY} for each in (saved, config))
    changed = [key for key, _, _ in differences(before, now)]
    if changed:
        weights = f"; pretrained={folder} starts another from its weights" if (folder / POLICY).exists() else ""
        way_out = f"choose another output=DIR (hydra.sweep.dir=DIR of a sweep), or continue it with resume={folder}"
        raise UserError(
            f"{folder} holds a training that differs in {', '.join(changed[:3])}{', …' if changed[3:] else ''}: "
            f"{'omit that to continue it' if config.get('resume') else way_out}{weights}"
        )


def _require_own_parts(parsed: Sequence[Override], groups: Sequence[str]) -> None:
    for override in parsed:
        group = _path(override).partition(".")[0]
        if group in groups:
            raise UserError(
                f"{override.input_line} cannot be combined with a checkpoint, whose weights belong to the {group} "
                "they were trained with: omit one of the two; options of task and evaluate can be combined"
            )


def _parsed(overrides: Sequence[str]) -> list[Override]:
    return OverridesParser.create().parse_overrides(list(overrides))


def _path(override: Override) -> str:
    """Return the dotted path that an override changes: its package, as in group@package=option, or that of its key."""
    package = override.package
    return package if package and not package.startswith("_") else override.key_or_group.replace("/", ".")


def _on_top(cfg: DictConfig, saved: Mapping[str, Any], parsed: Sequence[Override]) -> DictConfig:
    """Return `cfg` with the saved nodes, and the command line's overrides on top of these."""
    adopted = copy.deepcopy(cfg)
    with open_dict(adopted):
        for name, node in saved.items():
            adopted[name] = node
        for override in parsed:
            path = _path(override)
            if path.partition(".")[0] not in saved:
                continue
            if override.is_delete():
                parent, _, name = path.rpartition(".")
                node = OmegaConf.select(adopted, parent)
                if not isinstance(node, DictConfig):
                    raise UserError(f"{override.input_line} removes a key of {parent}, which the checkpoint lacks")
                node.pop(name, None)
            elif isinstance(value := override.value(), dict):  # which Hydra merges with what is there
                OmegaConf.update(adopted, path, value, merge=True, force_add=True)
            else:
                OmegaConf.update(adopted, path, OmegaConf.select(cfg, path), merge=False, force_add=True)
    return adopted
