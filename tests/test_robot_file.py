"""Arms from files: they act as the Panda does, and what is wrong with a file is said in one sentence."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import pytest
from arm import SAFETY
from command_line import here
from composing import composed
from conftest import make_tabletop
from defaults import defaults_of

from vla.config.build import require_no_paths
from vla.config.experiment import plain
from vla.deploy.control_loop import ControlLoop
from vla.deploy.joint_limiter import Robot
from vla.robots.chain import frame_positions
from vla.rollouts.rollout import rollout
from vla.spec import Spec
from vla.tasks.tabletop.expert import Waypoint
from vla.tasks.tabletop.robot_file import RobotFile

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


def mjcf() -> str:
    """The arm in degrees, with motors, an actuator per finger, a joint that nobody asked for, a lamp and a floor."""
    text, ends = "", ""
    for index, (axis, height) in enumerate(HINGES):
        text += f'<body name="b{index}" pos="0 0 {height}"><joint name="j{index}" axis="{axis}"/>'
        text += '<geom type="capsule" size="0.03" fromto="0 0 0 0 0 0.05"/>'
        ends += "</body>"
    hand = '<frame pos="0 0 0.05"><body name="hand"><geom type="box" size="0.02 0.06 0.01"/>'
    for name, axis in FINGERS.items():
        side = 0.004 * float(axis.split()[1])
        hand += f'<body name="{name}_link" pos="0 {side} 0.08"><geom type="box" size="0.008 0.004 0.01"/>'
        hand += f'<joint name="{name}" type="slide" axis="{axis}" range="0 0.04" armature="0.05"/></body>'
    motors = "".join(f'<motor joint="j{index}"/>' for index in range(6))
    grips = "".join(
        f'<position name="{name}" joint="{name}" kp="1000" kv="40" forcerange="-20 20"/>' for name in FINGERS
    )
    return f"""<mujoco><default><joint range="-175 175" limited="true"/></default><worldbody><light/><geom type="plane"
        size="1 1 1"/><body name="base"><joint name="lift" type="slide"/><geom size="0.05"/>{text}{hand}</body></frame>
        {ends}</body></worldbody><actuator>{motors}{grips}</actuator></mujoco>"""


def urdf() -> str:
    """The same arm; the hand is a link that does not move, and nothing has an actuator."""

    def link(name: str, size: str, height: float = 0.0) -> str:
        shape = f'<origin xyz="0 0 {height}"/><geometry><box size="{size}"/></geometry>'
        turning = " ".join(f'i{axes}="{0.01 * (axes[0] == axes[1])}"' for axes in ("xx", "yy", "zz", "xy", "xz", "yz"))
        inertia = f'<inertial><mass value="0.5"/><inertia {turning}/></inertial>'
        return f'<link name="{name}">{inertia}<collision>{shape}</collision></link>'

    def joint(name: str, kind: str, links: tuple[str, str], place: str, axis: str, high: float) -> str:
        low = 0.0 if kind == "prismatic" else -high
        return f"""<joint name="{name}" type="{kind}"><parent link="{links[0]}"/><child link="{links[1]}"/><origin
            xyz="{place}"/><axis xyz="{axis}"/><limit lower="{low}" upper="{high}" effort="100"
            velocity="1"/></joint>"""

    parts, before = [link("base", "0.1 0.1 0.1")], "base"
    for index, (axis, height) in enumerate(HINGES):
        parts += [link(f"b{index}", "0.06 0.06 0.04")]
        parts += [joint(f"j{index}", "revolute", (before, f"b{index}"), f"0 0 {height}", axis, 3.05)]
        before = f"b{index}"
    parts += [link("hand", "0.04 0.12 0.02"), joint("wrist", "fixed", (before, "hand"), "0 0 0.05", "0 0 1", 0.0)]
    for name, axis in FINGERS.items():
        side = f"0 {0.004 * float(axis.split()[1])} 0.08"
        parts += [link(f"{name}_link", "0.016 0.008 0.02")]
        parts += [joint(name, "prismatic", ("hand", f"{name}_link"), side, axis, 0.04)]
    return f'<robot name="arm">{"".join(parts)}</robot>'


def chosen(file: Path) -> list[str]:
    """Arguments of the command line that choose the arm in `file`."""
    values = {f"task.robot.{name}": json.dumps(value).replace('"', "") for name, value in ARM.items()}
    return ["task/robot=file", f"task.robot.file={file}", *(f"{key}={value}" for key, value in values.items())]


def make(file: Path) -> Tabletop:
    """The tabletop with the arm in `file`, as the command line makes it."""
    return make_tabletop("task.image_size=[64,64]", *chosen(file))


@pytest.fixture(scope="module")
def jaco() -> Iterator[Tabletop]:
    """The tabletop with Kinova's arm."""
    environment = make_tabletop("task/robot=jaco", "task/randomize=wide", "task.image_size=[48,48]")
    yield environment
    environment.close()


def successes(environment: Tabletop, seeds: range) -> int:
    with environment.blind():
        return sum(rollout(environment, Waypoint(environment.spec), seed).success for seed in seeds)


def test_the_expert_acts_with_an_arm_of_a_package() -> None:
    environment = make_tabletop("task/robot=jaco")
    assert successes(environment, range(8)) >= 7
    environment.close()


@pytest.mark.parametrize("kind", ["mjcf", "urdf"])
def test_the_expert_acts_with_an_arm_from_a_file(tmp_path: Path, kind: str) -> None:
    file = tmp_path / f"arm.{'xml' if kind == 'mjcf' else 'urdf'}"
    file.write_text(mjcf().replace('name="b2" ', "") if kind == "mjcf" else urdf())  # bodies need no name
    environment = make(file)
    assert "" not in environment.poses() and len(environment.simulation.compiled.robot_geoms) >= 10
    robot: Any = environment.spec.robot
    assert robot.joints == tuple(f"j{index}" for index in range(6))
    assert environment.simulation.scene.robot.widest == pytest.approx(0.08, abs=2e-3)
    assert successes(environment, range(4)) == 4
    assert environment.reset(0).rgb["wrist"].std() > 5
    environment.close()


def test_a_stored_episode_is_replayed_with_the_arm_that_the_command_names(tmp_path: Path) -> None:
    """A store chooses no files on this machine."""
    (tmp_path / "arm.xml").write_text(mjcf())
    arm, store = chosen(tmp_path / "arm.xml"), ("collect.folder=store", "collect.episodes=1", "expert=clean")
    here(tmp_path, "job=collect", "task.image_size=[16,16]", "cluster.workers=1", "output=run", *store, *arm)
    replay = ("job=inspect", "inspect.folder=store", "inspect.episode=0", "output=replay")
    refused = here(tmp_path, *replay, ok=False).stderr
    assert "names a path or an address in task.robot.file" in refused and "task/robot=OPTION gives yours" in refused
    assert "through the same states, bit for bit" in here(tmp_path, *replay, *arm).stdout
    assert "the episode store store" in here(tmp_path, *replay, "task/robot=jaco", ok=False).stderr


def test_the_spec_describes_the_compiled_arm(jaco: Tabletop) -> None:
    """The chain leads to the tool, the Jacobian is its derivative, and the spec survives a file."""
    robot: Any = jaco.spec.robot
    kinematics = jaco.simulation.scene.robot.kinematics
    joints = kinematics.home + np.array([0.3, -0.2, 0.1, 0.4, -0.3, 0.2])
    pose, jacobian = kinematics.forward(joints)
    jacobian = jacobian.copy()
    np.testing.assert_allclose(frame_positions(robot.chain, joints)[-1], pose[:3, 3], atol=1e-6)
    for index, step in enumerate(1e-5 * np.eye(6)):
        moved = (kinematics.forward(joints + step)[0][:3, 3] - kinematics.forward(joints - step)[0][:3, 3]) / 2e-5
        np.testing.assert_allclose(jacobian[:3, index], moved, atol=1e-6)
    assert Spec.from_dict(jaco.spec.to_dict()) == jaco.spec
    assert jaco.spec.state_units == ("rad",) * 6 + ("rad/s",) * 6 + ("m",)


def test_a_cartesian_policy_moves_the_arm_that_it_was_trained_with(jaco: Tabletop) -> None:
    """The loop of a deployment: the tool goes where the simulator's own kinematics say."""
    spec, arm = replace(jaco.spec, cameras=("front",), depth=()), jaco.simulation.scene.robot.kinematics
    limits = {"low": [-9.0] * 6, "high": [9.0] * 6, "speed": [2.0] * 6, "acceleration": [50.0] * 6}
    shares = {"speed_share": 1.0, "acceleration_share": 1.0}
    robot = Robot(
        **defaults_of("deploy/robot/simulated", joints=list(spec.require_robot("this").joints), **limits, **shares)
    )
    loop = ControlLoop(spec, robot, replace(SAFETY, workspace=((-2.0,) * 3, (2.0,) * 3)), 50.0)
    now, joints = 100.0, arm.home.copy()
    start = arm.forward(joints)[0].copy()
    loop.on_instruction("move", now)
    for tick in range(100):
        now += 0.02
        loop.on_joint_state(joints, np.zeros(6), 0.08, now)
        if tick % 5 == 0:
            loop.on_image("front", np.zeros((*spec.image_size, 3), np.uint8), now)
        if loop.next_observation(now) is not None:
            loop.set_plan(np.array([[0.0, 0.005, 0, 0, 0, 0, 1]], np.float32))
        if (command := loop.command(now)) is not None:
            joints = command.position
    moved = arm.forward(joints)[0]
    assert moved[1, 3] - start[1, 3] > 0.05
    np.testing.assert_allclose(moved[[0, 2], 3], start[[0, 2], 3], atol=3e-3)
    np.testing.assert_allclose(moved[:3, :3], start[:3, :3], atol=0.02)


def test_every_axis_of_randomisation_is_applied(jaco: Tabletop) -> None:
    """The arm starts where it is drawn, with its gripper as far open, and in another colour."""
    nominal = None
    for seed in range(5):
        observation = jaco.reset(seed)
        compiled, robot = jaco.simulation.compiled, cast(RobotFile, jaco.simulation.compiled.robot)
        drawn: Any = jaco.draws["arm"]
        assert observation.truth is not None
        assert np.linalg.norm(observation.truth["tcp"] - drawn["tcp"]) < 2e-3
        opening = np.clip(drawn["opening"], robot.narrowest, robot.widest)
        assert abs(observation.state[-1] - opening) < 5e-3 + 4 * jaco.draws["sensor"]["gripper"]
        colours = compiled.model.geom_rgba[compiled.robot_geoms, :3].copy()
        assert nominal is None or np.abs(colours - nominal).max() > 0.01
        nominal = colours


def test_the_same_seed_gives_the_same_episode(jaco: Tabletop) -> None:
    def play() -> list[bytes]:
        seen = [jaco.reset(4), *(jaco.step(np.array([0.02, 0.01, -0.03, 0, 0, 0.1, 0.0])) for _ in range(3))]
        return [item.state.tobytes() + item.rgb["wrist"].tobytes() for item in seen]

    first = play()
    jaco.reset(5)
    assert play() == first


WRONG: tuple[tuple[dict[str, Any], str], ...] = (
    (
        {"joints": [*ARM["joints"][:5], "j9"]},
        r"task\.robot\.joints names j9, which is no joint: there are lift, j0, j1",
    ),
    ({"joints": ["lift"], "home": [0.0]}, r"task\.robot\.joints names lift, which is not a hinge"),
    ({"joints": [f"j{index}" for index in (0, 2, 1, 3, 4, 5)]}, r"task\.robot\.joints names j1 after .*: base to tip"),
    ({"tool": "tcp"}, r"task\.robot\.tool names tcp, which is no site or body"),
    ({"open": {"claw": 1.0}, "closed": {"claw": 0.0}}, r"task\.robot\.open names claw, which is no actuator or joint"),
    ({"open": {"left": 0.04}}, r"task\.robot\.open names left, task\.robot\.closed left, right"),
    ({"fingertips": [["left_link"], ["thumb"]]}, r"task\.robot\.fingertips names thumb, which is no geom or body"),
    ({"home": [4.0, *HOME[1:]]}, r"task\.robot\.home has j0 at 4\.0, outside its limits, -3\.054 to 3\.054"),
    ({"home": HOME[1:]}, r"task\.robot\.home has 5 positions for 6 joints"),
    ({"home": [0.0] * 6}, r"task\.robot\.offset: the middle between the fingertips is at \[0\.0, 0\.0, -0\.16\]"),
    ({"home": [0.0, 0.37, 1.82, 0.0, 0.3, 0.0]}, r"task\.robot\.home leaves the axes of hand askew"),
    ({"open": dict.fromkeys(FINGERS, 0.001)}, r"leave the fingertips \d+ and \d+ mm apart, which holds no block"),
    ({"mount": "b3", "hand": Path("none.xml")}, r"task\.robot\.hand=none\.xml: there is no such file"),
)


@pytest.mark.parametrize(("changes", "message"), WRONG, ids=[message[12:40] for _, message in WRONG])
def test_what_does_not_fit_the_model_is_named(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    from vla.tasks.tabletop.robot_file import RobotFile

    file = tmp_path / "arm.xml"
    file.write_text(mjcf())
    arguments: dict[str, Any] = {**defaults_of("task/robot/file"), **ARM, "file": file, **changes}
    with pytest.raises(ValueError, match=message):
        RobotFile(**arguments)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, r"arm\.xml: there is no such file"),
        ("<mujoco><worldbody>", r"arm\.xml does not compile: XML"),
        ("<mujoco><include file='/etc/hostname'/></mujoco>", r"arm\.xml does not compile"),
        (mjcf().replace("<mujoco>", '<mujoco><asset><mesh file="link.stl"/></asset>'), r"link\.stl"),
        (mjcf().replace('name="j5"', 'name="j4"'), r"arm\.xml does not compile: .*repeated name 'j4'"),
    ],
)
def test_a_file_that_does_not_compile_is_named(tmp_path: Path, text: str | None, message: str) -> None:
    from vla.tasks.tabletop.robot_file import RobotFile

    if text is not None:
        (tmp_path / "arm.xml").write_text(text)
    arguments: dict[str, Any] = {**defaults_of("task/robot/file"), **ARM, "file": tmp_path / "arm.xml"}
    with pytest.raises(ValueError, match=message) as raised:
        RobotFile(**arguments)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    "path", ["/etc/passwd", "nowhere/arm.xml", "dm_control/../../a.xml", "dm_control//etc/passwd", "arm.xml"]
)
def test_an_installed_arm_is_within_its_package(path: str) -> None:
    from vla.tasks.tabletop.robot_file import InstalledRobot

    arguments: dict[str, Any] = {**defaults_of("task/robot/jaco"), "file": path}
    with pytest.raises(ValueError, match="must begin with the name of an installed package and stay within it"):
        InstalledRobot(**arguments)


def test_a_checkpoint_names_no_file_but_of_a_package() -> None:
    named = [f"task.robot.{name}={json.dumps(value)}".replace('"', "") for name, value in ARM.items()]
    config: Any = {"task": plain(composed("task/robot=file", "task.robot.file=arm.xml", *named))["task"]}
    with pytest.raises(ValueError, match=r"last\.ckpt names a path .* in task\.robot\.file: .*; task/robot=OPTION"):
        require_no_paths(config, ("task",), "last.ckpt", ())
    require_no_paths(config, ("task",), "last.ckpt", ("task.robot",))
    require_no_paths({"task": plain(composed("task/robot=jaco"))["task"]}, ("task",), "last.ckpt", ())


def test_the_panda_is_the_tabletop_without_a_file() -> None:
    """So that its stores and checkpoints stay valid."""
    assert "robot" not in composed("task/robot=panda").task
    assert composed("task/robot=jaco").collect.folder != composed().collect.folder
