"""Small arms with grippers in MJCF and URDF, and the tabletop with them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from conftest import make_tabletop
from defaults import defaults_of

from vla.rollouts.rollout import rollout
from vla.tasks.tabletop.expert import Waypoint

if TYPE_CHECKING:
    from vla.tasks.tabletop.environment import Tabletop

# An arm of six hinges: axis, and offset from the joint before along z [m].
HINGES = (("0 0 1", 0.1), ("0 1 0", 0.2), ("0 1 0", 0.4), ("0 0 1", 0.2), ("0 1 0", 0.2), ("0 0 1", 0.05))
HOME = [0.0, 0.37, 1.82, 0.0, 0.95, 0.0]
FINGERS = {"left": "0 1 0", "right": "0 -1 0"}
ARM: dict[str, Any] = {
    "joints": [f"j{index}" for index in range(6)],
    "home": HOME,
    "tool": "hand",
    "offset": [0.0, 0.0, 0.08],
    "open": dict.fromkeys(FINGERS, 0.04),
    "closed": dict.fromkeys(FINGERS, 0.0),
    "fingertips": [["left_link"], ["right_link"]],
}
GRIPS = "".join(f'<position name="{name}" joint="{name}" kp="1000" kv="40" forcerange="-20 20"/>' for name in FINGERS)


def fingers() -> str:
    """Two fingers that slide in a hand."""
    text = ""
    for name, axis in FINGERS.items():
        side = 0.004 * float(axis.split()[1])
        text += f'<body name="{name}_link" pos="0 {side} 0.08"><geom type="box" size="0.008 0.004 0.01"/>'
        text += f'<joint name="{name}" type="slide" axis="{axis}" range="0 0.04" armature="0.05"/></body>'
    return text


def mjcf(hand: str = fingers(), actuators: str = GRIPS, base: str = "", more: str = "") -> str:
    """The arm in degrees, with motors, an actuator per finger, a joint that nobody asked for, a lamp and a floor."""
    text, ends = "", ""
    for index, (axis, height) in enumerate(HINGES):
        text += f'<body name="b{index}" pos="0 0 {height}"><joint name="j{index}" axis="{axis}"/>'
        text += '<geom type="capsule" size="0.03" fromto="0 0 0 0 0 0.05"/>'
        ends += "</body>"
    motors = "".join(f'<motor joint="j{index}"/>' for index in range(6))
    return f"""<mujoco>{more}<default><joint range="-175 175" limited="true"/></default><worldbody><light/><geom
        type="plane" size="1 1 1"/><body name="base"><joint name="lift" type="slide"/><geom size="0.05"/>{base}{text}
        <frame pos="0 0 0.05"><body name="hand"><geom type="box" size="0.02 0.06 0.01"/>{hand}</body></frame>
        {ends}</body></worldbody><actuator>{motors}{actuators}</actuator></mujoco>"""


def prism(*outline: tuple[float, float]) -> str:
    """A mesh without a name: an outline of six corners y, z, the fourth of which looks inwards, 24 mm thick along x."""
    sides = [[corner, (corner + 1) % 6, corner + 6] for corner in range(6)]
    sides += [[(corner + 1) % 6, (corner + 1) % 6 + 6, corner + 6] for corner in range(6)]
    back = [[3, 4, 5], [3, 5, 0], [3, 0, 1], [3, 1, 2]]
    faces = [
        *sides,
        *([third, second, first] for first, second, third in back),
        *([c + 6 for c in each] for each in back),
    ]
    corners = [(x, *corner) for x in (-0.012, 0.012) for corner in outline]
    return f'vertex="{_numbers(1000 * np.array(corners))}" face="{_numbers(np.array(faces))}"'


def _numbers(values: np.ndarray) -> str:
    return " ".join(f"{value:g}" for value in values.ravel())


# The housing reaches under the moving jaw, so its convex hull fills the space between them. Its unit is a millimetre.
HOUSING = prism((-0.018, 0.0), (0.03, 0.0), (0.03, 0.02), (-0.006, 0.02), (-0.006, 0.12), (-0.018, 0.12))
MESHES = f"""<default><mesh scale="0.001 0.001 0.001"/></default><asset><mesh name="housing" {HOUSING}/></asset>"""
HINGED: dict[str, Any] = {
    "offset": [0.0, 0.0, 0.08],
    "open": {"jaw": 1.0},
    "closed": {"jaw": 0.0},
    "fingertips": [["fixed_jaw"], ["jaw"]],
}


def hinged(fixed: str = "", moving: str = "") -> str:
    """A fixed jaw, which is a mesh, and one on a hinge, with `fixed` and `moving` in their bodies."""
    return f"""<body name="fixed_jaw"><geom type="mesh" mesh="housing"/>{fixed}</body>
        <body name="jaw" pos="0 0.012 0.02"><joint name="jaw" axis="-1 0 0" range="-5 80" armature="0.01"/>
        <geom type="box" size="0.012 0.008 0.06" pos="0 -0.008 0.04"/>{moving}</body>"""


def urdf(mesh: str = "", second: bool = False) -> str:
    """The same arm; the hand is a link that does not move, and nothing has an actuator.

    Args:
        mesh: address of a mesh that is the shape of link b2; "": a box.
        second: the right finger mimics the left one, and so do those of a second gripper on the base.
    """

    def link(name: str, size: str) -> str:
        shape = f'<mesh filename="{mesh}"/>' if mesh and name == "b2" else f'<box size="{size}"/>'
        shape = f"<geometry>{shape}</geometry>"
        turning = " ".join(f'i{axes}="{0.01 * (axes[0] == axes[1])}"' for axes in ("xx", "yy", "zz", "xy", "xz", "yz"))
        inertia = f'<inertial><mass value="0.5"/><inertia {turning}/></inertial>'
        return f'<link name="{name}">{inertia}<collision>{shape}</collision></link>'

    def joint(name: str, kind: str, links: tuple[str, str], place: str, axis: str, high: float, mimic: str = "") -> str:
        low = 0.0 if kind == "prismatic" else -high
        return f"""<joint name="{name}" type="{kind}"><parent link="{links[0]}"/><child link="{links[1]}"/><origin
            xyz="{place}"/><axis xyz="{axis}"/><limit lower="{low}" upper="{high}" effort="100"
            velocity="1"/>{f'<mimic joint="{mimic}"/>' if mimic else ""}</joint>"""

    parts, before = [link("base", "0.1 0.1 0.1")], "base"
    for index, (axis, height) in enumerate(HINGES):
        parts += [link(f"b{index}", "0.06 0.06 0.04")]
        parts += [joint(f"j{index}", "revolute", (before, f"b{index}"), f"0 0 {height}", axis, 3.05)]
        before = f"b{index}"
    parts += [link("hand", "0.04 0.12 0.02"), joint("wrist", "fixed", (before, "hand"), "0 0 0.05", "0 0 1", 0.0)]
    for prefix, hand in (("", "hand"), *([("other_", "base")] if second else [])):
        for name, axis in FINGERS.items():
            side, leader = f"0 {0.004 * float(axis.split()[1])} 0.08", f"{prefix}left" if second else ""
            links, follows = (hand, f"{prefix}{name}_link"), "" if name == "left" else leader
            parts += [link(links[1], "0.016 0.008 0.02")]
            parts += [joint(f"{prefix}{name}", "prismatic", links, side, axis, 0.04, follows)]
    return f'<robot name="arm">{"".join(parts)}</robot>'


def chosen(file: Path, **changes: Any) -> list[str]:
    """Arguments of the command line that choose the arm in `file`."""
    values = {f"task.robot.{name}": json.dumps(value).replace('"', "") for name, value in {**ARM, **changes}.items()}
    return ["task/robot=file", f"task.robot.file={file}", *(f"{key}={value}" for key, value in values.items())]


def arguments_of(file: Path, **changes: Any) -> dict[str, Any]:
    """Arguments of a `RobotFile` for the arm in `file`."""
    return {**defaults_of("task/robot/file"), **ARM, "file": file, **changes}


def make(file: Path, *more: str, **changes: Any) -> Tabletop:
    """The tabletop with the arm in `file`, as the command line makes it."""
    return make_tabletop("task.image_size=[64,64]", *chosen(file, **changes), *more)


def successes(environment: Tabletop, seeds: range) -> int:
    """How many episodes of the scripted expert succeed."""
    with environment.blind():
        return sum(rollout(environment, Waypoint(environment.spec), seed).success for seed in seeds)
