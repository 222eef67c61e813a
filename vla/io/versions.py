"""Versions of the installed libraries."""

from __future__ import annotations

import re
from contextlib import suppress
from functools import cache
from importlib.metadata import PackageNotFoundError, distributions, version


@cache  # reading all metadata takes a third of a second
def installed_versions() -> dict[str, str]:
    """Return name → version of vla, of packages that require it, and of the requirements of these, if installed."""
    listed = set[str]()
    for each in distributions():
        names = {each.name, *(re.split(r"[^\w.-]", text)[0] for text in each.requires or ())}
        if "vla" in names and each.name:  # an interrupted installation leaves nameless ones
            listed |= names
    found = dict[str, str]()
    for name in sorted(listed):
        with suppress(PackageNotFoundError):
            found[name] = version(name) or "unknown"
    return found
