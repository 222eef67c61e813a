"""The README, the pages of help in docs/, the records in docs/results/, and the commands that they name."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
# Their commands need what the pages let a reader write or install, see their own tests.
OTHERS = {ROOT / "docs" / name for name in ("lerobot.md", "packages.md", "tutorial.md")}
PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")))
TEXT = "\n".join(page.read_text(encoding="utf-8") for page in PAGES if page not in OTHERS)
TEXT = TEXT.replace("\\\n", " ")  # commands that go over several lines


def commands(program: str) -> list[str]:
    """What follows a program in the texts, as `vla.run` or `tests/abuse.py`: in blocks of code and in sentences."""
    found = re.findall(rf"(?:^|`| )(?:python|-m) (?:-m )?{re.escape(program)}\b([^`\n]*?)(?: +#.*)?(?:`|$)", TEXT, re.M)
    return sorted({" ".join(arguments.split()) for arguments in found})
