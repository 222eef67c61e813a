"""Files and folders that are written whole or not at all, and what is said of a disk that does not take them."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from errno import EACCES, EDQUOT, EFBIG, EISDIR, ENOSPC, ENOTDIR, EPERM, EROFS
from pathlib import Path

UNWRITABLE = (EACCES, EDQUOT, EFBIG, EISDIR, ENOSPC, ENOTDIR, EPERM, EROFS)


@contextmanager
def atomic_path(target: Path) -> Iterator[Path]:
    """A path beside `target` for a draft, a file or a folder, which takes its place at the end.

    Several processes may write to one target at once. On failure the draft is removed and `target` stays as it was.

    Raises:
        OSError: it cannot be written; the message names `target`.
    """
    draft = target.with_name(f".{os.getpid()}.{target.name}")  # libraries choose the format by the suffix
    try:
        with writing(target):
            yield draft
            os.replace(draft, target)
    finally:
        if draft.is_dir():
            shutil.rmtree(draft, ignore_errors=True)
        else:
            with suppress(OSError):  # where nothing can be written, nothing can be removed either
                draft.unlink()


def write_text(target: Path, text: str) -> None:
    """Write a text file whole or not at all, into a folder that is made; see `atomic_path`."""
    with atomic_path(target) as draft:
        target.parent.mkdir(parents=True, exist_ok=True)
        draft.write_text(text, encoding="utf-8")


@contextmanager
def writing(target: Path) -> Iterator[None]:
    """Within, an error of the disk, which often names no file, becomes an OSError whose message names `target`."""
    try:
        yield
    except OSError as error:
        if error.errno not in UNWRITABLE:
            raise
        kept = ", the one before it is kept" if target.is_file() else ""
        raise OSError(
            f"{target} cannot be written ({error.strerror}){kept}: make room there, or choose another folder"
        ) from error
