"""Origin of a run's results: the command line, the commits of the code, and the machine."""

from __future__ import annotations

import shlex
import socket
import subprocess
import sys
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from hydra.core.hydra_config import HydraConfig

from vla.config.packages import config_folders, option_folders, trusted_names
from vla.io.documents import STRICT
from vla.io.errors import counted
from vla.parallel.limits import cores, processor

SECRET = "api_key"  # key whose values are written to no file
SECONDS = 10  # longest duration of a git command
DIRTY = "with uncommitted changes"  # in the code of a tree


@dataclass(frozen=True)
class Origin:
    """Where results come from."""

    __pydantic_config__ = STRICT

    command: str  # empty if it is unknown; secrets are replaced by asterisks
    commits: dict[str, str]  # git work tree with code (name, or path if two share it) → commit, and whether dirty
    host: str
    processor: str


def find_origin() -> Origin:
    """Return the origin of what this process computes."""
    overrides = HydraConfig.get().overrides.task if HydraConfig.initialized() else None
    command = "" if overrides is None else f"python -m vla.run {shlex.join(map(_without_secret, overrides))}".strip()
    torch = sys.modules.get("torch")
    gpu = f", {torch.cuda.get_device_name()}" if torch and torch.cuda.is_available() else ""
    return Origin(command, _commits(), socket.gethostname(), f"{processor()}, {counted(cores(), 'core')}{gpu}")


def _without_secret(override: str) -> str:
    return f"{override.partition('=')[0]}=***" if SECRET in override else override


def _commits() -> dict[str, str]:
    """Return the commits of this package, of its options, and of the packages that add parts."""
    packages = {"vla", *dict(option_folders()), *(name.partition(".")[0] for name in trusted_names())}
    specs = [find_spec(package) for package in sorted(packages)]
    places = [Path(place) for spec in specs if spec for place in spec.submodule_search_locations or ()]
    trees = dict[str, str]()
    for folder in (*places, *config_folders()):
        # A package that is installed into an ignored folder of a tree does not belong to it.
        if not folder.is_dir() or _git(folder, "check-ignore", "-q", ".") is not None:
            continue
        if (output := _git(folder, "rev-parse", "--show-toplevel", "HEAD")) is not None:
            tree, commit = output.splitlines()
            # Files that git does not know can be chosen, too.
            status = _git(folder, "--no-optional-locks", "status", "--porcelain", "--", ".")
            if status:
                trees[tree] = f"{commit} {DIRTY}"
            elif status is None and DIRTY not in trees.get(tree, ""):  # git took too long
                trees[tree] = f"{commit} perhaps {DIRTY}"
            trees.setdefault(tree, commit)
    names = [Path(tree).name for tree in trees]
    return {tree if names.count(name) > 1 else name: trees[tree] for tree, name in zip(trees, names, strict=True)}


def _git(folder: Path, *arguments: str) -> str | None:
    """Return what a git command prints about a folder, or None where it fails."""
    try:
        result = subprocess.run(["git", "-C", folder, *arguments], capture_output=True, text=True, timeout=SECONDS)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return result.stdout if result.returncode == 0 else None
