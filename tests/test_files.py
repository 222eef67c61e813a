"""What is written is there whole or not at all, and a disk that does not take it is named."""

from __future__ import annotations

import os
from errno import ENOENT, ENOSPC
from pathlib import Path

import pytest

from vla.data.formats.files import staging_folder
from vla.io.errors import UserError
from vla.io.files import atomic_path, remove_drafts, writing
from vla.runs.resume import training_lock


def test_a_file_and_a_folder_take_their_place_at_the_end(tmp_path: Path) -> None:
    for name in ("file.txt", "folder"):
        with atomic_path(tmp_path / name) as draft:
            assert draft.name.endswith(name) and draft.parent == tmp_path
            place = draft
            if name == "folder":
                draft.mkdir()
                place = draft / "inside"
            place.write_text(name)
            assert not (tmp_path / name).exists()
    assert (tmp_path / "file.txt").read_text() == "file.txt"
    assert (tmp_path / "folder/inside").read_text() == "folder"


def test_processes_of_one_number_write_one_folder(tmp_path: Path) -> None:
    # Such as those of containers, also one that was killed.
    with atomic_path(tmp_path / "folder") as one, atomic_path(tmp_path / "folder") as other:
        for draft in (one, other):
            draft.mkdir()
            (draft / "file").write_text(draft.name)
    assert [path.read_text() for path in tmp_path.rglob("file")] == [one.name]


@pytest.mark.parametrize("before", ["", "before"])
def test_a_full_disk_leaves_what_was_there_and_is_named(tmp_path: Path, before: str) -> None:
    target = tmp_path / "file"
    if before:
        target.write_text(before)
    with pytest.raises(OSError, match="make room there") as failed, atomic_path(target) as draft:
        draft.write_text("half")
        Path("/dev/full").write_text("the rest")
    assert str(failed.value).startswith(f"{target} cannot be written (No space left on device)")
    assert ("and the earlier one is kept" in str(failed.value)) == bool(before)
    assert [path.read_text() for path in tmp_path.iterdir()] == [before] * bool(before)


def test_only_what_a_disk_says_is_put_in_other_words(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError), writing(tmp_path):
        raise OSError(ENOENT, os.strerror(ENOENT), "other")
    with pytest.raises(OSError, match="inner cannot be written"), writing(tmp_path / "outer"), writing(Path("inner")):
        raise OSError(ENOSPC, os.strerror(ENOSPC))


def test_what_killed_processes_left_is_removed_and_nothing_else(tmp_path: Path) -> None:
    others = ["last.ckpt", "policy", ".training", ".0123abcd.other.ckpt", ".0123abcd.policy.before", ".0123abcd.run1"]
    for name in (*others, ".0123abcd.last.ckpt", ".0123abcd.policy"):
        if "policy" in name:
            (tmp_path / name).mkdir()
        (tmp_path / name / "model" if "policy" in name else tmp_path / name).touch()
    (tmp_path / ".0123abcd.run[1]").touch()
    remove_drafts(*(tmp_path / name for name in ("last.ckpt", "policy", "missing/policy", "run[1]")))
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(others)


def test_where_files_in_use_cannot_be_removed_the_error_is_that_of_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On NFS a file that is removed while it is open stays in its folder under another name."""
    monkeypatch.setattr(os, "unlink", lambda path, **_: os.rename(path, Path(path).with_name(".nfs1")))
    with pytest.raises(UserError, match="too few windows"), training_lock(tmp_path / "run"):
        raise UserError("too few windows")
    with staging_folder(tmp_path / "export", tmp_path / "export/.unfinished") as staging:
        assert staging.is_dir()
