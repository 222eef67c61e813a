"""Arms from files: they act as the Panda does, and what is wrong with a file is said in one sentence."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import mujoco
import numpy as np
import pytest
from arm import SAFETY
from arm_models import (
    ARM,
    FINGERS,
    GRIPS,
    HINGED,
    HOME,
    MESHES,
    arguments_of,
    chosen,
    fingers,
    hinged,
    make,
    mjcf,
    successes,
    urdf,
)
from command_line import here
from composing import composed
from conftest import make_tabletop
from defaults import defaults_of
from test_control_loop import World

from vla.config.build import require_no_paths
from vla.config.experiment import to_plain
from vla.deploy.control_loop import ControlLoop
from vla.deploy.joint_limiter import JointLimits
from vla.robots.chain import forward_of
from vla.spec import Spec
from vla.tasks.rendering.shapes import mesh_triangles
from vla.tasks.tabletop.compiled_scene import CompiledScene
from vla.tasks.tabletop.file_robot import FileRobot
from vla.tasks.tabletop.robot_file import InstalledRobot, RobotFile

if TYPE_CHECKING:
    from vla.tasks.tabletop.environment import Tabletop


@pytest.fixture(scope="module")
def jaco() -> Iterator[Tabletop]:
    """The tabletop with Kinova's arm."""
    environment = make_tabletop("task/robot=jaco", "task/randomize=wide", "task.image_size=[48,48]")
    yield environment
    environment.close()


def test_the_expert_acts_with_an_arm_of_a_package() -> None:
    environment = make_tabletop("task/robot=jaco")
    assert successes(environment, range(4)) == 4
    environment.close()


@pytest.mark.parametrize("kind", ["mjcf", "urdf"])
def test_the_expert_acts_with_an_arm_from_a_file(tmp_path: Path, kind: str) -> None:
    file = tmp_path / f"arm.{'xml' if kind == 'mjcf' else 'urdf'}"
    file.write_text(mjcf().replace('name="b2" ', "") if kind == "mjcf" else urdf())  # bodies need no name
    environment = make(file)
    assert "" not in environment.poses() and len(environment.simulation.compiled.robot_geoms) >= 10
    robot: Any = environment.spec.robot
    assert robot.joints == tuple(f"j{index}" for index in range(6))
    assert environment.simulation.compiled.robot.widest == pytest.approx(0.08, abs=2e-3)
    assert successes(environment, range(4)) == 4
    assert environment.reset(0).rgb["wrist"].std() > 5
    environment.close()


@pytest.mark.parametrize("goal", ["pick_place", "push"])
def test_the_expert_acts_with_a_jaw_on_a_hinge(tmp_path: Path, goal: str) -> None:
    """Its shapes have no names, and collide as convex hulls that touch those of the other jaw, even when open."""
    (tmp_path / "arm.xml").write_text(mjcf(hinged(), actuators="", more=MESHES))
    environment = make(tmp_path / "arm.xml", f"task/goal={goal}", **HINGED)
    assert successes(environment, range(4)) == 4
    environment.close()


def test_jaws_on_a_hinge_are_measured_at_their_far_ends(tmp_path: Path) -> None:
    (tmp_path / "arm.xml").write_text(mjcf(hinged(), actuators="", more=MESHES))
    robot = FileRobot(RobotFile(**arguments_of(tmp_path / "arm.xml", **HINGED)), "full")
    # Nearest to the fixed jaw, from 90 to 120 mm, is the inner corner at 90 mm, turned about the hinge at (12, 20) mm.
    sine, cosine = np.sin(HINGED["open"]["jaw"]), np.cos(HINGED["open"]["jaw"])
    corner = [0.012 - 0.016 * cosine + 0.07 * sine, 0.02 + 0.07 * cosine + 0.016 * sine]
    assert robot.widest == pytest.approx(np.hypot(corner[0] + 0.006, 0.09 - corner[1]), abs=1e-3)
    assert robot.narrowest == pytest.approx(0.002, abs=1e-3)
    # The tool point has the middle of a block's place between them, 12 mm above their ends.
    model = CompiledScene(robot, blocks=0).model
    tool = model.site(robot.tool)
    np.testing.assert_allclose(tool.pos, [0, -0.006 + 0.03, 0.12 - 0.012], atol=3e-3)
    np.testing.assert_allclose(robot.tip, [0.012, 0.017, 0.012, tool.pos[1] + 0.005], atol=1e-3)  # y is to the right
    # What is cut off collides with the world as well, and the whole shapes are drawn only.
    for body, whole in (("robot/fixed_jaw", 1), ("robot/jaw", 1)):
        geoms = [index for index in range(model.ngeom) if model.body(model.geom_bodyid[index]).name == body]
        assert sorted(bool(model.geom_contype[index]) for index in geoms) == [False] * whole + [True, True]


def test_sites_become_fingertips_of_their_own_shape(tmp_path: Path) -> None:
    tips = '<site name="tip" pos="0 -0.001 0.095" size="0.005"/>'
    hand = hinged(tips, tips.replace("tip", "jaw_tip").replace("-0.001", "-0.011").replace("0.095", "0.075"))
    (tmp_path / "arm.xml").write_text(mjcf(hand, actuators="", more=MESHES))
    sites = {**HINGED, "fingertips": [["tip"], ["jaw_tip"]], "offset": [0.0, 0.02, 0.1]}
    robot = FileRobot(RobotFile(**arguments_of(tmp_path / "arm.xml", **sites)), "full")
    angle = HINGED["open"]["jaw"]
    opened = np.array([0.012 - 0.011 * np.cos(angle) + 0.075 * np.sin(angle), 0.02])
    opened[1] += 0.075 * np.cos(angle) + 0.011 * np.sin(angle)
    assert robot.widest == pytest.approx(np.linalg.norm(opened - [-0.001, 0.095]) - 0.01, abs=1e-3)


def test_frames_and_angles_of_a_file_are_those_of_what_is_seen_and_of_what_holds(tmp_path: Path) -> None:
    """An element of MuJoCo's specification has neither the frames around it nor its angles as a quaternion."""
    plain_hand = hinged(*(f'<site name="{name}" type="box" size="0.01 0.004 0.01"/>' for name in ("tip", "jaw_tip")))
    turned = plain_hand.replace('mesh="housing"/>', 'mesh="housing" euler="0 0 90"/>')
    turned = turned.replace('<site name="tip" ', '<frame pos="0 -0.005 0.09"><site name="tip" euler="0 0 90" ')
    turned = turned.replace('0.01"/></body>', '0.01"/></frame></body>', 1)
    turned = turned.replace('<site name="jaw_tip" ', '<site name="jaw_tip" pos="0 -0.011 0.075" ')
    (tmp_path / "arm.xml").write_text(mjcf(turned, actuators="", more=MESHES))
    sites = {**HINGED, "fingertips": [["tip"], ["jaw_tip"]], "offset": [0.0, 0.02, 0.1]}
    robot = FileRobot(RobotFile(**arguments_of(tmp_path / "arm.xml", **sites)), "light")
    model = CompiledScene(robot, blocks=0).model
    tip = model.geom("robot/vla_tip_tip")
    np.testing.assert_allclose(tip.pos, [0, -0.005, 0.09], atol=1e-6)
    np.testing.assert_allclose(np.abs(tip.quat), [0.5**0.5, 0, 0, 0.5**0.5], atol=1e-6)
    geoms = [model.geom(index) for index in range(model.ngeom)]
    solid = next(
        geom for geom in geoms if model.body(geom.bodyid[0]).name == "robot/fixed_jaw" and "seen" not in geom.name
    )
    seen = model.geom(f"{solid.name}_seen")
    corners = [_corners(model, each) for each in (solid, seen)]
    np.testing.assert_allclose(corners[0].min(axis=0), corners[1].min(axis=0), atol=1e-5)
    np.testing.assert_allclose(corners[0].max(axis=0), corners[1].max(axis=0), atol=1e-5)


def _corners(model: mujoco.MjModel, geom: Any) -> np.ndarray:
    """The corners (N, 3) of a geom that is a mesh, in the frame of its body [m]."""
    turn = np.empty(9)
    mujoco.mju_quat2Mat(turn, geom.quat)
    return geom.pos + mesh_triangles(model, int(geom.dataid[0]))[0].astype(float) @ turn.reshape(3, 3).T


SECOND = """<body name="other" pos="0 0.5 0"><geom size="0.02"/>
    <body name="other_left"><joint name="other_left" type="slide"/><geom size="0.02"/><site name="other_tip"/></body>
    <body name="other_right"><joint name="other_right" type="slide"/><geom size="0.02"/></body>
    <body name="other_bar"><joint/><geom size="0.02"/></body></body>"""
COUPLED = """<tendon><fixed name="other"><joint joint="other_left" coef="1"/><joint joint="other_right" coef="1"/>
    </fixed><spatial name="cord"><site site="other_tip"/><site site="base_tip"/></spatial></tendon>
    <equality><joint joint1="left" joint2="right"/><joint joint1="other_left" joint2="other_right"/>
    <joint joint1="other_left"/><tendon tendon1="other"/><connect body1="other_left" body2="other_bar" anchor="0 0 0"/>
    <weld site1="other_tip" site2="base_tip"/></equality>"""


@pytest.mark.parametrize("kind", ["mjcf", "urdf"])
def test_couplings_of_a_second_gripper_go_and_those_of_the_first_stay(tmp_path: Path, kind: str) -> None:
    (tmp_path / "arm.xml").write_text(
        urdf(second=True)
        if kind == "urdf"
        else mjcf(
            actuators=GRIPS.partition(">")[0] + '><position name="other" tendon="other"/>',
            base=SECOND + '<site name="base_tip"/>',
            more=COUPLED,
        )
    )
    environment = make(tmp_path / "arm.xml", open={"left": 0.04}, closed={"left": 0.0})
    model = environment.simulation.compiled.model
    assert (model.neq, model.ntendon, model.eq_type[0]) == (1, 0, mujoco.mjtEq.mjEQ_JOINT)
    assert environment.simulation.compiled.robot.widest == pytest.approx(0.08, abs=2e-3)  # both fingers open
    assert successes(environment, range(2)) == 2
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
    kinematics = jaco.simulation.compiled.robot.kinematics
    joints = kinematics.home + np.array([0.3, -0.2, 0.1, 0.4, -0.3, 0.2])
    pose, jacobian = kinematics.forward(joints)
    jacobian = jacobian.copy()
    np.testing.assert_allclose(forward_of(robot.chain)(joints)[0][:3, 3], pose[:3, 3], atol=1e-6)
    for index, step in enumerate(1e-5 * np.eye(6)):
        moved = (kinematics.forward(joints + step)[0][:3, 3] - kinematics.forward(joints - step)[0][:3, 3]) / 2e-5
        np.testing.assert_allclose(jacobian[:3, index], moved, atol=1e-6)
    assert Spec.from_dict(jaco.spec.to_dict()) == jaco.spec
    assert jaco.spec.state_units == ("rad",) * 6 + ("rad/s",) * 6 + ("m",)


def test_a_cartesian_policy_moves_the_arm_that_it_was_trained_with(jaco: Tabletop) -> None:
    """The loop of a deployment: the tool goes where the simulator's own kinematics say."""
    spec, arm = replace(jaco.spec, cameras=("front",), depth=()), jaco.simulation.compiled.robot.kinematics
    limits = {"low": [-9.0] * 6, "high": [9.0] * 6, "speed": [2.0] * 6, "acceleration": [50.0] * 6}
    shares = {"speed_share": 1.0, "acceleration_share": 1.0}
    robot = JointLimits(
        **defaults_of("deploy/robot/simulated", joints=list(spec.require_robot("this").joints), **limits, **shares)
    )
    world, start = World(), arm.forward(arm.home)[0].copy()
    world.loop = ControlLoop(spec, robot, replace(SAFETY, workspace=((-2.0,) * 3, (2.0,) * 3)), 50.0)
    world.joints, world.cameras = arm.home.copy(), ["front"]
    world.answer = lambda observation: np.array([[0.0, 0.005, 0, 0, 0, 0, 1]], np.float32)
    world.loop.on_instruction("move", world.now)
    world.run(2.0)
    moved = arm.forward(world.joints)[0]
    assert moved[1, 3] - start[1, 3] > 0.05
    np.testing.assert_allclose(moved[[0, 2], 3], start[[0, 2], 3], atol=3e-3)
    np.testing.assert_allclose(moved[:3, :3], start[:3, :3], atol=0.02)


def test_every_axis_of_randomisation_is_applied(jaco: Tabletop) -> None:
    """The arm starts where it is drawn, with its gripper as far open, and in another colour."""
    nominal = None
    for seed in range(5):
        observation = jaco.reset(seed)
        compiled, robot = jaco.simulation.compiled, cast(FileRobot, jaco.simulation.compiled.robot)
        drawn: Any = jaco.draws["arm"]
        assert observation.truth is not None
        assert np.linalg.norm(observation.truth["tcp"] - drawn["tcp"]) < 2e-3
        opening = np.clip(drawn["opening"], robot.narrowest, robot.widest)
        assert abs(observation.state[-1] - opening) < 5e-3 + 4 * jaco.draws["sensor"]["gripper"]
        colours = compiled.model.geom_rgba[compiled.robot_geoms, :3].copy()
        assert nominal is None or np.abs(colours - nominal).max() > 0.01
        nominal = colours


WRONG: tuple[tuple[dict[str, Any], str], ...] = (
    (
        {"joints": [*ARM["joints"][:5], "j9"]},
        r"task\.robot\.joints names j9, which is no joint: there are lift, j0, j1",
    ),
    ({"joints": ["lift"], "home": [0.0]}, r"task\.robot\.joints names lift, which is not a hinge"),
    ({"joints": [f"j{index}" for index in (0, 2, 1, 3, 4, 5)]}, r"task\.robot\.joints names j1 after .*: base to tip"),
    ({"tool": "tcp"}, r"task\.robot\.tool names tcp, which is no site or body"),
    ({"open": {"claw": 1.0}, "closed": {"claw": 0.0}}, r"task\.robot\.open names claw, which is no actuator or joint"),
    ({"open": {"left": 0.04}}, r"open and closed must name the same, not \['left'\] and \['left', 'right'\]"),
    (
        {"fingertips": [["left_link"], ["thumb"]]},
        r"task\.robot\.fingertips names thumb, which is no geom, body or",
    ),
    ({"fingertips": [["air"], ["left_link"]]}, r"task\.robot\.fingertips names air, where nothing collides: "),
    ({"home": [4.0, *HOME[1:]]}, r"task\.robot\.home has j0 at 4\.0, outside its limits, -3\.054 to 3\.054"),
    ({"home": HOME[1:]}, r"task\.robot\.home has 5 positions for 6 joints"),
    ({"home": [0.0] * 6}, r"task\.robot\.offset: the middle between the fingertips is at \[0\.0, 0\.0, -0\.16\]"),
    ({"home": [0.0, 0.37, 1.82, 0.0, 0.3, 0.0]}, r"task\.robot\.home leaves the axes of hand askew"),
    ({"open": dict.fromkeys(FINGERS, 0.001)}, r"leave the fingertips \d+ and \d+ mm apart, which holds no block"),
    (
        {"camera": [0.1, 0.0, 0.0], "target": [0.0, 0.0, 0.0]},
        r"task\.robot\.camera and task\.robot\.target must differ",
    ),
    (
        {"open": dict.fromkeys(FINGERS, 0.025)},
        r"leave the fingertips 5\d and \d+ mm apart, which holds no block: that takes 52 mm",
    ),
    ({"mount": "b3", "hand": Path("none.xml")}, r"task\.robot\.hand=none\.xml: there is no such file"),
)


@pytest.mark.parametrize(("changes", "message"), WRONG, ids=[message[12:40] for _, message in WRONG])
def test_what_does_not_fit_the_model_is_named(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    (tmp_path / "arm.xml").write_text(mjcf(fingers() + '<body name="air"/>'))
    with pytest.raises(ValueError, match=message):
        FileRobot(RobotFile(**arguments_of(tmp_path / "arm.xml", **changes)), "light")


def test_a_checkpoint_names_no_file_but_of_a_package(tmp_path: Path) -> None:
    config: Any = {"task": to_plain(composed(*chosen(tmp_path / "arm.xml")))["task"]}
    with pytest.raises(
        ValueError, match=r"last\.ckpt names a path .* in task\.robot\.file: .*; task/robot=OPTION gives yours"
    ):
        require_no_paths(config, ("task",), "last.ckpt", ())
    require_no_paths(config, ("task",), "last.ckpt", ("task.robot",))
    require_no_paths({"task": to_plain(composed("task/robot=jaco"))["task"]}, ("task",), "last.ckpt", ())


@pytest.mark.parametrize(
    "path",
    [
        "/etc/passwd",
        "nowhere/arm.xml",
        "dm_control/../../a.xml",
        "dm_control//etc/passwd",
        "arm.xml",
        "sys/arm.xml",  # built in
        "zipimport/arm.xml",  # frozen
        "typing_extensions/arm.xml",  # no package
        "folder/arm.xml",
        "package/arm.xml",
    ],
)
def test_an_installed_arm_is_within_its_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, path: str) -> None:
    """Also if the working folder, which Python searches as well, has a file of such a name."""
    for folder in (".", "folder", "package"):
        (tmp_path / folder).mkdir(exist_ok=True)
        (tmp_path / folder / "arm.xml").write_text(mjcf())
    (tmp_path / "package" / "__init__.py").touch()
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    for name in ("file", "hand"):
        with pytest.raises(ValueError, match="must begin with the name of an installed package and stay within it"):
            InstalledRobot(**defaults_of("task/robot/jaco", **{name: path}))


def test_the_panda_is_the_tabletop_without_a_file() -> None:
    """So that its stores and checkpoints stay valid."""
    assert "robot" not in composed("task/robot=panda").task
    assert composed("task/robot=jaco").collect.folder != composed().collect.folder
