"""An evaluation that is interrupted, or whose disk is full, continues with the episodes that it has played."""

from __future__ import annotations

import json
import re
from contextlib import suppress
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
import toy_recordable as toy
from command_line import here

from vla.rollouts.evaluate import evaluate
from vla.rollouts.results import Result
from vla.runs.played import RESULTS_FILE, PlayedEpisodes
from vla.spec import FIRST_SEED, Array, Observation
from vla.tasks.perturb import Perturbed

SEEDS = range(FIRST_SEED, FIRST_SEED + 6)
EPISODES = 2
COMMAND = (
    "agent=expert",
    "task.time_limit=2",
    "recorder=none",
    f"evaluate.episodes={EPISODES}",
    "+evaluate.conditions.short.time_limit=1",
    "cluster.workers=1",
)


def reported(folder: Path) -> dict[str, Any]:
    """The report, without what differs between two evaluations of the same."""
    report: dict[str, Any] = json.loads((folder / "report.json").read_text())
    del report["config"]["output"]
    return report


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    folder = tmp_path_factory.mktemp("whole")
    done = here(folder, *COMMAND, "output=run")
    assert "as configured (1 of 2)" in done.stdout and "short (2 of 2)" in done.stdout
    assert not (folder / "run" / RESULTS_FILE).exists()
    return reported(folder / "run")


def test_a_report_without_room_costs_no_episode_and_no_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = [each for each in COMMAND if each != "recorder=none"]
    asked += ["evaluate.recordings=all", "task.image_size=[32,32]", "output=run"]
    with monkeypatch.context() as patch:
        patch.setattr("vla.jobs.evaluate.write_report", Mock(side_effect=OSError(28, "No space left on device")))
        failed = here(tmp_path, *asked, ok=False)
    assert "report.json cannot be written (No space left on device): make room there" in failed.stderr
    assert f"/{EPISODES} (" in failed.stdout and not (tmp_path / "run/report.json").exists()
    done = here(tmp_path, *asked)
    assert f"episodes already played: {2 * EPISODES}, in" in done.stdout + done.stderr
    assert not (tmp_path / "run" / RESULTS_FILE).exists()
    assert len(reported(tmp_path / "run")["recorded"]) == EPISODES


def test_two_processes_do_not_evaluate_in_one_folder(tmp_path: Path) -> None:
    with PlayedEpisodes(tmp_path / "run", {}):
        refused = here(tmp_path, *COMMAND, "output=run", ok=False)
    assert "another process evaluates in" in refused.stderr and "choose another output=DIR" in refused.stderr


def test_only_episodes_that_ended_in_an_error_are_played_again(tmp_path: Path, whole: dict[str, Any]) -> None:
    act = Perturbed.act

    def act_once(self: Perturbed, observation: Observation) -> Array:
        if not (tmp_path / "failed").exists():
            (tmp_path / "failed").touch()
            raise RuntimeError("a cable is loose")
        return act(self, observation)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Perturbed, "act", act_once)
        failed = here(tmp_path, *COMMAND, "output=run", ok=False)
    assert "1 episode ended in an error, see run/report.json" in failed.stderr
    done = here(tmp_path, *COMMAND, "output=run")
    assert f"episodes already played: {2 * EPISODES - 1}, in" in done.stdout + done.stderr
    assert reported(tmp_path / "run") == whole


def interrupted(folder: Path, *arguments: str) -> str:
    """What an evaluation says that is interrupted after each episode that it adds."""
    add = PlayedEpisodes.add

    def add_one(self: PlayedEpisodes, condition: str, result: Result) -> None:
        add(self, condition, result)
        raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(PlayedEpisodes, "add", add_one)
        done = here(folder, *COMMAND, *arguments, ok=False)
    assert done.returncode == 130 and not done.stderr
    return done.stdout


def test_an_interrupted_evaluation_says_which_command_goes_on(tmp_path: Path, whole: dict[str, Any]) -> None:
    first = interrupted(tmp_path)
    assert "already" not in first
    (folder,) = re.findall(r"^interrupted: the same command with (output=outputs/runs/.+) continues$", first, re.M)
    second = interrupted(tmp_path, folder)
    assert "episodes already played: 1, in" in second
    assert second.endswith("\ninterrupted: the same command continues\n")
    here(tmp_path, *COMMAND, folder)
    assert reported(tmp_path / folder.removeprefix("output="))["per_episode"] == whole["per_episode"]


def test_more_episodes_and_other_conditions_use_what_was_played(tmp_path: Path, whole: dict[str, Any]) -> None:
    interrupted(tmp_path, "output=run")
    assert "played: 1, in" in interrupted(tmp_path, "output=run", f"evaluate.episodes={EPISODES + 1}")
    assert "played: 2, in" in interrupted(tmp_path, "output=run", "++evaluate.conditions.short.time_limit=0.5")
    file = tmp_path / "run" / RESULTS_FILE
    *lines, last = file.read_text().splitlines(keepends=True)
    assert '"never_reached"' in last
    file.write_text("".join(lines) + last.replace('"never_reached"', '"success"'))
    done = here(tmp_path, *COMMAND, "output=run")
    assert "played: 3, in" in done.stdout + done.stderr
    assert reported(tmp_path / "run") == whole  # without the episode of the shorter condition


def play(folder: Path, head: dict[str, str], *seeds: int) -> dict[int, Result]:
    """What an evaluation finds that plays some seeds and is interrupted."""
    with suppress(KeyboardInterrupt), PlayedEpisodes(folder, head) as played:
        found = dict(played.results["seen"])
        for seed in seeds:
            played.add("seen", Result(seed, "success"))
        raise KeyboardInterrupt
    return found


def test_what_was_played_is_used_until_weights_or_versions_change(tmp_path: Path) -> None:
    assert not play(tmp_path, {"weights": "1"}) and not (tmp_path / RESULTS_FILE).exists()
    assert not play(tmp_path, {"weights": "1"}, *SEEDS)
    file = tmp_path / RESULTS_FILE
    file.write_bytes(file.read_bytes()[:-20])  # the line that a killed process left unfinished
    assert [*play(tmp_path, {"weights": "1"}, SEEDS[-1])] == [*SEEDS[:-1]]
    assert {*play(tmp_path, {"weights": "1"})} == {*SEEDS}
    assert not play(tmp_path, {"weights": "2"})


def test_known_episodes_are_not_played_again() -> None:
    makers = toy.make_environment, toy.make_agent, None
    expected, kept = evaluate(*makers, SEEDS).results, list[Result]()
    some, every = ({result.seed: result for result in found} for found in (expected[::2], expected))
    assert evaluate(*makers, SEEDS, known_results=some, on_result=kept.append).results == expected
    assert {result.seed for result in kept} == {*SEEDS} - {*some}
    more, until = range(FIRST_SEED, FIRST_SEED + 99), lambda report: report.episodes == 2
    assert evaluate(*makers, more, until=until, known_results=every, on_result=kept.append).results == expected[:2]
    assert len(kept) == len(SEEDS) - len(some)
