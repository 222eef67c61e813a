"""The packages control_msgs and franka_msgs, which there are no wheels of, from their definitions.

The generators come with the wheels of ROS. Of a definition there is what the node and the tests use. Every package
becomes one library, which goes by the names of all that ROS looks for: what has been loaded is not searched for.
"""

from __future__ import annotations

import json
import subprocess
import sys
import sysconfig
from collections.abc import Callable
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np

SUPPORTS = ("rosidl_typesupport_fastrtps_c", "rosidl_typesupport_introspection_c")
DEFINITIONS = {
    "control_msgs": {
        "msg/GripperCommand.msg": "float64 position\nfloat64 max_effort",
        "action/GripperCommand.action": (
            "GripperCommand command\n---\nfloat64 position\nfloat64 effort\nbool stalled\nbool reached_goal\n---\n"
            "float64 position"
        ),
        "action/FollowJointTrajectory.action": (
            "trajectory_msgs/JointTrajectory trajectory\n---\nint32 error_code\nint32 SUCCESSFUL = 0\n"
            "int32 INVALID_GOAL = -1\nint32 INVALID_JOINTS = -2\nint32 OLD_HEADER_TIMESTAMP = -3\n"
            "int32 PATH_TOLERANCE_VIOLATED = -4\nint32 GOAL_TOLERANCE_VIOLATED = -5\nstring error_string\n---\n"
            "string[] joint_names"
        ),
    },
    "franka_msgs": {
        "msg/GraspEpsilon.msg": "float64 inner\nfloat64 outer",
        "action/Grasp.action": (
            "float64 width\nGraspEpsilon epsilon\nfloat64 speed\nfloat64 force\n---\nbool success\nstring error\n---\n"
            "float64 current_width"
        ),
        "action/Move.action": (
            "float64 width\nfloat64 speed\n---\nbool success\nstring error\n---\nfloat64 current_width"
        ),
    },
}
USED = ("action_msgs", "builtin_interfaces", "service_msgs", "std_msgs", "trajectory_msgs", "unique_identifier_msgs")
PREFIX = Path(sys.prefix)


def make(folder: Path) -> None:
    """Generate and compile the packages; `folder` is to be on the path of Python modules."""
    sources = [_generate(folder / "source", folder, *package) for package in DEFINITIONS.items()]
    _compile(folder, [file for of_package in sources for file in of_package])


def _generate(source: Path, modules: Path, package: str, definitions: dict[str, str]) -> list[Path]:
    """Write the Python module and the sources of the library; returns the latter."""
    from rosidl_adapter.action import convert_action_to_idl
    from rosidl_adapter.msg import convert_msg_to_idl
    from rosidl_generator_c import generate_c
    from rosidl_generator_py.generate_py_impl import generate_py
    from rosidl_generator_type_description import generate_type_hash
    from rosidl_typesupport_c import generate_c as generate_dispatch
    from rosidl_typesupport_fastrtps_c import generate_typesupport_fastrtps_c
    from rosidl_typesupport_introspection_c import generate_c as generate_introspection

    output, idl = source / package, list[str]()
    for name, text in definitions.items():
        file = output / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
        convert = convert_action_to_idl if file.suffix == ".action" else convert_msg_to_idl
        with redirect_stdout(StringIO()):
            convert(output, package, Path(name), file.parent)
        idl.append(str(Path(name).with_suffix(".idl")))

    def run(generate: Callable[..., Any], templates: str, into: Path, *options: Any, **more: Any) -> list[Path]:
        arguments = {
            "package_name": package,
            "output_dir": str(into),
            "template_dir": str(PREFIX / f"share/{templates}/resource"),
            "idl_tuples": [f"{output}:{name}" for name in idl],
            "ros_interface_dependencies": [],
            "include_paths": [f"{used}:{PREFIX / 'share' / used}" for used in USED],
            "target_dependencies": [],
            **more,
        }
        file = output / "arguments.json"
        file.write_text(json.dumps(arguments))
        return [Path(made) for made in generate(str(file), *options)]

    run(generate_type_hash, "rosidl_generator_type_description", output)
    hashes = {"type_description_tuples": [f"{name}:{output / Path(name).with_suffix('.json')}" for name in idl]}
    made = run(generate_c, "rosidl_generator_c", output, **hashes)
    made += run(generate_typesupport_fastrtps_c, SUPPORTS[0], output)
    made += run(generate_introspection, SUPPORTS[1], source / SUPPORTS[1] / package)
    made += run(generate_dispatch, "rosidl_typesupport_c", output, SUPPORTS)
    for header in ("rosidl_generator_c", *SUPPORTS):
        text = (PREFIX / f"share/{header}/resource/{header}__visibility_control.h.in").read_text()
        text = text.replace("@PROJECT_NAME@", package).replace("@PROJECT_NAME_UPPER@", package.upper())
        (output / f"msg/{header}__visibility_control.h").write_text(text)
    (modules / package).mkdir()
    for part in ("msg", "action"):
        (modules / package / part).mkdir()
    (modules / package / "__init__.py").touch()
    made += run(generate_py, "rosidl_generator_py", modules / package, ["rosidl_typesupport_c"])
    return made


def _compile(modules: Path, sources: list[Path]) -> None:
    """Compile the library, all sources of a language at once: their headers take longer than they do."""
    source, include, library = modules / "source", PREFIX / "include", modules / "messages.so"
    headers = [source, source / SUPPORTS[1], include, *(folder for folder in include.iterdir() if folder.is_dir())]
    headers += [Path(sysconfig.get_path("include")), Path(np.get_include())]
    flags = ["-O0", "-w", "-fPIC", *(f"-I{folder}" for folder in headers)]
    alone = [file for file in sources if file.stem.endswith("__description")]  # their names for themselves clash
    groups = [[file for file in sources if file.suffix == suffix and file not in alone] for suffix in (".c", ".cpp")]
    objects = []
    for number, files in enumerate([*([file] for file in alone), *groups]):
        joined = source / f"{number}{files[0].suffix}"
        joined.write_text("".join(f'#include "{file}"\n' for file in files))
        objects.append(joined.with_suffix(".o"))
        subprocess.run(["gcc", *flags, "-c", joined, "-o", objects[-1]], check=True)
    parts = ("rosidl_generator_c", "rosidl_generator_py", "rosidl_typesupport_c", *SUPPORTS)
    needs = [f"{used}__{part}" for used in USED for part in parts]
    needs += ["rosidl_runtime_c", "rosidl_typesupport_c", *SUPPORTS, "rosidl_typesupport_fastrtps_cpp"]
    needs += ["rmw", "rcutils", "fastcdr", "stdc++"]
    link = ["gcc", "-shared", "-Wl,--no-as-needed,-rpath,$ORIGIN"]
    subprocess.run(
        [*link, "-o", library, *objects, f"-L{PREFIX / 'lib'}", *(f"-l{need}" for need in needs)], check=True
    )
    for package in DEFINITIONS:
        supports = [modules / package / f"lib{package}__{support}.so" for support in SUPPORTS]
        module = modules / package / f"{package}_s__rosidl_typesupport_c.so"
        for name, content in ((supports[0], [library]), (supports[1], [library]), (module, supports)):
            subprocess.run([*link, "-o", name, f"-Wl,-soname,{name.name}", *content], check=True)
