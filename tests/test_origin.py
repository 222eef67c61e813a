"""Where results come from: command line, commits, machine, and the values that differ from the default."""

from __future__ import annotations

import subprocess
from pathlib import Path
from types import SimpleNamespace

import pytest
from composing import composed

from vla.config import origin
from vla.config.experiment import Experiment
from vla.config.origin import find_origin
from vla.io import versions


def git(folder: Path, *arguments: str) -> str:
    options = ("-c", "user.name=Ada", "-c", "user.email=ada@example.org", "-c", "commit.gpgsign=false")
    done = subprocess.run(["git", "-C", folder, *options, *arguments], capture_output=True, text=True, check=True)
    return done.stdout.strip()


@pytest.fixture
def tree(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A git work tree with code in one folder, results in another, and an installed package in an ignored one."""
    folder = tmp_path / "mine"
    for name in ("conf", "outputs", ".venv/vla"):
        (folder / name).mkdir(parents=True)
        (folder / name / "file").write_text("1")
    (folder / ".gitignore").write_text(".venv\n")
    git(tmp_path, "init", "-q", str(folder))
    git(folder, "add", ".")
    git(folder, "commit", "-q", "-m", "begun")
    monkeypatch.setattr(origin, "config_folders", lambda: (folder / "conf",))
    places = SimpleNamespace(submodule_search_locations=[str(folder / ".venv/vla")])
    monkeypatch.setattr(origin, "find_spec", lambda name: places if name == "vla" else None)
    return folder


def test_a_tree_is_dirty_if_its_code_is(tree: Path) -> None:
    commit = git(tree, "rev-parse", "HEAD")
    (tree / "outputs/report.html").touch()
    assert find_origin().commits == {"mine": commit}
    (tree / "conf/new.yaml").touch()  # an option that git does not know can be chosen, too
    assert find_origin().commits == {"mine": f"{commit} with uncommitted changes"}
    git(tree, "add", ".")
    git(tree, "commit", "-q", "-m", "more")
    assert find_origin().commits == {"mine": git(tree, "rev-parse", "HEAD")}
    (tree / "conf/file").write_text("2")
    assert find_origin().commits["mine"].endswith(" with uncommitted changes")


def test_a_tree_of_which_git_says_nothing_in_time_is_perhaps_dirty(tree: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ask = origin._git
    monkeypatch.setattr(origin, "_git", lambda *asked: None if "status" in asked else ask(*asked))
    assert find_origin().commits["mine"].endswith(" perhaps with uncommitted changes")


def test_trees_of_one_name_are_told_apart(tree: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    other = tmp_path / "other/mine"
    git(tmp_path, "clone", "-q", str(tree), str(other))
    git(other, "commit", "-q", "--allow-empty", "-m", "more")
    monkeypatch.setattr(origin, "config_folders", lambda: (tree / "conf", other / "conf"))
    assert find_origin().commits == {str(folder): git(folder, "rev-parse", "HEAD") for folder in (tree, other)}


def test_code_that_is_in_no_tree_has_no_commit(tree: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(origin, "config_folders", lambda: (tmp_path, tmp_path / "missing"))
    assert find_origin().commits == {}
    monkeypatch.setattr(origin, "config_folders", lambda: (tree / "conf",))
    monkeypatch.setenv("PATH", str(tmp_path))
    assert find_origin().commits == {}


def test_the_command_line_can_be_copied_and_has_no_secret(monkeypatch: pytest.MonkeyPatch) -> None:
    typed = ["model=rt1", "task.image_size=[64,64]", "agent.api_key='a,b'", "+agent={url: x, api_key: y z}"]
    known = SimpleNamespace(overrides=SimpleNamespace(task=typed))
    monkeypatch.setattr(origin, "HydraConfig", SimpleNamespace(initialized=lambda: True, get=lambda: known))
    command = find_origin().command
    assert command == "python -m vla.run model=rt1 'task.image_size=[64,64]' 'agent.api_key=***' '+agent=***'"


def test_differences_from_the_default_show_resolved_values() -> None:
    cfg = composed(
        "model.shift=[3,4]", "collect.episodes=7", "task.image_size=[64,64]", "output=there", "evaluate=suite"
    )
    changes = {each["key"]: each for each in Experiment.from_config(cfg, composed).changes}
    assert changes["model.shift"] == {"key": "model.shift", "here": [3, 4], "default": [12, 12]}
    assert changes["collect.episodes"]["here"] == 7
    tint = changes["evaluate.conditions.light_intensity_wide"]["here"]["randomize"]["light"]["tint"]
    assert tint == cfg.task.randomize.light.tint and "${" not in str(changes)  # an interpolation


def test_settings_that_only_the_class_of_the_default_has_are_no_differences() -> None:
    changes = {
        each["key"]: each
        for each in Experiment.from_config(composed("model/image=film_efficientnet"), composed).changes
    }
    assert "model.image._target_" in changes and "-" not in [each["here"] for each in changes.values()]


def test_the_package_of_a_world_is_among_the_versions(monkeypatch: pytest.MonkeyPatch) -> None:
    world = SimpleNamespace(name="gym-world", requires=["gymnasium>=1", "pygame"])
    monkeypatch.setattr(versions, "distributions", lambda: [world])
    monkeypatch.setattr(versions, "version", lambda name: "2.3")
    assert versions.installed_versions.__wrapped__() == {"gym-world": "2.3"}
