"""Verification and derivation of stores: all damage is found, and undamaged episodes are copied byte for byte."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from toy import ARM_SPEC, make_arm, make_environment, make_expert
from toy_episodes import CONFIG, EPISODES, MORE, add, change, content, flip

from vla.data.derivation import derive_store
from vla.data.episodes import EpisodeStore
from vla.data.index import listed
from vla.data.verification import episode_of, find_episode, require_whole, verify_store
from vla.parallel.pool import LocalCluster
from vla.rollouts.collect import collect
from vla.spec import Episode


def of_another_task(folder: Path, episodes: list[Episode]) -> EpisodeStore:
    add(folder, episodes)
    header = json.loads((folder / "store.json").read_text())
    (folder / "store.json").write_text(json.dumps({**header, "config": {"task": {"size": 2.0}}}))
    return EpisodeStore(folder)


def test_an_episode_comes_out_as_it_went_in(tmp_path: Path) -> None:
    store = add(tmp_path, EPISODES)
    for entry in store.episodes:
        came, went = episode_of(store, entry), EPISODES[entry.seed]
        assert (came.seed, came.instruction, came.outcome) == (went.seed, went.instruction, went.outcome)
        assert (came.task, came.milestones) == (went.task, went.milestones)
        np.testing.assert_array_equal(came.actions, went.actions)
        np.testing.assert_array_equal(came.executed, went.executed)
        for seen, was in zip(came.observations, went.observations, strict=True):
            assert seen.truth is not None and was.truth is not None and list(seen.truth) == list(was.truth)
            np.testing.assert_array_equal(seen.truth["point"], was.truth["point"])
            np.testing.assert_array_equal(seen.depth["wrist"], was.depth["wrist"])
            np.testing.assert_array_equal(seen.state, was.state)


def test_a_whole_store_is_described(tmp_path: Path) -> None:
    found = verify_store(add(tmp_path, EPISODES))
    require_whole(found)
    steps = sum(len(episode.actions) for episode in EPISODES if episode.success)
    assert found.outcomes == {"success": 4, "timeout": 1} and found.success_rate == 0.8
    assert found.hours == pytest.approx(steps / 10 / 3600)
    assert found.sizes["rgb_front"] == steps * 16 * 16 * 3 == (tmp_path / "rgb_front.bin").stat().st_size
    np.testing.assert_array_equal(found.actions[:12], EPISODES[0].actions)


def test_an_empty_store_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="holds no episodes yet: collect some first"):
        require_whole(verify_store(add(tmp_path, [])))


def lose_a_line(folder: Path) -> None:
    change(folder / "index.jsonl", lambda data: data.replace(b'"seed": 1,', b'"seed": 1\0', 1))


def lose_a_line_end(folder: Path) -> None:
    change(folder / "index.jsonl", lambda data: data.replace(b'\n{"seed": 2', b'\t{"seed": 2'))


def lose_a_field(folder: Path) -> None:
    (folder / "depth_wrist.bin").unlink()


def lose_a_tail(folder: Path) -> None:
    os.truncate(folder / "state.bin", (folder / "state.bin").stat().st_size - 1)


def poison(folder: Path) -> None:
    store = add(folder / "new", [])
    with store.writing():
        seen = EPISODES[0].observations
        store.append(replace(EPISODES[0], observations=[replace(seen[0], state=seen[0].state * np.nan), *seen[1:]]))
    for path in (folder / "new").iterdir():
        os.replace(path, folder / path.name)
    (folder / "new").rmdir()


DAMAGE: dict[str, tuple[Callable[[Path], object], list[int], str]] = {
    "a changed bit": (lambda folder: change(folder / "rgb_front.bin", lambda data: flip(data, 0)), [0], "rows changed"),
    "a short file": (lose_a_tail, [4], "rows changed"),
    "a missing file": (lose_a_field, [0, 1, 2, 4], "rows changed"),
    "a garbled line": (lose_a_line, [1], "no readable line"),
    "a lost line end": (lose_a_line_end, [1, 2], "no readable line"),
    "a changed seed": (
        lambda folder: change(folder / "index.jsonl", lambda data: data.replace(b'"seed": 1,', b'"seed": 9,')),
        [1],
        "no readable line",
    ),
    "a changed place": (
        lambda folder: change(folder / "index.jsonl", lambda data: data.replace(b'"start": 12,', b'"start": 72,')),
        [1],
        "no readable line",
    ),
    "a changed word": (
        lambda folder: change(folder / "index.jsonl", lambda data: data.replace(b"red", b"rad", 1)),
        [0],
        "no readable line",
    ),
    "a garbled last line": (
        lambda folder: change(folder / "index.jsonl", lambda data: flip(data, len(data) - 2)),
        [4],
        "no readable line",
    ),
    "a changed end": (
        lambda folder: change(folder / "index.jsonl", lambda data: flip(data, len(data) - 1)),
        [4],
        "no readable line",
    ),
    "a garbled first line": (
        lambda folder: change(folder / "index.jsonl", lambda data: b"#" + data),
        [0],
        "no readable line",
    ),
    "no number": (poison, [0], "not finite"),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_damage_is_found_named_and_left_behind(tmp_path: Path, name: str) -> None:
    damage, seeds, problem = DAMAGE[name]
    folder, repaired = tmp_path / "store", tmp_path / "repaired"
    tried = EPISODES[:1] if name == "no number" else EPISODES
    add(folder, tried)
    damage(folder)
    before = content(folder)
    found = verify_store(EpisodeStore(folder, damaged=True))
    assert sorted(seed for some in found.damaged.values() for seed in some) == seeds
    with pytest.raises(ValueError, match=rf"{len(seeds)} damaged episodes .*{problem}.*inspect\.repair=true"):
        require_whole(found)
    if len(seeds) == len(tried):
        return
    assert derive_store([EpisodeStore(folder, damaged=True)], repaired, repair=True) == seeds
    assert content(folder) == before
    store = EpisodeStore(repaired)
    assert [entry.outcome for entry in store.tried] == [
        "damaged" if seed in seeds else EPISODES[seed].outcome for seed in range(5)
    ]
    expected = add(tmp_path / "expected", EPISODES)
    for entry in store.episodes:
        rows = expected.read(expected.tried[entry.seed])
        for field, values in store.read(entry).items():
            np.testing.assert_array_equal(values, rows[field])


def test_collection_goes_on_in_a_repaired_store(tmp_path: Path) -> None:
    store = add(tmp_path / "store", EPISODES)
    change(tmp_path / "store" / "action.bin", lambda data: flip(data, 0))
    derive_store([EpisodeStore(store.folder, damaged=True)], tmp_path / "repaired", repair=True)
    repaired = EpisodeStore.create_or_open(tmp_path / "repaired", ARM_SPEC, CONFIG)
    summary = collect(repaired, make_arm, make_expert, episodes=4, cluster=LocalCluster(1, "beside"), seed=0)
    assert (summary.tried, summary.failures) == (5, {"timeout": 1}) and summary.success_rate == 0.8
    assert [(entry.seed, entry.outcome) for entry in repaired.tried][::5] == [(0, "damaged"), (5, "success")]


def test_stores_of_one_config_become_what_one_collection_would_have_made(tmp_path: Path) -> None:
    early, late = add(tmp_path / "early", MORE[:5]), add(tmp_path / "late", MORE[3:])
    add(tmp_path / "whole", MORE)
    derive_store([late, early], tmp_path / "merged")
    assert content(tmp_path / "merged") == content(tmp_path / "whole")


def test_copies_with_different_damage_make_a_whole_one(tmp_path: Path) -> None:
    copies = [tmp_path / "one", tmp_path / "two"]
    for copy in copies:
        add(copy, EPISODES)
    change(copies[0] / "action.bin", lambda data: flip(data, 0))
    change(copies[1] / "state.bin", lambda data: flip(data, len(data) - 1))
    stores = [EpisodeStore(copy, damaged=True) for copy in copies]
    assert derive_store(stores, tmp_path / "merged", repair=True) == []
    assert content(tmp_path / "merged") == content(add(tmp_path / "whole", EPISODES).folder)


def test_stores_of_several_configs_keep_them_apart(tmp_path: Path) -> None:
    first, second = add(tmp_path / "first", EPISODES[:2]), of_another_task(tmp_path / "second", EPISODES[1:3])
    derive_store([first, second], tmp_path / "merged")
    merged = EpisodeStore(tmp_path / "merged")
    require_whole(verify_store(merged))
    assert [entry.seed for entry in merged.episodes] == [0, 1, 1, 2]
    assert find_episode(merged, 0)[0] == CONFIG and find_episode(merged, 2)[0] == {"task": {"size": 2.0}}
    with pytest.raises(ValueError, match="has 2 episodes of seed 1: inspect one of the stores"):
        find_episode(merged, 1)
    add(tmp_path / "third", MORE[6:7])
    derive_store([merged, EpisodeStore(tmp_path / "third")], tmp_path / "again")
    assert [entry.seed for entry in EpisodeStore(tmp_path / "again").episodes] == [0, 1, 6, 1, 2]


def test_a_store_that_was_put_together_serves_training_and_does_not_grow(tmp_path: Path) -> None:
    derive_store([add(tmp_path / "store", EPISODES)], tmp_path / "chosen", {"seed": [1, 2]})
    chosen = EpisodeStore.create_or_open(tmp_path / "chosen", ARM_SPEC, {"task": {"size": 3.0}})
    assert [entry.seed for entry in chosen.episodes] == [1, 2] and chosen.derived
    assert len(chosen.statistics.actions) == len(EPISODES[1].actions) + len(EPISODES[2].actions)
    assert (
        collect(chosen, make_environment, make_expert, episodes=2, cluster=LocalCluster(1, "beside"), seed=0).added == 0
    )
    with pytest.raises(ValueError, match=r"cannot grow: set collect\.episodes=2"):
        collect(chosen, make_environment, make_expert, episodes=3, cluster=LocalCluster(1, "beside"), seed=0)
    change(chosen.folder / "index.jsonl", lambda data: data[: data.index(b"\n") + 1])
    with pytest.raises(ValueError, match="has lost lines: derive it again"):
        verify_store(EpisodeStore(chosen.folder, damaged=True))


CHOICES: dict[str, tuple[dict[str, object], Callable[[Episode], bool]]] = {
    "a text": ({"colour": "red"}, lambda episode: episode.draws["colour"] == "red"),
    "an asterisk": ({"instruction": "*the b?ue*"}, lambda episode: "blue" in episode.instruction and episode.success),
    "texts": ({"outcome": ["success", "nothing"]}, lambda episode: episode.success),
    "a number": ({"seed": 2}, lambda episode: episode.seed == 2),
    "a range": ({"seed": [1, 2]}, lambda episode: episode.seed in (1, 2)),
    "an open range": ({"point": [0.2, None]}, lambda episode: min(episode.draws["point"]) >= 0.2),
    "both": ({"seed": [None, 3], "limit": 40}, lambda episode: episode.seed <= 3),
}


@pytest.mark.parametrize("name", CHOICES)
def test_conditions_choose_episodes(tmp_path: Path, name: str) -> None:
    where, fits = CHOICES[name]
    derive_store([add(tmp_path / "store", MORE)], tmp_path / "chosen", where)
    store = EpisodeStore(tmp_path / "chosen")
    assert [entry.seed for entry in store.tried] == [episode.seed for episode in MORE if fits(episode)]
    assert store.config["where"] == [where]
    require_whole(verify_store(store))


def test_a_store_that_was_copied_without_its_index_is_not_taken_for_an_empty_one(tmp_path: Path) -> None:
    folder = add(tmp_path / "store", EPISODES).folder
    (folder / "index.jsonl").unlink()
    with pytest.raises(ValueError, match=r"index\.jsonl is missing, which .* beside it needs: copy the folder again"):
        EpisodeStore(folder)


def test_an_empty_draw_fits_no_condition(tmp_path: Path) -> None:
    lacks: dict[int, list[str]] = {1: [], 2: ["depth"]}
    episodes = [replace(EPISODES[seed], draws={"lacks": values}) for seed, values in lacks.items()]
    derive_store([add(tmp_path / "store", episodes)], tmp_path / "chosen", {"lacks": "depth"})
    assert [entry.seed for entry in EpisodeStore(tmp_path / "chosen").tried] == [2]


def test_conditions_that_cannot_be_meant_are_refused(tmp_path: Path) -> None:
    store = add(tmp_path / "store", EPISODES)
    for where, words in {
        "colur": r"no episode has colur, did you mean colour\?",
        "zzz": "no episode has zzz: there are seed, task, instruction, outcome, steps, point, colour, limit",
    }.items():
        with pytest.raises(ValueError, match=words):
            derive_store([store], tmp_path / "new", {where: "red"})
    conditions: list[object] = [{}, [1, 2, 3], [], None]
    for condition in conditions:
        with pytest.raises(ValueError, match="colour must be a text"):
            derive_store([store], tmp_path / "new", {"colour": condition})
    with pytest.raises(ValueError, match=r"store: there are no episodes that fit inspect\.where={'colour': 'green'}"):
        derive_store([store], tmp_path / "new", {"colour": "green"})
    assert not (tmp_path / "new").exists()


def test_nothing_is_overwritten_or_left_half_written(tmp_path: Path) -> None:
    store = add(tmp_path / "store", EPISODES)
    with pytest.raises(ValueError, match=r"store exists already and is left alone: choose another inspect\.into"):
        derive_store([store], store.folder)
    other = EpisodeStore.create_or_open(tmp_path / "other", replace(ARM_SPEC, control_hz=20.0), CONFIG)
    with pytest.raises(ValueError, match=r"other has control_hz = 20.0, but .*store has 10.0"):
        derive_store([store, other], tmp_path / "new")
    change(store.folder / "action.bin", lambda data: flip(data, len(data) - 1))
    with pytest.raises(ValueError, match=r"the rows of seed 4 in .* were changed on disk: .* inspect\.repair=true"):
        derive_store([store], tmp_path / "new")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["other", "store"]
    shutil.copytree(store.folder, tmp_path / ".new.draft")  # as if killed there
    derive_store([EpisodeStore(store.folder, damaged=True)], tmp_path / "new", repair=True)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["new", "other", "store"]


def test_a_seed_that_is_not_there_is_named(tmp_path: Path) -> None:
    store = add(tmp_path, EPISODES)
    assert find_episode(store, 2)[1].seed == 2
    with pytest.raises(ValueError, match="has no seed 7: it holds 0 to 4"):
        find_episode(store, 7)
    with pytest.raises(
        ValueError, match=r"seed 3 in .* ended as timeout, and its steps were not kept: there is 2 or 4"
    ):
        find_episode(store, 3)
    change(tmp_path / "action.bin", lambda data: flip(data, 0))
    with pytest.raises(ValueError, match=r"the rows of seed 0 in .* were changed on disk"):
        find_episode(EpisodeStore(tmp_path), 0)


def test_seeds_are_listed_in_words() -> None:
    assert listed([3]) == "3"
    assert listed([4, 2, 3, 3]) == "2 to 4"
    assert listed([1, 5]) == "1, 5"
    assert listed([*range(0, 40, 2)]) == "0, 2, 4, 6, 8, 10, 12, 14 and 12 others"
