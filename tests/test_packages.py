"""A package of somebody else: installed, it adds options, and goes through every job from a folder of its own."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from importlib import import_module
from importlib.metadata import EntryPoint
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from collecting import content
from command_line import here
from command_line import vla as vla_process
from composing import composed
from conftest import made_once
from saved_policies import save_run

from vla import jobs
from vla.api import load_environment, load_policy
from vla.config import packages
from vla.config.adopt import adopt, finetune, resume
from vla.config.annotations import locate
from vla.config.build import build
from vla.config.compose import compose_task
from vla.config.experiment import Experiment, to_plain
from vla.jobs.preview import recording

EXAMPLE = Path(__file__).parent / "example_package"
ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGE = (DOCS / "packages.md").read_text(encoding="utf-8")
OWN_MODEL = (DOCS / "models.md").read_text(encoding="utf-8").split("## A model of your own")[1].split("\n## ")[0]
COMMANDS = re.findall(r"^python -m vla\.run (.*)$", PAGE, re.MULTILINE)
MODEL = "mypackage.models.Mine"
TINY = (
    *("validate.episodes=0", "collect.episodes=12", "cluster.workers=2", "evaluate.episodes=3"),
    *(
        "trainer.accelerator=cpu",
        "trainer.max_steps=4",
        "trainer.val_check_interval=4",
        "data.batch_size=8",
        "data.validation_windows=8",
    ),
)


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The folder into which the package is installed; programs that are started find it there."""

    def install(folder: Path) -> None:
        shutil.copytree(EXAMPLE, folder / "mypackage")  # building leaves files beside the source
        options = ("-q", "--no-index", "--no-deps", "--no-build-isolation", "--disable-pip-version-check")
        target, source = folder / "target", folder / "mypackage"
        subprocess.run([sys.executable, "-m", "pip", "install", *options, "--target", target, source], check=True)

    target = made_once(tmp_path_factory, "package", install) / "target"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", os.pathsep.join([str(target), str(ROOT / "tests"), str(ROOT)]))
        yield target


@pytest.fixture(scope="module")
def home(installed: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder to work in, with the outcome of the main job in `run`, done by two workers in each stage."""

    def work(folder: Path) -> None:
        vla_process(folder, "experiment=mine", *TINY, "collect.folder=episodes", "output=run")

    done = made_once(tmp_path_factory, "package_job", work)
    return Path(shutil.copytree(done, tmp_path_factory.mktemp("home") / "home"))


@pytest.fixture
def importable(installed: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Within, this process finds the package as well, and trusts nothing; commands need no processes of their own."""
    monkeypatch.syspath_prepend(installed)
    monkeypatch.setenv(packages.TRUSTED, "")
    caches = (packages.option_folders, packages.can_be_trusted)
    for cached in caches:
        cached.cache_clear()
    yield
    for cached in caches:
        cached.cache_clear()
    for name in [name for name in sys.modules if name.partition(".")[0] == "mypackage"]:
        del sys.modules[name]


@pytest.mark.parametrize(("page", "count"), [(PAGE, 6), (OWN_MODEL, 2)], ids=["packages", "models"])
def test_the_page_shows_what_the_package_holds(page: str, count: int) -> None:
    sources = "\n".join(path.read_text(encoding="utf-8") for path in EXAMPLE.rglob("*") if path.is_file())
    blocks = re.findall(r"^```(?:toml|yaml|python)\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    assert len(blocks) == count
    for block in blocks:
        assert block in sources


def test_installing_it_adds_its_options(home: Path, importable: None) -> None:
    assert COMMANDS[0] == "--help"
    listed = here(home, COMMANDS[0]).stdout
    for group in ("task", "expert", "model", "tokenizer", "recorder", "deploy", "experiment"):
        assert re.search(rf"^\W*{group}: .*\bmine\b", listed, re.MULTILINE), group
    assert "\n  survey      Measure the start of some episodes.\n" in listed and "\nmetric: distance\n" in listed
    assert f"_target_: {MODEL}" in here(home, "model=mine", "--cfg", "job").stdout


def test_a_package_without_its_folder_of_options_is_named(
    home: Path, importable: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    broken = EntryPoint("broken", "mypackage.missing", packages.ENTRY_POINTS)
    monkeypatch.setattr(packages, "entry_points", lambda group: [broken])
    said = here(home, "--help", ok=False).stderr
    assert said.startswith("error: the installed package mypackage names mypackage.missing as its options")
    assert len(said.splitlines()) == 1


@pytest.mark.parametrize(("option", "hiding"), [("model/bc.yaml", "vla"), ("model/theirs.yaml", "first_package")])
def test_an_option_that_another_one_would_hide_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, option: str, hiding: str
) -> None:
    names = ("first_package", "second_package")
    for name, file in zip(names, ("model/theirs.yaml", option), strict=True):
        (tmp_path / name / "conf/model").mkdir(parents=True)
        (tmp_path / name / "conf" / file).touch()
    entries = [EntryPoint(name, f"{name}.conf", packages.ENTRY_POINTS) for name in names]
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(packages, "entry_points", lambda group: entries)
    words = f"^the installed packages {hiding} and second_package both have the option {option}"
    with pytest.raises(ValueError, match=words):
        packages.option_folders.__wrapped__()


def test_a_job_with_a_group_of_its_own_is_two_options_and_a_module(home: Path, importable: None) -> None:
    asked = ("job=survey", "task=mine", "survey.episodes=3")
    world = import_module("mypackage.world").Square(16, 30)
    starts = [world.reset(seed) for seed in range(3)]
    away = [np.linalg.norm(start.truth["target"] - start.state) for start in starts]
    assert here(home, *asked, "output=surveyed").stdout == f"mean {1000 * np.mean(away):.3f}\n"
    for wrong, words in (
        ("metric.unit=0", "metric.unit must be greater than 0, got 0"),
        ("survey.episodes=0", "survey.episodes must be greater than or equal to 1, got 0"),
        ("+survey.length=3", "survey.length is unknown: Survey takes episodes, seed"),
        ("~metric", "job=mypackage.survey needs metric=OPTION"),
    ):
        assert words in here(home, *asked, wrong, ok=False).stderr
    with pytest.raises(ValueError, match=r"job names mypackage\.survey, which is not trusted: add trust=\[mypackage\]"):
        jobs.find("mypackage.survey")


@pytest.mark.parametrize("name", ["nothing", "os.path", "vla.io.files", "sweep", ""])
def test_what_is_no_job_is_none(name: str) -> None:
    with pytest.raises(ValueError, match=f"there is no job '{name}'; --help lists the jobs"):
        jobs.find(name)


def test_its_parts_do_the_main_job(home: Path) -> None:
    assert COMMANDS[1] == "experiment=mine"
    report = json.loads((home / "run/report.json").read_text())
    assert (report["episodes"], report["errors"], report["model"]) == (3, 0, "mine")
    assert report["config"]["model"]["_target_"] == MODEL and report["config"]["trust"] == []
    recordings = [(home / f"run/recordings/{seed}.jsonl").read_text().splitlines() for seed in report["seeds"]]
    assert [json.loads(lines[-1]) for lines in recordings] == [each["outcome"] for each in report["per_episode"]]


def test_each_stage_is_a_job_of_its_own(home: Path, importable: None) -> None:
    """And gives what the main job gave, with another number of workers."""
    mine = ("experiment=mine", *TINY, "cluster.workers=1", "collect.folder=alone", "output=staged")
    here(home, "job=collect", *mine)
    assert content(home / "alone") == content(home / "episodes")
    here(home, "job=train", *mine)
    assert not (home / "staged/report.json").exists()
    here(home, "job=evaluate", *mine)
    whole, staged = (json.loads((home / folder / "report.json").read_text()) for folder in ("run", "staged"))
    assert staged["per_episode"] == whole["per_episode"]


def test_its_recorder_keeps_what_a_preview_shows(home: Path, importable: None) -> None:
    here(home, "job=preview", "experiment=mine", "recorder=mine", "preview.episodes=2", "output=look")
    assert sorted(path.name for path in (home / "look/recordings").iterdir()) == ["0.jsonl", "1.jsonl"]


def test_folders_of_a_recorder_are_replaced_by_those_of_the_next_preview(tmp_path: Path) -> None:
    def make_recorder(folder: Path) -> Callable[[], Any]:
        def make() -> None:
            (folder / "0").mkdir()
            (folder / "0/frame.png").touch()

        return make

    for _ in range(2):
        experiment = cast(Experiment, SimpleNamespace(make_recorder=make_recorder))
        with recording(experiment, tmp_path / "look.rrd") as (_, files):
            pass
        assert files == [tmp_path / "recordings/0"] and (tmp_path / "recordings/0/frame.png").is_file()


def test_its_demonstrations_are_described_replayed_and_exported(home: Path, importable: None) -> None:
    shutil.copytree(home / "episodes", home / "copy")  # whose card is none of the others' business
    replay = ("job=inspect", "inspect.folder=copy", "inspect.episode=0", "output=replay")
    assert "12 intact" in here(home, "job=inspect", "inspect.folder=copy").stdout
    assert "dx | m" in (home / "copy/card.md").read_text()
    assert "add trust=[mypackage]" in here(home, *replay, ok=False).stderr
    assert "bit for bit" in here(home, *replay, "trust=[mypackage]").stdout
    assert (home / "replay/episode-0.rrd").stat().st_size > 1000
    assert "bit for bit" in here(home, *replay, "trust=[mypackage]", "recorder=mine").stdout
    assert (home / "replay/recordings/0.jsonl").is_file()
    here(home, "job=export", "experiment=mine", *TINY, "collect.folder=copy", "export.folder=files")
    state = json.loads((home / "files/episode_00000/step_0000/robot_state.json").read_text())
    assert {"x", "y"} <= {*state} and (home / "files/episode_00000/step_0000/rgb_image.png").is_file()


def test_its_runs_are_swept(home: Path, importable: None) -> None:
    small = (*TINY, "cluster.workers=1", "evaluate.episodes=2", "collect.folder=episodes")
    done = here(home, "-m", "hydra.sweep.dir=grid", "experiment=mine", *small, "learner.lr=0.1,0.2")
    assert "seen [%]" in done.stdout and done.stdout.endswith("wrote grid/sweep.html\n")
    rates, differences = (home / "grid/sweep.md").read_text().split("\n\n")
    head, _, *lines = rates.splitlines()
    assert differences.startswith("| second | minus first | condition |") and "\n| 0.2 | 0.1 | seen |" in differences
    reports = [json.loads((home / f"grid/{cell}/report.json").read_text()) for cell in (0, 1)]
    assert {(report["model"], report["episodes"]) for report in reports} == {("mine", 2)}
    assert head.startswith("| learner.lr | ") and [line.split(" | ")[0] for line in lines] == ["| 0.1", "| 0.2"]
    assert all(f" | {100 * report['success']:.1f} (" in line for report, line in zip(reports, lines, strict=True))


def test_a_checkpoint_is_refused_until_the_package_is_trusted(home: Path, importable: None) -> None:
    report = json.loads((home / "run/report.json").read_text())
    evaluating, deploying = (shlex.split(each.replace("RUN", report["checkpoint"])) for each in COMMANDS[2:])
    *untrusting, trusting = evaluating
    assert trusting == deploying[-1] == "trust=[mypackage]"
    numbers = ("evaluate.episodes=3", "cluster.workers=1", "output=again")
    refused = here(home, *untrusting, *numbers, ok=False).stderr
    assert refused.splitlines()[-1] == (
        f"error: {report['checkpoint']} names mypackage.world.Square, which is not trusted: "
        "add trust=[mypackage] if you trust its source"
    )
    assert "Traceback" not in refused and not (home / "again").exists()
    here(home, *evaluating, *numbers)
    assert json.loads((home / "again/report.json").read_text())["per_episode"] == report["per_episode"]
    here(home, *deploying, "deploy.episodes=2", "output=deployed")
    assert json.loads((home / "deployed/report.json").read_text())["episodes"] == 2


def test_a_policy_that_predicts_no_tokens_is_loaded_by_programs(home: Path, importable: None) -> None:
    tiny = (*TINY, "cluster.workers=1", "collect.folder=episodes", "output=regression")
    here(home, "experiment=mine", "model=regression", *tiny)
    file = home / "regression"
    trust = ["mypackage"]
    policy, world = load_policy(file, trust=trust), load_environment(file, trust=trust)
    assert type(policy.model).__name__ == "Regression" and not policy.model.uses_tokens
    observation, _ = world.reset(seed=1_000_000)
    policy.reset(observation["instruction"], 0)
    assert world.action_space.contains(policy.act(observation))
    with pytest.raises(ValueError, match=r"names mypackage\.\w+\.\w+, which is not trusted"):
        load_environment(file)


def test_a_checkpoint_never_trusts_itself(importable: None, tmp_path: Path) -> None:
    config = to_plain(composed()) | {"trust": ["mypackage"]}
    config["task"] = config["data"] = {"_target_": "vla.spec.Environment"}  # which is cheap to import
    config["model"] = {"_target_": MODEL, "width": 8, "text": config["model"]["text"]}
    path = save_run(tmp_path / "runs/theirs", config)
    mine = f"output={tmp_path}/runs/mine"  # beside it, as if it were an own run
    evaluating, starting = composed(mine, f"checkpoint={path}"), composed(mine, f"pretrained={path}")
    ways = (
        lambda: adopt(evaluating, []),
        lambda: finetune(starting, []),
        lambda: resume(composed(mine), path, []),
    )
    packages.trust([], [])
    for way in ways:
        with pytest.raises(
            ValueError, match=r"(theirs|last\.ckpt) names mypackage\.models\.Mine, which is not trusted: add trust="
        ):
            way()
    packages.trust(["mypackage"], [])
    for way in ways:
        assert to_plain(way())["trust"] == []


def test_programs_find_its_options(importable: None) -> None:
    assert compose_task("mine", steps=5) == {"_target_": "mypackage.world.Square", "size": 16, "steps": 5}


def test_a_choice_trusts_one_class(importable: None) -> None:
    packages.trust([], [MODEL, "other.models.Mine"])
    assert packages.trusted_names() == [MODEL]
    assert locate("model._target_", MODEL).__name__ == "Mine"
    for target in ("mypackage.tokenizers.Few", "mypackage.world.Square", "other.models.Mine"):
        with pytest.raises(ValueError, match=rf"^node names {re.escape(target)}, which is not trusted: add trust="):
            locate("node", target)


def test_a_package_is_trusted_by_its_whole_name(importable: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(packages.TRUST, "another, mypackage")
    packages.trust([], [])
    assert packages.trusted_names() == ["another", "mypackage"]
    assert locate("node", MODEL).__name__ == "Mine"
    with pytest.raises(ValueError, match=r"mypackage_evil\.Model, which is not trusted: add trust=\[mypackage_evil\]"):
        locate("node", "mypackage_evil.Model")
    with pytest.raises(ValueError, match=r"cannot be imported on \S+, where another must be installed: No module"):
        locate("node", "another.models.Model")


def test_what_a_trusted_package_imports_is_not_trusted(importable: None) -> None:
    packages.trust(["mypackage"], [])
    with pytest.raises(
        ValueError, match=r"must name a class that is defined in mypackage, got 'mypackage\.recorder\.P"
    ):
        locate("node", "mypackage.recorder.Path")
    with pytest.raises(
        ValueError, match=r"recorder\._target_ must name a class of kind Recorder, got mypackage\.world"
    ):
        build({"_target_": "mypackage.world.Straight", "noise": 0.1}, "recorder", folder=Path())


@pytest.mark.parametrize("name", ["os", "builtins", "subprocess", "torch", "lightning", "numpy", "__main__"])
def test_libraries_cannot_be_trusted(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(packages.TRUSTED, name)  # as if somebody had got past the first check
    with pytest.raises(ValueError, match=r"^trust cannot name .*give the name by which a package is imported"):
        packages.trust([name], [])
    with pytest.raises(ValueError, match=r"^node must name a class of vla, of a package that trust=\[…\] names"):
        locate("node", f"{name}.Thing")


@pytest.mark.parametrize("wrong", ["mypackage", None, ["mypackage.models"], [""], [3]])
def test_trust_is_a_list_of_packages(wrong: Any) -> None:
    with pytest.raises(ValueError, match=r"^trust (must be a list of packages|cannot name)"):
        packages.trust(wrong, [])
