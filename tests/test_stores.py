"""`job=inspect` as its arguments ask for it."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import pytest
from command_line import here
from toy_episodes import EPISODES, MORE, add, change, content, flip

from vla.config.nodes import Inspection
from vla.data.episodes import EpisodeStore
from vla.jobs.inspect import inspect_store, replay_episode


def inspect(folder: Path, **arguments: Any) -> None:
    nothing: dict[str, Any] = {"stores": None, "where": None, "repair": False, "into": None, "episode": None}
    wanted: dict[str, Any] = {**nothing, "folder": str(folder), **arguments}
    inspect_store(Inspection(**wanted))


def stored(folder: Path) -> dict[str, bytes]:
    return {name: data for name, data in content(folder).items() if not name.startswith("card")}


def test_what_is_damaged_is_described_and_repaired_beside_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    store = add(tmp_path / "store", EPISODES)
    change(store.folder / "action.bin", lambda data: flip(data, 0))
    damaged = stored(store.folder)
    with pytest.raises(ValueError, match=r"store has 1 damaged episodes \(seeds 0: rows changed or lost\)"):
        inspect(store.folder)
    assert "3 intact, of 5 seeds tried" in capsys.readouterr().out
    inspect(store.folder, repair=True)
    assert [entry.seed for entry in EpisodeStore(tmp_path / "store-repaired").episodes] == [1, 2, 4]
    assert stored(store.folder) == damaged and (tmp_path / "store-repaired/card.md").exists()
    with pytest.raises(ValueError, match="store-repaired exists already"):
        inspect(store.folder, repair=True)


def test_what_is_whole_is_not_repaired(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    store = add(tmp_path / "store", EPISODES)
    with caplog.at_level(logging.INFO, "vla"):
        inspect(store.folder, repair=True)
    assert "nothing is repaired" in caplog.text and [path.name for path in tmp_path.iterdir()] == ["store"]


def test_stores_are_merged(tmp_path: Path) -> None:
    stores = [str(add(tmp_path / name, some).folder) for name, some in (("a", MORE[:4]), ("b", MORE[3:]))]
    inspect(tmp_path / "nowhere", stores=stores, into=str(tmp_path / "merged"))
    assert stored(tmp_path / "merged") == stored(add(tmp_path / "whole", MORE).folder)


def test_a_replay_changes_no_store(tmp_path: Path) -> None:
    for asked in ("inspect.repair=true", "inspect.into=there"):
        refused = here(tmp_path, "job=inspect", "inspect.episode=7", asked, ok=False).stderr
        assert f"omit {asked.partition('=')[0]}" in refused


def test_a_card_that_cannot_be_written_hides_no_damage(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    store = add(tmp_path / "store", EPISODES)
    (store.folder / "card.png").mkdir()
    inspect(store.folder)
    assert "could not write" in caplog.text


def test_a_new_store_needs_a_folder(tmp_path: Path) -> None:
    for asked in ({"where": {"seed": 1}}, {"stores": ["a", "b"]}):
        with pytest.raises(ValueError, match=r"give its folder, inspect\.into=DIR"):
            inspect(tmp_path, **asked)


def test_an_episode_without_a_task_has_no_scene(tmp_path: Path) -> None:
    store = EpisodeStore.create_or_open(tmp_path / "store", add(tmp_path / "other", []).spec, {})
    with store.writing():
        store.append(EPISODES[0])
    with pytest.raises(ValueError, match="does not contain the task of seed 0"):
        replay_episode(tmp_path, store.folder, 0)
