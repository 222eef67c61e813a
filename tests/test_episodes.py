"""The episode store: nothing lost, nothing doubled, nothing half written, and clear words where it cannot be read."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from collecting import content
from toy import ARM_SPEC
from toy_episodes import CODECS, CONFIG, EPISODES, add, full_disk

from vla.data.episodes import EpisodeStore
from vla.data.header import Codec
from vla.data.verification import episode_of


def test_what_was_stored_is_read_back(tmp_path: Path) -> None:
    written, store = add(tmp_path, EPISODES), EpisodeStore(tmp_path)
    assert store.attempts == written.attempts
    assert store.spec == ARM_SPEC
    assert [entry.seed for entry in store.episodes] == [0, 1, 2, 4]
    assert store.attempts[3].outcome == "timeout" and store.attempts[3].steps == 0
    assert store.next_seed == 5
    assert store.attempts[0].draws["colour"] in ("red", "blue") and store.attempts[0].draws["limit"] == 40
    assert len(store.rows("state")) == sum(entry.steps for entry in store.episodes)
    for entry in store.episodes:
        came, went = episode_of(store, entry), EPISODES[entry.seed]
        for name in ("seed", "task", "instruction", "outcome", "milestones"):
            assert getattr(came, name) == getattr(went, name)
        np.testing.assert_array_equal([came.actions, came.executed], [went.actions, went.executed])
        for seen, was in zip(came.observations, went.observations, strict=True):
            for kind in ("rgb", "depth", "truth"):
                one, other = getattr(seen, kind), getattr(was, kind)
                assert one.keys() == other.keys() and all(np.array_equal(one[name], other[name]) for name in other)
            np.testing.assert_array_equal(seen.state, was.state)


def test_a_world_may_describe_its_steps_in_lists_and_arrays(tmp_path: Path) -> None:
    written = add(tmp_path, EPISODES)
    sequences: dict[str, Any] = {"cameras": [*ARM_SPEC.cameras], "image_size": [*ARM_SPEC.image_size]}
    spec = replace(ARM_SPEC, **sequences, low=np.array(ARM_SPEC.low))  # type: ignore[arg-type]
    assert EpisodeStore.create_or_open(tmp_path, spec, CONFIG).spec == written.spec
    with pytest.raises(ValueError, match=r"^this task has control_hz = 5\.0, but the episode store .* has 10\.0"):
        EpisodeStore.create_or_open(tmp_path, replace(spec, control_hz=5.0), CONFIG)


def test_the_files_can_be_read_without_this_package(tmp_path: Path) -> None:
    add(tmp_path, EPISODES)
    fields = json.loads((tmp_path / "store.json").read_text())["fields"]
    line = json.loads((tmp_path / "index.jsonl").read_text().splitlines()[1])
    layout = fields["rgb_front"]
    frames = np.fromfile(tmp_path / "rgb_front.bin", layout["dtype"]).reshape(-1, *layout["shape"])
    np.testing.assert_array_equal(frames[line["start"]], EPISODES[1].observations[0].rgb["front"])


def test_statistics_and_samples_are_those_of_all_stored_actions(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    statistics, stored = add(tmp_path, EPISODES).statistics, [each.actions for each in EPISODES if each.success]
    np.testing.assert_array_equal(statistics.actions, np.concatenate(stored))
    np.testing.assert_array_equal(statistics.low, np.concatenate(stored).min(0))
    np.testing.assert_array_equal(statistics.high, np.concatenate(stored).max(0))
    padded = [np.concatenate([actions, actions[-1:].repeat(3, 0)]) for actions in stored]  # chunks stay within episodes
    expected = [each[step : step + 4] for each in padded for step in range(len(each) - 3)]
    np.testing.assert_array_equal(statistics.chunks(4), expected)
    monkeypatch.setattr("vla.spec.MAX_SAMPLE", 40)
    few = statistics.chunks(4)
    np.testing.assert_array_equal(few[[0, -1]], [expected[0], expected[-1]])
    assert few.shape == (10, 4, 3)


def test_a_reader_can_keep_to_the_first_episodes(tmp_path: Path) -> None:
    add(tmp_path, EPISODES)
    assert [entry.seed for entry in EpisodeStore(tmp_path, episodes=2).episodes] == [0, 1]
    assert len(EpisodeStore(tmp_path, episodes=2).statistics.actions) == sum(len(each.actions) for each in EPISODES[:2])
    with pytest.raises(ValueError, match="holds 4 of 9 episodes"):
        EpisodeStore(tmp_path, episodes=9)
    empty = add(tmp_path / "empty", [])
    assert empty.episodes == [] and empty.next_seed is None and empty.rows("rgb_front").shape == (0, 16, 16, 3)
    with pytest.raises(ValueError, match="no episodes yet"):
        _ = empty.statistics


TEARS: dict[str, tuple[float, float, float]] = {  # share of the last episode in one file, in the others, in the index
    "nothing": (0, 0, 0),
    "half a file": (0.5, 0, 0),
    "every file, no line": (1, 1, 0),
    "every file, half a line": (1, 1, 0.5),
    "every file, a line without its end": (1, 1, 0.999),
}


@pytest.mark.parametrize("codec", CODECS, ids=str)
@pytest.mark.parametrize("tear", TEARS)
def test_a_commit_cut_short_is_as_if_it_never_began(tmp_path: Path, tear: str, codec: Codec) -> None:
    whole, torn = tmp_path / "whole", tmp_path / "torn"
    add(whole, EPISODES, codec)
    add(torn, EPISODES[:4], codec)
    one, others, index = TEARS[tear]
    for file in sorted(content(whole).keys() - {"store.json"}):
        share = index if file == "index.jsonl" else one if file.startswith("rgb_front") else others
        missing = (whole / file).read_bytes()[(torn / file).stat().st_size :]
        with (torn / file).open("ab") as stream:
            stream.write(missing[: int(share * len(missing))])
    assert [entry.seed for entry in EpisodeStore(torn).attempts] == [0, 1, 2, 3]
    add(torn, EPISODES[4:], codec)
    assert content(torn) == content(whole)


@pytest.mark.parametrize("codec", CODECS, ids=str)
def test_a_full_disk_takes_back_the_half_written_episode_only(tmp_path: Path, codec: Codec) -> None:
    whole, full = tmp_path / "whole", tmp_path / "full"
    add(whole, EPISODES, codec)
    store = add(full, EPISODES[:2], codec)
    before = content(full)
    with store.writing():
        safe = r"cannot take seed 2 .*: make room and run again to continue after 2 safe episodes"
        most = max(map(len, before.values()))
        with full_disk(most + 1000), pytest.raises(ValueError, match=safe):
            store.append(EPISODES[2])
        assert content(full) == before
        store.append(EPISODES[2])
    add(full, EPISODES[3:], codec)
    assert content(full) == content(whole)


def test_a_full_disk_takes_no_store(tmp_path: Path) -> None:
    with full_disk(100), pytest.raises(OSError, match=r"store\.json cannot be written \(.*\): make room there"):
        add(tmp_path, [])
    add(tmp_path, EPISODES)
    assert not list(tmp_path.glob(".*")) and "store.json" in content(tmp_path)


def test_episodes_that_have_lost_their_description_are_not_adopted(tmp_path: Path) -> None:
    add(tmp_path, EPISODES)
    description = (tmp_path / "store.json").read_bytes()
    (tmp_path / "store.json").unlink()
    before = content(tmp_path)
    for config in (CONFIG, {**CONFIG, "task": {"size": 2.0}}):
        with pytest.raises(ValueError, match=r"holds action\.bin without store\.json, which describes it"):
            EpisodeStore.create_or_open(tmp_path, ARM_SPEC, config)
    assert content(tmp_path) == before
    (tmp_path / "store.json").write_bytes(description)
    assert len(EpisodeStore.create_or_open(tmp_path, ARM_SPEC, CONFIG).episodes) == 4


def test_a_store_of_another_task_is_refused(tmp_path: Path) -> None:
    add(tmp_path, EPISODES)
    with pytest.raises(ValueError, match=r"this task has control_hz = 20\.0, but the episode store .* has 10\.0"):
        EpisodeStore.create_or_open(tmp_path, replace(ARM_SPEC, control_hz=20.0), CONFIG)
    with pytest.raises(ValueError, match=r"has episodes of another task: set another collect\.folder"):
        EpisodeStore.create_or_open(tmp_path, ARM_SPEC, {**CONFIG, "task": {"size": 2.0}})


def test_an_episode_that_does_not_fit_is_refused(tmp_path: Path) -> None:
    store, seen = add(tmp_path, []), EPISODES[0].observations
    lost = [*seen[:-1], replace(seen[-1], state=seen[-1].state * np.nan)]
    small, blind = [replace(each, state=each.state[:6]) for each in seen], [replace(each, rgb={}) for each in seen]
    for says, episode in {
        r"state must be \(12, 15\) float32, got \(12, 6\)": replace(EPISODES[0], observations=small),
        "an observation lacks 'front', which the spec names": replace(EPISODES[0], observations=blind),
        "seed 0: state has numbers that are not finite": replace(EPISODES[0], observations=lost),
        "seed 0: action has numbers that are not finite": replace(EPISODES[0], actions=EPISODES[0].actions * np.inf),
        "an episode store keeps finite numbers": replace(EPISODES[0], draws={"distance": np.nan}),
    }.items():
        with store.writing(), pytest.raises(ValueError, match=says):
            store.append(episode)
    assert EpisodeStore(tmp_path).attempts == []
    add(tmp_path, EPISODES[:2])
    store = EpisodeStore(tmp_path)
    with store.writing(), pytest.raises(ValueError, match="expects seed 2 next, got seed 4"):
        store.append(EPISODES[4])


def test_what_cannot_be_read_is_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"there is no episode store in .*nowhere"):
        EpisodeStore(tmp_path / "nowhere")
    whole = tmp_path / "whole"
    add(whole, EPISODES)

    def damaged(name: str, change: Callable[[bytes], bytes]) -> Path:
        shutil.copytree(whole, folder := tmp_path / "damaged", dirs_exist_ok=True)
        (folder / name).write_bytes(change((whole / name).read_bytes()))
        return folder

    with pytest.raises(ValueError, match=r"depth_wrist\.bin is shorter than its index says"):
        EpisodeStore(damaged("depth_wrist.bin", lambda data: data[:-1]))
    with pytest.raises(ValueError, match=r"line 2 of .*index\.jsonl does not follow"):
        EpisodeStore(damaged("index.jsonl", lambda data: data.split(b"\n")[0] + b"\n" + data))
    with pytest.raises(ValueError, match="has no field 'rgb': it has action, depth_front"):
        EpisodeStore(whole).rows("rgb")


@pytest.mark.parametrize("name", ["index.jsonl", "executed.bin", "rgb_front.bin"])
def test_nothing_is_written_behind_a_link(name: str, tmp_path: Path) -> None:
    add(tmp_path / "store", EPISODES)
    victim = tmp_path / "victim"
    victim.write_bytes((tmp_path / "store" / name).read_bytes())
    (tmp_path / "store" / name).unlink()
    (tmp_path / "store" / name).symlink_to(victim)
    victim.open("ab").write(b"x" * 9000)
    before = victim.read_bytes()
    store = EpisodeStore(tmp_path / "store", allow_damage=True)
    assert [entry.seed for entry in store.episodes] == [0, 1, 2, 4]
    with pytest.raises(ValueError, match=rf"{re.escape(name)} is a link"), EpisodeStore(tmp_path / "store").writing():
        pass
    assert victim.read_bytes() == before
