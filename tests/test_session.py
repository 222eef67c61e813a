"""What the arm may do: fresh inputs make it move, anything late or wrong makes it brake and hold."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import pytest

from vla.deploy.governor import Robot
from vla.deploy.session import ACTION, Command, Safety, Session, State
from vla.spec import Observation, Spec
from vla.tasks.control import HOME, JOINT_HIGH, JOINT_LOW, forward

JOINTS = tuple(f"panda_joint{number}" for number in range(1, 8))
SPEC = Spec(
    cameras=("front", "wrist"),
    image_size=(8, 8),
    joints=JOINTS,
    action=ACTION,
    units=("m", "m", "m", "rad", "rad", "rad", "1"),
    low=(-0.04,) * 3 + (-0.25,) * 3 + (0.0,),
    high=(0.04,) * 3 + (0.25,) * 3 + (1.0,),
    frame="panda_link0",
    control_hz=10.0,
)
ROBOT = Robot(
    joints=list(JOINTS),
    low=JOINT_LOW.tolist(),
    high=JOINT_HIGH.tolist(),
    speed=[2.0] * 7,
    acceleration=[50.0] * 7,
    fingers=["left", "right"],
    speed_share=1.0,
    acceleration_share=1.0,
)
IMAGE = np.zeros((8, 8, 3), np.uint8)
FORWARD = np.array([[0.01, 0, 0, 0, 0, 0, 1.0]], np.float32)  # 1 cm along x, gripper open


class World:
    """An arm that does what it is told, two cameras, and a clock."""

    def __init__(self, safety: Safety | None = None) -> None:
        self.session = Session(SPEC, ROBOT, safety or Safety(), 50.0)
        self.now, self.joints = 100.0, HOME.copy()
        self.cameras, self.feels, self.follows = ["front", "wrist"], True, True
        self.apart = 0.0  # by how much the wrist's images are older [s]
        self.answer: Callable[[Observation], np.ndarray | None] = lambda observation: FORWARD

    def ticks(self, seconds: float) -> Iterator[Command]:
        """Go on for so long: joint states and commands at 50 Hz, images at 10 Hz."""
        for tick in range(round(seconds * 50)):
            self.now += 0.02
            if self.feels:
                self.session.feel(self.joints, np.zeros(7), 0.08, self.now)
            if tick % 5 == 0:
                for camera in self.cameras:
                    self.session.see(camera, IMAGE, self.now - (self.apart if camera == "wrist" else 0.0))
            observation = self.session.look(self.now)
            if observation is not None:
                actions = self.answer(observation)
                if actions is not None:
                    self.session.plan(actions, self.now)
            command = self.session.command(self.now)
            if command is not None:
                if self.follows:
                    self.joints = command.position.copy()
                yield command

    def run(self, seconds: float) -> list[Command]:
        return list(self.ticks(seconds))

    @property
    def tool(self) -> np.ndarray:
        return forward(self.joints)[0][:3, 3]


@pytest.fixture
def world() -> World:
    """A session that runs."""
    world = World()
    world.run(0.1)
    world.session.listen("put the red block on the pad", world.now)
    world.run(0.2)
    assert world.session.state is State.RUNNING
    return world


def test_nothing_is_commanded_before_the_arm_is_felt() -> None:
    world = World()
    world.feels = False
    assert world.run(0.5) == [] and world.session.state is State.WAITING


def test_without_an_instruction_the_measured_pose_is_held() -> None:
    world = World()
    for command in world.run(0.5):
        np.testing.assert_array_equal(command.position, HOME)
        assert command.opening == 1.0
    assert world.session.state is State.WAITING and "instruction" in world.session.reason


def test_actions_move_the_tool_as_far_as_they_say(world: World) -> None:
    world.answer = lambda observation: 0 * FORWARD
    world.run(1.0)
    start, actions = world.tool, iter([FORWARD] * 8)
    world.answer = lambda observation: next(actions, 0 * FORWARD)
    world.run(1.5)
    np.testing.assert_allclose(world.tool - start, [0.08, 0, 0], atol=0.002)


def test_a_chunk_is_executed_to_its_end_before_the_policy_is_asked_again() -> None:
    world, asked = World(), []

    def answer(observation: Observation) -> np.ndarray:
        asked.append(world.now)
        return np.repeat(FORWARD, 4, 0)

    world.answer = answer
    world.run(0.1)
    world.session.listen("go", world.now)
    start = world.tool
    world.run(1.2)
    assert np.diff(asked) == pytest.approx([0.4] * (len(asked) - 1), abs=0.021) and len(asked) >= 3
    np.testing.assert_allclose((world.tool - start)[0], 0.11, atol=0.015)


def test_a_late_answer_still_ends_where_and_when_it_should(world: World) -> None:
    """Its observation is older, so less time is left for the motions."""
    world.answer = lambda observation: 0 * FORWARD
    world.run(0.5)
    asked: list[float] = []
    world.answer = lambda observation: asked.append(world.now)
    start, ticks = world.tool, world.ticks(1.0)
    while not asked or world.now < asked[0] + 0.11:
        next(ticks)
    world.session.plan(np.repeat(FORWARD, 3, 0), world.now)
    while world.now < asked[0] + 0.34:
        next(ticks)
    assert (world.tool - start)[0] == pytest.approx(0.03, abs=0.004)


@pytest.mark.parametrize(
    ("break_it", "reason"),
    [
        (lambda world: setattr(world, "cameras", ["front"]), "camera wrist is older"),
        (lambda world: setattr(world, "cameras", []), "camera front is older"),
        (lambda world: setattr(world, "apart", 0.08), "images of front, wrist lie more than 0.05 s apart"),
        (lambda world: setattr(world, "feels", False), "joint state is older"),
        (lambda world: setattr(world, "answer", lambda observation: None), "policy takes longer"),
    ],
    ids=["one camera", "no camera", "cameras out of step", "no joint states", "no answer"],
)
def test_what_is_late_brakes_the_arm_and_holds_it(world: World, break_it: Callable[[World], None], reason: str) -> None:
    world.run(0.3)
    break_it(world)
    commands = world.run(1.2)
    assert world.session.state is State.HOLDING and reason in world.session.reason
    resting = [index for index, command in enumerate(commands) if not command.velocity.any()]
    assert resting[0] * 0.02 < 0.7 and resting == list(range(resting[0], len(commands)))


def test_a_frame_counts_once_every_camera_has_a_newer_one(world: World) -> None:
    world.session.hold("a hand in the way")

    def see(*cameras: str) -> State:
        world.now += 0.01
        world.session.feel(world.joints, np.zeros(7), 0.08, world.now)
        for camera in cameras:
            world.session.see(camera, IMAGE, world.now)
        world.session.command(world.now)
        return world.session.state

    for cameras in (("front", "wrist"), ("wrist",), ("front",), ("wrist",)):  # two of each, and a wrist's
        assert see(*cameras) is State.HOLDING
    assert see("front") is State.RUNNING


def test_a_held_session_runs_again_after_fresh_frames(world: World) -> None:
    world.cameras = []
    world.run(0.6)
    assert world.session.state is State.HOLDING
    world.cameras = ["front", "wrist"]
    world.run(0.2)  # two of each camera
    assert world.session.state is State.HOLDING
    world.run(0.2)
    assert world.session.state is State.RUNNING


@pytest.mark.parametrize("actions", [np.full((1, 7), np.nan), np.zeros((1, 6)), np.zeros((0, 7)), np.zeros(7)])
def test_an_unusable_answer_holds_and_three_in_a_row_are_a_fault(world: World, actions: np.ndarray) -> None:
    before = world.tool
    world.answer = lambda observation: actions
    world.run(0.12)
    assert world.session.state is State.HOLDING and "policy" in world.session.reason
    world.run(3.0)
    assert world.session.state is State.FAULT and "3 times" in world.session.reason
    assert np.linalg.norm(world.tool - before) < 0.03
    world.session.listen("go on", world.now)
    assert not world.session.resume(world.now)
    world.run(0.2)
    assert world.session.state is State.FAULT


def test_a_stop_lasts_until_resumed(world: World) -> None:
    world.session.stop("by hand")
    commands = world.run(1.0)
    assert world.session.state is State.STOPPED and not commands[-1].velocity.any()
    assert world.session.reason.startswith("by hand; to go on: python -m vla.deploy.say --resume")
    assert not world.session.listen("put the blue block on the pad", world.now)
    world.run(0.2)
    assert world.session.state is State.STOPPED
    assert world.session.resume(world.now)
    world.run(0.5)
    assert world.session.state is State.RUNNING


def test_empty_words_stop(world: World) -> None:
    world.session.listen("  ", world.now)
    assert world.session.state is State.STOPPED


def test_one_instruction_is_not_worked_on_for_ever() -> None:
    world = World(Safety(instruction=1.0))
    world.run(0.1)
    world.session.listen("go", world.now)
    world.answer = lambda observation: np.zeros((1, 7))
    world.run(1.5)
    assert world.session.state is State.STOPPED
    assert world.session.reason == "1 s on one instruction are over; to go on: say what to do next"


def test_the_next_instruction_ends_a_stop_because_the_time_was_up_and_no_other() -> None:
    world = World(Safety(instruction=1.0))
    world.run(0.1)
    world.session.listen("go", world.now)
    world.run(1.5)
    assert world.session.state is State.STOPPED
    assert world.session.listen("go", world.now)
    world.run(0.5)
    assert world.session.state is State.RUNNING
    world.run(1.0)
    assert world.session.state is State.STOPPED
    world.session.stop("by hand")  # on top of the other one
    assert not world.session.listen("go on", world.now)
    world.run(0.5)
    assert world.session.state is State.STOPPED and "by hand" in world.session.reason


def test_an_arm_that_does_not_follow_is_a_fault(world: World) -> None:
    world.follows = False
    world.run(3.0)
    assert world.session.state is State.FAULT and "from where it was sent" in world.session.reason


def test_an_arm_outside_its_limits_is_a_fault() -> None:
    world = World()
    world.joints = JOINT_HIGH - 0.01
    assert world.run(0.2) == [] and world.session.state is State.FAULT and "outside" in world.session.reason


def test_what_lies_ahead_ends_at_rest(world: World) -> None:
    ticks = world.ticks(1.0)
    while not next(ticks).velocity.any():
        pass
    ahead = world.session.horizon(world.now)
    assert not ahead[-1].velocity.any() and ahead[0].velocity.any()
    moved = np.diff([command.position for command in ahead], axis=0) / 0.02
    assert (np.abs(moved) <= ROBOT.fastest + 1e-9).all()


def test_what_lies_ahead_follows_from_the_command_whatever_changes() -> None:
    """A controller that is sent a new trajectory every tick, and one that is sent no more, keep to the limits."""
    world = World()
    generator = np.random.default_rng(0)
    world.answer = lambda observation: generator.uniform(SPEC.low, SPEC.high, (1, 7))
    world.run(0.1)
    world.session.listen("go", world.now)
    sent: list[np.ndarray] = []
    for command in world.ticks(2.0):
        ahead = [each.position for each in world.session.horizon(world.now)]
        sent.append(command.position)
        speeds = np.diff([*sent[-3:], *ahead], axis=0) / 0.02
        assert (np.abs(speeds) <= ROBOT.fastest + 1e-9).all()
        assert (np.abs(np.diff(speeds, axis=0)) / 0.02 <= ROBOT.hardest + 1e-6).all()
    assert np.ptp(sent, axis=0).max() > 0.1


def test_a_new_instruction_is_looked_at_with_the_next_frame(world: World) -> None:
    heard: list[str] = []

    def answer(observation: Observation) -> np.ndarray:
        heard.append(observation.instruction)
        return np.repeat(FORWARD * [0, 0, 0, 0, 0, 0, 1], 20, 0)

    world.answer = answer
    world.run(0.2)
    world.session.listen("lift the red block", world.now)
    world.run(0.2)
    assert heard[-1] == "lift the red block"


def test_a_policy_of_another_kind_of_action_is_refused() -> None:
    from dataclasses import replace

    spec = replace(SPEC, action=("x", "y"), units=("m", "m"), low=(0.0, 0.0), high=(1.0, 1.0))
    with pytest.raises(ValueError, match="acts with x, y"):
        Session(spec, ROBOT, Safety(), 50.0)
    with pytest.raises(ValueError, match="command_hz"):
        Session(SPEC, ROBOT, Safety(), 5.0)
