"""Files are data: what a checkpoint or an episode store names is never run, and never decides where files go."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from zipfile import ZIP_DEFLATED, ZipFile

import pytest
import torch
import toy
from omegaconf import OmegaConf
from test_conf import CONF, composed
from test_run import vla

from vla.annotations import LIBRARY, OWN, locate
from vla.check import check
from vla.parts import make_policy, plain
from vla.policy import read_checkpoint
from vla.resume import adopt, go_on, start_from

# Everything under these could be named once, and some of it acts when it is built.
PREFIXES = ("torch", "lightning", "dm_control.composer.variation")
HANDLER = "torch.distributed.elastic.multiprocessing.subprocess_handler.subprocess_handler.SubprocessHandler"


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
    assert {name for name in named if not name.startswith(OWN)} == set(LIBRARY)


def command(mark: Path) -> dict[str, Any]:
    """A node that runs a command when it is built."""
    arguments: dict[str, Any] = {
        "args": ["-c", f"id > {mark}"],
        "env": {},
        "stdout": None,
        "stderr": None,
        "local_rank_id": 0,
    }
    return {"_target_": HANDLER, "entrypoint": "/bin/sh", **arguments, "numa_options": None}


def node(target: str, **arguments: Any) -> dict[str, Any]:
    return {"_target_": target, **arguments}


def hostile(mark: Path) -> dict[str, tuple[str, Any]]:
    """Attack → the key of a configuration, and what it holds; each of them once acted, mostly by leaving `mark`."""
    created = "${oc.select:model.text,${oc.create:{_target_:%s}}}"
    files = {"file_name": str(mark), "log_dir": str(mark), "f": str(mark), "name": str(mark), "filename": str(mark)}
    return {
        **{f"a command as {key}": (key, command(mark)) for key in ("model.image", "model.text", "task.goal")},
        "a command as an axis": ("task.randomize.mass", command(mark)),
        "a command as a plugin": ("trainer.plugins", [command(mark)]),
        "a library": ("model.image", node("torch._inductor.codecache.DLLWrapper", lib_path=files["f"])),
        "an allocator": (
            "model.image",
            node(
                "torch.cuda.memory.CUDAPluggableAllocator",
                path_to_so_file=str(mark),
                alloc_fn_name="a",
                free_fn_name="b",
            ),
        ),
        "a file emptied": ("model.image", node("torch.serialization._open_file", name=str(mark), mode="w")),
        "an archive": ("model.image", node("torch.package.PackageExporter", f=str(mark))),
        "a folder": (
            "model.image",
            node("lightning.fabric.loggers.csv_logs._ExperimentWriter", log_dir=str(mark)),
        ),
        "an event file": ("model.image", node("torch.utils.tensorboard.SummaryWriter", log_dir=str(mark))),
        "a process": ("model.image", node("torch._inductor.autotune_process.TuningProcess")),
        "a pool": ("model.image", node("torch._inductor.compile_worker.subproc_pool.SubprocPool", nprocs=1)),
        "a server": ("model.image", node("torch.distributed.debug._frontend.FrontendServer", port=0)),
        "code behind a reference": (
            "model.image",
            created % f"torch._inductor.codecache.PyCodeCache.load,_args_:[\"open({str(mark)!r},'w')\"]",
        ),
        "a log behind a reference": ("model.image", created % f"logging.FileHandler,filename:{mark}"),
        "an array behind a reference": ("model.image", created % f"numpy.savetxt,fname:{mark},X:[1]"),
        "the environment": ("chosen.experiment", "${oc.env:PATH}"),
        "the working folder": ("task.goal.language.phrasings", ["take {block} ${hydra:runtime.cwd}"]),
    }


ATTACKS = list(hostile(Path()))


def checkpoint(path: Path, key: str, value: Any) -> Path:
    """A checkpoint whose configuration is the default one but for a key."""
    config = plain(composed("expert=clean", "trainer=cpu"))
    *parents, name = key.split(".")
    holder = config
    for parent in parents:
        holder = holder[parent]
    holder[name] = value
    path.parent.mkdir(parents=True, exist_ok=True)
    torch.save({"config": config, "spec": toy.SPEC.to_dict(), "state_dict": {}}, path)
    return path


@pytest.mark.parametrize("attack", ATTACKS)
def test_nothing_that_a_checkpoint_names_is_run(tmp_path: Path, attack: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    mark = tmp_path / "mark"
    path = checkpoint(tmp_path / "runs/theirs/checkpoints/last.ckpt", *hostile(mark)[attack])
    output = f"output={tmp_path}/runs/mine"  # beside it, as if it were an own run
    evaluated = composed(output, f"checkpoint={path}")
    started = composed(output, f"pretrained={path}")
    resumed = composed(output, f"checkpoint={path}", "resume=true")
    adopted = {
        "evaluate": lambda: check(adopt(evaluated, read_checkpoint(path).config, [])),
        "resume": lambda: check(go_on(resumed, [])),
        "pretrained": lambda: check(start_from(started, [])),
        "policy": lambda: make_policy(plain(evaluated.policy), path),
    }
    untouched = {"a command as a plugin": {"evaluate", "pretrained", "policy"}}
    for part in ("task.goal", "an axis"):
        untouched[f"a command as {part}"] = {"pretrained", "policy"}
    for way, do in adopted.items():
        if way in untouched.get(attack, set()):
            continue  # what is wrong there is nothing that this way reads
        with pytest.raises(ValueError):
            do()
        assert not mark.exists()


WAYS = {
    "evaluate": ("checkpoint=theirs/checkpoints/last.ckpt", "evaluate.episodes=1", "recorder=none"),
    "resume": ("checkpoint=theirs/checkpoints/last.ckpt", "resume=true", "job=train"),
    "pretrained": ("pretrained=theirs/checkpoints/last.ckpt", "job=train"),
    "export": ("checkpoint=theirs/checkpoints/last.ckpt", "job=export", "export=program", "export.folder=new"),
    "deploy": ("checkpoint=theirs/checkpoints/last.ckpt", "job=deploy", "deploy=ros2"),
    "inspect": ("job=inspect", "inspect.folder=store", "inspect.episode=0"),
}


@pytest.mark.parametrize("way", WAYS)
def test_a_hostile_file_ends_every_job_in_one_sentence(tmp_path: Path, folder: Path, way: str) -> None:
    mark = tmp_path / "mark"
    checkpoint(tmp_path / "theirs/checkpoints/last.ckpt", "model.image", command(mark))
    shutil.copytree(folder, tmp_path / "store")
    header = json.loads((tmp_path / "store/store.json").read_text())
    header["config"] = {"task": plain(composed()).get("task"), "expert": {}}
    header["config"]["task"]["goal"] = command(mark)
    (tmp_path / "store/store.json").write_text(json.dumps(header))
    done = vla(tmp_path, *WAYS[way], ok=False)
    errors = [line for line in done.stderr.splitlines() if line.startswith("error: ")]
    assert len(errors) == 1 and "_target_ must name a class" in errors[0], done.stderr
    assert "Traceback" not in done.stderr and not mark.exists()


def test_somebody_elses_checkpoint_does_not_say_where_files_go(tmp_path: Path) -> None:
    theirs: dict[str, Any] = {
        "collect.folder": "/nowhere",
        "logger": {"mlflow": node("lightning.pytorch.loggers.MLFlowLogger")},
    }
    theirs |= {"trainer.default_root_dir": "/nowhere", "trainer.max_steps": 7}
    config = OmegaConf.create(plain(composed()))
    for key, value in theirs.items():
        OmegaConf.update(config, key, value, force_add=True, merge=False)
    path = tmp_path / "theirs/checkpoints/last.ckpt"
    path.parent.mkdir(parents=True)
    torch.save({"config": plain(config), "spec": toy.SPEC.to_dict(), "state_dict": {}}, path)
    mine = composed(f"output={tmp_path}/elsewhere/mine", f"checkpoint={path}", "resume=true")
    resumed = go_on(mine, [])
    assert "/nowhere" not in json.dumps(plain(resumed)) and "mlflow" not in resumed.logger
    assert resumed.trainer.max_steps == 7  # how far, which is no more than a number
    own = composed(f"output={tmp_path}/mine", f"checkpoint={path}", "resume=true")
    assert go_on(own, []).collect.folder == "/nowhere"  # a run beside one's own is one's own


def test_a_path_in_somebody_elses_checkpoint_is_refused(tmp_path: Path) -> None:
    config = plain(composed("expert=lerobot", "expert.folder=/nowhere"))
    path = tmp_path / "last.ckpt"
    torch.save({"config": config, "spec": toy.SPEC.to_dict(), "state_dict": {}}, path)
    with pytest.raises(ValueError, match=r"last\.ckpt names a path in expert\.folder"):
        go_on(composed(f"output={tmp_path}/elsewhere/mine", f"checkpoint={path}", "resume=true"), [])


def test_a_model_that_its_checkpoint_cannot_hold_is_refused_before_it_is_made(tmp_path: Path) -> None:
    path = checkpoint(tmp_path / "last.ckpt", "model.width", 16384)
    config = torch.load(path, weights_only=True)["config"]
    config["model"]["text_width"] = 16384
    torch.save({"config": config, "spec": toy.SPEC.to_dict(), "state_dict": {}}, path)
    with pytest.raises(ValueError, match="describes a model that is larger than the file"):
        make_policy(plain(composed().policy), path)


def test_compressed_checkpoints_are_refused_before_they_are_unpacked(tmp_path: Path) -> None:
    with ZipFile(tmp_path / "bomb.ckpt", "w", ZIP_DEFLATED) as archive, archive.open("archive/data.pkl", "w") as file:
        for _ in range(256):
            file.write(bytes(2**20))
    with pytest.raises(ValueError, match=r"bomb\.ckpt cannot be read as a checkpoint"):
        read_checkpoint(tmp_path / "bomb.ckpt")
