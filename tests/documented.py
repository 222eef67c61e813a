"""The commands that the README and the pages beside it name."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
# Their commands need what the pages let a reader write or install, see their own tests.
OTHERS = ("lerobot.md", "packages.md", "tutorial.md")
NAMES = sorted(path for path in (ROOT / "docs").glob("*.md") if path.name not in OTHERS)
PAGES = (README, *(page.read_text(encoding="utf-8") for page in NAMES))
TEXT = "\n".join(PAGES).replace("\\\n", " ")  # commands that go over several lines


def commands(program: str) -> list[str]:
    """What follows a program in the texts, as `vla.run` or `tests/abuse.py`: in blocks of code and in sentences."""
    found = re.findall(rf"(?:^|`| )(?:python|-m) (?:-m )?{re.escape(program)}\b([^`\n]*?)(?: +#.*)?(?:`|$)", TEXT, re.M)
    return sorted({" ".join(arguments.split()) for arguments in found})
