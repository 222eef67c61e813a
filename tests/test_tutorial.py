"""The tutorial, followed in a copy of the project: its files as printed, its commands on small numbers."""

from __future__ import annotations

import json
import re
import shlex
import shutil
from pathlib import Path

from command_line import SMALL, vla

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs/tutorial.md").read_text(encoding="utf-8")
FILES = re.findall(r"^```(?:python|yaml)\n# (\S+)\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL)
COMMANDS = re.findall(r"^python -m vla\.run (.*)$", PAGE, re.MULTILINE)


def small(command: str) -> list[str]:
    if "job=preview" in command:
        return ["preview.episodes=1"]
    if "checkpoint=" in command:
        return ["evaluate.episodes=1", "cluster.workers=1", "recorder=none"]
    return [*SMALL, "collect.episodes=6", "recorder=none"]


def test_the_tutorial_ends_with_a_policy_for_its_own_goal(tmp_path: Path) -> None:
    for part in ("vla", "conf"):
        shutil.copytree(ROOT / part, tmp_path / part)
    for name, text in FILES:
        assert not (tmp_path / name).exists()
        (tmp_path / name).write_text(text, encoding="utf-8")
    assert len(FILES) == 2 and len(COMMANDS) == 4
    for command in COMMANDS:
        vla(tmp_path, *shlex.split(command), *small(command))
    report = json.loads((tmp_path / "outputs/runs/left_of/report.json").read_text(encoding="utf-8"))
    assert report["config"]["task"]["goal"]["_target_"].endswith(".LeftOf")
    assert {result["task"] for result in report["per_episode"]} == {"left_of"}
    levels = json.loads((tmp_path / "outputs/runs/left_of_wide/report.json").read_text(encoding="utf-8"))
    assert levels["conditions"]["wide"]["compared"]
