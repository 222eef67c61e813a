"""The policy as a ROS 2 node: real rclpy, real middleware on the loopback, simulated cameras and arm."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from arm import FORWARD, ROBOT, SAFETY, SPEC
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticStatus
from fake_batch import as_policy, make_bc
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import GetState
from rclpy.duration import Duration
from sensor_msgs.msg import Image, JointState
from std_msgs.msg import Float64MultiArray
from test_server import remote, serving
from world import World, positions

from vla.deploy.client_observation import Keys
from vla.deploy.lifecycle_node import LATCHED_QOS
from vla.deploy.safety import State
from vla.robots.panda import HOME

pytestmark = pytest.mark.realtime

FROZEN = Time(sec=5, nanosec=5)
PER_JOINT = ("joints", "low", "high", "speed", "acceleration")


@pytest.fixture
def world(make_world: Callable[..., World]) -> World:
    """A world whose arm the agent moves."""
    world = make_world()
    world.start()
    assert world.becomes(State.RUNNING), world.loop.reason
    return world


def test_observations_are_those_of_the_messages_and_move_the_arm_from_its_measured_pose(world: World) -> None:
    seen, first = world.policy.seen[-1], world.commands[0]
    assert seen.instruction == "put the red block on the pad" and set(seen.rgb) == {"front", "wrist"}
    assert seen.state[14] == pytest.approx(0.08) and seen.truth is None
    assert np.abs(seen.state[:7] - world.joints).max() < 0.2  # in the order of the spec, not of the message
    assert first.name == ROBOT.joints  # until the policy moves it, the gripper stays as it is
    np.testing.assert_allclose(first.position[:7], HOME)
    assert list(first.velocity) == list(first.effort) == []
    world.live(1.0)
    assert world.commands[-1].name == [*ROBOT.joints, *ROBOT.fingers]
    steps = np.diff([command.position[:7] for command in world.commands], axis=0)
    assert np.abs(steps).sum() > 0.1
    assert (np.abs(steps) <= ROBOT.max_speed * 0.02 + 1e-9).all()
    assert world.told["state"] == "running" and float(world.told["inference p99 [ms]"]) > 0
    assert world.statuses[-1].level == DiagnosticStatus.OK


def test_a_bug_in_a_callback_stops_the_arm_and_not_the_process(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(world.loop.observer, "add_image", lambda *_: 1 / 0)
    assert world.becomes(State.FAULT)
    world.live(0.4)
    assert world.commands[-1].position == world.commands[-5].position
    assert "internal error of the agent" in world.statuses[-1].message


def test_a_policy_server_that_goes_away_leaves_the_arm_at_rest(
    make_world: Callable[..., World], monkeypatch: pytest.MonkeyPatch
) -> None:
    cameras = {camera: f"observation/{camera}" for camera in SPEC.cameras}
    policy, world = as_policy(make_bc(spec=SPEC), spec=SPEC), make_world()
    with serving(policy, keys=Keys(cameras, ["observation/state"], "prompt")) as url:
        agent = remote(url, images=cameras, spec=SPEC)
        monkeypatch.setattr(world.policy, "plan", lambda seen: world.policy.seen.append(seen) or agent.plan(seen))
        world.start()
        world.live(0.5)
        assert (
            world.state is State.RUNNING and np.ptp([each.position[:7] for each in world.commands], axis=0).max() > 0.01
        )
    assert world.becomes(State.FAULT)
    world.live(0.4)
    assert world.commands[-1].position == world.commands[-5].position
    assert f"the policy server at {url} failed: it closed the connection" in world.statuses[-1].message


def test_invalid_images_hold_the_arm(world: World, capfd: pytest.CaptureFixture[str]) -> None:
    """Truncated ones, those of a frozen clock or one that is ahead, and older ones than differing clocks explain."""
    invalid: dict[str, Callable[[Image], None]] = {
        "bytes": lambda image: setattr(image, "data", image.data[:-1]),
        "same time stamp": lambda image: setattr(image.header, "stamp", FROZEN),
        "camera front: its time stamp is 3600 s old": lambda image: setattr(
            image.header.stamp, "sec", image.header.stamp.sec - 3600
        ),
        "s in the future: synchronise the clocks": lambda image: setattr(
            image.header.stamp, "sec", image.header.stamp.sec + 2
        ),
        "front: its time stamp is 36": lambda image: setattr(image.header.stamp, "sec", image.header.stamp.sec + 3650),
    }
    for words, world.changed in invalid.items():
        assert world.becomes(State.HOLDING)
        world.live(0.4)
        assert world.state is State.HOLDING and words in capfd.readouterr().err
        world.changed = lambda image: None
        assert world.becomes(State.RUNNING)
    assert int(world.told["messages dropped"]) > 9


def test_simulated_time_stamps_the_images_and_holds_the_arm_when_it_is_frozen(make_world: Callable[..., World]) -> None:
    world = make_world("joint_state", "--ros-args", "-p", "use_sim_time:=true")
    world.simulated = 50.0
    world.start()
    assert world.becomes(State.RUNNING), world.loop.reason
    assert world.agent.get_clock().now().nanoseconds * 1e-9 == pytest.approx(world.simulated, abs=5)
    frozen = world.simulated
    world.changed = lambda image: setattr(image.header, "stamp", Time(sec=int(frozen)))
    world.live(0.8)
    assert world.state is State.HOLDING


def test_of_a_chunk_as_much_is_executed_as_in_evaluation(world: World) -> None:
    world.policy.chunk, world.policy.execute = 8, 3
    world.live(0.5)
    before = len(world.policy.seen)
    world.live(1.2)
    assert 3 <= len(world.policy.seen) - before <= 5
    world.policy.history, before = 2, len(world.policy.seen)
    world.live(1.0)
    assert len(world.policy.seen) - before >= 6  # of 10 frames: in training, those of a history have no gaps


def test_a_chunk_that_the_next_one_continues_goes_on_meanwhile(make_world: Callable[..., World]) -> None:
    world = make_world()
    world.policy.chunk, world.policy.execute, world.policy.takes = 8, 2, 0.25
    world.policy.chunking = object()
    world.start()
    assert world.becomes(State.RUNNING)
    world.live(2.0)
    assert world.loop.late_plans == 0
    rests = [seen.running for seen in world.policy.seen if seen.running is not None]
    assert len(rests) >= 2 and {rest.delay for rest in rests} <= {1, 2, 3, 4, 5} and rests[-1].delay >= 3
    for rest in rests:
        assert rest.delay <= len(rest.actions) <= 6
        np.testing.assert_array_equal(rest.actions, np.repeat(FORWARD, len(rest.actions), 0))


def test_a_policy_that_fails_is_a_fault_that_only_deactivation_ends(world: World) -> None:
    world.policy.fails = True
    assert world.becomes(State.FAULT)
    world.live(0.4)
    assert world.commands[-1].position == world.commands[-5].position
    world.policy.fails = False
    assert not world.trigger("resume").success
    assert world.change(Transition.TRANSITION_DEACTIVATE) and world.change(Transition.TRANSITION_ACTIVATE)
    assert world.becomes(State.WAITING)


def test_a_person_takes_the_arm_over_and_hands_it_back(world: World) -> None:
    assert world.hand_over(True).success
    world.live(0.1)
    world.commands.clear()
    person = world.node.create_publisher(JointState, "/commands", 1)
    world.live(1.2)
    assert world.commands == [] and world.state is State.HANDED_OVER
    assert world.told["handed over"] == "yes"
    refused = world.hand_over(False)
    assert not refused.success and "1 other publisher(s) on /commands" in refused.message
    world.node.destroy_publisher(person)
    world.joints = world.joints + 0.1
    world.live(0.5)
    left = world.joints
    assert world.hand_over(False).success
    world.live(5.0, until=lambda: world.commands)
    assert world.commands[0].name == ROBOT.joints  # the gripper stays as it is
    np.testing.assert_allclose(world.commands[0].position, left)
    assert world.becomes(State.RUNNING)
    steps = np.diff([command.position[:7] for command in world.commands], axis=0)
    assert (np.abs(steps) <= ROBOT.max_speed * 0.02 + 1e-9).all()


def test_a_dry_run_commands_nothing_and_tells_what_it_would(make_world: Callable[..., World]) -> None:
    """With compressed images."""
    world = make_world(dry_run=True, compressed=True)
    would: list[JointState] = []
    world.node.create_subscription(JointState, "/vla_agent/dry_run/commands", would.append, 100)
    world.start(lambda: would)
    world.live(1.5)
    assert world.commands == [] and world.state is State.RUNNING
    moved = np.abs(np.array([command.position[:7] for command in would]) - HOME).max()
    assert 1e-3 < moved < 0.1 and (world.joints == HOME).all()
    assert world.told["handed over"] == "yes"


def test_an_instruction_that_is_ignored_after_a_stop_is_reported(
    world: World, capfd: pytest.CaptureFixture[str]
) -> None:
    assert world.trigger("stop").success
    world.live(0.6)
    assert world.commands[-1].position == world.commands[-5].position
    world.say("put the blue block on the pad")
    said = (
        "instruction ignored while stopped: 'put the blue block on the pad'; stopped by request; to continue: python -m"
    )
    world.live(5.0, until=lambda: world.statuses[-1].message.startswith(said))
    world.live(0.2)
    assert world.statuses[-1].message.startswith(said)
    assert world.state is State.STOPPED and capfd.readouterr().err.count(said) == 1
    assert world.trigger("resume").success
    assert world.becomes(State.RUNNING)
    world.live(5.0, until=lambda: world.policy.seen[-1].instruction == "put the blue block on the pad")
    assert world.policy.seen[-1].instruction == "put the blue block on the pad"


def test_an_agent_that_an_instruction_has_resumed_is_resumed_but_not_one_with_a_fault(
    make_world: Callable[..., World],
) -> None:
    world = make_world(safety=replace(SAFETY, instruction=0.5))
    world.start()
    assert world.becomes(State.RUNNING) and world.becomes(State.STOPPED)
    world.say("put the blue block on the pad")
    assert world.becomes(State.HOLDING)
    assert world.trigger("resume").success
    world.agent.fail("it broke")
    refused = world.trigger("resume")
    assert not refused.success and refused.message.startswith("nothing to resume: it broke; to continue: deactivate")


def test_joint_states_that_are_late_or_frozen_hold_the_arm(world: World, capfd: pytest.CaptureFixture[str]) -> None:
    def stamp(state: JointState) -> None:
        now = world.node.get_clock().now().to_msg()
        state.header.stamp = frozen if behind is None else Time(sec=now.sec - behind, nanosec=now.nanosec)

    behind: int | None
    frozen, world.measured = world.node.get_clock().now().to_msg(), stamp
    for after, words in ((2, ""), (None, "joint states: two messages have the same time stamp")):
        behind = 0
        assert world.becomes(State.RUNNING)
        world.live(0.4)
        assert world.state is State.RUNNING
        behind = after
        world.live(0.8)
        assert world.state is State.HOLDING
        assert world.statuses[-1].message.startswith("no joint state within the last 0.2 s")
        assert words in capfd.readouterr().err


def test_a_stop_is_not_replaced_by_the_instruction_that_follows_it(world: World) -> None:
    world.say("")
    world.words.wait_for_all_acked(Duration(seconds=5))  # while the node is busy with something else
    world.say("put the red block on the pad")
    assert world.becomes(State.STOPPED)
    world.live(0.5)
    assert world.state is State.STOPPED


def test_an_instruction_too_long_is_dropped_and_the_former_one_followed(
    world: World, capfd: pytest.CaptureFixture[str]
) -> None:
    world.say("push " * 10**5)
    world.live(1.0)
    assert world.becomes(State.RUNNING) and world.policy.seen[-1].instruction == "put the red block on the pad"
    printed = capfd.readouterr().err
    assert "an instruction of 500000 characters, the limit is 1000" in printed and len(printed) < 2000
    world.say(("push " * 200).strip())
    world.live(5.0, until=lambda: world.policy.seen[-1].instruction.startswith("push"))
    assert len(world.policy.seen[-1].instruction) == 999 and len(world.told["instruction"]) <= 80


def test_another_node_that_commands_the_arm_is_a_fault_and_one_that_sends_images_holds_it(world: World) -> None:
    camera = world.node.create_publisher(Image, "/front", 1)
    assert world.becomes(State.HOLDING)
    states = list[State]()
    world.live(1.5, until=lambda: states.append(world.state))  # longer than the time from one check to the next
    assert {*states} == {State.HOLDING}
    world.node.destroy_publisher(camera)
    assert world.becomes(State.RUNNING)
    other = world.node.create_publisher(JointState, "/commands", 1)
    assert world.becomes(State.FAULT)
    assert world.change(Transition.TRANSITION_DEACTIVATE)
    assert not world.change(Transition.TRANSITION_ACTIVATE)
    world.node.destroy_publisher(other)


def test_wrong_requests_of_the_lifecycle_are_refused_and_survived(world: World) -> None:
    assert not world.change(Transition.TRANSITION_CONFIGURE)
    assert not world.change(99)
    world.live(0.2)
    assert world.state is State.RUNNING
    assert world.change(Transition.TRANSITION_DEACTIVATE)
    assert not world.change(Transition.TRANSITION_DEACTIVATE)
    assert world.change(Transition.TRANSITION_CLEANUP)
    assert world.ask(GetState, "get_state", GetState.Request()).current_state.label == "unconfigured"
    world.start()
    assert world.becomes(State.RUNNING)


def test_deactivation_brakes_first(world: World) -> None:
    world.live(0.4)
    count = len(world.commands)
    assert world.change(Transition.TRANSITION_DEACTIVATE)
    world.spin(lambda: len(world.commands) > count)
    world.live(0.2)
    steps = np.diff([command.position[:7] for command in world.commands], axis=0)
    assert np.abs(steps[count // 2 : count]).max() > 0 and not steps[-1].any()
    change = np.abs(np.diff(steps, axis=0)).max(0)
    assert (change <= ROBOT.max_acceleration * 0.02**2 + 1e-9).all()


@pytest.mark.parametrize("command", ["trajectory", "forward"])
def test_limits_hold_from_one_message_to_the_next(make_world: Callable[..., World], command: str) -> None:
    """Though the goals jump; a trajectory begins where the one before has led by then."""
    world = make_world(command, robot=replace(ROBOT, speed_share=0.25, acceleration_share=0.05))
    generator = np.random.default_rng(0)
    world.policy.action = lambda: generator.uniform(SPEC.low, SPEC.high, (1, 7)).astype(np.float32)
    world.start()
    world.live(1.5)
    reached, before = list[np.ndarray](), positions(world.commands[0])
    fastest, hardest = 0.25 * np.array(ROBOT.speed), 0.05 * np.array(ROBOT.acceleration)
    for ahead in map(positions, world.commands):
        speeds = np.diff([*(reached[-2:] if command != "trajectory" else ()), *ahead], axis=0) / 0.02
        assert (np.abs(speeds) <= fastest + 1e-9).all()
        assert (np.abs(np.diff(speeds, axis=0)) / 0.02 <= hardest + 1e-6).all()
        assert (np.abs(before - ahead[0]) <= 2 * fastest * 0.02).all(1).any()
        reached.append(ahead[0])
        before = ahead
    assert len(reached) > 50 and np.ptp(reached, axis=0).max() > 0.05


def test_trajectories_end_at_rest_and_plain_positions_have_fingers_of_their_own(
    make_world: Callable[..., World],
) -> None:
    world = make_world("trajectory")
    fingers: list[Float64MultiArray] = []
    world.node.create_subscription(Float64MultiArray, "/gripper", fingers.append, 10)
    world.start()
    world.live(0.3)
    message = max(world.commands, key=lambda command: len(command.points))
    assert list(message.joint_names) == ROBOT.joints and len(message.points) > 3
    assert not any(message.points[-1].velocities)
    assert list(fingers[-1].data) == [0.04, 0.04]


def test_ros_arguments_remap(make_world: Callable[..., World]) -> None:
    world = make_world("joint_state", "--ros-args", "-r", "/front:=/isaac/front/compressed")
    assert world.change(Transition.TRANSITION_CONFIGURE)
    kinds = dict(world.agent.get_topic_names_and_types())
    assert kinds["/isaac/front/compressed"] == ["sensor_msgs/msg/CompressedImage"]  # of the name that is listened to


def test_whoever_comes_later_gets_the_last_status(make_world: Callable[..., World]) -> None:
    world, late = make_world(), list[DiagnosticStatus]()
    policy: Any = world.policy
    policy.chunk, policy.execute, policy.history, policy.chunking = 8, 4, 2, object()
    assert world.change(Transition.TRANSITION_CONFIGURE)
    world.node.create_subscription(DiagnosticStatus, "/vla_agent/status", late.append, LATCHED_QOS)
    world.spin(lambda: late)
    assert world.loop._execute == 1  # a history sees every step


def test_a_gripper_that_nothing_commands_is_told(
    make_world: Callable[..., World], capfd: pytest.CaptureFixture[str]
) -> None:
    world = make_world("trajectory")
    world.settings.topics = replace(world.settings.topics, gripper=None)
    assert world.change(Transition.TRANSITION_CONFIGURE)
    assert "moves a gripper, and nothing commands it" in capfd.readouterr().err


def test_a_robot_that_does_not_fit_refuses_to_configure(make_world: Callable[..., World]) -> None:
    world = make_world()
    world.settings.robot = replace(ROBOT, **{name: getattr(ROBOT, name)[:2] for name in PER_JOINT})
    assert not world.change(Transition.TRANSITION_CONFIGURE)
    assert world.ask(GetState, "get_state", GetState.Request()).current_state.label == "unconfigured"
