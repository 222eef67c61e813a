"""Progress of a run's training, the run to resume, and the lock of a folder in training."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from vla.config.adopt import require_identity
from vla.config.differences import differences
from vla.data.index import INDEX
from vla.io.errors import UserError, counted
from vla.io.files import try_lock
from vla.models.checkpoint import Header, read_header
from vla.models.policy_folder import POLICY, read_policy
from vla.runs.files import ReportFile
from vla.runs.folder import CHECKPOINTS, LAST, REPORT, read_report

log = logging.getLogger(__name__)

LOCK = ".training"  # held by the process that trains into a folder

LENGTHS = ("max_steps", "max_time")  # of the trainer


def training_progress(folder: Path, config: Mapping[str, Any]) -> tuple[Path | None, Path | None]:
    """Return the progress of the training of `config` in a folder; raise a UserError if it holds a different training.

    The first result is the checkpoint of an unfinished training, or None. The second is the folder of the policy that a
    finished training selected, or None; it needs no checkpoint. Both are None before the first save.
    """
    if has_rounds(folder):
        raise UserError(f"{folder} has the rounds of a job=improve: continue them by that job, or choose output=DIR")
    last, policy_folder = folder / CHECKPOINTS / LAST, folder / POLICY
    if last.exists():
        header = read_header(last)
    elif policy_folder.is_dir():
        policy = read_policy(policy_folder)
        header = Header(policy.config, True, policy.training.steps)
    else:
        return None, None
    require_identity(header.config, config, folder)
    trainer, old_trainer = config["trainer"], header.config.get("trainer", {})
    changed = any(trainer.get(name) != old_trainer.get(name) for name in LENGTHS)
    longer = changed and not 0 <= trainer["max_steps"] <= header.steps
    if changed and not longer and trainer["max_steps"] != header.steps:
        log.warning("%s was trained for %s, more than trainer.max_steps", folder, counted(header.steps, "step"))
    if header.finished and policy_folder.is_dir() and not longer:
        saved_config = {**read_policy(policy_folder).config, "output": header.config.get("output")}
        require_identity(saved_config, config, folder)  # other jobs build this one
        log.info("training is already finished: %s", policy_folder)
        return None, policy_folder
    if not last.exists():
        raise UserError(f"a longer training would continue from {last}, which is gone: choose another output=DIR")
    if isinstance(trainer.get("strategy"), dict) and not isinstance(old_trainer.get("strategy"), dict):
        # A sharded optimiser orders its parameters differently.
        raise UserError(f"trainer=fsdp cannot continue {last}, which was trained without it: use trainer=ddp")
    log.info("resuming from %s", last)
    return last, None


def has_rounds(folder: Path) -> bool:
    """Return whether a folder has the trainings of a job=improve."""
    return any(folder.glob(f"round_*/{CHECKPOINTS}"))


def cached_report(folder: Path, config: Mapping[str, Any], checkpoint: Path, weights: str) -> ReportFile | None:
    """Return the report of a run; None unless it is of the same policy, with the digest `weights`, and of the same
    evaluation, and without errors."""
    report = read_report(folder)
    if report is None or report.checkpoint != str(checkpoint) or report.weights != weights:
        return None
    against, nearest = config["evaluate"]["against"], config["evaluate"]["nearest"]
    # Since then, the run to compare with may have been evaluated again, or more demonstrations collected.
    sources = [*([Path(against) / REPORT] if against else []), *([Path(nearest) / INDEX] if nearest else [])]
    if any(path.stat().st_mtime > (folder / REPORT).stat().st_mtime for path in sources):
        return None
    if any(part.errors for part in report.reports.values()) or differences(report.config, config):
        return None
    log.info("evaluation is already finished: %s", folder / REPORT)
    return report


def newest_run(runs: Path) -> Path:
    """Return the run in a folder that was trained last; raise a UserError if there is none."""
    files = [file for pattern in ("*", "*/round_*") for file in runs.glob(f"{pattern}/{CHECKPOINTS}/{LAST}")]
    if not files:
        raise UserError(f"resume=last: nothing was trained in {runs}; resume=DIR names a run elsewhere")
    newest = max(files, key=lambda file: file.stat().st_mtime)
    return runs / newest.relative_to(runs).parts[0]


@contextmanager
def training_lock(folder: Path) -> Iterator[None]:
    """In a training's first process, lock a folder of checkpoints, or of rounds; a UserError if another process has."""
    if not first_process():
        yield
        return
    folder.mkdir(parents=True, exist_ok=True)
    busy = f"another process is training in {folder}: wait for it, or choose another output=DIR"
    lock = try_lock(folder / LOCK, busy)
    try:
        yield
    finally:
        refused = [path.name for path in folder.glob("*")] == [LOCK]  # before any work
        if refused:
            (folder / LOCK).unlink(missing_ok=True)  # while it is held: a later process creates a new one
        lock.release()
        if refused:  # only now, because on NFS a file that is open stays under another name
            with suppress(OSError):  # it is another process's by now
                folder.rmdir()


def first_process() -> bool:
    """Return whether this is the first process of a training."""
    from lightning.pytorch.utilities import rank_zero_only

    return bool(rank_zero_only.rank == 0)  # type: ignore[attr-defined]
