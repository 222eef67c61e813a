"""Third-party packages: their config options, and trust in their classes.

A package adds options by an entry point of the group `vla.conf`, which names the folder of its YAML files. Its classes
are built only if the user trusts the package by name, or chooses the class on the command line.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from importlib.metadata import entry_points, packages_distributions, requires
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.plugins import Plugins
from hydra.plugins.search_path_plugin import SearchPathPlugin

from vla.io.errors import UserError

TRUST = "VLA_TRUST"  # environment variable of the user: packages, separated by commas
TRUSTED = "VLA_TRUSTED"  # environment variable that passes trusted packages and classes to child processes
ENTRY_POINTS = "vla.conf"
MISSING = "???"  # a value that the command line must give
GYMNASIUM = "gymnasium"  # the package whose own environments need no trust; its classes cannot be trusted
PACKAGE = Path(__file__).resolve().parents[1]
# Options of `vla` itself: inside the package if installed from a wheel, beside it in a clone.
CONF = next(path for path in (PACKAGE / "conf", PACKAGE.parent / "conf") if (path / "config.yaml").is_file())


class _InstalledOptions(SearchPathPlugin):
    """Adds the options of installed packages to Hydra's search path, after those of `vla`, which take precedence."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        """Append the folder of every package."""
        for package, folder in option_folders():
            search_path.append(package, f"file://{folder}")


def offer_options() -> None:
    """Register the options of installed packages with Hydra."""
    Plugins.instance().register(_InstalledOptions)


def config_folders() -> tuple[Path, ...]:
    """Return the folders of all options, that of `vla` first. Raises as `option_folders`."""
    return CONF, *(folder for _, folder in option_folders())


@cache
def option_folders() -> tuple[tuple[str, Path], ...]:
    """Return (package, folder of options) of installed packages.

    Raises a UserError if one has no such folder, or an option that another one, or `vla`, has already.
    """
    folders = [("vla", CONF)]
    for entry in sorted(entry_points(group=ENTRY_POINTS), key=lambda entry: entry.value):
        package, *parts = entry.value.split(".")
        spec = find_spec(package)
        places = spec.submodule_search_locations or () if spec else ()
        folder = next((path for place in places if (path := Path(place, *parts)).is_dir()), None)
        if folder is None:
            raise UserError(
                f"the installed package {package} names {entry.value} as its options, which is not a folder: its wheel "
                "must include the YAML files"
            )
        folder = folder.resolve()
        for option in sorted(path.relative_to(folder) for path in folder.rglob("*.yaml")):
            if owners := [owner for owner, other in folders if other != folder and (other / option).is_file()]:
                raise UserError(
                    f"the installed packages {owners[0]} and {package} both have the option {option}, and the first "
                    "would hide the second: rename one, or uninstall a package"
                )
        folders.append((package, folder))
    return tuple(folders[1:])


def trust(packages: Any, targets: Iterable[Any], node_packages: Iterable[Any] = ()) -> None:
    """Set the third-party classes that this process and its children may build; raise a UserError for unsuitable ones.

    Args:
        packages: list of names, in addition to those in the environment variable `VLA_TRUST`.
        targets: every `_target_` in the config composed from the command line, before any file is read. Of packages
            that add options, exactly these classes are trusted.
        node_packages: every `package` argument in that config; these packages are trusted, too.
    """
    if not isinstance(packages, list):
        raise UserError(f"trust must be a list of packages, as in trust=[mypackage], got {packages!r}")
    node_packages = [name for name in node_packages if name != MISSING]
    names = [*packages, *_names(TRUST), *node_packages]
    for name in names:
        _require_trustworthy("package" if name in node_packages else "trust", name)
    providers = {package for package, _ in option_folders()}
    classes = {target for target in targets if isinstance(target, str) and target.partition(".")[0] in providers}
    os.environ[TRUSTED] = ",".join(sorted({*names, *classes}))


@contextmanager
def trusting(packages: Sequence[str]) -> Iterator[None]:
    """Trust further packages within the context; raise a UserError if they cannot be trusted."""
    if isinstance(packages, str):
        raise UserError(f"trust must be a list of packages, as in trust=[{packages!r}], got {packages!r}")
    for name in packages:
        _require_trustworthy("trust", name)
    old_value = os.environ.get(TRUSTED)
    os.environ[TRUSTED] = ",".join(sorted({*trusted_names(), *packages}))
    try:
        yield
    finally:
        del os.environ[TRUSTED]
        if old_value is not None:
            os.environ[TRUSTED] = old_value


def trusted_names() -> list[str]:
    """Return the trusted packages and classes; outside a run, those in the environment variable `VLA_TRUST`."""
    return _names(TRUSTED if TRUSTED in os.environ else TRUST)


def is_trusted(target: Any) -> bool:
    """Return whether the third-party class or package `target` may be used."""
    if target == GYMNASIUM:
        return True
    matches = isinstance(target, str) and any(f"{target}.".startswith(f"{name}.") for name in trusted_names())
    return matches and can_be_trusted(target.partition(".")[0])


def _require_trustworthy(key: str, name: Any) -> None:
    if name != GYMNASIUM and (not isinstance(name, str) or not can_be_trusted(name)):
        raise UserError(
            f"{key} cannot name {name!r}: give the name by which a package is imported, without a submodule; the "
            "package must depend on vla or gymnasium"
        )


@cache
def can_be_trusted(package: str) -> bool:
    """Return whether a top-level package can be trusted: it depends on `vla` or gymnasium, or has no distribution.

    Constructors of the standard library and of other libraries may act on files, processes and networks.
    """
    if not package.isidentifier() or package.startswith("_") or package in sys.stdlib_module_names:
        return False
    return all(map(_depends_on_vla, packages_distributions().get(package, ())))


def _names(variable: str) -> list[str]:
    return [name for part in os.environ.get(variable, "").split(",") if (name := part.strip())]


def _depends_on_vla(distribution: str) -> bool:
    requirements = [requirement for requirement in requires(distribution) or () if "extra ==" not in requirement]
    return any(re.match(r"(vla|gymnasium)\b(?![.-])", requirement, re.IGNORECASE) for requirement in requirements)
