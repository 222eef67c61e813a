"""Deployment from the command line: nodes in their own processes, instructions, signals, bags."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import sysconfig
import threading
import time
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import rclpy
from command_line import SMALL, here, vla
from composing import composed
from documented import TEXT
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.lifecycle import LifecycleNode
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from warm import Started

from vla.config.experiment import Experiment, make_environment, to_plain
from vla.data.episodes import EpisodeStore
from vla.deploy import say
from vla.deploy.loop import Loop
from vla.deploy.messages import SimulatedEpisode
from vla.deploy.operator import DemoOperator, Operator, require_alone
from vla.deploy.ros import RosNetwork, split_arguments
from vla.io.errors import UserError
from vla.jobs import deploy as job
from vla.models.policy_folder import read_policy
from vla.robots.panda import forward
from vla.rollouts.results import Result
from vla.tasks import gl as backend

WORKER = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
DOMAIN = 33 + 33 * (WORKER % 3)  # after those of test_policy_node
CHECKPOINT = "checkpoint=run"


@pytest.fixture
def start(home: Path) -> Iterator[Callable[..., Started]]:
    """Starts a module in `home`, on the domain of these tests, and ends it with the test."""
    started: list[Started] = []

    def start(module: str, *arguments: str) -> Started:
        started.append(Started(home, module, *arguments, environment={"ROS_DOMAIN_ID": str(DOMAIN)}))
        return started[-1]

    yield start
    for process in started:
        process.kill()
        process.wait()


def documented_names() -> set[str]:
    """Return the topics, services and nodes in the documented commands of `ros2`."""
    found = re.findall(r"^ *ros2 (?:topic|service|lifecycle) .*?( /\S+)", TEXT, re.MULTILINE)
    assert len(found) >= 5
    return {name.strip() for name in found}


class Probe:
    """Records joint states and commands, and sends instructions."""

    def __init__(self) -> None:
        RosNetwork("loopback", None, None).apply()
        self.context = Context()
        rclpy.init(context=self.context, domain_id=DOMAIN)
        self.node = rclpy.create_node("probe", context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.states: list[JointState] = []
        self.commands: list[JointState] = []
        self.node.create_subscription(JointState, "/isaac/franka/joint_states", self.states.append, 10)
        self.node.create_subscription(JointState, "/isaac/franka/joint_commands", self.commands.append, 10)
        self._words = self.node.create_publisher(String, "/user/command", 1)

    def until(self, true: Callable[[], Any], seconds: float = 60.0) -> None:
        """Spin until a condition holds."""
        deadline = time.monotonic() + seconds
        while not true():
            assert time.monotonic() < deadline
            self.executor.spin_once(timeout_sec=0.02)

    def spin(self, seconds: float) -> None:
        """Spin for some seconds."""
        end = time.monotonic() + seconds
        self.until(lambda: time.monotonic() > end)

    def say(self, words: str) -> None:
        """Send an instruction once agent and simulator subscribe."""
        self.until(lambda: self._words.get_subscription_count() >= 2)
        self._words.publish(String(data=words))

    def discovered(self) -> set[str]:
        """Return the discovered nodes, topics and services."""
        graph = (self.node.get_topic_names_and_types(), self.node.get_service_names_and_types())
        nodes = [f"/{name}" for name in self.node.get_node_names()]
        return {*nodes, *(name for names in graph for name, _ in names)}

    def moved(self) -> float:
        """Return the largest change of a joint between the newest two joint states [rad]."""
        if len(self.states) < 2:
            return 0.0
        return float(np.abs(np.subtract(self.states[-1].position, self.states[-2].position)).max())

    def close(self) -> None:
        """Destroy the node."""
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.try_shutdown(context=self.context)


@pytest.fixture
def probe() -> Iterator[Probe]:
    """A probe on the domain of these tests."""
    probe = Probe()
    yield probe
    probe.close()


@pytest.mark.realtime
def test_an_instruction_moves_the_arm_and_a_signal_leaves_it_at_rest(
    home: Path, start: Callable[..., Started], probe: Probe
) -> None:
    """The other signal ends the agent whose simulator was killed, below."""
    number = signal.SIGTERM
    simulator = start("vla.run", "job=deploy", "deploy=simulator", CHECKPOINT)
    agent = start("vla.run", "job=deploy", "deploy=ros2", CHECKPOINT, "deploy.robot.speed_share=0.3")
    record = start("vla.deploy.record", "bag")
    probe.until(lambda: probe.states and probe.commands)
    probe.until(lambda: probe.discovered() >= documented_names())  # names arrive after the first messages
    np.testing.assert_allclose(probe.commands[0].position[:7], probe.states[0].position[:7], atol=1e-3)
    said = start("vla.deploy.say", "put the red block on the pad")
    assert said.wait(30) == 0
    probe.until(lambda: probe.moved() > 1e-3)
    agent.send_signal(number)
    assert agent.wait(10) == 0, agent.printed()
    probe.spin(1.0)
    last, before = probe.commands[-1].position, probe.commands[-2].position
    assert last[:7] == before[:7] and probe.moved() < 1e-3  # it braked before it ended
    simulator.send_signal(number)
    record.send_signal(number)
    assert simulator.wait(10) == 0 and record.wait(10) == 0
    assert re.fullmatch(r"[1-9]\d+ messages in bag\n", record.printed())


@pytest.mark.realtime
def test_the_shell_stops_and_resumes_the_agent_and_when_that_is_killed_the_simulator_holds_the_arm(
    home: Path, start: Callable[..., Started], probe: Probe
) -> None:
    simulator = start("vla.run", "job=deploy", "deploy=simulator", CHECKPOINT)
    agent = start("vla.run", "job=deploy", "deploy=ros2", CHECKPOINT)
    probe.until(lambda: probe.commands)
    probe.say("put the red block on the pad")
    probe.until(lambda: probe.moved() > 1e-3)
    assert start("vla.deploy.say", "").wait(30) == 0
    probe.until(lambda: probe.moved() < 1e-4)
    assert start("vla.deploy.say", "--resume", "put the blue block on the pad").wait(30) == 0
    probe.until(lambda: probe.moved() > 1e-3)
    state = start("vla.deploy.say", "--state").printed(30)
    assert "  state: running\n" in state and "inference p50 [ms]: " in state
    assert start("vla.deploy.say", "--resume", "put the blue block on the pad").wait(30) == 0  # it is running already
    reset = start("vla.deploy.say", "--reset", "put the blue block on the pad")
    assert reset.printed(30).startswith('episode 1000001: "') and reset.wait() == 0
    probe.until(lambda: probe.moved() > 1e-3)
    assert start("vla.deploy.say", "--hand-over").wait(30) == 0
    probe.spin(0.1)
    probe.commands.clear()
    probe.spin(0.5)
    assert probe.commands == []
    assert start("vla.deploy.say", "--hand-back").wait(30) == 0
    probe.until(lambda: probe.commands and probe.moved() > 1e-3)
    agent.kill()
    probe.spin(0.5)
    heard = len(probe.states)
    probe.until(lambda: len(probe.states) >= heard + 35)  # 0.7 s of the simulator, however busy the machine is
    assert probe.moved() < 1e-3
    simulator.send_signal(signal.SIGTERM)
    assert "no commands: the arm holds its pose" in simulator.printed(60)


@pytest.mark.realtime
def test_the_whole_loop_reports_and_its_bag_is_learned_from(home: Path, start: Callable[..., Started]) -> None:
    limit = "task.time_limit=1.5"
    loop = start("vla.run", "job=deploy", "deploy=loop", CHECKPOINT, limit, "deploy.episodes=2", "output=loop")
    printed = loop.printed(100)
    assert loop.wait() == 0, printed
    assert "/2 (" in printed.strip().splitlines()[-1] and "wrote loop/report.html, report.json, report.png" in printed
    report = json.loads((home / "loop/report.json").read_text())
    assert report["seeds"] == [1_000_000, 1_000_001] and report["checkpoint"] == CHECKPOINT.partition("=")[2]
    # As simulated, whatever the clock says.
    assert [(each["steps"], each["motion"]["time_s"]) for each in report["per_episode"]] == [(15, 1.5), (15, 1.5)]
    learn_from_the_bag(home)


def loop_of(output: Path, *overrides: str) -> Experiment:
    agent = ("agent=remote", "agent.url=ws://127.0.0.1:1")
    return Experiment.from_config(composed("job=deploy", "deploy=loop", *agent, f"output={output}", *overrides))


def test_an_episode_that_breaks_off_is_an_error_of_the_loop(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def play() -> Result:
        if results:
            return results.pop()
        raise UserError("timed out after 60 s")

    results = [Result(5, "success")]
    operator = SimpleNamespace(play=play, stopped=threading.Event(), values={})
    monkeypatch.setattr(Loop, "running", lambda loop: nullcontext(operator))
    with pytest.raises(ValueError, match=r"ended with an error, see .*report.json: timed out after 60 s"):
        job.run(loop_of(tmp_path))
    report = json.loads((tmp_path / "report.json").read_text())
    assert (report["successes"], report["episodes"], report["errors"], report["seeds"]) == (1, 1, 1, [5, 6])


@pytest.mark.parametrize(
    ("override", "sentence"),
    [
        ("deploy.agent.topics.commands=/other", r"deploy\.agent\.topics and deploy\.simulator\.topics differ"),
        ("deploy.simulator.network.domain=7", r"deploy\.agent\.network and deploy\.simulator\.network differ"),
        ("deploy/robot@deploy.agent.robot=fr3", r"deploy\.agent\.robot\.joints and deploy\.simulator\.robot\.joints"),
        ("deploy.agent.autostart=false", r"from an agent with deploy\.agent\.autostart"),
        ("deploy.simulator.seed=999999", "seed=999999: seeds below 1000000 are for demonstrations: raise it"),
    ],
)
def test_a_loop_that_would_report_something_else_is_refused(override: str, sentence: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=sentence):
        job.run(loop_of(tmp_path, override))


def test_a_loop_is_refused_where_there_is_a_bag_before_anything_starts(tmp_path: Path) -> None:
    (tmp_path / "bag").mkdir()
    with pytest.raises(UserError, match="bag exists already: choose another folder"):
        job.run(loop_of(tmp_path))


def test_a_loop_that_is_interrupted_before_an_episode_is_over_leaves_no_report(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (stopped := threading.Event()).set()
    operator = SimpleNamespace(stopped=stopped, values={})
    monkeypatch.setattr(Loop, "running", lambda loop: nullcontext(operator))
    job.run(loop_of(tmp_path))
    assert not [*tmp_path.iterdir()]


@pytest.mark.parametrize("name", ["vla_agent", "vla_simulator", "vla_operator"])
def test_a_loop_does_not_start_beside_nodes_that_it_would_take_for_its_own(name: str) -> None:
    names = ["vla_operator", "vla_say", name]
    node = SimpleNamespace(get_name=lambda: "vla_operator", get_node_names=lambda: names)
    with pytest.raises(UserError, match=f"{name} of another command is on the same network and domain"):
        require_alone(node)
    names.pop()
    require_alone(node)


def test_the_state_that_is_told_is_the_newest_of_those_that_a_late_subscriber_gets(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    statuses = iter([SimpleNamespace(message=text, values=[]) for text in ("stopped", "holding", "running")])

    def wait(operator: Operator, condition: Callable[[], bool], description: str) -> None:
        while not condition():
            operator.status = next(statuses, operator.status)  # type: ignore[assignment]

    monkeypatch.setattr(Operator, "wait", wait)
    operator = Operator.__new__(Operator)
    operator.status = None
    assert operator.describe() == "running"


def test_without_a_simulator_to_reset_the_agent_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    def create_client(kind: Any, service: str) -> Any:
        called.append(service)
        return SimpleNamespace(service_is_ready=lambda: "simulator" not in service)

    def wait(operator: Operator, condition: Callable[[], bool], description: str) -> None:
        if not condition():
            raise UserError(f"timed out, waiting for {description}")

    called: list[str] = []
    monkeypatch.setattr(Operator, "wait", wait)
    operator = Operator.__new__(Operator)
    operator.node = SimpleNamespace(create_client=create_client, destroy_client=lambda client: None)
    with pytest.raises(UserError, match="waiting for the service /vla_simulator/reset"):
        operator.next_episode()
    assert called == ["/vla_simulator/reset"]


def learn_from_the_bag(home: Path) -> None:
    """The other two commands of docs/ros2.md, after the one that recorded."""
    bag = ("expert=bag", "expert.folder=loop/bag", "collect.folder=lessons")
    here(home, "job=collect", CHECKPOINT, *bag)
    store = EpisodeStore(home / "lessons")
    policy = read_policy(home / "run")
    store.spec.require(policy.spec.without_truth, "the bag", "the policy")
    assert len(store.episodes) == 2
    for entry in store.episodes:
        assert 8 <= entry.steps <= 20 and "block" in entry.instruction
        rows = store.read(entry)
        assert rows["rgb_front"].std() > 5 and not entry.draws["recorded"]["person"]
        tools = [forward(joints)[0][:3, 3] for joints in rows["state"][:, :7]]
        moved = rows["action"][:6, :3].sum(0)  # within reach of the arm, that of an untrained policy
        np.testing.assert_allclose(moved, tools[6] - tools[0], atol=0.04)
        assert np.linalg.norm(moved) > 0.05
    lessons = (*SMALL, "collect.more=[lessons]", "output=wiser")
    here(home, "job=train", CHECKPOINT.replace("checkpoint", "pretrained", 1), *lessons)
    assert (home / "wiser/checkpoints/last.ckpt").is_file()


def test_arguments_of_ros_are_split_off() -> None:
    line = ["job=deploy", "--ros-args", "-r", "a:=b", "-p", "c:=1", "--", "deploy=ros2"]
    assert split_arguments(line) == (["job=deploy", "deploy=ros2"], ["--ros-args", "-r", "a:=b", "-p", "c:=1"])
    assert split_arguments(["job=train"]) == (["job=train"], [])


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["deploy=ros2", "agent=expert"], "plans no chunks of actions"),
        ([CHECKPOINT, "deploy=ros2", "deploy.network.profile=nowhere.xml"], "nowhere.xml"),
        ([CHECKPOINT, "deploy=ros2", "deploy.topics.commands='bad topic!'"], "topics.commands is 'bad topic!'"),
        ([CHECKPOINT, "deploy=ros2", "--ros-args", "--nonsense"], "--nonsense"),
        ([CHECKPOINT, "deploy=loop", "deploy.agent.command=trajectory"], "obeys deploy.agent.command=joint_state only"),
        ([CHECKPOINT, "deploy=simulator", "deploy.joints_hz=25"], "joints_hz=25 must be a multiple of the task's 10"),
        ([CHECKPOINT, "deploy=simulator", "deploy/robot=ur5e"], "the task has 7 joints, the robot 6"),
        ([CHECKPOINT, "deploy=simulator", "~deploy.topics.images.wrist"], "no topic for the task's cameras wrist"),
        ([CHECKPOINT, "deploy=ros2", "~deploy.topics.images.wrist"], "wrist"),
    ],
)
def test_invalid_deployments_end_in_one_sentence(
    home: Path, arguments: list[str], words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("vla.deploy.ros.arguments", [])
    run = vla if words == "wrist" else here
    done = run(home, "job=deploy", *arguments, ok=False)
    # The node, in a process of its own, logs its own errors, too.
    assert re.fullmatch(r"(\[ERROR\] .*\n)?error: .*\n", done.stderr) and words in done.stderr


def test_a_too_long_instruction_is_not_sent(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["say", "push " * 201])
    with pytest.raises(SystemExit, match=r"^error: the instruction has 1005 characters"):
        say.main()


def test_an_interrupted_instruction_is_not_sent(start: Callable[..., Started], probe: Probe) -> None:
    said = start("vla.deploy.say", "push the block")
    probe.until(lambda: "vla_say" in probe.node.get_node_names())
    said.send_signal(signal.SIGINT)
    assert said.wait(5) == -signal.SIGINT  # and not after the ten seconds in which it waits for an agent


def test_an_instruction_that_no_agent_obeys_is_an_error(start: Callable[..., Started], probe: Probe) -> None:
    heard: list[str] = []
    probe.node.create_subscription(String, "/user/command", lambda message: heard.append(message.data), 1)
    said = start("vla.deploy.say", "lift the block")
    probe.until(lambda: heard)  # as by a recorder
    assert said.wait(30) == 1 and "waiting for /vla_agent to subscribe to /user/command" in said.printed()
    assert heard == ["lift the block"]
    agent = LifecycleNode("vla_agent", context=probe.context)
    agent.create_subscription(String, "/user/command", lambda message: None, 1)
    probe.executor.add_node(agent)
    with ThreadPoolExecutor() as threads:
        said = threads.submit(start("vla.deploy.say", "push the block").printed, 30)
        probe.until(said.done)
    assert "unconfigured and ignores instructions: ros2 lifecycle set /vla_agent configure, ros2 life" in said.result()
    agent.destroy_node()


def test_without_ros_the_error_says_what_to_install(home: Path, tmp_path: Path) -> None:
    (tmp_path / "rclpy.py").write_text("raise ImportError('not here')")
    done = vla(tmp_path, "job=deploy", "deploy=ros2", f"checkpoint={home / 'run'}", ok=False)
    assert "vla[ros]" in done.stderr and "not here" in done.stderr and "Traceback" not in done.stderr


def test_a_policy_is_deployed_where_nothing_renders(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(backend, "PROBE", "raise SystemExit(1)")
    for name in ("MUJOCO_GL", "DISPLAY", backend.WORKING_BACKEND, backend.FAILED_BACKENDS):
        monkeypatch.setenv(name, "")  # so that what the code sets is undone, too
        monkeypatch.delenv(name)
    backend.choose_backend()
    assert os.environ["MUJOCO_GL"] == "disabled"
    for task in ("tabletop", "metaworld", "libero"):
        with pytest.raises(UserError, match="this machine cannot render with MUJOCO_GL=egl or osmesa"):
            make_environment(to_plain(composed(f"task={task}"))["task"])
    for name in ("MUJOCO_GL", backend.FAILED_BACKENDS):
        monkeypatch.delenv(name)
    monkeypatch.setenv("DISPLAY", ":99")  # which nobody serves
    backend.choose_backend()
    with pytest.raises(UserError, match="MUJOCO_GL=glfw or egl or osmesa"):
        backend.require_backend()


def test_a_middleware_that_ignores_the_profile_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RMW_IMPLEMENTATION", "rmw_cyclonedds_cpp")
    with pytest.raises(ValueError, match="rmw_cyclonedds_cpp, which ignores the profile"):
        RosNetwork("loopback", None, None).apply()
    RosNetwork("localhost", None, None).apply()
    monkeypatch.setenv("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp")
    RosNetwork("loopback", None, None).apply()


def test_a_ros_installation_finds_the_node(tmp_path: Path) -> None:
    prefix = Path(sysconfig.get_path("data"))
    assert (prefix / "share/ament_index/resource_index/packages/vla").is_file()
    package = ElementTree.parse(prefix / "share/vla/package.xml").getroot()
    assert package.findtext("name") == "vla" and package.find("maintainer") is not None
    compile((prefix / "share/vla/launch/agent.launch.py").read_text(), "agent.launch.py", "exec")
    agent, python = tmp_path / "lib/vla/agent", tmp_path / "bin/python"  # an installation whose Python does nothing
    for file in (agent, python):
        file.parent.mkdir(parents=True)
    shutil.copy(prefix / "lib/vla/agent", agent)
    python.write_text('#!/bin/sh\necho "$@"')
    python.chmod(0o700)
    done = subprocess.run([agent, "checkpoint=my run"], capture_output=True, text=True, check=True)
    assert done.stdout == "-m vla.run job=deploy deploy=ros2 checkpoint=my run\n"


EPISODE = {
    **{"seed": 1, "instruction": "lift it", "done": False, "steps": 7, "seconds": 0.7},
    **{"outcome": "timeout", "task": "", "milestones": ["near"]},
}


@pytest.mark.parametrize(
    "wrong",
    [
        *("{", "[" * 10**5, "{}"),
        *(json.dumps({**EPISODE, **each}) for each in ({"seed": -1}, {"outcome": None}, {"instruction": "a" * 1001})),
    ],
    ids=lambda text: text[:40],
)
def test_the_operator_drops_messages_that_no_simulator_sends(wrong: str, caplog: pytest.LogCaptureFixture) -> None:
    operator = DemoOperator.__new__(DemoOperator)
    operator._on_episode(String(data=json.dumps(EPISODE)))
    known = operator._episode
    assert known == SimulatedEpisode(1, "lift it", False, 7, 0.7, "timeout", "", ("near",))
    operator._on_episode(String(data=wrong))
    assert operator._episode == known
    dropped = "dropped a message: /vla_simulator/episode is damaged or of another kind"
    assert dropped in caplog.text
