"""A recorded bag becomes episodes: the observations of the policy node, who acted, and what was done."""

from __future__ import annotations

import random
import sys
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import bags
import composing
import numpy as np
import pytest
from arm import ARM, NO_FINGERS, ROBOT, SPEC
from rosbags.rosbag2 import StoragePlugin, Writer

from vla.config.build import build
from vla.config.experiment import to_plain
from vla.deploy.bag_import import BagDemonstrations, _Bag, _Picture, _Segment
from vla.deploy.observer import JointMeasurement
from vla.deploy.record import BagRecorder
from vla.deploy.settings import Topics
from vla.io.errors import UserError
from vla.spec import Episode

UNSEEN_GRIPPER = replace(SPEC, robot=replace(ARM, gripper=None))
TOPICS = Topics(dict(bags.IMAGES), "/joint_states", "/words", "/commands", None, None)


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A session in which a policy errs and a person takes over."""
    return bags.write(tmp_path_factory.mktemp("bags") / "bag")


def imported(folder: Path, spec: Any = SPEC, **changed: Any) -> BagDemonstrations:
    options: dict[str, Any] = {"topics": TOPICS, "robot": ROBOT, **changed}
    return BagDemonstrations(folder, **options, spec=spec)


def episodes_of(demonstrations: BagDemonstrations) -> list[Episode]:
    return [demonstrations.episode(number) for number in range(len(demonstrations))]


def brightness(episode: Episode) -> list[int]:
    """Return the numbers of the steps that the images show."""
    return [int(seen.rgb["front"].mean()) // 3 for seen in episode.observations]


def test_an_episode_is_what_was_done_for_an_instruction_by_the_policy_or_a_person(bag: Path) -> None:
    episodes = episodes_of(imported(bag))
    words = ["put the red block on the pad"] * 3 + ["lift the blue block"]
    assert [episode.instruction for episode in episodes] == words
    assert [episode.draws["recorded"]["person"] for episode in episodes] == [False, True, False, False]
    assert {episode.outcome for episode in episodes} == {"unverified"}
    np.testing.assert_allclose(episodes[0].actions[:18], bags.SESSION[1].actions[:18], atol=2e-4)
    state = episodes[0].observations[0].state
    assert state[14] == pytest.approx(0.08) and np.abs(state[:7] - bags.HOME).max() < 0.05
    assert [seen.instruction for seen in episodes[3].observations] == ["lift the blue block"] * 6
    person = episodes[1]  # from the first motion to the last
    numbers = brightness(person)
    assert numbers == list(range(numbers[0], numbers[-1] + 1))
    assert 32 <= numbers[0] <= 33 and 44 <= numbers[-1] <= 46  # of the 33 … 44 in which the person moved the arm
    first = numbers.index(33)
    np.testing.assert_allclose(person.actions[first : first + 12], bags.SESSION[4].actions, atol=2e-4)
    assert person.actions.dtype == np.float32 and (person.actions[first:, 6] == 0).all()


def test_an_arm_that_is_guided_by_hand_moves_as_measured(tmp_path: Path) -> None:
    parts = (
        bags.Part("running", bags.moving(6, 0), instruction="lift it"),
        bags.Part("handed over", bags.moving(10, 1, gripper=0.0), person=True, commands=False),
        bags.Part("holding", bags.resting()),
    )
    episode = imported(bags.write(tmp_path / "bag", parts)).episode(1)
    first = brightness(episode).index(7)
    np.testing.assert_allclose(episode.actions[first : first + 8, :6], bags.moving(8, 1)[:, :6], atol=2e-4)
    assert (episode.actions[first : first + 8, 6] == 0).all()  # as measured, not as the policy last commanded


def test_fingers_that_a_person_closes_around_something_are_labelled_closed_until_they_open(tmp_path: Path) -> None:
    parts = (
        bags.Part("running", bags.moving(6, 0), instruction="lift it"),
        bags.Part("handed over", bags.moving(5, 1), person=True, commands=False),
        bags.Part("handed over", bags.moving(5, 2, gripper=0.5), person=True, commands=False),
        bags.Part("handed over", bags.moving(5, 3, gripper=0.8), person=True, commands=False),
        bags.Part("handed over", bags.moving(5, 4), person=True, commands=False),
        bags.Part("holding", bags.resting()),
    )
    episode = imported(bags.write(tmp_path / "bag", parts)).episode(1)
    first = brightness(episode).index(7)
    openings = episode.actions[first : first + 18, 6]
    assert openings[3:].tolist() == pytest.approx([1, 0, 0, 0, 0, 0, 0.8, 0.8, 0.8, 0.8, 0.8, 1, 1, 1, 1])


@pytest.mark.parametrize("storage", [StoragePlugin.MCAP, StoragePlugin.SQLITE3], ids=["mcap", "sqlite3"])
def test_a_session_without_a_policy_is_all_of_a_person(tmp_path: Path, storage: StoragePlugin) -> None:
    parts = [
        bags.Part("", np.concatenate([bags.resting(), bags.moving(10, seed)]), instruction=words)
        for seed, words in enumerate(["lift it", "lift it", "put it down", ""])
    ]
    episodes = episodes_of(imported(bags.write(tmp_path / "bag", parts, storage, status=False, compressed=True)))
    assert [episode.instruction for episode in episodes] == ["lift it", "put it down"]  # the second repeats the first
    assert brightness(episodes[1])[-1] >= 37


def test_joint_positions_of_any_robot_are_learned_from_a_bag_alone(bag: Path) -> None:
    topics = [f"expert.topics.{name}={getattr(TOPICS, name)}" for name in ("joint_states", "instruction", "commands")]
    images = [f"expert.topics.images.{camera}={topic}" for camera, topic in TOPICS.images.items()]
    chosen = ("task=recorded", "task.joints=all", "task.units=rad", "task.image_size=[8,8]", "expert=bag")
    robot = "expert.robot.fingers=[left,right]"
    config: Any = to_plain(composing.composed(*chosen, f"expert.folder={bag}", robot, *topics, *images))
    spec = build(config["task"], "task").spec
    assert (spec.control_hz, spec.cameras, spec.action) == (10.0, ("front", "wrist"), tuple(ROBOT.joints))
    demonstrations = build(config["expert"], "expert", spec=spec)
    assert len(demonstrations) == config["collect"]["episodes"] == 4
    episode = demonstrations.episode(1)
    states = [seen.state for seen in episode.observations]
    np.testing.assert_allclose(episode.actions[:-1], states[1:], atol=0.01)
    assert np.abs(np.diff(episode.actions, axis=0)).sum() > 0.05
    degrees = replace(spec, units=("deg",) * len(spec.action))
    with pytest.raises(ValueError, match=r"does not match the task: .* \(other units, or absolute\?\)"):
        build(config["expert"], "expert", spec=degrees)


def test_without_rosbags_a_sentence_says_what_to_install(
    bag: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "rosbags.rosbag2", None)
    for work in (lambda: imported(bag), lambda: BagRecorder(None, tmp_path / "new")):
        with pytest.raises(UserError, match=r"pip install 'rosbags"):
            work()
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ({"topics": replace(TOPICS, images={"front": "/top", "wrist": "/wrist"})}, "has no topic /top, it has"),
        (
            {"topics": replace(TOPICS, images={"front": "/commands"}), "spec": replace(SPEC, cameras=("front",))},
            "/commands can be used: they are of type sensor_msgs/msg/JointState",
        ),
        ({"topics": replace(TOPICS, commands="/words")}, "/words can be used: they are of type std_msgs/msg/Str"),
        ({"robot": replace(ROBOT, joints=[f"fr3_joint{n}" for n in range(1, 8)])}, "lacks fr3_joint1, .* has"),
        ({"robot": replace(ROBOT, joints=ROBOT.joints[::-1])}, r"panda_joint1 where expert\.robot\.joints has"),
        ({"robot": replace(ROBOT, **NO_FINGERS)}, r"name the joints in expert\.robot\.fingers"),
        (
            {"robot": replace(ROBOT, **NO_FINGERS), "spec": UNSEEN_GRIPPER},
            r"moves a gripper: .* expert\.robot\.fingers",
        ),
        ({"spec": replace(SPEC, robot=None)}, "expert=bag needs a robot"),
        ({"spec": replace(SPEC, cameras=("top",))}, r"no topic for cameras top: add \+expert\.topics"),
    ],
)
def test_a_bag_that_does_not_fit_is_refused_in_a_sentence(bag: Path, changed: Any, says: str) -> None:
    with pytest.raises(ValueError, match=says) as refused:
        imported(bag, **changed)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("fps", [60.0, 25.0, 15.0])
def test_steps_have_the_rate_of_the_task_whatever_that_of_the_cameras(fps: float) -> None:
    demonstrations = BagDemonstrations.__new__(BagDemonstrations)
    demonstrations.spec = replace(SPEC, cameras=("front",))
    bag: Any = SimpleNamespace(folder="bag", inputs=[])
    for tick in range(500):  # ten seconds
        bag.inputs.append((0.02 * tick, JointMeasurement(0.02 * tick, np.zeros(7), np.zeros(7), 0.0)))
    bag.inputs += [(at, _Picture("front", at)) for at in np.arange(0, 10, 1 / fps)]
    bag.inputs.sort(key=lambda each: each[0])
    steps = demonstrations._steps(bag, _Segment("go", False, 0.0, 10.0))
    assert len(steps) == pytest.approx(10 * SPEC.control_hz, abs=2)


def test_an_empty_instruction_ends_nothing_where_a_status_tells_what_goes_on(tmp_path: Path) -> None:
    parts = (
        bags.Part("running", bags.moving(8, 0), instruction="lift it"),
        bags.Part("stopped", bags.resting(), instruction=""),
        bags.Part("handed over", bags.moving(10, 1), person=True),
        bags.Part("holding", bags.resting()),
    )
    episodes = episodes_of(imported(bags.write(tmp_path / "bag", parts)))
    assert [episode.instruction for episode in episodes] == ["lift it"] * 2


def test_the_agents_of_two_arms_are_not_mistaken_for_each_other(tmp_path: Path) -> None:
    status = {"level": 0, "name": "", "message": "", "hardware_id": "", "values": []}
    with Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        session = bags.Session(writer, status=True, compressed=False)
        session.send("/left/vla_agent/status", bags.make("diagnostic_msgs/msg/DiagnosticStatus", **status))
        for part in bags.SESSION[:3]:
            session.play(part)
    with pytest.raises(UserError, match="several agents, /left/vla_agent/status, /vla_agent/status: record each"):
        imported(tmp_path / "bag")


def test_joint_states_count_when_they_were_taken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    written = bags.Session._joint_state

    def late(session: bags.Session, joints: Any) -> Any:  # by 0.1 s
        session.now -= 0.1
        message = written(session, joints)
        session.now += 0.1
        return message

    monkeypatch.setattr(bags.Session, "_joint_state", late)
    measured = _Bag(bags.write(tmp_path / "bag"), TOPICS, ROBOT).measured
    assert [at for at, _ in measured[:3]] == pytest.approx([-0.08, -0.06, -0.04], abs=0.011)


def test_gaps_and_long_instructions_are_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    steps, blind = bags.moving(8, 0), bags.Part("running", bags.moving(4, 0), images=False)
    parts = (bags.Part("running", steps, instruction="lift it"), blind, bags.Part("running", steps))
    imported(bags.write(tmp_path / "gap", parts))
    assert "no step for up to 0.50 s" in caplog.text
    with pytest.raises(ValueError, match="an instruction of 1600 characters"):
        imported(bags.write(tmp_path / "long", [bags.Part("running", steps, instruction="lift it " * 200)]))


def test_a_segment_without_images_is_left_out(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    parts = (
        bags.Part("running", bags.moving(8, 0), instruction="lift it"),
        bags.Part("running", bags.moving(8, 1), instruction="lower it", images=False),
        bags.Part("stopped", bags.resting()),
    )
    folder = bags.write(tmp_path / "bag", parts)
    assert len(imported(folder)) == 1 and "no image of front, wrist in" in caplog.text
    assert BagDemonstrations.recording(folder, asdict(TOPICS), asdict(ROBOT)).episodes == 1


def test_images_of_another_kind_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    layout = {"height": 8, "width": 8, "encoding": "mono8", "is_bigendian": 0, "step": 8, "data": np.zeros(64, "u1")}
    monkeypatch.setattr(
        bags.Session,
        "_images",
        lambda self: [
            self.send(topic, bags.make("sensor_msgs/msg/Image", header=self._header(), **layout))
            for topic in bags.IMAGES.values()
        ],
    )
    with pytest.raises(ValueError, match="no message on /front can be used: image encoding is 'mono8', expected one"):
        imported(bags.write(tmp_path / "bag"))


def test_the_bags_in_a_folder_are_imported_in_order(tmp_path: Path) -> None:
    for name, words in (("first", "lift it"), ("second", "put it down")):
        bags.write(tmp_path / name, [bags.Part("running", bags.moving(10, 0), instruction=words)])
    assert [episode.instruction for episode in episodes_of(imported(tmp_path))] == ["lift it", "put it down"]


@pytest.mark.parametrize("name", ["bag.mcap", "metadata.yaml"])
def test_a_damaged_bag_is_imported_or_refused_in_a_sentence(tmp_path: Path, name: str) -> None:
    """Bits that flip in many places, ends that are missing, sizes that are huge; folders that are no bags."""
    with pytest.raises(ValueError, match=r"is not a bag: it has no metadata\.yaml"):
        imported(tmp_path)
    whole = bags.write(tmp_path / "bag", bags.SESSION[9:])
    data, generator = (whole / name).read_bytes(), random.Random(0)
    refused = 0
    for trial in range(32):
        changed, place = bytearray(data), generator.randrange(len(data) - 8)
        if trial % 4 == 0:
            del changed[place:]
        elif trial % 4 == 1:
            changed[place : place + 8] = (1 << generator.randrange(20, 62)).to_bytes(8, "little")
        else:
            changed[place] ^= 1 << generator.randrange(8)
        (whole / name).write_bytes(changed)
        try:
            assert all(np.isfinite(episode.actions).all() for episode in episodes_of(imported(whole)))
        except ValueError as error:
            assert str(whole) in str(error) and "\n" not in str(error) and len(str(error)) < 1000
            refused += 1
    assert refused > 5
