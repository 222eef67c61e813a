"""Models in MJCF or URDF, read from files.

The files are data, which MuJoCo compiles. Names that they lack, files that are missing and models that do not compile
end in one sentence.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Iterable
from functools import cache
from itertools import chain
from pathlib import Path
from urllib.parse import unquote, urlsplit

import mujoco

from vla.io.errors import UserError
from vla.io.suggestion import suggestion

log = logging.getLogger(__name__)

# What a model says of the world around it: that of the tabletop holds, and MuJoCo warns of every difference.
OF_THE_WORLD = ("option", "authored", "visual", "stat", "memory", "nstack", "nconmax", "njmax", "nuserdata")
LISTED = 30  # names in an error


def read(key: str, file: Path) -> mujoco.MjSpec:
    """Read a model, with absolute paths of its meshes and without its textures; `key` names the file in errors.

    Raises:
        UserError: there is no such file, no such mesh, or MuJoCo does not compile it.
    """
    path, named = Path(file).absolute(), f"task.robot.{key}={file}"
    if not path.is_file():
        raise UserError(f"{named}: there is no such file")
    try:
        spec = mujoco.MjSpec.from_file(str(path))
    except (ValueError, mujoco.FatalError) as error:
        raise UserError(f"{named} does not compile: {_line(error)}") from error
    for mesh in spec.meshes:
        if mesh.file:
            name = Path(mesh.file).name if spec.strippath else mesh.file
            mesh.file = str(_located(named, name, path.parent / (spec.compiler.meshdir or ""), path))
    spec.compiler.meshdir = ""
    _drop_textures(spec, named, path)
    plain = mujoco.MjSpec()
    for name in (*OF_THE_WORLD, *(name for name in dir(plain) if name.startswith("nuser_"))):
        setattr(spec, name, getattr(plain, name))
    # URDF: keep shapes that do not collide, and links that do not move, which the tool may be one of.
    spec.compiler.discardvisual = spec.compiler.fusestatic = False
    try:
        spec.compile()
    except (ValueError, mujoco.FatalError) as error:
        raise UserError(f"{named} does not compile: {_line(error)}") from error
    return spec


def _located(named: str, mesh: str, folder: Path, model: Path) -> Path:
    """Return the file of a mesh that is named by a path in a folder, or by an address as in ROS.

    Raises:
        UserError: an address of another kind, or of a package that is not found.
    """
    if "://" not in mesh:
        return folder / mesh
    kind, package, rest, *_ = urlsplit(mesh)
    inside = unquote(rest).lstrip("/")
    if kind == "file":
        return Path("/", inside)
    if kind != "package":
        raise UserError(f"{named} has a mesh at {mesh}: meshes are at package://, file:// or a path")
    installed = (prefix / "share" for prefix in _folders("AMENT_PREFIX_PATH"))
    sources = (each for folder in _folders("ROS_PACKAGE_PATH") for each in (folder, folder.parent))
    for parent in chain(model.parents, installed, sources):
        if (parent / package).is_dir():
            return parent / package / inside
    raise UserError(
        f"{named} has a mesh at {mesh}: no folder {package} is above the file, in AMENT_PREFIX_PATH or in "
        "ROS_PACKAGE_PATH"
    )


def _folders(variable: str) -> list[Path]:
    return [Path(folder) for folder in os.environ.get(variable, "").split(os.pathsep) if folder]


def _drop_textures(spec: mujoco.MjSpec, named: str, path: Path) -> None:
    """Take textures, which are not drawn and so need not exist, out of a model."""
    text = path.read_bytes()
    in_urdf = b"<robot" in text and b"<texture" in text  # MuJoCo itself ignores these
    if in_urdf or any(texture.file or any(texture.cubefiles) for texture in spec.textures):
        _say(f"{named}: its textures are left out, and shapes have the colours of their materials")
    for material in spec.materials:
        material.textures = [""] * len(material.textures)
    for texture in [*spec.textures]:
        spec.delete(texture)


@cache
def _say(sentence: str) -> None:
    """Log a sentence, once in a process."""
    log.info("%s", sentence)


def compiled(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """Compile a model that was changed.

    Raises:
        UserError: it does not compile.
    """
    try:
        return spec.compile()
    except (ValueError, mujoco.FatalError) as error:
        raise UserError(f"task.robot does not compile: {_line(error)}") from error


def _line(error: Exception) -> str:
    return " ".join(str(error).split())


def require(key: str, names: Iterable[str], known: Iterable[str], kind: str) -> None:
    """Raise a UserError that lists the `kind` of elements that there are if one of `names` is not among them."""
    there = [name for name in known if name]
    for name in names:
        if name not in there:
            listed = ", ".join(there[:LISTED]) + (", …" if len(there) > LISTED else "")
            hint = suggestion(name, there) or ":"
            raise UserError(f"task.robot.{key} names {name}, which is no {kind}{hint} there are {listed or 'none'}")
