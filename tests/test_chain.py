"""Several instructions in a row, and the way from there to a report."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from conftest import make_tabletop
from defaults import defaults_of
from rerun.chunk import RrdReader

from vla.deploy.joint_limiter import JointLimits
from vla.deploy.ros import RosNetwork
from vla.deploy.ros2 import SimulatorDeployment
from vla.deploy.settings import Topics
from vla.reports.evaluation import summary, write_report
from vla.reports.run_page import write_page
from vla.rollouts.evaluate import play_episode
from vla.rollouts.recorder import RerunRecorder
from vla.rollouts.results import Report, Result, recording_name
from vla.rollouts.rollout import replay, rollout
from vla.rollouts.statistics import bounded_mean_interval, wilson_interval
from vla.spec import FIRST_SEED, Array, Observation
from vla.tasks.tabletop.expert import Waypoint
from vla.tasks.tabletop.goals.goal import Arrangement, Goal
from vla.tasks.tabletop.goals.several import Chain
from vla.tasks.tabletop.goals.skills import Lift, PickPlace, Place, Push, Stack
from vla.tasks.tabletop.language import Grammar

if TYPE_CHECKING:
    from vla.tasks.tabletop.environment import Tabletop

GRAMMAR = Grammar(["{move} {block}"], {"move": ["move"]}, ["{block}"], {"move": ["shift"]}, [])
COMMON: Any = {"language": GRAMMAR, "hold_steps": 3}
GOALS: dict[str, Goal | None] = {
    "lift": Lift(**COMMON, height=0.1),
    "place": Place(**COMMON, radius=0.04),
    "push": Push(**COMMON, radius=0.04, highest=0.02),
    "stack": Stack(**COMMON),
}
FIRST, SECOND = FIRST_SEED + 2, FIRST_SEED + 3


@pytest.fixture(scope="module")
def chain() -> Iterator[Tabletop]:
    """Chains of three instructions, seen by small cameras."""
    environment = make_tabletop("task/goal=chain", "task.goal.length=3", "task.image_size=[32,32]")
    yield environment
    environment.close()


class Tiring:
    """The expert, which carries out only so many instructions and then rests; remembers how often it was reset."""

    def __init__(self, expert: Waypoint, most: int) -> None:
        self._expert, self._most = expert, most
        self.info: dict[str, object] = {}
        self.heard: list[str] = []

    def reset(self, instruction: str, seed: int) -> None:
        """Hear an instruction."""
        self.heard = [*self.heard, instruction]

    def act(self, observation: Observation) -> Array:
        """Act, or rest with an open hand."""
        action = self._expert.act(observation)
        return action if len(self.heard) <= self._most else np.array([0, 0, 0, 0, 0, 0, 1], np.float32)


def test_every_instruction_is_possible_where_those_before_leave_the_blocks() -> None:
    chain, seen = Chain(GOALS, length=4), set()
    for seed in range(200):
        now = Arrangement()
        links = chain.plan(3, np.random.RandomState(seed))
        assert len(links) == 4
        for goal, referents in links:
            seen.add(type(goal))
            block = referents.blocks[0]
            assert ("block", block) not in now.spots.values()  # nothing stands on it
            assert now.held in (None, block)  # what is in the hand is put down first
            if isinstance(goal, Stack):
                assert not now.is_stacked(referents.blocks[1])
            elif not isinstance(goal, Lift):
                assert ("pad", referents.pads[0]) not in now.spots.values()
            after = goal.after(now, referents)
            assert after is not None
            now = after
    assert seen == {Lift, Place, Push, Stack}


def test_a_way_is_found_where_a_wrong_choice_leads_nowhere() -> None:
    goals: dict[str, Goal | None] = {name: GOALS[name] for name in ("lift", "place")}
    for seed in range(50):  # with both pads full, a third block must not be lifted
        assert len(Chain(goals, length=9).plan(3, np.random.RandomState(seed))) == 9


def test_a_chain_that_cannot_be_is_refused() -> None:
    with pytest.raises(ValueError, match=r"give no chain of 2 instructions with 2 blocks: lower task\.goal\.length"):
        Chain({"lift": GOALS["lift"]}, length=2)
    with pytest.raises(ValueError, match=r"task\.goal\.goals\.pick cannot be part of a chain"):
        Chain({"pick": PickPlace(**COMMON, radius=0.04)}, length=2)
    coloured = Grammar(
        ["{move} {block}"], {"move": ["move"]}, ["{block}"], {"move": ["shift"]}, held_out_colours=["red"]
    )
    with pytest.raises(ValueError, match="names blocks of all colours"):
        Chain({"lift": Lift(language=coloured, height=0.1, hold_steps=3), "place": GOALS["place"]}, length=2)


def test_the_next_instruction_comes_when_one_is_completed(chain: Tabletop, tmp_path: Path) -> None:
    recorder = RerunRecorder(tmp_path, pictures=1)
    agent = Tiring(Waypoint(chain.spec), most=3)
    episode = rollout(chain, agent, FIRST, recorder)
    said = [seen.instruction for seen in episode.observations]
    wanted = [episode.draws["language"]["instruction"], *episode.draws["language"]["then"]]
    assert list(dict.fromkeys(said)) == wanted == agent.heard and len(wanted) == 3
    assert episode.success and episode.completed == (3, 3) and episode.task == "chain"
    with chain.blind():
        assert replay(chain, episode).first_difference is None
    file = tmp_path / f"{recording_name(FIRST, 'success')}.rrd"
    [entry] = RrdReader(file).recordings()
    [chunk] = RrdReader(file).store(store=entry).stream().filter(content=["/instruction"]).to_chunks()
    columns = chunk.to_record_batch().to_pydict()
    assert columns["step"] == [said.index(each) for each in wanted]
    assert all(each in text for each, [text] in zip(wanted, columns["TextDocument:text"], strict=True))


def test_a_chain_ends_where_one_instruction_fails_and_its_outcome_is_about_that_one(chain: Tabletop) -> None:
    with chain.blind():
        result = play_episode(chain, Tiring(Waypoint(chain.spec), most=1), SECOND)
        again = play_episode(chain, Tiring(Waypoint(chain.spec), most=1), SECOND)
        chain.reset(SECOND)
        assert chain.completed == 0 and chain.instructions == 3
    assert result.completed == (1, 3) and result.outcome not in ("success", "error") and result.steps > 100
    assert again == result


def test_a_demonstration_has_one_instruction_and_begins_where_those_before_it_end(chain: Tabletop) -> None:
    expert, starts = Waypoint(chain.spec), []
    with chain.blind():
        for seed in (0, 3, 7):
            episode = rollout(chain, expert, seed)
            assert episode.success and episode.completed is None and episode.task in GOALS
            assert {seen.instruction for seen in episode.observations} == {episode.draws["language"]["instruction"]}
            assert "then" not in episode.draws["language"]
            assert replay(chain, episode).first_difference is None
            starts.append(chain.simulation.compiled.data.time - len(episode.observations) / 10)
    assert min(starts) == pytest.approx(0) and max(starts) > 1  # [s] of the instructions before


def in_a_row(*counts: int) -> Report:
    return Report(
        tuple(
            Result(FIRST_SEED + index, "success" if count == 4 else "dropped", completed=(count, 4))
            for index, count in enumerate(counts)
        )
    )


def test_a_chain_is_also_asked_for_with_other_blocks(chain: Tabletop) -> None:
    environment = make_tabletop("task/goal=chain", "task.goal.length=3", "task/randomize/naming=swapped")
    for seed in (FIRST, SECOND):
        with environment.blind(), chain.blind():
            environment.reset(seed)
            chain.reset(seed)
        asked, before = environment.simulation.requests, chain.simulation.requests
        assert [type(each.goal) for each in asked] == [type(each.goal) for each in before]
        assert all(one.referents.blocks != other.referents.blocks for one, other in zip(asked, before, strict=True))
        assert all(one.referents.pads == other.referents.pads for one, other in zip(asked, before, strict=True))
    environment.close()


def test_a_report_tells_how_many_were_completed_in_a_row(tmp_path: Path) -> None:
    report = in_a_row(4, 4, 2, 0)
    assert report.completion_counts == {"1/4": 3, "2/4": 3, "3/4": 2, "4/4": 2}
    lines = str(report).splitlines()
    assert "2/4 3/4 (75.0 %, 95 % CI 30.1-95.4)" in lines
    assert any(line.startswith("completed in a row on average 2.50 (95 % CI ") for line in lines)
    told = summary(report)
    assert told["in_a_row"]["3/4"]["count"] == 2
    assert told["mean_in_a_row"]["ci_low"] < told["mean_in_a_row"]["mean"] == 2.5 < told["mean_in_a_row"]["ci_high"]
    write_report(report, tmp_path / "report.json", None, {})
    page = write_page(tmp_path).read_text()
    assert "Instructions completed in a row" in page and "on average 2.50" in page and ">3/4</td>" in page
    assert json.loads((tmp_path / "report.json").read_text())["per_episode"][2]["completed"] == [2, 4]


def test_episodes_of_one_instruction_have_no_such_rates() -> None:
    report = Report((Result(FIRST_SEED, "success"),))
    assert report.mean_completed is None and not summary(report)["in_a_row"] and "completed" not in str(report)


def test_the_interval_of_a_bounded_mean() -> None:
    low, high = wilson_interval(7, 10)
    assert bounded_mean_interval([4] * 7 + [0] * 3, 4) == pytest.approx((4 * low, 4 * high))
    narrow = bounded_mean_interval([3] * 7 + [2] * 3, 4)
    assert narrow[0] < 2.7 < narrow[1] and narrow[1] - narrow[0] < 0.6 * 4 * (high - low)
    assert bounded_mean_interval([4] * 10, 4) == pytest.approx(
        [4 * bound for bound in wilson_interval(10, 10)], abs=0.1
    )
    random = np.random.default_rng(0)
    covered = []
    for _ in range(400):  # chains in which every instruction succeeds with a probability of 0.8
        done = np.minimum(random.geometric(0.2, 50) - 1, 4)
        low, high = bounded_mean_interval(done.tolist(), 4)
        covered.append(low <= sum(0.8**n for n in range(1, 5)) <= high)
    assert np.mean(covered) > 0.92


def test_disturbances_are_of_the_episode_not_of_an_instruction() -> None:
    environment = make_tabletop("task/goal=chain", "task.goal.length=3", "task/randomize/disturbance=wide")
    expert, happened = Waypoint(environment.spec), 0
    with environment.blind():
        for seed in (FIRST_SEED, FIRST_SEED + 1):
            observation, began = environment.reset(seed), []
            while not environment.done:
                known = environment.completed
                observation = environment.step(expert.act(observation))
                began += [len(environment.events)] if environment.completed > known else []
            happened += len(environment.events)
            assert len(environment.events) <= 1 and began == sorted(began)  # none is forgotten
    assert happened == 2 and environment.completed == 3
    environment.close()


def test_a_simulator_that_plays_single_instructions_refuses_a_chain(chain: Tabletop, tmp_path: Path) -> None:
    parts: dict[str, Any] = {
        "robot": JointLimits(**defaults_of("deploy/robot/simulated")),
        "topics": Topics(**defaults_of("deploy/topics/isaac")),
        **defaults_of("deploy/simulator", seed=FIRST),
    }
    nothing: Any = None
    deployment = SimulatorDeployment(
        **parts,
        network=RosNetwork("loopback", None, None),
        policy=nothing,
        environment=lambda: chain,
        output=tmp_path,
    )
    with pytest.raises(ValueError, match=r"^deploy=simulator waits for one instruction .*: set task\.goal\.length=1$"):
        deployment.run()


def test_a_chain_starts_anywhere_under_noise_and_without_images(chain: Tabletop) -> None:
    noisy = make_tabletop("task/goal=chain", "task/randomize/sensor=wide", "task.image_size=[32,32]")
    first, second, again = (noisy.reset(seed).rgb["front"] for seed in (0, 1, 0))
    assert np.array_equal(first, again) and not np.array_equal(first, second)
    noisy.close()
    with chain.blind():
        assert chain.reset(0).rgb == {}
