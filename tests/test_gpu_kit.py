"""The kit for a machine with a GPU, tried on a CPU."""

from __future__ import annotations

import json
import re
import sys
import time
import tomllib
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import minutes
import notes
import pack
import probe
import pytest
from command_line import here

ROOT = Path(__file__).parents[1]


def test_the_steps_leave_their_figures(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In this process but for the first, as programs of their own take most of the time to start."""
    started = minutes.Minutes.run

    def run(kit: minutes.Minutes, step: str, name: str, limit: float, *command: str) -> dict[str, Any]:
        if "vla.run" in command:
            smaller = ("model.width=16", "data.batch_size=4") if name == "bc" else ()
            done = here(kit.work, *command[3:], "task.image_size=[32,32]", *smaller)
            return kit.note(step, name, {"status": done.returncode, "log": done.stdout.splitlines()})
        if "latency" in command:
            probe.latency(Path(command[3]), *command[4:])
            return {}
        return started(kit, step, name, limit, *command)

    out = tmp_path / "out"
    monkeypatch.setattr(minutes.Minutes, "run", run)
    asked = [str(out), "a", "b", "g", "v", "--dry", "--total", "600", "--work", str(tmp_path / "work")]
    monkeypatch.setattr(sys, "argv", ["minutes.py", *asked])
    minutes.main()
    facts, collected, trained, large = (json.loads((out / f"{step}.json").read_text()) for step in "abgv")
    assert facts["facts"]["status"] == 0 and facts["cores"] and facts["torch"] and "limits" not in facts
    assert collected["collect"]["status"] == 0 and "6 episodes" in " ".join(collected["collect"]["log"])
    assert trained["bc"]["training"]["steps"] == 3 and trained["bc"]["metrics"][0]["train/loss"] > 0
    assert large["smolvla_tiny"]["training"]["steps"] == 10 and "smolvla_tiny,model.text.name=null" in large["latency"]
    assert sum(trained["bc_evaluated"]["outcomes"].values()) == 1 and trained["bc_evaluated"]["latency_ms"] > 0


def prepared(tmp_path: Path, total: float) -> minutes.Minutes:
    sizes = minutes.DRY._replace(slower=1)
    return minutes.Minutes(tmp_path / "out", tmp_path / "work", None, sizes, total, 0, None, [])


def test_a_command_past_its_limit_ends_with_all_that_it_started(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(minutes, "LEAST", 0)
    code = "import subprocess, time; print(subprocess.Popen(['sleep', '600']).pid, flush=True); time.sleep(600)"
    noted = prepared(tmp_path, 100).run("x", "slow", 1, sys.executable, "-c", code)
    assert noted["status"] == "ran past its limit"
    child, end = Path(f"/proc/{noted['log'][0]}/stat"), time.monotonic() + 60
    while child.exists() and child.read_text().split()[2] not in "ZX":  # it was killed, and may be about to end
        assert time.monotonic() < end
        time.sleep(0.05)
    assert json.loads((tmp_path / "out/x.json").read_text())["slow"] == noted


def test_without_time_nothing_is_started_and_what_was_noted_stays(tmp_path: Path) -> None:
    kit = prepared(tmp_path, minutes.LEAST)
    kit.note("x", "before", {"value": 1})
    kit.run("x", "late", 60, "touch", str(tmp_path / "started"))
    assert not (tmp_path / "started").exists()
    content = json.loads((tmp_path / "out/x.json").read_text())
    assert content["before"] == {"value": 1} and content["late"]["status"] is None


def test_the_rates_of_a_training_leave_out_the_loader(tmp_path: Path) -> None:
    measures = {"train: bf16": 120, "train: loader alone": 9999}
    eager = {"benchmark": {"measures": {name: {"value": value} for name, value in measures.items()}}}
    (tmp_path / "c.json").write_text(json.dumps({"eager": eager, "compiled": {"status": "ran past its limit"}}))
    assert notes.rates_of(tmp_path / "c.json") == {"eager": 120.0}
    assert notes.rates_of(tmp_path / "none.json") == {}


def test_what_vla_depends_on_is_there_or_packed() -> None:
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
    names = {pack.normalised(re.split(r"[ ;<>=!~\[]", line)[0]) for line in declared}
    assert names <= {*map(pack.normalised, pack.PACKAGES), *pack.THERE, *pack.LEFT_OUT}
    assert len(pack.pinned(pack.PACKAGES)) == len(pack.PACKAGES)


def test_only_what_is_used_of_a_package_is_packed(tmp_path: Path) -> None:
    files = ("dm_control/mjcf/element.py", "dm_control/suite/walker.py", "dm_control/mjcf/element_test.py")
    wheel = tmp_path / "dm_control-1.0-py3-none-any.whl"
    with ZipFile(wheel, "w") as archive:
        for name in files:
            archive.writestr(name, b"")
    pack.unpack(wheel, tmp_path / "site")
    found = {path.relative_to(tmp_path / "site").as_posix() for path in (tmp_path / "site").rglob("*.py")}
    assert found == {"dm_control/mjcf/element.py"}
