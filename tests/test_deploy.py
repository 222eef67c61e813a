"""Deployment as a user types it: nodes in processes of their own, words, signals, bags."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import sysconfig
import time
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from test_run import SMALL, vla

from vla.deploy import messages
from vla.deploy.bag import HEARD
from vla.deploy.governor import Robot
from vla.deploy.images import fitted
from vla.deploy.ros import Network, split_arguments
from vla.record import VIEWER
from vla.tasks import backend

WORKER = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
DOMAIN = 15 + 20 * (WORKER % 5)
CHECKPOINT = "checkpoint=run/checkpoints/last.ckpt"


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a small trained checkpoint."""
    folder = tmp_path_factory.mktemp("deploy")
    few = ["collect.episodes=4", "data.validation_fraction=0", "trainer.limit_val_batches=0"]
    vla(folder, *SMALL, *few, "job=train", "output=run")
    return folder


@pytest.fixture
def start(home: Path) -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """Starts a module in `home`, on the domain of these tests, and ends it with the test."""
    started: list[subprocess.Popen[str]] = []

    def start(module: str, *arguments: str) -> subprocess.Popen[str]:
        command = [sys.executable, "-u", "-m", module, *arguments]
        options: Any = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
        environment = {**os.environ, "ROS_DOMAIN_ID": str(DOMAIN)}
        started.append(subprocess.Popen(command, cwd=home, env=environment, **options))
        return started[-1]

    yield start
    for process in started:
        process.kill()
        process.wait()


class Ear:
    """Somebody who listens to joint states and commands, and may speak."""

    def __init__(self) -> None:
        Network("SYSTEM_DEFAULT", "loopback").apply()
        self._context = Context()
        rclpy.init(context=self._context, domain_id=DOMAIN)
        self.node = rclpy.create_node("ear", context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self.states: list[JointState] = []
        self.commands: list[JointState] = []
        self.node.create_subscription(JointState, "/isaac/franka/joint_states", self.states.append, 10)
        self.node.create_subscription(JointState, "/isaac/franka/joint_commands", self.commands.append, 10)
        self._words = self.node.create_publisher(String, "/user/command", 1)

    def until(self, true: Callable[[], Any], seconds: float = 60.0) -> None:
        """Listen until something holds."""
        give_up = time.monotonic() + seconds
        while not true():
            assert time.monotonic() < give_up
            self._executor.spin_once(timeout_sec=0.02)

    def listen(self, seconds: float) -> None:
        """Listen for a while."""
        end = time.monotonic() + seconds
        self.until(lambda: time.monotonic() > end)

    def say(self, words: str) -> None:
        """Speak, once agent and simulator listen."""
        self.until(lambda: self._words.get_subscription_count() >= 2)
        self._words.publish(String(data=words))

    def published_by(self, node: str) -> set[str]:
        """The topics of another node, as far as they are known here by now."""
        if node not in self.node.get_node_names():
            return set()
        topics = self.node.get_publisher_names_and_types_by_node(node, "/")
        return {name for name, _ in topics} - {"/rosout", "/parameter_events"}

    def moved(self) -> float:
        """How far the joints went between the newest two joint states [rad]."""
        if len(self.states) < 2:
            return 0.0
        return float(np.abs(np.subtract(self.states[-1].position, self.states[-2].position)).max())

    def close(self) -> None:
        """Stop listening."""
        self._executor.shutdown()
        self.node.destroy_node()
        rclpy.try_shutdown(context=self._context)


@pytest.fixture
def ear() -> Iterator[Ear]:
    """An ear on the domain of these tests."""
    ear = Ear()
    yield ear
    ear.close()


@pytest.mark.realtime
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_words_move_the_arm_and_a_signal_leaves_it_at_rest(
    home: Path, start: Callable[..., subprocess.Popen[str]], ear: Ear, number: int
) -> None:
    simulator = start("vla.run", "job=deploy", "deploy=simulator", CHECKPOINT)
    agent = start("vla.run", "job=deploy", "deploy=ros2", CHECKPOINT, "--ros-args", "-p", "speed_share:=0.3")
    watch = start("vla.deploy.watch")
    view = start("vla.deploy.view", "--save", f"view{number}.rrd")
    ear.until(lambda: ear.states and ear.commands)
    np.testing.assert_allclose(ear.commands[0].position[:7], ear.states[0].position[:7], atol=1e-3)
    said = start("vla.deploy.say", "put the red block on the pad")
    assert said.wait(30) == 0
    ear.until(lambda: ear.moved() > 1e-3)
    agent.send_signal(number)
    assert agent.wait(10) == 0, agent.communicate()[0]
    ear.listen(1.0)
    last, before = ear.commands[-1].position, ear.commands[-2].position
    assert np.abs(np.subtract(last, before)).max() < 0.02 and ear.moved() < 1e-3
    simulator.send_signal(number)
    watch.send_signal(number)
    view.send_signal(number)
    assert simulator.wait(10) == 0 and watch.wait(10) == 0 and view.wait(10) == 0
    assert (home / f"view{number}.rrd").stat().st_size > 10_000
    assert "running" in watch.communicate()[0]


@pytest.mark.realtime
def test_when_the_agent_is_killed_the_simulator_holds_the_arm(
    home: Path, start: Callable[..., subprocess.Popen[str]], ear: Ear
) -> None:
    start("vla.run", "job=deploy", "deploy=simulator", CHECKPOINT)
    agent = start("vla.run", "job=deploy", "deploy=ros2", CHECKPOINT)
    ear.until(lambda: ear.commands)
    ear.say("put the red block on the pad")
    ear.until(lambda: ear.moved() > 1e-3)
    assert start("vla.deploy.say", "").wait(30) == 0
    ear.until(lambda: ear.moved() < 1e-4)
    assert start("vla.deploy.say", "--resume", "put the blue block on the pad").wait(30) == 0
    ear.until(lambda: ear.moved() > 1e-3)
    refused = start("vla.deploy.say", "--resume", "put the blue block on the pad")
    assert "error: there is nothing to resume" in refused.communicate(timeout=30)[0] and refused.returncode == 1
    reset = start("vla.deploy.say", "--reset", "put the blue block on the pad")
    assert reset.communicate(timeout=30)[0].startswith('episode 1000001: "') and reset.returncode == 0
    ear.until(lambda: ear.moved() > 1e-3)
    agent.kill()
    ear.listen(0.5)
    heard = len(ear.states)
    ear.until(lambda: len(ear.states) >= heard + 35)  # 0.7 s for the simulator, however busy the machine is
    assert ear.moved() < 1e-3


@pytest.mark.realtime
def test_when_the_simulator_is_killed_the_agent_holds_the_arm_and_says_why(
    start: Callable[..., subprocess.Popen[str]], ear: Ear
) -> None:
    simulator = start("vla.run", "job=deploy", "deploy=simulator", CHECKPOINT)
    agent = start("vla.run", "job=deploy", "deploy=ros2", CHECKPOINT)
    ear.until(lambda: ear.commands)
    ear.say("put the red block on the pad")
    ear.until(lambda: ear.moved() > 1e-3)
    simulator.kill()
    ear.listen(1.0)
    ear.commands.clear()
    ear.listen(0.3)
    assert ear.commands and not np.ptp([command.position[:7] for command in ear.commands], axis=0).any()
    agent.send_signal(signal.SIGINT)
    printed = agent.communicate(timeout=10)[0]
    assert agent.returncode == 0, printed
    assert re.search(r"holding: the newest (image of the camera \w+|joint state) is older than", printed), printed


@pytest.mark.realtime
def test_the_whole_loop_reports_and_its_bag_moves_an_agent_again(
    home: Path, start: Callable[..., subprocess.Popen[str]], ear: Ear
) -> None:
    limit = "task.time_limit=1.5"
    loop = start("vla.run", "job=deploy", "deploy=loop", CHECKPOINT, limit, "deploy.episodes=2", "output=loop")
    printed = loop.communicate(timeout=100)[0]
    assert loop.returncode == 0, printed
    assert "/2 (" in printed.strip().splitlines()[-1]
    report = json.loads((home / "loop/report.json").read_text())
    assert report["seeds"] == [1_000_000, 1_000_001] and report["checkpoint"] == CHECKPOINT.partition("=")[2]
    recorded = subprocess.run([VIEWER, "rrd", "stats", "loop/session.rrd"], cwd=home, capture_output=True, text=True)
    for entity in ("camera/isaac/camera/image_raw", "joints/commanded/panda_joint7", "gripper/measured", "words"):
        assert entity in recorded.stdout
    ear.commands.clear()
    start("vla.run", "job=deploy", "deploy=ros2", CHECKPOINT, "deploy.safety.tracking=9")
    ear.until(lambda: ear.node.count_subscribers("/isaac/franka/joint_states") > 1)  # the agent listens, too
    player = start("vla.deploy.bag", "play", "loop/bag", "--speed", "2")
    ear.until(lambda: ear.published_by("vla_bag") >= {*HEARD})
    assert ear.published_by("vla_bag") == {*HEARD}  # and no commands
    assert player.wait(60) == 0, player.communicate()[0]
    ear.listen(0.2)
    assert np.ptp([command.position[:7] for command in ear.commands], axis=0).max() > 0.01


def test_what_the_node_thinks_is_what_the_evaluated_policy_does(home: Path) -> None:
    """On the same observations, through messages and back, bit for bit."""
    from vla import parts
    from vla.policy import read_checkpoint
    from vla.spec import Observation

    checkpoint = home / "run/checkpoints/last.ckpt"
    environment = parts.make_environment(read_checkpoint(checkpoint).config["task"])
    node = {"_target_": "vla.policy.Policy"}
    evaluated, deployed = (parts.make_policy(node, checkpoint, environment) for _ in range(2))
    names = list(environment.spec.joints)
    robot = Robot(names, [-9.0] * 7, [9.0] * 7, [1.0] * 7, [1.0] * 7, ["left", "right"])
    observation = environment.reset(5)
    for _ in range(6):
        action = evaluated.act(observation)
        images = {
            camera: messages.fill_image(SimpleNamespace(header=SimpleNamespace()), image, camera)
            for camera, image in observation.rgb.items()
        }
        fingers = [observation.gripper / 2] * 2
        state = JointState(name=[*names, "left", "right"], position=[*observation.joints.tolist(), *fingers])
        state.velocity = [*observation.velocities.tolist(), 0.0, 0.0]
        joints, velocities, gripper = messages.joints_from(state, robot)
        size = environment.spec.image_size
        rgb = {camera: fitted(messages.image_from(message), size, "centre") for camera, message in images.items()}
        seen = Observation(rgb, {}, joints.astype(np.float32), velocities, gripper, observation.instruction)
        np.testing.assert_array_equal(deployed.plan(seen)[0], action)
        observation = environment.step(action)
    environment.close()


def test_what_is_for_ros_is_kept_from_hydra() -> None:
    line = ["job=deploy", "--ros-args", "-r", "a:=b", "-p", "c:=1", "--", "deploy=ros2"]
    assert split_arguments(line) == (["job=deploy", "deploy=ros2"], ["--ros-args", "-r", "a:=b", "-p", "c:=1"])
    assert split_arguments(["job=train"]) == (["job=train"], [])


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["deploy=ros2"], "checkpoint=FILE"),
        (["deploy=ros2", "checkpoint=nowhere.ckpt"], "there is no checkpoint nowhere.ckpt"),
        ([CHECKPOINT], "deploy=OPTION"),
        ([CHECKPOINT, "deploy=ros2", "deploy.command=velocity"], "joint_state, trajectory, forward"),
        ([CHECKPOINT, "deploy=ros2", "deploy.network.profile=nowhere.xml"], "nowhere.xml"),
        ([CHECKPOINT, "deploy=ros2", "deploy.robot.speed_share=2"], "speed_share"),
        ([CHECKPOINT, "deploy=ros2", "deploy.network.domain=9999"], "9999"),
        ([CHECKPOINT, "deploy=ros2", "deploy.topics.commands='bad topic!'"], "topics.commands is 'bad topic!'"),
        ([CHECKPOINT, "deploy=ros2", "--ros-args", "--nonsense"], "--nonsense"),
        ([CHECKPOINT, "deploy=ros2", "--ros-args", "-p", "command_hz:=0.0"], "command_hz out of range"),
        ([CHECKPOINT, "deploy=loop", "deploy.episodes=0"], "deploy.episodes"),
        ([CHECKPOINT, "deploy=ros2", "~deploy.topics.images.wrist"], "wrist"),
    ],
)
def test_what_cannot_be_deployed_ends_in_one_sentence(home: Path, arguments: list[str], words: str) -> None:
    done = vla(home, "job=deploy", *arguments, ok=False)
    # What is found by the node itself stands in its log as well.
    assert re.fullmatch(r"(\[ERROR\] .*\n)?error: .*\n", done.stderr) and words in done.stderr


def test_an_instruction_that_nobody_would_hear_is_not_said(start: Callable[..., subprocess.Popen[str]]) -> None:
    said = start("vla.deploy.say", "push " * 201)
    assert said.communicate(timeout=30)[0].startswith("error: the instruction has 1005 characters")
    assert said.returncode == 1


def test_a_damaged_checkpoint_is_named_before_anything_starts(home: Path) -> None:
    whole = (home / "run/checkpoints/last.ckpt").read_bytes()
    (home / "cut.ckpt").write_bytes(whole[: len(whole) // 2])
    for option in ("ros2", "loop"):
        done = vla(home, "job=deploy", f"deploy={option}", "checkpoint=cut.ckpt", "output=cut", ok=False)
        assert done.returncode == 1 and done.stdout == "" and not (home / "cut").exists()
        assert re.fullmatch(r"error: cut\.ckpt .*damaged.*\n", done.stderr)


def test_without_ros_the_way_out_is_named(home: Path) -> None:
    (home / "without").mkdir()
    (home / "without/rclpy.py").write_text("raise ImportError('not here')")
    paths = [str(home / "without"), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}
    command = [sys.executable, "-m", "vla.run", "job=deploy", "deploy=ros2", CHECKPOINT]
    done = subprocess.run(command, cwd=home, env=environment, capture_output=True, text=True)
    assert done.returncode == 1 and "vla[ros]" in done.stderr and "Traceback" not in done.stderr


def test_a_policy_is_deployed_where_nothing_renders(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(backend, "PROBE", "raise SystemExit(1)")
    for name in ("MUJOCO_GL", "DISPLAY", backend.TRIED):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(RuntimeError, match="nothing here can render with MUJOCO_GL=egl or osmesa"):
        backend.choose_backend()
    backend.choose_backend(required=False)
    assert os.environ["MUJOCO_GL"] == "disabled"


def test_a_ros_installation_finds_the_node() -> None:
    prefix = Path(sysconfig.get_path("data"))
    assert (prefix / "share/ament_index/resource_index/packages/vla").is_file()
    package = ElementTree.parse(prefix / "share/vla/package.xml").getroot()
    assert package.findtext("name") == "vla" and package.find("maintainer") is not None
    compile((prefix / "share/vla/launch/agent.launch.py").read_text(), "agent.launch.py", "exec")
    done = subprocess.run([prefix / "lib/vla/agent", "--help"], capture_output=True, text=True)
    assert done.returncode == 0 and "deploy" in done.stdout
