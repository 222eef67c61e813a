"""A robot arm with a gripper in MJCF or URDF, as a configuration describes it.

The files are data, which MuJoCo compiles. Missing names and files, and models that do not compile, are UserErrors.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from itertools import chain
from os.path import normpath
from pathlib import Path
from typing import Annotated
from urllib.parse import unquote, urlsplit

import mujoco
from annotated_types import MinLen

from vla.io.errors import UserError, suggestion
from vla.io.files import require_file
from vla.io.types import Inherited, Names, Point, Positive, Text

log = logging.getLogger(__name__)

Values = Annotated[dict[str, float], MinLen(1)]
HAND = "hand_"  # in front of the names in a hand's own file
# Settings of a model for the world around it: the tabletop's apply, and MuJoCo warns of every difference.
OF_THE_WORLD = ("option", "authored", "visual", "stat", "memory", "nstack", "nconmax", "njmax", "nuserdata")
MAX_LISTED = 30  # names in an error


@dataclass(frozen=True, kw_only=True)
class RobotFile:
    """An arm in a file, with its hand or with the hand in a file of its own.

    Attributes:
        file: arm, in MJCF or URDF.
        hand: file of its hand, whose names get the prefix `hand_`; None: `file` contains the hand.
        mount: site or body of the arm that carries this hand.
        place: position of the base; the table's top is at height 0 [m].
        yaw: of the base [rad].
        joints: J hinges of the arm, base to tip; other joints outside of the hand are fixed.
        home: (J,) positions in which the gripper points down over the table and closes sideways [rad].
        speed: largest speed of the joints [rad/s].
        tool: site or body of the hand whose axes are the tool's: x is the one that points forward at home, z down.
        offset: of the tool point, between the fingertips, in this frame [m]. It is moved sideways to the middle of the
            jaws when a block is between them, and down if the fingertips reach far below it.
        open: actuator or joint of the gripper → its value when open; joints get position servos.
        closed: the same when closed.
        force: largest force of these servos [N], or torque [N m].
        fingertips: names of the geoms, bodies or sites that hold a block, for each side.
        camera: position of the wrist camera in the tool's frame [m].
        target: point that it looks at [m].
    """

    file: Path
    hand: Path | None
    mount: Text | None
    place: Point
    yaw: float
    joints: Names
    home: list[float]
    speed: Positive
    tool: Text
    offset: Point
    open: Values
    closed: Values
    force: Positive
    fingertips: tuple[Names, Names]
    camera: Point
    target: Point

    def read(self) -> mujoco.MjSpec:
        """Read the model of the arm with its hand (UserError: a file is missing or does not compile)."""
        spec = read(self.file, "file")
        if self.hand is not None:
            hand = read(self.hand, "hand")
            names = (element.name for element in (*spec.sites, *spec.bodies))
            require("mount", [self.mount or ""], names, "site or body of the arm")
            if site := spec.site(self.mount):
                spec.attach(hand, site=site, prefix=HAND)
            else:
                spec.attach(hand, frame=spec.body(self.mount).add_frame(), prefix=HAND)
        return spec


class InstalledRobot(RobotFile):
    """An arm whose files are in an installed package, which is not imported."""

    def __init__(self, file: Text, hand: Text | None, **inherited: Inherited) -> None:
        """Take paths that begin with the name of a package, such as dm_control/third_party/kinova/jaco_arm.xml
        (UserError: no such package, or a path out of it)."""
        super().__init__(file=_package_file(file), hand=_package_file(hand) if hand else None, **inherited)


def _package_file(path: str) -> Path:
    """Return a file or folder in a package; one in the working folder, which Python also finds, is not installed."""
    package, _, subpath = path.partition("/")
    spec = find_spec(package) if package.isidentifier() else None
    source = Path(spec.origin).absolute() if spec and spec.origin else Path()
    file = Path(normpath(source.parent / subpath))
    if source.name != "__init__.py" or source.parents[1] == Path.cwd() or source.parent not in file.parents:
        raise UserError(f"task.robot: {path} must begin with the name of an installed package and stay within it")
    return file


def read(file: Path, key: str) -> mujoco.MjSpec:
    """Read a model, with absolute paths of its meshes and without its textures; `key` names the file in errors
    (UserError: there is no such file, no such mesh, or MuJoCo does not compile it)."""
    path, label = Path(file).absolute(), f"task.robot.{key}={file}"
    if not path.is_file():
        raise UserError(f"{label}: there is no such file")
    try:
        spec = mujoco.MjSpec.from_file(str(path))
    except (ValueError, mujoco.FatalError) as error:
        raise UserError(f"{label} does not compile: {' '.join(str(error).split())}") from error
    for mesh in spec.meshes:
        if mesh.file:
            name = Path(mesh.file).name if spec.strippath else mesh.file
            mesh_file = _mesh_file(label, name, path.parent / (spec.compiler.meshdir or ""), path)
            require_file(mesh_file)
            mesh.file = str(mesh_file)
    spec.compiler.meshdir = ""
    _drop_textures(spec, label, path)
    defaults = mujoco.MjSpec()
    for name in (*OF_THE_WORLD, *(name for name in dir(defaults) if name.startswith("nuser_"))):
        setattr(spec, name, getattr(defaults, name))
    # URDF: keep shapes that do not collide, and links that do not move, of which the tool may be one.
    spec.compiler.discardvisual = spec.compiler.fusestatic = False
    compile_model(spec, label)
    return spec


def _mesh_file(label: str, mesh: str, folder: Path, model: Path) -> Path:
    """Return the file of a mesh, given by a path in a folder or by a URI as in ROS (UserError: a URI of another scheme,
    or of a package that is not found)."""
    if "://" not in mesh:
        return folder / mesh
    try:
        kind, package, location, *_ = urlsplit(mesh)
    except ValueError as error:  # such as a bracket
        raise UserError(f"{label} has a mesh at {mesh}, which is no address: {error}") from error
    subpath = unquote(location).lstrip("/")
    if kind == "file":
        return Path("/", subpath)
    if kind != "package":
        raise UserError(f"{label} has a mesh at {mesh}: meshes are at package://, file:// or a path")
    shares = (prefix / "share" for prefix in _folders("AMENT_PREFIX_PATH"))
    sources = (source for folder in _folders("ROS_PACKAGE_PATH") for source in (folder, folder.parent))
    for parent in chain(model.parents, shares, sources):
        if (parent / package).is_dir():
            return parent / package / subpath
    raise UserError(
        f"{label} has a mesh at {mesh}: no folder {package} is above the file, in AMENT_PREFIX_PATH or in "
        "ROS_PACKAGE_PATH"
    )


def _folders(variable: str) -> list[Path]:
    return [Path(folder) for folder in os.environ.get(variable, "").split(os.pathsep) if folder]


def _drop_textures(spec: mujoco.MjSpec, label: str, path: Path) -> None:
    """Remove the textures of a model, which are not drawn, so that their files need not exist."""
    text = path.read_bytes()
    in_urdf = b"<robot" in text and b"<texture" in text  # MuJoCo itself ignores these
    if in_urdf or any(texture.file or any(texture.cubefiles) for texture in spec.textures):
        _say(f"{label}: its textures are left out, and shapes have the colours of their materials")
    for material in spec.materials:
        material.textures = [""] * len(material.textures)
    for texture in [*spec.textures]:
        spec.delete(texture)


@cache
def _say(sentence: str) -> None:
    """Log a sentence, once in a process."""
    log.info("%s", sentence)


def compile_model(spec: mujoco.MjSpec, name: str = "task.robot") -> mujoco.MjModel:
    """Compile a model that was changed; a UserError says that `name` does not compile."""
    try:
        return spec.compile()
    except (ValueError, mujoco.FatalError) as error:
        raise UserError(f"{name} does not compile: {' '.join(str(error).split())}") from error


def require(key: str, names: Iterable[str], elements: Iterable[str], kind: str) -> None:
    """Raise a UserError, which lists the known elements of this `kind`, if one of `names` is not among them."""
    element_names = [name for name in elements if name]
    for name in names:
        if name not in element_names:
            listing = ", ".join(element_names[:MAX_LISTED]) + (", …" if len(element_names) > MAX_LISTED else "")
            hint = suggestion(name, element_names) or ":"
            raise UserError(f"task.robot.{key} names {name}, which is no {kind}{hint} there are {listing or 'none'}")
