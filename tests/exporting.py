"""A small store of two kinds of episodes, and what an export of it holds."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import composing
from toy import ARM_SPEC, ToyEnvironment, ToyExpert
from toy_episodes import add

from vla.config.build import build
from vla.config.experiment import to_plain
from vla.data.episodes import EpisodeStore
from vla.rollouts.rollout import rollout
from vla.spec import Episode, Spec


def stored(folder: Path, spec: Spec = ARM_SPEC, seeds: range = range(2)) -> tuple[EpisodeStore, list[Episode]]:
    """A store of toy episodes; seeds that are three more than a multiple of five fail."""
    episodes = [rollout(ToyEnvironment(spec=spec), ToyExpert(), seed) for seed in seeds]
    return add(folder, episodes, spec=spec), episodes


def composed(name: str, folder: Path, *overrides: str) -> Any:
    """The configuration of `export=name` and `overrides`."""
    return to_plain(composing.composed(f"export={name}", f"export.folder={folder}", *overrides).export)


def exporter(name: str, folder: Path, *overrides: str) -> Any:
    """What `export=name` and `overrides` describe."""
    return build(composed(name, folder, *overrides), "export")


def content(folder: Path) -> dict[str, bytes]:
    """Every file below a folder."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
