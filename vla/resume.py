"""Going on with a training that was interrupted: which one, with which configuration, and alone."""

from __future__ import annotations

import copy
import logging
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from filelock import FileLock, Timeout
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from omegaconf import DictConfig, OmegaConf, open_dict

from vla.check import require_no_paths

if TYPE_CHECKING:
    from vla.policy import Checkpoint

log = logging.getLogger(__name__)

LAST = "last.ckpt"
FOUND = "VLA_LAST"  # what checkpoint=last was found to be
LOCK = ".training"  # held by the process that trains into a folder of checkpoints

OF_POLICY = ("task", "tokenizer", "model")
CHOSEN = {"experiment": "experiment", "model": "model", "randomize": "task/randomize"}  # name in `chosen` → group
# What training follows from, apart from where and how fast it runs.
OF_TRAINING = (
    *("task", "expert", "collect.episodes", "collect.seed", "data", "tokenizer", "model", "learner", "seed"),
    *("experiment", "variant", "pretrained"),
)
# What a training's length and steps are, of a trainer.
FAR = ("max_steps", "max_epochs", "val_check_interval", "accumulate_grad_batches", "gradient_clip_val")
# What makes two trainings in one folder the same one.
IDENTITY = (
    *("task", "expert", "collect.episodes", "collect.seed", "collect.folder", "data"),
    *("tokenizer", "model", "learner", "validate", "seed", "pretrained"),
    *(f"trainer.{name}" for name in (*FAR, "precision", "devices", "num_nodes")),
)
# What somebody else's checkpoint decides of a training that goes on from it; where files lie, what is logged where and
# on which devices it runs, the command line decides.
OF_OTHERS = (
    *("task", "expert", "data", "tokenizer", "model", "learner", "validate", "seed", "chosen"),
    *("evaluate", "policy", "recorder"),
)
# What the report on a policy says of its training.
TOLD = ("expert", "collect", "data", "learner", "trainer", "validate", "seed", "pretrained")


def adopt(cfg: DictConfig, saved: Mapping[str, Any], overrides: Sequence[str]) -> DictConfig:
    """`cfg` with the task, tokenizer and model of a checkpoint's config `saved`, and for a report with the rest of its
    training.

    What the command line `overrides` say about the task, as in `task/randomize=wide task.blocks=4`, applies on top.

    Raises:
        ValueError: an override of the tokenizer or the model, which the weights were trained with, or of an experiment
            or variant, which stand for several choices.
    """
    said = _parsed(overrides)
    _require_own_parts(said)
    named = {override.key_or_group for override in said}
    kept = saved.get("chosen", {})
    chosen = {name: cfg.chosen[name] if group in named else kept.get(name) for name, group in CHOSEN.items()}
    names = [*OF_POLICY, *(name for name in TOLD if cfg.job == "evaluate" and name in saved)]
    require_no_paths(saved, OF_POLICY, cfg.checkpoint)
    return _on_top(cfg, {**{name: saved[name] for name in names}, "chosen": chosen}, said)


def start_from(cfg: DictConfig, overrides: Sequence[str]) -> DictConfig:
    """`cfg` with tokenizer and model of the policy `cfg.pretrained`, from whose weights it is to be trained, and with
    its batches, which depend on how large the model is.

    Raises:
        ValueError: there is no such policy, `cfg` trains nothing anew, or an override of the tokenizer or the model, or
            of an experiment or variant, which may stand for them.
    """
    from vla.policy import read_checkpoint

    if cfg.checkpoint is not None or cfg.job not in ("train", "evaluate"):
        raise ValueError(
            f"pretrained={cfg.pretrained} is what a new training starts from: it goes with job=train or evaluate, and "
            "without checkpoint=, which goes on with a training or evaluates it"
        )
    said = _parsed(overrides)
    _require_own_parts(said)
    own = Path(cfg.output) / "checkpoints" / LAST  # of the same training, where it is to be gone on with
    saved = read_checkpoint(own if own.exists() and not Path(cfg.pretrained).exists() else cfg.pretrained).config
    chosen = {**_plain(cfg.chosen), "model": saved.get("chosen", {}).get("model")}
    parts = ("tokenizer", "model", "data")
    require_no_paths(saved, parts, cfg.pretrained)
    return _on_top(cfg, {**{name: saved[name] for name in parts if name in saved}, "chosen": chosen}, said)


def _require_own_parts(said: Sequence[Override]) -> None:
    for override in said:
        group = _path(override).partition(".")[0]
        if group in ("tokenizer", "model", "experiment", "variant"):
            raise ValueError(
                f"{override.input_line} cannot be combined with a checkpoint, whose weights belong to the {group} "
                "they were trained with: leave one of the two out; task/randomize=wide and evaluate=suite can be"
            )


def go_on(cfg: DictConfig, overrides: Sequence[str]) -> DictConfig:
    """The configuration of the training that made `cfg.checkpoint`, to go on with it.

    "last" stands for the newest interrupted run among the neighbours of `cfg.output`, in whose folder it goes on; if
    its training was finished, what it chose is evaluated. What the command line `overrides` say about anything but
    what the training follows from applies on top.

    Raises:
        ValueError: there is none, it has nothing left to do, or an override would make it another training.
    """
    from vla.policy import read_checkpoint
    from vla.results import run_of

    last = cfg.checkpoint == "last"
    path = _newest_interrupted(Path(cfg.output).parent) if last else Path(cfg.checkpoint)
    saved = read_checkpoint(path)
    said = _parsed(overrides)
    for override in said:
        if f"{_path(override)}.".startswith(tuple(f"{name}." for name in OF_TRAINING)):
            raise ValueError(
                f"{override.input_line} cannot be combined with going on from {path}: with other data, another "
                f"model or learner it is another training, so leave it out, or start one, with pretrained={path} in "
                "place of checkpoint= if it is to start from these weights"
            )
    own = _is_own(path, cfg)
    names = [name for name in cfg if name not in ("job", "output")] if own else OF_OTHERS
    resumed = _on_top(cfg, {name: saved.config[name] for name in names if name in saved.config}, said)
    named = {_path(override) for override in said}
    if not own:
        require_no_paths(_plain(resumed), OF_OTHERS, path)
        for name in ("episodes", "seed"):
            if name in saved.config.get("collect", {}):
                OmegaConf.update(resumed, f"collect.{name}", saved.config["collect"][name])
    if not own or "trainer" in named:  # how fast it goes on, not how far
        for name in FAR:
            if name in saved.config.get("trainer", {}) and f"trainer.{name}" not in named:
                OmegaConf.update(resumed, f"trainer.{name}", saved.config["trainer"][name], force_add=True)
    _require_same_sharing(resumed, saved)
    if not last and saved.finished:
        _require_steps_left(resumed, path)
    resumed.checkpoint, resumed.resume = str(path), True
    if last and "output" not in named:
        resumed.output = str(path.parent.parent)
    if last and "job" not in named:
        resumed.job = saved.config.get("job", cfg.job)
    if last and saved.finished and resumed.job == "evaluate":
        chosen = run_of(path).chosen
        resumed.checkpoint, resumed.resume = str(path.with_name(chosen or path.name)), chosen is None
    return resumed


def taken_up(cfg: DictConfig) -> DictConfig | None:
    """`cfg` with the checkpoint that its folder holds of the very training that it asks for, if there is one: to go on
    from, or to evaluate what was chosen where that training came to its end; None if nothing is left to do.

    Raises:
        ValueError: the folder holds another training.
    """
    from vla.policy import read_checkpoint
    from vla.results import differences, run_of

    path = Path(cfg.output) / "checkpoints" / LAST
    given = Path(cfg.checkpoint).resolve() if cfg.checkpoint else None
    elsewhere = given is not None and (cfg.resume or cfg.job == "train") and given.parent != path.resolve().parent
    if not path.exists() or (given is not None and not elsewhere):
        return cfg
    saved = read_checkpoint(path)
    apart = [key for key, _, _ in differences(_identity(saved.config), _identity(_plain(cfg)))]
    if apart:
        raise ValueError(
            f"{cfg.output} holds a training that differs in {', '.join(apart[:3])}{', …' if apart[3:] else ''}: choose "
            f"another output=DIR, or hydra.sweep.dir=DIR of a sweep, or go on with it by checkpoint={path} resume=true"
        )
    chosen = run_of(path).chosen if saved.finished else None  # killed in between, it has yet to be chosen
    if chosen is None:
        _require_same_sharing(cfg, saved)
    found = copy.deepcopy(cfg)
    found.checkpoint, found.resume = str(path.with_name(chosen or LAST)), chosen is None
    log.info("%s %s", "nothing is trained anew: there is" if chosen else "going on from", found.checkpoint)
    return None if chosen and (cfg.job == "train" or not _first_process()) else found


def reported(cfg: DictConfig, checkpoint: Path) -> float | None:
    """The success rate in the report that `cfg.output` holds, if that is of the same checkpoint, asked the same."""
    from vla.results import REPORT, differences, read_run

    report = read_run(Path(cfg.output)).report
    if report is None or report.checkpoint != str(checkpoint):
        return None
    if (Path(cfg.output) / REPORT).stat().st_mtime < checkpoint.stat().st_mtime:  # which was trained for longer since
        return None
    if any(part.errors for part in (report, *report.conditions.values())):
        return None
    if {key for key, _, _ in differences(report.config, _plain(cfg))} - {"checkpoint", "resume"}:
        return None
    log.info("nothing is evaluated anew: %s is of this very experiment", Path(cfg.output) / REPORT)
    return report.success


def _is_own(checkpoint: Path, cfg: DictConfig) -> bool:
    """Whether a checkpoint lies in a run beside the one that `cfg.output` names, where the user's own runs lie."""
    return checkpoint.resolve().parent.parent.parent == Path(cfg.output).resolve().parent


def _require_same_sharing(cfg: DictConfig, saved: Checkpoint) -> None:
    """Where weights are shared out, Lightning numbers what the optimiser remembers in another order."""
    sharing = OmegaConf.is_dict(OmegaConf.select(cfg, "trainer.strategy"))
    if sharing and not isinstance(saved.config.get("trainer", {}).get("strategy"), dict):
        raise ValueError(
            f"trainer=fsdp cannot go on from {saved.path}, which was trained without it: use trainer=ddp, or start anew"
        )


def _require_steps_left(cfg: DictConfig, path: Path) -> None:
    import torch

    steps = torch.load(path, map_location="cpu", weights_only=True, mmap=True).get("global_step", 0)
    if 0 <= cfg.trainer.max_steps <= steps:
        raise ValueError(
            f"{path} has reached trainer.max_steps={cfg.trainer.max_steps}: raise it, or evaluate it with "
            f"checkpoint={path} alone"
        )


def _plain(cfg: DictConfig) -> dict[str, Any]:
    return cast("dict[str, Any]", OmegaConf.to_container(cfg, resolve=True))


def _identity(config: Mapping[str, Any]) -> dict[str, Any]:
    """Key → value of what makes a training this one; None where the configuration does not have the key."""
    values: dict[str, Any] = {}
    for key in IDENTITY:
        group, _, name = key.partition(".")
        values[key] = config[group].get(name) if name else config.get(group)
    return values


def _newest_interrupted(runs: Path) -> Path:
    """As `newest_interrupted`; processes that a trainer starts are told by the first, which holds that run by then."""
    if os.environ.get("LOCAL_RANK", "0") == "0" or FOUND not in os.environ:
        os.environ[FOUND] = str(newest_interrupted(runs))
    return Path(os.environ[FOUND])


def newest_interrupted(runs: Path) -> Path:
    """The checkpoint of the newest run in a folder whose training, or the evaluation after it, did not come to its end.

    Raises:
        ValueError: there is none.
    """
    from vla.policy import read_checkpoint
    from vla.results import run_of

    files = sorted(runs.glob(f"*/checkpoints/{LAST}"), key=lambda path: path.stat().st_mtime, reverse=True)
    for path in files:
        if _held(path.parent):
            continue
        saved = read_checkpoint(path)
        unreported = saved.config.get("job") == "evaluate" and not (path.parent.parent / "report.json").exists()
        unchosen = run_of(path).chosen is None  # killed between its last save and its end
        if not saved.finished or unchosen or unreported:
            return path
    raise ValueError(
        f"checkpoint=last: none of the {len(files)} trainings in {runs} was interrupted; checkpoint=FILE names one"
    )


@contextmanager
def alone(checkpoints: Path) -> Iterator[None]:
    """Within, no other training writes into this folder; the processes of one training count as one.

    Raises:
        ValueError: another one does.
    """
    if not _first_process():
        yield
        return
    checkpoints.mkdir(parents=True, exist_ok=True)
    lock = FileLock(checkpoints / LOCK, blocking=False)
    try:
        lock.acquire()
    except Timeout as error:
        raise ValueError(
            f"another process is training into {checkpoints}: give it time, or another output=DIR"
        ) from error
    try:
        yield
    finally:
        lock.release()


def _first_process() -> bool:
    from lightning.pytorch.utilities import rank_zero_only

    return bool(rank_zero_only.rank == 0)  # type: ignore[attr-defined]


def _held(checkpoints: Path) -> bool:
    """Whether a training is writing there now."""
    try:
        with FileLock(checkpoints / LOCK, blocking=False):
            return False
    except Timeout:
        return True


def _parsed(overrides: Sequence[str]) -> list[Override]:
    return OverridesParser.create().parse_overrides(list(overrides))


def _path(override: Override) -> str:
    return override.key_or_group.replace("/", ".")


def _on_top(cfg: DictConfig, saved: Mapping[str, Any], said: Sequence[Override]) -> DictConfig:
    """`cfg` with the saved nodes, and on top of these what was said on the command line."""
    adopted = copy.deepcopy(cfg)
    with open_dict(adopted):
        for name, node in saved.items():
            adopted[name] = node
        for override in said:
            path = _path(override)
            if path.partition(".")[0] not in saved:
                continue
            if override.is_delete():
                parent, _, name = path.rpartition(".")
                OmegaConf.select(adopted, parent).pop(name, None)
            else:
                OmegaConf.update(adopted, path, OmegaConf.select(cfg, path), merge=False, force_add=True)
    return adopted
