"""Arms and grippers that listen to actions: real rclpy, with servers that answer as the real ones."""

from __future__ import annotations

import itertools
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from arm import FORWARD, ROBOT, SAFETY, SPEC
from defaults import defaults_of
from lifecycle_msgs.msg import Transition
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.task import Future
from sensor_msgs.msg import JointState
from world import TOPICS, World

from vla.deploy import actions
from vla.deploy.bag import open_bag
from vla.deploy.bag_import import BagDemonstrations
from vla.deploy.record import BagRecorder
from vla.deploy.ros import RosNetwork
from vla.deploy.ros2 import PolicyDeployment
from vla.deploy.safety import State
from vla.deploy.settings import FrankaGripper, GripperCommand
from vla.robots.panda import HOME, forward
from vla.spec import Array

pytestmark = [
    pytest.mark.realtime,
    pytest.mark.usefixtures("action_packages"),
    pytest.mark.filterwarnings("ignore:coroutine"),  # goals that a server still executes at the end of a test
]

FOLLOW = "follow_joint_trajectory"


class Controller:
    """An action server whose goals a test ends; a new goal aborts the one before."""

    def __init__(self, node: Any, kind: Any, name: str) -> None:
        self.goals: list[Any] = []
        self.ended: list[str] = []  # how goals ended, in this order
        self.accepts, self.takes = True, 0.0  # goals, after so long [s]
        self._kind = kind
        self._running: tuple[Any, Future] | None = None
        self.server = ActionServer(
            *(node, kind, name, self._execute),
            goal_callback=self._on_goal,
            cancel_callback=lambda handle: CancelResponse.ACCEPT,
        )

    @property
    def running(self) -> bool:
        """Whether a goal is executed."""
        return self._running is not None

    @property
    def cancelled(self) -> bool:
        """Whether the client has cancelled the goal that is executed."""
        return self._running is not None and bool(self._running[0].is_cancel_requested)

    def _on_goal(self, goal: Any) -> GoalResponse:
        time.sleep(self.takes)
        return GoalResponse.ACCEPT if self.accepts else GoalResponse.REJECT

    async def _execute(self, handle: Any) -> Any:
        if self._running is not None:
            self.end("abort", **self.replaced)
        done = Future()
        self._running = handle, done
        self.goals.append(handle.request)
        self.begin(handle.request)
        how, result = await done
        getattr(handle, how)()
        self.ended.append(how)
        return result

    replaced: ClassVar[dict[str, Any]] = {}  # what the result of a replaced goal says

    def begin(self, goal: Any) -> None:
        """Begin to execute a goal."""

    def end(self, how: str, **result: Any) -> None:
        """End the goal that is executed: succeed, abort, or as a cancelled one."""
        assert self._running is not None
        (_, done), self._running = self._running, None
        done.set_result((how, self._kind.Result(**result)))

    def obey(self) -> None:
        """End a goal that the client has cancelled."""
        if self.cancelled:
            self.end("canceled")


class TrajectoryController(Controller):
    """Plays the joint_trajectory_controller: `follow` moves the arm."""

    replaced: ClassVar[dict[str, Any]] = {
        "error_code": -1,
        "error_string": "Current goal cancelled due to new incoming action.",
    }

    def begin(self, goal: Any) -> None:
        """Forget the trajectory before."""
        points = goal.trajectory.points
        self._start = time.monotonic()
        self._times = np.array([point.time_from_start.sec + 1e-9 * point.time_from_start.nanosec for point in points])
        self._positions = np.array([point.positions for point in points])

    def follow(self, joints: Array) -> Array:
        """Return where the trajectory is now; without one the arm stays."""
        self.obey()
        if not self.running:
            return joints
        passed = time.monotonic() - self._start
        if passed >= self._times[-1]:
            self.end("succeed")
            return self._positions[-1]
        times, positions = [0.0, *self._times], np.vstack([joints, self._positions])
        return np.array([np.interp(passed, times, each) for each in positions.T])


def controlled(world: World) -> TrajectoryController:
    """Give the world's arm a trajectory controller."""
    from control_msgs.action import FollowJointTrajectory

    controller = TrajectoryController(world.node, FollowJointTrajectory, "/commands")
    world.follow = controller.follow
    return controller


def speeds(goal: Any) -> np.ndarray:
    return np.diff([point.positions for point in goal.trajectory.points], axis=0) / 0.02


def test_an_arm_follows_trajectories_that_replace_each_other(make_world: Callable[..., World]) -> None:
    world = make_world(FOLLOW, robot=replace(ROBOT, speed_share=0.25, acceleration_share=0.2))
    controller = controlled(world)
    world.start()
    assert list(controller.goals[0].trajectory.joint_names) == ROBOT.joints
    np.testing.assert_allclose(controller.goals[0].trajectory.points[0].positions, HOME)
    seen = len(world.policy.seen)
    controller.goals.clear()
    world.live(1.0)
    assert world.state is State.RUNNING and "abort" in controller.ended
    assert 3 < len(controller.goals) <= len(world.policy.seen) - seen + 2  # one per plan
    assert np.abs(world.joints - HOME).max() > 0.02
    for goal in controller.goals:
        assert not any(goal.trajectory.points[-1].velocities)
        assert (np.abs(speeds(goal)) <= 0.25 * np.array(ROBOT.speed) + 1e-9).all()
        assert (np.abs(np.diff(speeds(goal), axis=0)) <= 0.2 * np.array(ROBOT.acceleration) * 0.02 + 1e-9).all()
    for before, after in itertools.pairwise(controller.goals):
        ahead = np.array([point.positions for point in before.trajectory.points])
        off = np.abs(ahead - after.trajectory.points[0].positions).max(1).min()
        assert off <= 2 * 0.2 * max(ROBOT.acceleration) * 0.02**2 + 1e-9  # it goes on where the arm is
    assert world.commands[-1].name == [*ROBOT.joints, *ROBOT.fingers]


def test_hand_over_cancels_what_is_executed_and_the_arm_is_taken_back_where_it_was_left(
    make_world: Callable[..., World],
) -> None:
    world = make_world(FOLLOW)
    controller = controlled(world)
    world.start()
    world.live(0.3)
    assert world.hand_over(True).success
    world.live(0.5)
    assert not any(controller.goals[-1].trajectory.points[-1].velocities) and not controller.running
    count, world.joints = len(controller.goals), world.joints + 0.1
    world.live(0.6)
    assert len(controller.goals) == count and world.state is State.HANDED_OVER
    left = world.joints
    assert world.hand_over(False).success
    world.live(5.0, until=lambda: len(controller.goals) > count)
    np.testing.assert_allclose(controller.goals[count].trajectory.points[0].positions, left)
    assert world.becomes(State.RUNNING)


def test_a_server_that_fails_stops_the_policy_with_its_name_and_the_reason(
    make_world: Callable[..., World], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A violated tolerance, another client's goal, a rejection, silence, and an end."""
    world = make_world(FOLLOW)
    controller = controlled(world)
    world.start()

    def fails(saying: str) -> None:
        world.live(5.0, until=lambda: world.state is State.FAULT)
        reason = world.loop.reason
        assert reason.startswith(saying) and "to continue: deactivate and activate" in reason, reason
        world.live(0.2)
        resting = world.joints
        world.live(0.1)
        np.testing.assert_array_equal(world.joints, resting)
        assert world.change(Transition.TRANSITION_DEACTIVATE)
        controller.accepts = True

    def goes_on() -> None:
        assert world.change(Transition.TRANSITION_ACTIVATE)
        world.say("put the red block on the pad")
        assert world.becomes(State.RUNNING)
        world.live(0.3, until=lambda: controller.running)

    world.live(1.0, until=lambda: controller.running)
    controller.end("abort", error_code=-4, error_string="panda_joint2 is 0.3 rad off")
    fails("the action server /commands aborted a goal: error code -4, panda_joint2 is 0.3 rad off")
    goes_on()
    for _ in range(20):  # goals of another client: the next own one may be under way and replace them
        if controller.running:
            controller.end("abort", **controller.replaced)
        world.live(0.1, until=lambda: world.state is State.FAULT)
    fails("the action server /commands aborted a goal: error code -1, Current goal cancelled due to new incoming")
    goes_on()
    controller.accepts = False
    fails("the action server /commands rejected a goal")
    goes_on()
    monkeypatch.setattr(actions, "ANSWER", 0.02)
    controller.takes = 0.1
    fails("the action server /commands has not answered a goal for 0.02 s")
    world.live(3.0, until=lambda: controller.running and controller.cancelled)  # accepted too late
    controller.obey()
    world.live(3.0, until=lambda: controller.ended[-1] == "canceled")
    assert controller.ended[-1] == "canceled"
    monkeypatch.setattr(actions, "ANSWER", 1.0)
    controller.takes = 0.0
    goes_on()
    controller.server.destroy()
    fails("the action server /commands has vanished")
    monkeypatch.setattr(actions, "PATIENCE", 0.1)
    assert not world.change(Transition.TRANSITION_ACTIVATE)


GRIPPERS = {
    "GripperCommand": GripperCommand(**defaults_of("deploy/gripper/gripper_command")),
    "franka": FrankaGripper(**defaults_of("deploy/gripper/franka")),
}


def test_a_gripper_goal_that_was_cancelled_before_the_activation_is_no_failure_after_it(
    make_world: Callable[..., World],
) -> None:
    from control_msgs.action import GripperCommand as Kind

    world = make_world("joint_state", gripper=GRIPPERS["GripperCommand"])
    gripper = Controller(world.node, Kind, "/gripper")
    world.start()
    world.live(2.0, until=lambda: gripper.running)
    assert world.change(Transition.TRANSITION_DEACTIVATE)
    world.live(2.0, until=lambda: gripper.cancelled)
    assert world.change(Transition.TRANSITION_ACTIVATE)
    gripper.obey()
    world.live(0.5)
    assert gripper.ended == ["canceled"] and world.state is not State.FAULT


@pytest.mark.parametrize("name", GRIPPERS)
def test_a_gripper_is_told_once_per_change_and_a_grasp_is_no_error(make_world: Callable[..., World], name: str) -> None:
    world = make_world("joint_state", gripper=GRIPPERS[name])
    if name == "franka":
        from franka_msgs.action import Grasp, Move

        close, open_ = Controller(world.node, Grasp, "/gripper/grasp"), Controller(world.node, Move, "/gripper/move")
        grasped, fault = {"success": False}, {"success": False, "error": "libfranka: connection lost"}
    else:
        from control_msgs.action import GripperCommand as Kind

        close = open_ = Controller(world.node, Kind, "/gripper")
        grasped, fault = {"stalled": True}, {"stalled": False}

    def policy(opening: float) -> None:
        world.policy.action = lambda: np.append(FORWARD[:, :6], [[opening]], 1).astype(np.float32)

    def told(controller: Controller) -> Any:
        world.live(2.0, until=lambda: controller.running)
        world.live(0.2)
        assert controller.running
        return controller.goals[-1]

    world.start()
    goal = told(open_)
    assert len(open_.goals) == 1 and world.state is State.RUNNING
    assert (goal.width if name == "franka" else goal.command.position) == GRIPPERS[name].open
    open_.end("succeed", **({"success": True} if name == "franka" else {"reached_goal": True}))
    for opening in (0.5, 0.3, 0.5, 0.3):  # once it is clearly closed
        policy(opening)
        world.live(0.2)
    goal = told(close)
    assert len({*map(id, [*open_.goals, *close.goals])}) == 2
    assert (goal.width if name == "franka" else goal.command.position) == 0.0
    close.end("abort", **grasped)
    world.live(0.3)
    assert world.state is State.RUNNING
    policy(1.0)
    told(open_)
    open_.end("abort", **fault)
    assert world.becomes(State.FAULT)
    assert "aborted a goal: " in world.loop.reason
    assert world.loop.reason.startswith(f"the action server /gripper{'/move' if name == 'franka' else ''}")


def undecided(make_world: Callable[..., World]) -> tuple[World, Controller, Controller]:
    """A policy that wants to close the gripper while that opens; the controllers of both."""
    from franka_msgs.action import Grasp, Move

    world = make_world("joint_state", gripper=GRIPPERS["franka"])
    grasp, move = Controller(world.node, Grasp, "/gripper/grasp"), Controller(world.node, Move, "/gripper/move")
    world.start()
    world.live(1.0, until=lambda: move.running)
    world.policy.action = lambda: np.append(FORWARD[:, :6], [[0.0]], 1).astype(np.float32)
    world.live(0.6)
    assert move.running and not grasp.goals
    return world, grasp, move


def test_a_gripper_that_changes_its_mind_cancels_first(make_world: Callable[..., World]) -> None:
    world, grasp, move = undecided(make_world)
    move.obey()
    world.live(1.0, until=lambda: grasp.running)
    assert grasp.running and grasp.goals[0].force == 20.0 and grasp.goals[0].epsilon.outer == 0.08


def test_after_a_stop_no_goal_of_the_gripper_follows(make_world: Callable[..., World]) -> None:
    world, grasp, move = undecided(make_world)
    world.loop.stop("by hand")
    world.live(0.3)
    move.obey()
    world.live(0.6)
    assert not grasp.goals and not move.running
    assert world.loop.resume(time.monotonic())
    world.live(2.0, until=lambda: grasp.running)
    assert grasp.running


def test_a_dry_run_sends_no_goal(make_world: Callable[..., World]) -> None:
    world = make_world(FOLLOW, dry_run=True, gripper=GRIPPERS["GripperCommand"])
    would: list[JointState] = []
    world.node.create_subscription(JointState, "/vla_agent/dry_run/commands", would.append, 100)
    controller = controlled(world)
    world.start(lambda: would)
    world.live(0.3)
    assert world.state is State.RUNNING and controller.goals == [] and world.commands == []


def test_what_goals_command_is_recorded_and_imported(make_world: Callable[..., World], tmp_path: Path) -> None:
    world = make_world(FOLLOW)
    controlled(world)
    recorder = BagRecorder(world.node, tmp_path / "bag")
    world.start()
    world.live(1.2)
    recorder.close()
    topics = replace(TOPICS, commands="/vla_agent/commands", gripper=None)
    imported = BagDemonstrations(tmp_path / "bag", topics, ROBOT, spec=SPEC)
    (episode,) = map(imported.episode, range(len(imported)))
    places = [forward(np.array(command.position[:7]))[0][0, 3] for command in world.commands]
    assert len(episode.actions) > 5 and np.abs(episode.actions[:, 1:6]).max() < 1e-3
    assert 0.5 * np.ptp(places) < episode.actions[:, 0].sum() < np.ptp(places) + 1e-3 and np.ptp(places) > 0.02


def test_a_topic_of_an_unknown_type_does_not_end_a_recording(
    make_world: Callable[..., World], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    node = make_world().node
    kinds = {"/of_anybody": "std_msgs/msg/Nothing", "/words": "std_msgs/msg/String"}
    topics = [(topic, [kind]) for topic, kind in kinds.items()]
    monkeypatch.setattr(node, "get_topic_names_and_types", lambda: topics)
    BagRecorder(node, tmp_path / "bag").close()
    with open_bag(tmp_path / "bag") as reader:
        assert [connection.topic for connection in reader.connections] == ["/words"]


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ({"command": FOLLOW}, "control_msgs/action/FollowJointTrajectory is not installed: apt install ros-jazzy-cont"),
        ({"gripper": GRIPPERS["franka"]}, "franka_msgs/action/Grasp is not installed: build franka_ros2, and source"),
        ({}, "ROS 2 is not installed"),
    ],
)
def test_what_is_not_installed_is_named_before_anything_else(
    monkeypatch: pytest.MonkeyPatch, changed: dict[str, Any], says: str
) -> None:
    monkeypatch.setattr(RosNetwork, "apply", lambda network: None)
    for module in ("rclpy", "control_msgs", "franka_msgs"):
        monkeypatch.setitem(sys.modules, module, None)
        monkeypatch.setitem(sys.modules, f"{module}.action", None)

    def unexpected() -> Any:
        raise AssertionError("something else was done")

    options = {"command": "joint_state", "gripper": None, **changed}
    deployment = PolicyDeployment(
        **defaults_of("deploy/ros2", **options),
        **{"robot": ROBOT, "network": RosNetwork("loopback", None, None), "topics": TOPICS, "safety": SAFETY},
        **{"policy": unexpected, "environment": unexpected, "output": Path()},
    )
    with pytest.raises(ValueError, match=says) as refused:
        deployment.run()
    assert "\n" not in str(refused.value)
