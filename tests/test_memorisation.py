"""What a policy has memorised: policies without a sense, and demonstrations replayed."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import toy
from fake_batch import as_policy, make_act
from toy_recordable import RecordableEnvironment

from vla.data.episodes import EpisodeStore
from vla.data.verification import episode_of
from vla.io.errors import UserError
from vla.rollouts.evaluate import evaluate
from vla.rollouts.memorisation import AgentWithoutModality, Modality, NearestDemonstration, open_memory
from vla.rollouts.rollout import rollout
from vla.spec import FIRST_SEED, Array, Observation


class Noting(toy.ToyExpert):
    """The toy expert, which keeps what it saw and heard."""

    def reset(self, instruction: str, seed: int) -> None:
        super().reset(instruction, seed)
        self.seen: list[Observation] = []
        self.heard = instruction

    def act(self, observation: Observation) -> Array:
        self.seen.append(observation)
        return super().act(observation)


def test_without_images_all_is_grey_and_without_an_instruction_nothing_is_said() -> None:
    environment, agent = RecordableEnvironment(), Noting()
    blind = AgentWithoutModality(lambda _: agent, "images", environment)
    seen = rollout(environment, blind, FIRST_SEED).observations[0]
    for blind in agent.seen:
        assert all((image == 128).all() for image in blind.rgb.values())
        assert not any(image.any() for image in blind.depth.values())
    assert agent.seen[0].rgb.keys() == seen.rgb.keys() and agent.seen[0].instruction == agent.heard == seen.instruction
    assert np.array_equal(agent.seen[0].state, seen.state)
    rollout(environment, AgentWithoutModality(lambda _: agent, "instruction", environment), FIRST_SEED)
    assert agent.heard == agent.seen[0].instruction == ""
    assert np.array_equal(agent.seen[0].rgb["front"], seen.rgb["front"])
    rollout(environment, AgentWithoutModality(lambda _: agent, "both", environment), FIRST_SEED)
    assert agent.heard == agent.seen[0].instruction == "" and (agent.seen[0].rgb["front"] == 128).all()
    assert np.array_equal(agent.seen[0].state, seen.state)


@pytest.mark.parametrize("modality", ["images", "both", "instruction"])
def test_images_are_rendered_only_where_the_policy_reads_them(modality: Modality) -> None:
    policy, environment = as_policy(make_act(chunk=4, execute=2)), toy.make_environment()
    agent = AgentWithoutModality(lambda _: policy, modality, environment)
    every, some = (rollout(environment, agent, FIRST_SEED, all_images=complete) for complete in (True, False))
    assert np.array_equal(every.executed, some.executed)
    rendered = [step for step, seen in enumerate(some.observations) if seen.rgb]
    assert rendered == ([*range(0, len(some.observations), 2)] if modality == "instruction" else [0])


def test_the_nearest_demonstration_of_a_known_scene_is_its_own_unless_that_is_shown(folder: Path) -> None:
    store, environment = EpisodeStore(folder), toy.make_environment()
    agent = NearestDemonstration(folder, 20, spec=environment.spec)
    for entry in store.episodes[:3]:
        recorded, seen = store.rows("executed")[entry.span], environment.reset(entry.seed)
        agent.reset(entry.instruction, FIRST_SEED)
        assert agent.looks
        assert np.array_equal([agent.act(seen) for _ in recorded], recorded) and not agent.looks
        agent.reset(entry.instruction, entry.seed)
        assert not np.array_equal([agent.act(seen) for _ in recorded], recorded)
    # Among those with the same instruction, if there is one.
    seen = environment.reset(store.episodes[0].seed)
    other = next(entry.instruction for entry in store.episodes if entry.instruction != seen.instruction)
    own, theirs, any_of_them = (
        _first_action(agent, replace(seen, instruction=said)) for said in (seen.instruction, other, "whatever")
    )
    assert np.array_equal(own, any_of_them) and not np.array_equal(own, theirs)


def test_demonstrations_with_images_of_another_size_are_replayed(folder: Path) -> None:
    store, environment = EpisodeStore(folder), toy.make_environment()
    agent = NearestDemonstration(folder, None, spec=replace(toy.SPEC, image_size=(32, 48)))
    for entry in store.episodes[:5]:
        seen = environment.reset(entry.seed)
        wide = np.zeros((32, 48, 3), np.uint8)  # sharper, and with sides that the demonstrations do not show
        wide[:, 8:40] = seen.rgb["eye"].repeat(2, 0).repeat(2, 1)
        recorded = store.rows("executed")[entry.span][0]
        assert np.array_equal(_first_action(agent, replace(seen, rgb={"eye": wide}), FIRST_SEED), recorded)


def _first_action(agent: NearestDemonstration, observation: Observation, seed: int = 0) -> Array:
    agent.reset(observation.instruction, seed)
    return agent.act(observation)


def test_another_part_of_the_same_recording_is_no_other_demonstration(folder: Path, tmp_path: Path) -> None:
    source = EpisodeStore(folder)
    first, other = (episode_of(source, entry) for entry in source.episodes[:2])
    parts = EpisodeStore.create_or_open(tmp_path, toy.SPEC.without_truth, {})
    with parts.writing():
        for seed, (whole, recording) in enumerate([(first, 0), (first, 0), (other, 1)]):
            parts.append(replace(whole, seed=seed, draws={"recorded": {"episode": recording}}))
    agent, seen = NearestDemonstration(tmp_path, None, spec=toy.SPEC), first.observations[0]
    assert np.array_equal(_first_action(agent, seen, seed=1), other.executed[0])
    assert np.array_equal(_first_action(agent, seen, seed=2), first.executed[0])
    with pytest.raises(UserError, match="has no other recording than the one that is shown"):
        _first_action(NearestDemonstration(tmp_path, 2, spec=toy.SPEC), seen, seed=1)


def test_new_scenes_are_mostly_failed_and_other_stores_refused(folder: Path, tmp_path: Path) -> None:
    make = partial(NearestDemonstration, folder, 30)
    report = evaluate(
        toy.make_environment, lambda environment: make(spec=environment.spec), None, range(FIRST_SEED, FIRST_SEED + 20)
    )
    assert report.success < 0.3 and not report.errors  # the expert succeeds in four of five
    with pytest.raises(ValueError, match="has cameras"):
        NearestDemonstration(folder, 20, spec=toy.ARM_SPEC)
    with pytest.raises(ValueError, match="30 of 31 episodes"):
        NearestDemonstration(folder, 31, spec=toy.SPEC)
    EpisodeStore.create_or_open(tmp_path, toy.SPEC, {})
    with pytest.raises(ValueError, match="holds no episodes yet"):
        open_memory(tmp_path, None, toy.SPEC)
