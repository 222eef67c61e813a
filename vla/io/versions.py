"""Versions of the installed libraries."""

from __future__ import annotations

import re
from contextlib import suppress
from functools import cache
from importlib.metadata import PackageNotFoundError, distributions, version


@cache  # reading all metadata takes a third of a second
def installed_versions() -> dict[str, str]:
    """Return name → version of vla, of packages that require it, and of the requirements of these, if installed.

    Packages that require gymnasium, such as those of worlds, are among them, without their requirements.
    """
    requirements = set[str]()
    for package in distributions():
        names = {package.name, *(re.split(r"[^\w.-]", text)[0] for text in package.requires or ())}
        if "vla" in names and package.name:  # an interrupted installation leaves nameless ones
            requirements |= names
        elif "gymnasium" in names and package.name:
            requirements.add(package.name)
    versions = dict[str, str]()
    for name in sorted(requirements):
        with suppress(PackageNotFoundError):
            versions[name] = version(name) or "unknown"
    return versions
