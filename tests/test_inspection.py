"""Verification and derivation of stores, and `job=inspect`: damage is found, and undamaged episodes are copied."""

from __future__ import annotations

import logging
import shutil
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from collecting import content
from command_line import SMALL
from composing import composed
from toy import ARM_SPEC, make_arm, make_environment, make_expert
from toy_episodes import CODECS, CONFIG, EPISODES, MORE, add, change, flip, full_disk

from vla.config.experiment import Experiment
from vla.config.nodes import Inspection
from vla.data.derivation import derive_store
from vla.data.episodes import EpisodeStore
from vla.data.header import Codec
from vla.data.index import format_numbers, index_line
from vla.data.verification import find_episode, require_whole, verify_store
from vla.io.errors import UserError
from vla.jobs.collect import demonstrations
from vla.jobs.inspect import inspect_store, run
from vla.parallel.pool import Cluster
from vla.rollouts.collect import collect
from vla.spec import Episode


def test_a_whole_store_is_described(tmp_path: Path) -> None:
    found = verify_store(add(tmp_path, EPISODES))
    require_whole(found)
    steps = sum(len(episode.actions) for episode in EPISODES if episode.success)
    assert found.outcomes == {"success": 4, "timeout": 1} and found.success_rate == 0.8
    assert found.hours == pytest.approx(steps / 10 / 3600)
    assert found.sizes["rgb_front"] == steps * 16 * 16 * 3 == (tmp_path / "rgb_front.bin").stat().st_size
    np.testing.assert_array_equal(found.actions[:12], EPISODES[0].actions)
    with pytest.raises(ValueError, match="holds no episodes yet: collect some first"):
        require_whole(verify_store(add(tmp_path / "empty", [])))


def of_index(edit: Callable[[bytes], bytes]) -> Callable[[Path], object]:
    return lambda folder: change(folder / "index.jsonl", edit)


def replaced(old: bytes, new: bytes) -> Callable[[Path], object]:
    return of_index(lambda data: data.replace(old, new, 1))


def poison(folder: Path) -> None:
    """Numbers that are not finite, with their checksum, as another program may write them."""
    store = EpisodeStore(folder)
    states, entry = np.array(store.rows("state")), store.episodes[0]
    states[0] = np.nan
    (folder / "state.bin").write_bytes(states.tobytes())
    crc = {**entry.crc, "state": zlib.crc32(states[entry.span].data)}
    lines = (folder / "index.jsonl").read_bytes().splitlines(keepends=True)
    (folder / "index.jsonl").write_bytes(b"".join([index_line(replace(entry, crc=crc)), *lines[1:]]))


DAMAGE: dict[str, tuple[Callable[[Path], object], list[int], str]] = {
    "a changed bit": (lambda folder: change(folder / "rgb_front.bin", lambda data: flip(data, 0)), [0], "rows changed"),
    "a short file": (lambda folder: change(folder / "state.bin", lambda data: data[:-1]), [4], "rows changed"),
    "a missing file": (lambda folder: (folder / "depth_wrist.bin").unlink(), [0, 1, 2, 4], "rows changed"),
    "a garbled line": (replaced(b'"seed": 1,', b'"seed": 1\0'), [1], "no readable line"),
    "a lost line end": (replaced(b'\n{"seed": 2', b'\t{"seed": 2'), [1, 2], "no readable line"),
    "a changed seed": (replaced(b'"seed": 1,', b'"seed": 9,'), [1], "no readable line"),
    "a changed place": (replaced(b'"start": 12,', b'"start": 72,'), [1], "no readable line"),
    "a garbled first line": (of_index(lambda data: b"#" + data), [0], "no readable line"),
    "a lost first line": (of_index(lambda data: data[data.index(b"\n") + 1 :]), [0], "no readable line"),
    "a garbled last line": (of_index(lambda data: flip(data, len(data) - 2)), [4], "no readable line"),
    "a changed end": (of_index(lambda data: flip(data, len(data) - 1)), [4], "no readable line"),
    "no number": (poison, [0], "not finite"),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_damage_is_found_named_and_left_behind(tmp_path: Path, name: str) -> None:
    damage, seeds, problem = DAMAGE[name]
    folder, repaired = add(tmp_path / "store", EPISODES).folder, tmp_path / "repaired"
    damage(folder)
    before = content(folder)
    found = verify_store(EpisodeStore(folder, allow_damage=True))
    assert sorted(seed for some in found.damaged_seeds.values() for seed in some) == seeds
    with pytest.raises(ValueError, match=rf"{len(seeds)} damaged episodes? .*{problem}.*inspect\.repair=true"):
        require_whole(found)
    assert derive_store([EpisodeStore(folder, allow_damage=True)], repaired, repair=True) == seeds
    assert content(folder) == before
    store, expected = EpisodeStore(repaired), add(tmp_path / "expected", EPISODES)
    outcomes = ["damaged" if episode.seed in seeds else episode.outcome for episode in EPISODES]
    assert [entry.outcome for entry in store.attempts] == outcomes
    for entry in store.episodes:
        rows = expected.read(expected.attempts[entry.seed])
        assert all(np.array_equal(values, rows[field]) for field, values in store.read(entry).items())


def test_collection_goes_on_in_a_repaired_store(tmp_path: Path) -> None:
    store = add(tmp_path / "store", EPISODES)
    change(store.folder / "action.bin", lambda data: flip(data, 0))
    derive_store([EpisodeStore(store.folder, allow_damage=True)], tmp_path / "repaired", repair=True)
    repaired = EpisodeStore.create_or_open(tmp_path / "repaired", ARM_SPEC, CONFIG)
    summary = collect(repaired, make_arm, make_expert, episodes=4, cluster=Cluster(1, "beside"), seed=0)
    assert (summary.attempts, summary.failures) == (5, {"timeout": 1}) and summary.success_rate == 0.8
    assert [(entry.seed, entry.outcome) for entry in repaired.attempts][::5] == [(0, "damaged"), (5, "success")]


@pytest.mark.parametrize("codec", CODECS, ids=str)
def test_stores_of_one_config_become_what_one_collection_would_have_made(tmp_path: Path, codec: Codec) -> None:
    early, late = add(tmp_path / "early", MORE[:5], codec), add(tmp_path / "late", MORE[3:], codec)
    derive_store([late, early], tmp_path / "merged")
    assert content(tmp_path / "merged") == content(add(tmp_path / "whole", MORE, codec).folder)
    assert not EpisodeStore.create_or_open(tmp_path / "merged", ARM_SPEC, CONFIG).is_derived


def test_copies_with_different_damage_make_a_whole_one(tmp_path: Path) -> None:
    for name, file in (("one", "action.bin"), ("two", "state.bin")):
        add(tmp_path / name, EPISODES)
        change(tmp_path / name / file, lambda data, at=0 if name == "one" else -1: flip(data, at % len(data)))
    stores = [EpisodeStore(tmp_path / name, allow_damage=True) for name in ("one", "two")]
    assert derive_store(stores, tmp_path / "merged", repair=True) == []
    assert content(tmp_path / "merged") == content(add(tmp_path / "whole", EPISODES).folder)


def test_stores_of_several_configs_keep_them_apart(tmp_path: Path) -> None:
    first, second = add(tmp_path / "first", EPISODES[:2]), add(tmp_path / "second", EPISODES[1:3])
    change(second.folder / "store.json", lambda data: data.replace(b'"size": 1.0', b'"size": 2.0'))
    derive_store([first, EpisodeStore(second.folder)], tmp_path / "merged")
    merged = EpisodeStore(tmp_path / "merged")
    require_whole(verify_store(merged))
    assert [entry.seed for entry in merged.episodes] == [0, 1, 1, 2]
    assert find_episode(merged, 0)[0] == CONFIG and find_episode(merged, 2)[0] == {**CONFIG, "task": {"size": 2.0}}
    with pytest.raises(ValueError, match="has 2 episodes of seed 1: inspect one of the stores"):
        find_episode(merged, 1)
    add(tmp_path / "third", MORE[6:7])
    derive_store([merged, EpisodeStore(tmp_path / "third")], tmp_path / "again")
    assert [entry.seed for entry in EpisodeStore(tmp_path / "again").episodes] == [0, 1, 6, 1, 2]


def test_a_store_that_was_put_together_serves_training_and_does_not_grow(tmp_path: Path) -> None:
    derive_store([add(tmp_path / "store", EPISODES)], tmp_path / "chosen", {"seed": [1, 2]})
    chosen = EpisodeStore.create_or_open(tmp_path / "chosen", ARM_SPEC, {"task": {"size": 3.0}})
    assert [entry.seed for entry in chosen.episodes] == [1, 2] and chosen.is_derived
    assert len(chosen.statistics.actions) == len(EPISODES[1].actions) + len(EPISODES[2].actions)
    cluster = Cluster(1, "beside")
    assert collect(chosen, make_environment, make_expert, episodes=2, cluster=cluster, seed=0).added == 0
    with pytest.raises(ValueError, match=r"cannot grow: set collect\.episodes=2"):
        collect(chosen, make_environment, make_expert, episodes=3, cluster=cluster, seed=0)
    change(chosen.folder / "index.jsonl", lambda data: data[: data.index(b"\n") + 1])
    with pytest.raises(ValueError, match="has lost lines: derive it again"):
        verify_store(EpisodeStore(chosen.folder, allow_damage=True))


CHOICES: dict[str, tuple[dict[str, object], Callable[[Episode], bool]]] = {
    "a text": ({"colour": "red"}, lambda episode: episode.draws["colour"] == "red"),
    "an asterisk": ({"instruction": "*the b?ue*"}, lambda episode: "blue" in episode.instruction and episode.success),
    "texts": ({"outcome": ["success", "nothing"]}, lambda episode: episode.success),
    "a number": ({"seed": 2}, lambda episode: episode.seed == 2),
    "a range": ({"seed": [1, 2]}, lambda episode: episode.seed in (1, 2)),
    "an open range": ({"point": [0.2, None]}, lambda episode: min(episode.draws["point"]) >= 0.2),
    "both": ({"seed": [None, 3], "limit": 40}, lambda episode: episode.seed <= 3),
    "brackets": ({"label": "[a]"}, lambda episode: episode.seed == 1),
    "a draw that some lack": ({"lacks.which": "depth"}, lambda episode: episode.seed == 2),
}


@pytest.mark.parametrize("name", CHOICES)
def test_conditions_choose_episodes(tmp_path: Path, name: str) -> None:
    lacks: dict[int, Any] = {1: {"which": []}, 2: {"which": ["depth"]}}
    draws = [{"lacks": lacks.get(one.seed, {}), "label": "[a]" if one.seed == 1 else "a"} for one in MORE]
    episodes = [replace(one, draws={**one.draws, **more}) for one, more in zip(MORE, draws, strict=True)]
    where, fits = CHOICES[name]
    derive_store([add(tmp_path / "store", episodes)], tmp_path / "chosen", where)
    store = EpisodeStore(tmp_path / "chosen")
    assert [entry.seed for entry in store.attempts] == [episode.seed for episode in MORE if fits(episode)]
    assert store.config["where"] == [where]
    require_whole(verify_store(store))


def test_conditions_that_cannot_be_meant_are_refused(tmp_path: Path) -> None:
    store = add(tmp_path / "store", EPISODES)
    refused: list[tuple[dict[str, object], str]] = [
        ({"colur": "red"}, r"no episode has colur, did you mean colour\?"),
        ({"zzz": "red"}, "no episode has zzz: there are seed, task, instruction, outcome, steps, point, colour, limit"),
        *(({"colour": condition}, "colour must be a text") for condition in ({}, [1, 2, 3], [], None)),
        ({"colour": "green"}, r"store: there are no episodes that fit inspect\.where={'colour': 'green'}"),
    ]
    for where, says in refused:
        with pytest.raises(ValueError, match=says):
            derive_store([store], tmp_path / "new", where)
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
    with full_disk(0), pytest.raises(UserError, match=r"/new cannot be written \(.*\), nothing of it is kept"):
        derive_store([store], tmp_path / "new")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["other", "store"]
    shutil.copytree(store.folder, tmp_path / ".0123abcd.new")  # as if killed there
    derive_store([EpisodeStore(store.folder, allow_damage=True)], tmp_path / "new", repair=True)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["new", "other", "store"]
    (store.folder / "index.jsonl").unlink()
    with pytest.raises(ValueError, match=r"index\.jsonl is missing, which .* beside it needs: copy the folder again"):
        EpisodeStore(store.folder)


def test_configs_that_a_collection_takes_for_one_are_one_when_stores_are_merged(tmp_path: Path) -> None:
    first, second = (
        add(tmp_path / "first", MORE[:4], limit=10.0),
        add(tmp_path / "second", MORE[2:], limit=10, new=None),
    )
    derive_store([first, second], tmp_path / "merged")
    merged = EpisodeStore(tmp_path / "merged")
    assert [entry.seed for entry in merged.attempts] == [episode.seed for episode in MORE] and not merged.is_derived


def test_two_processes_do_not_write_one_new_store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = add(tmp_path / "store", EPISODES)

    called = []

    def meanwhile(items: list[Any], description: str) -> list[Any]:
        called.append(description)
        with pytest.raises(UserError, match=r"another process writes .*new: wait for it"):
            derive_store([store], tmp_path / "inner/new")
        return items

    monkeypatch.setattr("vla.data.derivation.track", meanwhile)
    derive_store([store], tmp_path / "inner/new")
    assert called == ["writing"]
    assert verify_store(EpisodeStore(tmp_path / "inner/new")).intact_entries == store.episodes
    assert [path.name for path in (tmp_path / "inner").iterdir()] == ["new"]


def test_a_folder_that_is_made_while_a_new_store_is_written_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = add(tmp_path / "store", EPISODES)

    def meanwhile(items: list[Any], description: str) -> list[Any]:
        add(tmp_path / "new", EPISODES[:1])
        return items

    monkeypatch.setattr("vla.data.derivation.track", meanwhile)
    with pytest.raises(UserError, match="new exists already and is left alone"):
        derive_store([store], tmp_path / "new")
    assert EpisodeStore(tmp_path / "new").episodes == store.episodes[:1]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["new", "store"]


def test_a_seed_that_is_not_there_is_named(tmp_path: Path) -> None:
    store = add(tmp_path, EPISODES)
    assert find_episode(store, 2)[1].seed == 2
    with pytest.raises(ValueError, match="has no seed 7: it holds 0 to 4"):
        find_episode(store, 7)
    with pytest.raises(ValueError, match=r"seed 3 in .* ended as timeout, .* not kept; seeds with steps: 0, 1, 2, 4"):
        find_episode(store, 3)
    change(tmp_path / "action.bin", lambda data: flip(data, 0))
    with pytest.raises(ValueError, match=r"the rows of seed 0 in .* were changed on disk"):
        find_episode(EpisodeStore(tmp_path), 0)
    texts = [format_numbers(seeds) for seeds in ([3], [4, 2, 3, 3], [1, 5], range(0, 40, 2))]
    assert texts == ["3", "2 to 4", "1, 5", "0, 2, 4, 6, 8, 10, 12, 14 and 12 others"]


def inspect(folder: Path, **arguments: Any) -> None:
    defaults: dict[str, Any] = {"stores": None, "where": None, "repair": False, "into": None, "episode": None}
    inspect_store(Inspection(str(folder), **defaults | arguments))


def test_the_job_describes_what_is_damaged_and_repairs_it_beside_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    store = add(tmp_path / "store", EPISODES)
    with caplog.at_level(logging.INFO, "vla"):
        inspect(store.folder, repair=True)
    assert "nothing is repaired" in caplog.text and [path.name for path in tmp_path.iterdir()] == ["store"]
    change(store.folder / "action.bin", lambda data: flip(data, 0))
    (store.folder / "card.png").unlink()
    (store.folder / "card.png").mkdir()  # a card that cannot be written hides no damage
    damaged = (store.folder / "action.bin").read_bytes()
    with pytest.raises(ValueError, match=r"store has 1 damaged episode \(1 seed, 0: rows changed or lost\)"):
        inspect(store.folder)
    assert "3 intact, of 5 seeds tried" in capsys.readouterr().out and "could not write" in caplog.text
    inspect(store.folder, repair=True)
    assert [entry.seed for entry in EpisodeStore(tmp_path / "store-repaired").episodes] == [1, 2, 4]
    assert (store.folder / "action.bin").read_bytes() == damaged and (tmp_path / "store-repaired/card.md").exists()
    with pytest.raises(ValueError, match="store-repaired exists already"):
        inspect(store.folder, repair=True)


def test_a_store_that_was_put_together_is_of_a_task_as_any_other(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    def collected(name: str, *overrides: str) -> None:
        asked = ("job=collect", f"collect.folder={tmp_path / name}", *SMALL, "collect.episodes=1", *overrides)
        demonstrations(Experiment.from_config(composed(*asked)))

    collected("all")
    inspect(tmp_path / "all", where={"seed": [0, 9]}, into=str(tmp_path / "chosen"))
    collected("chosen")
    assert "chosen was derived" not in caplog.text
    collected("chosen", "task.time_limit=6")
    assert "chosen was derived from demonstrations with another task" in caplog.text
    collected("chosen", "task.image_size=[64,64]")
    with pytest.raises(UserError, match=r"the episode store .*chosen has cameras = .* the task has"):
        collected("chosen", "task.cameras=[front]")


def test_the_job_merges_and_refuses_what_contradicts_itself(tmp_path: Path) -> None:
    stores = [str(add(tmp_path / name, some).folder) for name, some in (("a", MORE[:4]), ("b", MORE[3:]))]
    inspect(tmp_path / "nowhere", stores=stores, into=str(tmp_path / "merged"))
    whole = content(add(tmp_path / "whole", MORE).folder)
    assert {name: data for name, data in content(tmp_path / "merged").items() if "card" not in name} == whole
    for asked in ({"where": {"seed": 1}}, {"stores": ["a", "b"]}):
        with pytest.raises(ValueError, match=r"give its folder, inspect\.into=DIR"):
            inspect(tmp_path, **asked)
    for option in ("inspect.repair=true", "inspect.into=there"):
        with pytest.raises(ValueError, match=f"omit {option.partition('=')[0]}"):
            run(Experiment.from_config(composed("job=inspect", "inspect.episode=7", option)))
    store = EpisodeStore.create_or_open(tmp_path / "store", ARM_SPEC, {})
    with store.writing():
        store.append(EPISODES[0])
    with pytest.raises(ValueError, match="does not contain the task of seed 0"):
        arguments = (f"inspect.folder={store.folder}", "inspect.episode=0", f"output={tmp_path}")
        run(Experiment.from_config(composed("job=inspect", *arguments)))


def test_an_imported_episode_is_not_replayed(tmp_path: Path) -> None:
    store = add(tmp_path / "store", [replace(EPISODES[0], draws={"recorded": {"episode": 0}})])
    arguments = (f"inspect.folder={store.folder}", "inspect.episode=0", f"output={tmp_path}")
    with pytest.raises(UserError, match=r"seed 0 in .*store was imported from a recording, so there is no world"):
        run(Experiment.from_config(composed("job=inspect", *arguments)))
