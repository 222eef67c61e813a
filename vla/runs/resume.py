"""Progress of a run's training, the run to resume, and the lock of a folder in training."""

from __future__ import annotations

import logging
import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from vla.config.adopt import require_identity
from vla.config.differences import differences
from vla.io.errors import UserError
from vla.models.checkpoint import read_header
from vla.models.policy_folder import POLICY, read_policy
from vla.runs.folder import CHECKPOINTS, CONFIG, ERRORS, LAST, REPORT, read_report
from vla.spec import IN_DISTRIBUTION

log = logging.getLogger(__name__)

FOUND = "VLA_LAST"  # environment variable that passes the run found by resume=last to other processes
LOCK = ".training"  # held by the process that trains into a folder

LENGTHS = ("max_steps", "max_time")  # of the trainer


@dataclass(frozen=True)
class TrainingProgress:
    """Progress of a run's training; both fields are None before its first save."""

    resume_from: Path | None = None  # checkpoint of an unfinished training
    chosen: Path | None = None  # folder of the policy that a finished training selected


def training_progress(folder: Path, config: Mapping[str, Any]) -> TrainingProgress:
    """Return the progress of the training that `config` describes in a folder; a UserError if it holds another one."""
    last = folder / CHECKPOINTS / LAST
    if not last.exists():
        return TrainingProgress()
    saved = read_header(last)
    require_identity(saved.config, config, folder)
    trainer, before = config["trainer"], saved.config.get("trainer", {})
    longer = (
        any(trainer.get(name) != before.get(name) for name in LENGTHS) and not 0 <= trainer["max_steps"] <= saved.steps
    )
    chosen = folder / POLICY
    if saved.finished and chosen.is_dir() and not longer:
        require_identity(read_policy(chosen).config, config, folder)  # which is the one that is built
        log.info("training is already finished: %s", chosen)
        return TrainingProgress(chosen=chosen)
    if isinstance(trainer.get("strategy"), dict) and not isinstance(before.get("strategy"), dict):
        # A sharded optimiser orders its parameters differently.
        raise UserError(f"trainer=fsdp cannot continue {last}, which was trained without it: use trainer=ddp")
    log.info("resuming from %s", last)
    return TrainingProgress(resume_from=last)


def cached_success(folder: Path, config: Mapping[str, Any], checkpoint: Path) -> float | None:
    """Return the success rate of a run's report if it is of the same policy and the same evaluation."""
    report = read_report(folder)
    if report is None or report.checkpoint != str(checkpoint):
        return None
    against = config["evaluate"]["against"]
    # Since the report the training may have continued, or the run that it compares with have been evaluated again.
    newer = [checkpoint] if against is None else [checkpoint, Path(against) / REPORT]
    if (folder / REPORT).stat().st_mtime < max(path.stat().st_mtime for path in newer):
        return None
    if any(part.errors for part in report.reports.values()) or differences(report.config, config):
        return None
    log.info("evaluation is already finished: %s", folder / REPORT)
    return report.reports[IN_DISTRIBUTION].success


def interrupted_run(runs: Path) -> Path:
    """Return the newest unfinished run in a folder, found once per command; a UserError if there is none.

    The first process passes the result to the processes that a trainer starts, because it locks that run.
    """
    started = os.environ.get("SLURM_STEP_NUM_TASKS", os.environ.get("TORCHELASTIC_RUN_ID") and os.environ["WORLD_SIZE"])
    if int(started or 1) > 1:
        raise UserError("resume=last: each of several processes would search for itself: name the run, resume=RUN")
    if os.environ.get("LOCAL_RANK", "0") == "0" or FOUND not in os.environ:
        os.environ[FOUND] = str(_newest_interrupted(runs))
    return Path(os.environ[FOUND])


def _newest_interrupted(runs: Path) -> Path:
    # Rounds begin with episodes, before there is a checkpoint.
    patterns = (f"*/{CHECKPOINTS}/{LAST}", f"*/round_*/{CHECKPOINTS}/{LAST}", "*/round_*/episodes/index.jsonl")
    files = sorted(chain(*map(runs.glob, patterns)), key=lambda path: path.stat().st_mtime, reverse=True)
    for last in files:
        training = last.parent.parent
        in_rounds = training.parent != runs
        run, lock = (training.parent, training.parent) if in_rounds else (training, last.parent)
        if not _locked(lock) and (not _evaluated(run, last, run / CONFIG) if in_rounds else _unfinished(run)):
            return run
    raise UserError(f"resume=last: no run in {runs} was interrupted; resume=DIR names one")


def _evaluated(run: Path, *since: Path) -> bool:
    """Return whether a run has a report that is not older than the files `since`."""
    began = max((path.stat().st_mtime for path in since if path.exists()), default=0.0)
    return any(path.exists() and path.stat().st_mtime >= began for path in (run / REPORT, run / ERRORS))


def _unfinished(run: Path) -> bool:
    """Return whether a training was interrupted, or the evaluation that was to follow."""
    saved = read_header(run / CHECKPOINTS / LAST)
    last = run / CHECKPOINTS / LAST
    return not saved.finished or (saved.config.get("job") == "evaluate" and not _evaluated(run, last))


@contextmanager
def training_lock(folder: Path) -> Iterator[None]:
    """Lock a folder of checkpoints, or of rounds; a UserError if another process holds the lock.

    Only the first process of a training takes it.
    """
    if not first_process():
        yield
        return
    folder.mkdir(parents=True, exist_ok=True)
    lock = FileLock(folder / LOCK, blocking=False)
    try:
        lock.acquire()
    except Timeout as error:
        raise UserError(
            f"another process is training or evaluating in {folder}: wait for it, or choose another output=DIR"
        ) from error
    try:
        yield
    finally:
        if [path.name for path in folder.glob("*")] == [LOCK]:  # refused before any work
            shutil.rmtree(folder)
        lock.release()


def _locked(folder: Path) -> bool:
    try:
        with FileLock(folder / LOCK, blocking=False):
            return False
    except Timeout:
        return True


def first_process() -> bool:
    """Return whether this is the first process of a training."""
    from lightning.pytorch.utilities import rank_zero_only

    return bool(rank_zero_only.rank == 0)  # type: ignore[attr-defined]
