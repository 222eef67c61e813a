"""Files are data: what a checkpoint or an episode store names is never run, and never decides where files go."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
from composing import CONF, composed, run_job
from hostile import HANDLER, hostile, node, put, ways
from saved_policies import change_json, save_policy, save_run
from toy_episodes import EPISODES, add

from vla.config.adopt import adopt, finetune, resume
from vla.config.annotations import LIBRARY, OWN_PREFIX, locate
from vla.config.experiment import make_policy, to_plain
from vla.io.errors import UserError

# Everything under these could be named once, and some of it acts when it is built.
PREFIXES = ("torch", "lightning", "dm_control.composer.variation")


def classes(package: str) -> Iterator[str]:
    """Dotted names of the classes that the source files of a package define, without importing them."""
    spec = find_spec(package)
    assert spec is not None and spec.origin is not None
    root = Path(spec.origin).parent
    for path in root.rglob("*.py"):
        module = ".".join([package, *path.relative_to(root).with_suffix("").parts]).removesuffix(".__init__")
        found = re.findall(r"^class (\w+)", path.read_text(encoding="utf-8", errors="replace"), re.MULTILINE)
        yield from (f"{module}.{name}" for name in found)


def test_no_class_of_a_library_is_within_reach() -> None:
    names = [name for prefix in PREFIXES for name in classes(prefix)]
    assert len(names) > 3000 and HANDLER in names
    for name in names:
        with pytest.raises(ValueError, match=r"^node\._target_ must name a class"):
            locate("node._target_", name)


def test_the_library_classes_that_may_be_built_are_those_of_the_options() -> None:
    texts = [path.read_text(encoding="utf-8") for path in CONF.rglob("*.yaml")]
    named = {name for text in texts for name in re.findall(r"_target_: (\S+)", text)}
    assert {name for name in named if not name.startswith(OWN_PREFIX)} == set(LIBRARY)


ATTACKS = list(hostile(Path()))
REFUSED = r"_target_ must name a class|holds the reference '.*only resolved values are read from files"


@pytest.fixture(scope="module")
def toy_store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a store with one episode."""
    return add(tmp_path_factory.mktemp("stores") / "store", EPISODES[:1]).folder


def run_of(path: Path, key: str, value: Any) -> Path:
    """A run whose configuration is the default one but for a key."""
    config = to_plain(composed("expert=clean", "trainer.accelerator=cpu"))
    put(config, key, value)
    return save_run(path, config)


@pytest.mark.parametrize("attack", ATTACKS)
def test_nothing_that_a_policy_names_is_run(tmp_path: Path, attack: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    mark = tmp_path / "mark"
    path = run_of(tmp_path / "runs/theirs", *hostile(mark)[attack])
    output = f"output={tmp_path}/runs/mine"  # beside it, as if it were an own run
    all_ways = ways(path, output) | {
        "benchmark": lambda: run_job(adopt(composed(output, f"checkpoint={path}", "job=benchmark"), [])),
        "resume": lambda: run_job(resume(composed(f"output={path}"), path, [])),
    }
    untouched = {"a command as a plugin": {*all_ways} - {"resume"}}
    for part in ("task.goal", "an axis"):
        untouched[f"a command as {part}"] = {"pretrained", "policy"}
    for way, do in all_ways.items():
        if way in untouched.get(attack, set()):
            continue  # what is wrong there is nothing that this way reads
        with pytest.raises(UserError, match=REFUSED):
            do()
        assert not mark.exists(), way


@pytest.mark.parametrize("attack", ATTACKS)
def test_nothing_that_a_store_names_is_run(tmp_path: Path, attack: str, toy_store: Path) -> None:
    mark = tmp_path / "mark"
    key, value = hostile(mark)[attack]
    config = {"task": to_plain(composed("expert=clean", "trainer.accelerator=cpu"))["task"], "expert": {}}
    put(config, key if key.startswith("task.") else "task.goal", value)
    shutil.copytree(toy_store, tmp_path / "store")
    header = json.loads((tmp_path / "store/store.json").read_text())
    (tmp_path / "store/store.json").write_text(json.dumps({**header, "config": config}))
    with pytest.raises(UserError, match=REFUSED):
        run_job(composed("job=inspect", f"inspect.folder={tmp_path}/store", "inspect.episode=0", f"output={tmp_path}"))
    assert not mark.exists()


def test_only_ones_own_runs_are_resumed(tmp_path: Path) -> None:
    save_run(tmp_path / "theirs", to_plain(composed("collect.folder=/nowhere")))
    elsewhere = composed(f"output={tmp_path}/elsewhere/mine")
    with pytest.raises(ValueError, match="is not among your runs"):
        resume(elsewhere, tmp_path / "theirs", [])
    beside = composed(f"output={tmp_path}/mine")
    assert resume(beside, tmp_path / "theirs", []).collect.folder == "/nowhere"


def test_a_path_in_somebody_elses_policy_is_refused(tmp_path: Path) -> None:
    config = to_plain(composed())
    config["task"]["goal"] = node("vla.data.formats.lerobot_import.LeRobotDemonstrations", folder="/nowhere")
    path = save_policy(tmp_path / "theirs", config)
    with pytest.raises(ValueError, match=r"theirs names a path or an address in task\.goal\.folder"):
        adopt(composed(f"checkpoint={path}"), [])


def test_folders_loggers_and_devices_are_never_those_of_a_policy(tmp_path: Path) -> None:
    theirs: dict[str, Any] = {
        **to_plain(composed("expert=lerobot", "expert.folder=/theirs", "collect.episodes=7", "trainer.max_steps=9")),
        **{"output": "/theirs", "pretrained": "/theirs", "resume": "/theirs", "checkpoint": "/theirs"},
        "logger": {"csv": {"_target_": "lightning.pytorch.loggers.CSVLogger", "name": "/theirs"}},
    }
    theirs["collect"] |= {"folder": "/theirs"}
    theirs["inspect"] = {"folder": "/theirs", "into": "/theirs"}
    theirs["export"] |= {"folder": "/theirs"}
    theirs["trainer"] |= {"default_root_dir": "/theirs", "accelerator": "theirs", "devices": 99, "profiler": "theirs"}
    path = save_policy(tmp_path / "somebody", theirs)
    own = (f"output={tmp_path}/mine",)
    for adopted in (
        *(adopt(composed(*own, f"checkpoint={path}", f"job={job}"), []) for job in ("evaluate", "export", "benchmark")),
        finetune(composed(*own, f"pretrained={path}"), []),
    ):
        assert "theirs" not in repr(to_plain(adopted))
        assert to_plain(adopted)["trainer"].get("devices") != 99
    reported = to_plain(adopt(composed(*own, f"checkpoint={path}"), []))
    assert (reported["collect"]["episodes"], reported["trainer"]["max_steps"]) == (7, 9)
    assert reported["expert"] == {**theirs["expert"], "folder": None}


def test_a_model_that_its_weights_do_not_fill_is_refused_before_it_is_made(tmp_path: Path) -> None:
    path = run_of(tmp_path / "theirs", "model.width", 16384)
    config = path / "policy/config.json"
    change_json(config, lambda nodes: {**nodes, "model": nodes["model"] | {"text_width": 16384}})
    with pytest.raises(ValueError, match="describes a model that is larger than its weights"):
        make_policy(to_plain(composed().policy), path)
