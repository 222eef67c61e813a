"""The control loop: fresh inputs move the arm, late or invalid ones make it brake and hold."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from arm import ARM, FORWARD, ROBOT, SAFETY, SPEC
from defaults import defaults_of

from vla.deploy.control_loop import REPETITION_TIME, ControlLoop
from vla.deploy.joint_limiter import JointLimits
from vla.deploy.motion import LEEWAY, Command
from vla.deploy.observer import JointMeasurement
from vla.deploy.safety import Safety, State
from vla.robots.panda import HOME, JOINT_HIGH, forward
from vla.spec import Observation, RobotModel

IMAGE = np.zeros((8, 8, 3), np.uint8)


class World:
    """A simulated arm that follows its commands, two cameras, and a clock."""

    def __init__(self, safety: Safety = SAFETY, follows_positions: bool = True, execute: int | None = None) -> None:
        self.loop = ControlLoop(SPEC, ROBOT, safety, 50.0, follows_positions, execute)
        self.now, self.joints = 100.0, HOME.copy()
        self.cameras, self.measures, self.follows = ["front", "wrist"], True, True
        self.apart = 0.0  # delay of the wrist's images [s]
        self.answer: Callable[[Observation], np.ndarray | None] = lambda observation: FORWARD

    def ticks(self, seconds: float) -> Iterator[Command]:
        """Run for some seconds: joint states and commands at 50 Hz, images at 10 Hz."""
        for tick in range(round(seconds * 50)):
            self.now += 0.02
            if self.measures:
                self.loop.observer.add_joint_state(
                    JointMeasurement(self.now, self.joints, np.zeros_like(self.joints), 0.08)
                )
            if tick % 5 == 0:
                for camera in self.cameras:
                    self.loop.observer.add_image(camera, IMAGE, self.now - (self.apart if camera == "wrist" else 0.0))
            observation = self.loop.next_observation(self.now)
            if observation is not None:
                actions = self.answer(observation)
                if actions is not None:
                    self.loop.set_plan(actions)
            command = self.loop.command(self.now)
            if command is not None:
                if self.follows:
                    self.joints = command.position.copy()
                yield command

    def run(self, seconds: float) -> list[Command]:
        return list(self.ticks(seconds))

    def begin(self) -> None:
        """Measure, and give the first instruction."""
        self.run(0.3)
        self.loop.on_instruction("go", self.now)

    @property
    def tool(self) -> np.ndarray:
        return forward(self.joints)[0][:3, 3]


@pytest.fixture
def world() -> World:
    """A running loop."""
    world = World()
    world.begin()
    world.run(0.2)
    assert world.loop.state is State.RUNNING
    return world


def test_the_measured_pose_is_held_until_there_is_an_instruction() -> None:
    """Nothing is commanded before the first joint state."""
    world = World()
    world.measures = False
    assert world.run(0.5) == [] and world.loop.state is State.WAITING
    world.measures = True
    commands = world.run(0.7)
    assert len(commands) > 20
    for command in commands:
        np.testing.assert_array_equal(command.position, HOME)
        assert command.opening is None  # whatever it holds, it holds
    assert world.loop.state is State.WAITING and "instruction" in world.loop.reason


def test_whether_the_arm_follows_a_plan_is_told(world: World) -> None:
    world.answer = lambda observation: None
    world.run(0.2)
    assert world.loop.set_plan(FORWARD)
    assert not world.loop.set_plan(FORWARD)  # for which nobody has asked
    world.run(0.2)
    world.loop.on_instruction("something else", world.now)
    assert not world.loop.set_plan(FORWARD)
    world.run(0.2)
    assert not world.loop.set_plan(np.full_like(FORWARD, np.nan))


def test_an_arm_is_not_taken_over_where_it_was_long_ago() -> None:
    world = World()
    world.measures = False
    world.loop.observer.add_joint_state(JointMeasurement(world.now - SAFETY.joints_age, HOME + 0.1, np.zeros(7), 0.08))
    assert world.run(0.2) == [] and "no joint state within" in world.loop.reason
    world.measures = True
    assert world.run(0.2)[0].position == pytest.approx(HOME)


def test_an_arm_whose_joint_states_come_from_two_sources_is_neither_taken_over_nor_moved() -> None:
    def publish_another_pose(world: World) -> None:
        measured = world.loop.observer.newest_joint_state
        assert measured is not None
        world.loop.observer.add_joint_state(measured._replace(joints=world.joints + 0.3))

    world = World()
    world.loop.on_instruction("go", world.now)
    for _ in range(25):
        world.run(0.02)
        publish_another_pose(world)
    assert not world.loop.motion.started and "does another node publish" in world.loop.reason
    world.run(0.8)
    assert world.loop.state is State.RUNNING
    positions = []
    for command in world.ticks(1.0):
        publish_another_pose(world)
        positions.append(command.position)
    assert world.loop.state is State.HOLDING and "does another node publish" in world.loop.reason
    np.testing.assert_array_equal(positions[-20:], [positions[-1]] * 20)
    world.run(0.8)
    assert world.loop.state is State.RUNNING


def test_actions_move_the_tool_as_far_as_they_say(world: World) -> None:
    world.answer = lambda observation: 0 * FORWARD
    world.run(1.0)
    start, actions = world.tool, iter([FORWARD] * 8)
    world.answer = lambda observation: next(actions, 0 * FORWARD)
    world.run(1.5)
    np.testing.assert_allclose(world.tool - start, [0.08, 0, 0], atol=0.002)


def test_the_gripper_neither_opens_nor_closes_beyond_its_stroke(monkeypatch: pytest.MonkeyPatch) -> None:
    wider = replace(SPEC, low=(*SPEC.low[:6], -0.1), high=(*SPEC.high[:6], 1.1))
    monkeypatch.setattr("test_control_loop.SPEC", wider)  # bounds that follow from data
    for gripper, opening in ((1.1, 1.0), (-0.1, 0.0)):
        world = World()
        world.begin()
        world.answer = lambda observation, gripper=gripper: np.array([[*[0.0] * 6, gripper]])
        assert world.run(1.0)[-1].opening == opening


def test_a_chunk_is_executed_to_its_end_before_the_policy_is_asked_again() -> None:
    world, asked = World(), []

    def answer(observation: Observation) -> np.ndarray:
        asked.append(world.now)
        return np.repeat(FORWARD, 4, 0)

    world.answer = answer
    world.begin()
    start = world.tool
    world.run(1.2)
    assert np.diff(asked) == pytest.approx([0.4] * (len(asked) - 1), abs=0.021) and len(asked) >= 3
    np.testing.assert_allclose((world.tool - start)[0], 0.11, atol=0.015)


def test_a_plan_to_continue_is_executed_until_the_next_one_is_there() -> None:
    """The policy sees what remains of it, and how much of that will be over by then."""
    world, asked, plans = World(execute=2), list[tuple[float, Observation]](), list[np.ndarray]()

    def answer(observation: Observation) -> np.ndarray:
        asked.append((world.now, observation))
        plans.append(np.linspace(0.1, 0.8, 8)[:, None] * FORWARD + 0.01 * len(plans) * FORWARD)
        return plans[-1].astype(np.float32)

    world.answer = answer
    world.loop.delays.add(0.12)
    world.begin()
    world.run(1.2)
    assert len(asked) >= 4 and np.diff([at for at, _ in asked]) == pytest.approx([0.2] * (len(asked) - 1), abs=0.021)
    assert asked[0][1].running is None
    for plan, (_, observation) in zip(plans, asked[1:], strict=False):
        assert observation.running is not None and observation.running.delay == 2  # 0.12 s at 10 Hz
        np.testing.assert_array_equal(observation.running.actions, plan[2:].astype(np.float32))
    world.loop.on_instruction("", world.now)
    world.loop.on_instruction("go on", world.now)
    world.loop.resume(world.now)
    del asked[:]
    world.run(0.5)
    assert asked[0][1].running is None  # what was dropped is not continued


def test_a_late_answer_still_ends_where_and_when_it_should(world: World) -> None:
    """Its observation is older, so less time is left for the motions."""
    world.answer = lambda observation: 0 * FORWARD
    world.run(0.5)
    asked: list[float] = []
    world.answer = lambda observation: asked.append(world.now)
    start, ticks = world.tool, world.ticks(1.0)
    while not asked or world.now < asked[0] + 0.11:
        next(ticks)
    world.loop.set_plan(np.repeat(FORWARD, 3, 0))
    while world.now < asked[0] + 0.34:
        next(ticks)
    assert (world.tool - start)[0] == pytest.approx(0.03, abs=0.004)


@pytest.mark.parametrize(
    ("break_it", "reason"),
    [
        (lambda world: setattr(world, "cameras", ["front"]), "camera wrist is older"),
        (lambda world: setattr(world, "cameras", []), "camera front is older"),
        (lambda world: setattr(world, "apart", 0.08), "images of front, wrist are more than 0.05 s apart"),
        (lambda world: setattr(world, "measures", False), "no joint state within"),
        (lambda world: setattr(world, "answer", lambda observation: None), "inference takes longer"),
    ],
    ids=["one camera", "no camera", "cameras out of step", "no joint states", "no answer"],
)
def test_late_inputs_brake_and_hold_the_arm(world: World, break_it: Callable[[World], None], reason: str) -> None:
    world.run(0.3)
    break_it(world)
    commands = world.run(1.2)
    assert world.loop.state is State.HOLDING and reason in world.loop.reason
    resting = [index for index, command in enumerate(commands) if not command.velocity.any()]
    assert resting[0] * 0.02 < 0.7 and resting == list(range(resting[0], len(commands)))
    world.cameras, world.apart, world.measures, world.answer = ["front", "wrist"], 0.0, True, lambda _: FORWARD
    world.loop.reject_plan("late")
    world.run(0.2)  # two of each camera
    assert world.loop.state is State.HOLDING
    world.run(0.2)
    assert world.loop.state is State.RUNNING


def test_a_frame_counts_once_every_camera_has_a_newer_one(world: World) -> None:
    world.loop.hold("a hand in the way")

    def after(*cameras: str) -> State:
        world.now += 0.01
        world.loop.observer.add_joint_state(JointMeasurement(world.now, world.joints, np.zeros(7), 0.08))
        for camera in cameras:
            world.loop.observer.add_image(camera, IMAGE, world.now)
        world.loop.command(world.now)
        return world.loop.state

    for cameras in (("front", "wrist"), ("wrist",), ("front",), ("wrist",)):  # two of each, and a wrist's
        assert after(*cameras) is State.HOLDING
    assert after("front") is State.RUNNING


@pytest.mark.parametrize("actions", [np.full((1, 7), np.nan), np.zeros((1, 6)), np.zeros((0, 7)), np.zeros(7)])
def test_an_unusable_answer_holds_and_three_in_a_row_are_a_fault(world: World, actions: np.ndarray) -> None:
    before = world.tool
    world.answer = lambda observation: actions
    world.run(0.12)
    assert world.loop.state is State.HOLDING and "policy" in world.loop.reason
    world.run(3.0)
    assert world.loop.state is State.FAULT and "3 times" in world.loop.reason
    assert np.linalg.norm(world.tool - before) < 0.03
    world.loop.on_instruction("go on", world.now)
    assert not world.loop.resume(world.now)
    world.run(0.2)
    assert world.loop.state is State.FAULT


@pytest.mark.parametrize("stop", [lambda loop: loop.stop("by hand"), lambda loop: loop.on_instruction(" ", 0.0)])
def test_a_stop_lasts_until_resumed(world: World, stop: Callable[[ControlLoop], Any]) -> None:
    stop(world.loop)
    commands = world.run(1.0)
    assert world.loop.state is State.STOPPED and not commands[-1].velocity.any()
    assert "; to continue: python -m vla.deploy.say --resume" in world.loop.reason
    assert not world.loop.on_instruction("put the blue block on the pad", world.now)
    world.run(0.2)
    assert world.loop.state is State.STOPPED
    assert world.loop.resume(world.now)
    world.run(0.5)
    assert world.loop.state is State.RUNNING


def test_the_next_instruction_ends_a_stop_by_time_out_and_no_other() -> None:
    world = World(replace(SAFETY, instruction=1.0))
    world.run(0.1)
    for _ in range(3):  # as `ros2 topic pub` repeats it
        world.loop.on_instruction("go", world.now)
        world.run(0.5)
    assert world.loop.state is State.STOPPED
    assert world.loop.reason == "time-out: 1 s on one instruction; to continue: send the next instruction"
    world.run(REPETITION_TIME)
    assert world.loop.on_instruction("go", world.now)
    world.run(0.5)
    assert world.loop.state is State.RUNNING
    world.run(1.0)
    assert world.loop.state is State.STOPPED
    world.loop.stop("by hand")  # on top of the other one
    assert not world.loop.on_instruction("go on", world.now)
    world.run(0.5)
    assert world.loop.state is State.STOPPED and "by hand" in world.loop.reason


def handed_over(world: World) -> None:
    """Hand the resting arm over, and let a person move it elsewhere."""
    world.loop.hold("a person takes over")
    world.run(0.2)
    assert world.loop.motion.limiter.resting
    world.loop.hand_over()
    world.joints = world.joints + 0.2


@pytest.mark.parametrize("measures", [True, False], ids=["seen", "unseen"])
@pytest.mark.parametrize(
    ("how", "says"),
    [
        (lambda loop: None, "moved while it was held"),
        (lambda loop: loop.stop("enough"), "moved while it was held"),
        (lambda loop: loop.fail("the policy failed three times"), "failed three times"),
    ],
    ids=["lost", "stopped", "fault"],
)
def test_an_arm_that_is_moved_while_it_is_held_is_not_pulled_back(
    world: World, how: Callable[[ControlLoop], Any], says: str, measures: bool
) -> None:
    how(world.loop)
    world.run(0.5)
    world.measures, world.follows = measures and world.loop.state is not State.RUNNING, False
    world.run(0.6)
    world.joints, world.measures = HOME + 0.4, True
    world.run(SAFETY.tracking_for + 0.1)
    np.testing.assert_array_equal(world.run(0.1)[-1].position, HOME + 0.4)
    assert world.loop.state is State.FAULT and says in world.loop.reason


def test_an_arm_that_meets_an_obstacle_does_not_go_on_pushing(world: World) -> None:
    world.follows = False
    world.run(3.0)
    assert world.loop.state is State.FAULT and "away from its command" in world.loop.reason
    np.testing.assert_array_equal(world.run(0.1)[-1].position, world.joints)


def test_a_jaw_that_grasps_something_is_at_no_fault_and_keeps_its_grip_after_one() -> None:
    limits = JointLimits(**defaults_of("deploy/robot/so101"))
    names, units = tuple(limits.joints), ("rad",) * 6
    spec = replace(
        replace(SPEC, state=names, state_units=units, action=names, units=units, robot=RobotModel(names, "base")),
        low=tuple(limits.low),
        high=tuple(limits.high),
    )
    world, closed = World(), np.array([0.0, 0, 0, 0, 0, 0.1])
    world.loop, world.joints = ControlLoop(spec, limits, replace(SAFETY, workspace=None), 50.0), closed.copy()
    world.joints[5] = limits.low[5] - 0.002  # where an empty jaw may close to
    world.begin()
    world.answer, world.follows = lambda observation: closed[None].astype(np.float32), False
    world.run(0.6)
    world.joints[5] = 0.5  # of what it grasps
    command = world.run(SAFETY.tracking_for + 1.0)[-1]
    assert world.loop.state is State.RUNNING and command.position[5] == pytest.approx(0.1, abs=0.01)
    world.joints[0] = 0.5  # somebody pushes the arm
    command = world.run(SAFETY.tracking_for + 0.6)[-1]
    assert world.loop.state is State.FAULT and command.position[0] == 0.5
    assert command.position[5] == pytest.approx(0.1, abs=0.01)


def test_an_arm_in_the_hands_of_a_person_is_not_commanded_and_goes_on_from_where_it_is_left(world: World) -> None:
    world.run(0.3)
    handed_over(world)
    assert world.run(3.0) == [] and world.loop.state is State.HANDED_OVER
    assert world.loop.on_instruction("lift the red block", world.now)
    left = world.joints
    world.loop.take_back(world.now)
    commands = world.run(1.0)
    np.testing.assert_array_equal(commands[0].position, left)
    assert commands[0].opening is None and commands[-1].opening == 1.0  # once the policy says so
    steps = np.diff([command.position for command in commands], axis=0)
    assert (np.abs(np.diff(steps, axis=0)) <= ROBOT.max_acceleration * 0.02**2 + 1e-9).all()
    assert world.loop.state is State.RUNNING and np.abs(steps).sum() > 0.01


def after_a_gap(world: World) -> None:
    """Measure a moving arm once, after some time without joint states."""
    world.measures = False
    world.run(1.5)
    world.loop.observer.add_joint_state(JointMeasurement(world.now, world.joints + 0.4, np.ones(7), 0.08))


def test_an_overdue_plan_is_not_followed_even_if_nobody_looked_before(world: World) -> None:
    world.answer = lambda observation: None
    world.run(0.2)  # asks
    world.loop.drop_overdue(world.now)
    assert world.loop.state is State.RUNNING
    world.loop.drop_overdue(world.now + SAFETY.inference + 0.1)
    assert not world.loop.set_plan(FORWARD)
    assert world.loop.state is State.HOLDING and "inference takes longer" in world.loop.reason


@pytest.mark.parametrize(
    ("move", "says"),
    [
        (
            lambda world: setattr(world, "joints", JOINT_HIGH - 0.01),
            r"panda_joint1 is at 2\.887 rad, outside -2\.847 to 2\.847: move it inside first",
        ),
        (lambda world: setattr(world, "measures", False), "no joint state within"),
        (
            lambda world: world.loop.observer.add_joint_state(
                JointMeasurement(world.now, world.joints + 0.01, np.zeros(7), 0.08)
            ),
            "still moves",
        ),
        (after_a_gap, "less than 0.2 s of joint states"),
    ],
    ids=["outside", "unseen", "moving", "seen again"],
)
def test_an_arm_is_taken_back_only_at_rest_and_within_its_limits(
    world: World, move: Callable[[World], None], says: str
) -> None:
    handed_over(world)
    world.run(0.5)
    move(world)
    if "moves" not in says and "less" not in says:
        world.run(0.5)
    with pytest.raises(ValueError, match=says):
        world.loop.take_back(world.now)
    assert world.run(0.2) == [] and world.loop.state is State.HANDED_OVER


def test_whatever_happens_in_the_hands_of_a_person_nothing_is_commanded(world: World) -> None:
    handed_over(world)
    for _ in range(3):  # inferences that began before
        world.loop.reject_plan("the policy failed")
    assert world.loop.state is State.HANDED_OVER and world.loop.rejections == 0
    world.loop.stop("by hand")
    assert world.run(0.2) == [] and world.loop.state is State.STOPPED
    assert world.loop.resume(world.now) and world.loop.state is State.HANDED_OVER
    world.loop.fail("internal error")
    assert world.run(0.2) == [] and world.loop.state is State.FAULT
    world.loop.restart()
    assert world.run(0.2) == [] and len(world.run(0.2)) >= 9  # once joint states have come for long enough


def test_in_a_dry_run_every_plan_starts_where_the_arm_is() -> None:
    world = World(follows_positions=False)
    world.follows = False
    world.begin()
    commands = world.run(3.0)
    assert world.loop.state is State.RUNNING  # the arm does not follow, which is no fault
    away = np.array([forward(command.position)[0][:3, 3] for command in commands]) - world.tool
    assert 0.005 < away[:, 0].max() < 0.012 and np.abs(away[:, 1:]).max() < 0.002  # one action of 1 cm


@pytest.mark.parametrize("axis", range(3), ids="xyz")
def test_the_tool_stays_in_the_workspace_whose_corners_are_any_two_opposite_ones(axis: int) -> None:
    middle = forward(HOME)[0][:3, 3]
    for sign in (-1, 1):
        world = World(replace(SAFETY, workspace=(tuple(middle - 0.05 * sign), tuple(middle + 0.05 * sign))))
        move = np.zeros_like(FORWARD)
        move[:, axis], move[:, -1] = 0.01 * sign, 1
        world.answer = lambda observation, move=move: move
        world.begin()
        world.run(1.2)
        assert world.tool[axis] == pytest.approx(middle[axis] + 0.05 * sign, abs=0.002)


@pytest.mark.parametrize("fast", [False, True])
@pytest.mark.parametrize("motion", [(0, 0, -0.04), (0.04, 0.04, -0.04)], ids=str)
def test_the_tool_stays_in_the_workspace_where_joints_at_their_limits_bend_its_path(
    motion: tuple[float, ...], fast: bool
) -> None:
    assert SAFETY.workspace is not None
    low, high = map(np.array, SAFETY.workspace)
    world = World()
    world.loop = ControlLoop(SPEC, replace(ROBOT, acceleration=[100.0 if fast else 50.0] * 7), SAFETY, 50.0)
    random = np.random.default_rng(0)
    world.begin()
    turns: list[float] = []

    def answer(observation: Observation) -> np.ndarray:
        turns.append(random.choice([-1.0, 1.0]))
        return np.array([[*motion, 0, 0, 0.25 * turns[-1], 1]], np.float32)

    world.answer = answer
    tools = np.array([forward(command.position)[0][:3, 3] for command in world.run(6.0)])
    assert len(turns) > 20 and world.loop.state is State.RUNNING
    assert np.max([low - tools, tools - high]) <= LEEWAY
    assert tools[:, 2].min() < 0.03  # it gets there


def test_an_arm_outside_the_workspace_may_come_back() -> None:
    tool = forward(HOME)[0][:3, 3]
    world = World(replace(SAFETY, workspace=(tuple(tool - 0.3), tuple(tool + np.array([0.3, 0.3, -0.05])))))
    world.begin()
    world.answer = lambda observation: np.array([[0.0, 0, 0.01, 0, 0, 0, 1]], np.float32)  # away from it
    heights = [forward(command.position)[0][2, 3] for command in world.run(3.0)]
    assert max(heights) <= tool[2] + 1e-6 and abs(heights[-1] - (tool[2] - 0.05)) < LEEWAY


def test_an_arm_outside_its_limits_is_a_fault() -> None:
    world = World()
    world.joints = JOINT_HIGH - 0.01
    assert world.run(0.4) == [] and world.loop.state is State.FAULT and "outside" in world.loop.reason
    world.joints = HOME.copy()  # a person moves it inside
    assert world.run(0.2) == [] and world.loop.state is State.FAULT


def test_a_plan_for_the_instruction_before_is_not_executed(world: World) -> None:
    world.answer = lambda observation: 0 * FORWARD
    world.run(0.5)
    asked: list[Observation] = []
    world.answer = lambda observation: asked.append(observation)
    ticks = world.ticks(2.0)
    while not asked:
        next(ticks)
    start = world.tool
    world.loop.on_instruction("lift the blue block", world.now)
    world.loop.set_plan(np.repeat(FORWARD, 8, 0))  # the answer to what was seen before
    while len(asked) < 2:
        next(ticks)
    assert asked[1].instruction == "lift the blue block"
    np.testing.assert_allclose(world.tool, start, atol=1e-4)


def test_what_was_grasped_is_held_to_the_end_of_what_was_sent_ahead() -> None:
    world = World()
    world.loop = ControlLoop(SPEC, replace(ROBOT, acceleration=[3.0] * 7), SAFETY, 50.0)
    world.begin()
    grasp = np.repeat(FORWARD, 4, 0)
    grasp[:, 6] = [1, 1, 0, 0]
    asked: list[Observation] = []
    world.answer = lambda observation: grasp if not asked.append(observation) and len(asked) == 1 else None
    openings = []
    for command in world.ticks(0.9):
        world.loop.motion.commit(command, world.now)
        openings.append(command.opening)
    closed = next(number for number, opening in enumerate(openings) if opening is not None and opening < 0.5)
    assert all(opening == 0 for opening in openings[closed:])


@pytest.mark.parametrize(("actions", "longest"), [(1, np.inf), (8, np.inf), (8, 0.3)])
def test_the_horizon_is_continuous_with_the_commands(actions: int, longest: float) -> None:
    """A controller that is sent a new trajectory every tick, and one that is sent no more, keep to the limits."""
    world = World()
    generator = np.random.default_rng(0)
    world.answer = lambda observation: generator.uniform(SPEC.low, SPEC.high, (actions, 7))
    world.begin()
    sent: list[np.ndarray] = []
    for command in world.ticks(1.0):
        _, *planned = world.loop.motion.trajectory_to_rest(command, world.now, longest)
        ahead = [each.position for each in planned]
        assert not planned[-1].velocity.any()
        sent.append(command.position)
        speeds = np.diff([*sent[-3:], *ahead], axis=0) / 0.02
        assert (np.abs(speeds) <= ROBOT.max_speed + 1e-9).all()
        assert (np.abs(np.diff(speeds, axis=0)) / 0.02 <= ROBOT.max_acceleration + 1e-6).all()
    assert np.ptp(sent, axis=0).max() > 0.1


def test_an_arm_that_executes_trajectories_of_its_own_stays_within_the_limits(world: World) -> None:
    """Though ticks are skipped, and with a goal for every plan and stop only."""
    loop, random, path, sent = world.loop, np.random.default_rng(0), [world.joints.copy()], 0
    world.answer = lambda observation: random.uniform(SPEC.low, SPEC.high, (1, 7)).astype(np.float32)
    ahead: list[Command] = [Command(world.joints.copy(), np.zeros(7), 1.0)]
    since = world.now
    for number, command in enumerate(world.ticks(3.0)):
        if (new := loop.motion.commit(command, world.now)) is not None:
            ahead, since, sent = new, world.now, sent + 1
        np.testing.assert_array_equal(
            command.position, ahead[min(round((world.now - since) * 50), len(ahead) - 1)].position
        )
        path.append(command.position)
        if number % 7 == 3:  # the next tick is skipped, and the arm moves on
            world.now += 0.02
            path.append(ahead[min(round((world.now - since) * 50), len(ahead) - 1)].position)
        if number == 120:
            loop.stop("enough")
    speeds = np.diff(path, axis=0) * 50
    assert np.abs(speeds).max() > 0.1 and (np.abs(speeds) <= ROBOT.max_speed + 1e-9).all()
    assert (np.abs(np.diff(speeds, axis=0)) <= ROBOT.max_acceleration * 0.02 + 1e-9).all()
    assert sent < 50 and loop.motion.limiter.resting


def test_an_arm_that_follows_each_trajectory_until_the_next_stays_within_the_limits_when_ticks_are_late(
    world: World,
) -> None:
    loop, random, late = world.loop, np.random.default_rng(0), np.random.default_rng(1)
    world.answer = lambda observation: random.uniform(SPEC.low, SPEC.high, (1, 7)).astype(np.float32)
    path, sent = list[np.ndarray](), (world.now, [world.joints.copy()] * 2)
    for command in world.ticks(3.0):
        since, points = sent
        at = (np.arange(since, world.now, 0.001) - since) * 50
        path += list(np.stack([np.interp(at, range(len(points)), joints) for joints in np.transpose(points)], axis=1))
        ahead = [each.position for each in loop.motion.trajectory_to_rest(command, world.now, 0.3)]
        sent = world.now, [path[-1] if path else points[0], *ahead]
        world.now += late.choice([0.0, 0.01, 0.02, 0.06], p=[0.7, 0.1, 0.1, 0.1])
    speeds = np.diff(path, axis=0) / 0.001
    assert np.abs(speeds).max() > 0.1 and (np.abs(speeds) <= 1.1 * ROBOT.max_speed).all()
    # The commands of two ticks, of which the first was late, may come within one tick.
    assert (np.abs(speeds[20:] - speeds[:-20]) <= 2.2 * ROBOT.max_acceleration * 0.02).all()


SHORTER: Any = {name: getattr(ROBOT, name)[:6] for name in ("joints", "low", "high", "speed", "acceleration")}
OTHER: Any = {"action": ("x", "y"), "units": ("m", "m"), "low": (0, 0), "high": (1, 1)}


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"spec": replace(SPEC, **OTHER)}, "action is x .m., y .m., "),
        (
            {"spec": replace(SPEC, units=("mm",) * 3 + SPEC.units[3:])},
            r"action is dx .mm., .* expected dx .m., .*, or all joints",
        ),
        (
            {"spec": replace(SPEC, robot=replace(ARM, chain=()))},
            "the kinematics of the arm of 7 joints, and the checkpoint lacks its kinematic chain: train",
        ),
        (
            {"spec": replace(SPEC, robot=replace(ARM, home=()))},
            "arm of 7 joints, and the checkpoint lacks its home posture: train with",
        ),
        ({"spec": replace(SPEC, robot=None)}, "deployment needs a robot, and the spec of this world has none"),
        ({"safety": replace(SAFETY, workspace=None)}, "needs a box for the tool point"),
        ({"command_hz": 5.0}, "command_hz"),
        ({"limits": replace(ROBOT, **SHORTER)}, "the policy has 7 joints, the robot 6"),
        (
            {"limits": replace(ROBOT, joints=[*ARM.joints[1::-1], *ARM.joints[2:]])},
            rf"has {ARM.joints[0]} where deploy\.robot\.joints has {ARM.joints[1]}: list .* order, {ARM.joints[0]}, ",
        ),
    ],
    ids=["action", "units", "joints", "chain", "robot", "box", "rate", "arm", "order"],
)
def test_a_policy_that_does_not_fit_is_refused(changed: dict[str, Any], words: str) -> None:
    fitting: dict[str, Any] = {"spec": SPEC, "limits": ROBOT, "safety": SAFETY, "command_hz": 50.0}
    with pytest.raises(ValueError, match=words):
        ControlLoop(**fitting | changed)
