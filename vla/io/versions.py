"""Versions of the installed libraries."""

from __future__ import annotations

import re
from functools import cache
from importlib.metadata import distributions
from typing import Any


@cache  # reading all metadata takes a third of a second
def installed_versions() -> dict[str, str]:
    """Return name → version of vla, of packages made for it, and of what they require, as far as it is installed."""
    installed: dict[str, Any] = {}
    for each in distributions():
        if each.name:  # an interrupted installation leaves nameless ones; of several copies the first one is imported
            installed.setdefault(normal_name(each.name), each)
    needed = {
        name: [normal_name(re.split(r"[^\w.-]", text)[0]) for text in each.requires or ()]
        for name, each in installed.items()
    }
    ours = {name: names for name, names in needed.items() if name == "vla" or "vla" in names}
    listed = [*ours, *(name for names in ours.values() for name in names)]
    return {name: installed[name].version for name in sorted({*listed}) if name in installed}


def normal_name(name: str) -> str:
    """Return the name of a distribution in the spelling by which names are compared (PEP 503)."""
    return re.sub(r"[-_.]+", "-", name).lower()
