"""What a policy hides from a check: no code of it runs, nobody is called, and no secret leaves."""

from __future__ import annotations

from pathlib import Path
from zipfile import ZIP_DEFLATED, ZIP_STORED, ZipFile

import pytest
from composing import composed
from hostile import hidden, hiding, listener, save, ways
from saved_policies import save_run

from vla.config.experiment import to_plain
from vla.models.checkpoint import read_header
from vla.runs.resume import training_progress

ATTACKS = list(hiding(to_plain(composed("expert=waypoint")), Path(), 0))
SECRET = "hunter2secret"
HIDDEN = {"python": r"_target_ must name a class", "secret": "holds the reference"}  # what is said of it


def sentence(attack: str, way: str) -> str | None:
    """What is said of an attack on a way to use the policy; None, for anything, where none of it is read."""
    if "connection" not in attack:
        return next(said for word, said in HIDDEN.items() if word in attack)
    if way == "improve":
        return r"names a path or an address in expert\."
    return r"expert\.url must be" if way == "evaluate" and "recording" in attack else None


@pytest.mark.parametrize("attack", ATTACKS)
def test_nothing_that_is_hidden_acts(attack: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("ATTACK_SECRET", SECRET)
    mark = tmp_path / "mark"
    with listener() as (port, connected):
        config = hiding(to_plain(composed("expert=waypoint", "trainer.accelerator=cpu")), mark, port)[attack]
        path = save(tmp_path / "theirs", config)
        small = ("output=mine", "cluster.workers=1", "evaluate.episodes=1", "recorder=none")
        for way, do in ways(path, *small).items():
            with pytest.raises(ValueError, match=sentence(attack, way)):
                do()
            assert not mark.exists() and not connected(), way
    assert not [*(tmp_path / "mine").rglob("*")]


@pytest.mark.parametrize("attack", hidden(to_plain(composed()), Path()))
def test_what_a_mapping_of_a_checkpoint_hides_is_not_resumed(attack: str, tmp_path: Path) -> None:
    run = save_run(
        tmp_path / "run", hidden(to_plain(composed(f"output={tmp_path}/run")), tmp_path / "mark")[attack], False
    )
    with pytest.raises(ValueError, match=r"last\.ckpt (cannot be read as a checkpoint|holds )"):
        read_header(run / "checkpoints/last.ckpt")
    assert not (tmp_path / "mark").exists()


def test_a_checkpoint_whose_header_is_compressed_is_not_unpacked(tmp_path: Path) -> None:
    whole = save_run(tmp_path / "run", to_plain(composed()), False) / "checkpoints/last.ckpt"
    packed = tmp_path / "packed.ckpt"
    with ZipFile(whole) as source, ZipFile(packed, "w", ZIP_DEFLATED) as target:
        for entry in source.infolist():
            target.writestr(entry.filename, source.read(entry), None if entry.filename.endswith(".pkl") else ZIP_STORED)
    assert read_header(whole).config
    with pytest.raises(ValueError, match=r"packed\.ckpt cannot be read as a checkpoint"):
        read_header(packed)


def test_the_policy_of_a_run_is_the_one_that_is_checked(tmp_path: Path) -> None:
    config = to_plain(composed("expert=waypoint", f"output={tmp_path}"))
    save_run(tmp_path, config)
    save(tmp_path / "policy", hiding(config, tmp_path / "mark", 0)["python in a number"])
    with pytest.raises(ValueError, match=r"differs in tokenizer\.bins"):
        training_progress(tmp_path, config)
    assert not (tmp_path / "mark").exists()
