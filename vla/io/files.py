"""Atomic writes of files and folders, and errors that name the target."""

from __future__ import annotations

import glob
import json
import logging
import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from errno import EACCES, EDQUOT, EFBIG, EISDIR, ENOSPC, ENOTDIR, EPERM, EROFS
from pathlib import Path
from typing import TYPE_CHECKING

from vla.io.errors import UserError

if TYPE_CHECKING:
    from filelock import FileLock

log = logging.getLogger(__name__)

UNWRITABLE = (EACCES, EDQUOT, EFBIG, EISDIR, ENOSPC, ENOTDIR, EPERM, EROFS)


@contextmanager
def atomic_path(target: Path) -> Iterator[Path]:
    """Yield a draft path beside `target`, for a file or a folder; the draft replaces `target` at the end.

    A folder is replaced in two steps: a process that is killed between them leaves none under that name.
    Several processes may write to one target at once. On failure the draft is removed and `target` stays as it was;
    an OSError of a draft that cannot be written names `target`.
    """
    # Not the id of this process: in containers, a killed process or one of another machine may have had the same.
    # The suffix is kept, because libraries choose the format by it.
    draft = target.with_name(f".{secrets.token_hex(4)}.{target.name}")
    backup = draft.with_name(f"{draft.name}.before")
    try:
        with writing(target):
            yield draft
            if draft.is_dir() and target.is_dir():
                os.replace(target, backup)
            os.replace(draft, target)
    finally:
        if backup.is_dir() and not target.exists():
            os.replace(backup, target)
        for folder in (draft, backup):
            shutil.rmtree(folder, ignore_errors=True)
        with suppress(OSError):  # where nothing can be written, nothing can be removed either
            draft.unlink()


def remove_drafts(*targets: Path) -> None:
    """Remove drafts of `atomic_path` that killed processes left; no other process may write these targets meanwhile."""
    for target in targets:
        for draft in target.parent.glob(f".{'[0-9a-f]' * 8}.{glob.escape(target.name)}"):
            shutil.rmtree(draft, ignore_errors=True)
            with suppress(OSError):  # it was a folder
                draft.unlink()


def write_text(target: Path, text: str) -> None:
    """Write a text file atomically, creating its folder; see `atomic_path`."""
    with atomic_path(target) as draft:
        target.parent.mkdir(parents=True, exist_ok=True)
        draft.write_text(text, encoding="utf-8")


def write_json(target: Path, content: object) -> None:
    """Write strict JSON atomically, creating its folder; see `atomic_path`."""
    with atomic_path(target) as draft:
        target.parent.mkdir(parents=True, exist_ok=True)
        with draft.open("w", encoding="utf-8") as file:  # streamed: as one string it would take eight times its size
            json.dump(content, file, indent=1, allow_nan=False, ensure_ascii=False)
            file.write("\n")


def require_file(path: Path) -> None:
    """Raise a UserError if `path` is a folder, or a pipe or device, from which reading may never end."""
    if path.exists() and not path.is_file():
        raise UserError(f"{path} is a folder, a pipe or a device, not a file")


@contextmanager
def writing(target: Path) -> Iterator[None]:
    """Convert disk errors, which often name no file, into an OSError whose message names `target`."""
    try:
        yield
    except OSError as error:
        if error.errno not in UNWRITABLE:
            raise
        note = ", and the earlier one is kept" if target.is_file() else ""
        raise OSError(
            f"{target} cannot be written ({error.strerror}){note}: make room there, or choose another folder"
        ) from error


def try_lock(path: Path, message: str) -> FileLock:
    """Acquire a lock without waiting; a UserError with the text `message` if another process holds it."""
    from filelock import FileLock, Timeout  # takes 30 ms, and most processes lock nothing

    lock = FileLock(path, blocking=False)
    try:
        lock.acquire()
    except Timeout as error:
        raise UserError(message) from error
    return lock


@contextmanager
def warn_on_error(target: Path) -> Iterator[None]:
    """Reduce any error of writing `target` to a warning: the file only presents results that are already saved."""
    try:
        yield
    except Exception as error:
        log.warning("could not write %s, other results are saved: %s: %s", target, type(error).__name__, error)
