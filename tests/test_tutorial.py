"""The tutorial, followed in a copy of the project: its files as printed, its commands on small numbers."""

from __future__ import annotations

import json
import re
import shlex
import shutil
from pathlib import Path

import warm
from command_line import SMALL

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs/tutorial.md").read_text(encoding="utf-8")
FILES = re.findall(r"^```(?:python|yaml)\n# (\S+)\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL)
LOOK, *COMMANDS = re.findall(r"^python -m vla\.run (.*)$", PAGE, re.MULTILINE)
FOLLOW = """
import json, sys
from vla.run import main
for command in json.loads(sys.argv[1]):
    sys.argv[1:] = command
    main()
"""


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
    assert len(FILES) == 2 and len(COMMANDS) == 3
    assert LOOK == "job=preview output=outputs/look"  # without these files: see test_run
    (tmp_path / "follow.py").write_text(FOLLOW)
    commands = json.dumps([[*shlex.split(command), *small(command)] for command in COMMANDS])
    done = warm.run(tmp_path, commands, program="follow")
    assert done.returncode == 0, done.stdout + done.stderr
    report = json.loads((tmp_path / "outputs/runs/left_of/report.json").read_text(encoding="utf-8"))
    assert report["config"]["task"]["goal"]["_target_"].endswith(".LeftOf")
    assert {result["task"] for result in report["per_episode"]} == {"left_of"}
    levels = json.loads((tmp_path / "outputs/runs/left_of_wide/report.json").read_text(encoding="utf-8"))
    assert levels["conditions"]["wide"]["compared"]
