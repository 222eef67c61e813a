"""The entry, `python -m vla.run [job=…] [GROUP=OPTION …] [KEY=VALUE …]`: compose a config, check it, do the job."""

from __future__ import annotations

import os
import re
import shutil
import sys
import traceback
from pathlib import Path
from string import Template
from typing import NoReturn

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import ConfigCompositionException, HydraException, MissingConfigException, OverrideParseException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from vla.check import JOBS, check, suggestion
from vla.deploy import ros
from vla.ending import swift_end
from vla.resume import adopt, go_on, start_from, taken_up
from vla.sweep import failures, note_failure

PACKAGE = Path(__file__).resolve().parent
# Inside the package where it was installed from a wheel, beside it in a clone.
CONF = next(path for path in (PACKAGE / "conf", PACKAGE.parent / "conf") if (path / "config.yaml").is_file())

ADOPTING = ("evaluate", "export", "deploy", "benchmark")  # jobs that use a checkpoint's own task, tokenizer and model
SWEEP = "in the sweep "  # note on the error of a cell
TRACEBACKS = "VLA_TRACEBACKS"  # the user's wish for tracebacks, kept for the processes that a trainer starts


def sentence(error: Exception) -> str:
    """One line that says what is wrong, and what was probably meant."""
    cause = error.__cause__
    if isinstance(error, MissingConfigException) and error.missing_cfg_file and error.options is not None:
        group, _, option = error.missing_cfg_file.rpartition("/")
        hint = suggestion(option, error.options) or ":"
        return f"{group} has no option {option}{hint} there are {', '.join(error.options)}"
    if isinstance(error, OverrideParseException):
        reason = error.message.splitlines()[0]
        return f"cannot read {error.override}: {reason}; quote special characters, as in 'key=\"value\"'"
    if isinstance(error, ConfigCompositionException) and isinstance(cause, OmegaConfBaseException) and cause.full_key:
        return _unknown_key(cause)
    if isinstance(error, OmegaConfBaseException) and error.full_key:
        return f"{error.full_key}: {str(error).splitlines()[0]}"
    if isinstance(error, OSError) and error.filename:
        return f"{error.filename}: {error.strerror}"
    if type(error).__name__ == "FatalError" and "OpenGL" in str(error):
        backend = os.environ.get("MUJOCO_GL", "glfw")
        return f"MuJoCo cannot render here with MUJOCO_GL={backend}: set it to egl, or osmesa"
    text = " ".join(str(error).split())
    if "failed to map segment" in text:
        return f"the memory that this process may use is too little to load its libraries ({text}): raise ulimit -v"
    return text or type(error).__name__


def _unknown_key(error: OmegaConfBaseException) -> str:
    *path, name = str(error.key).replace("/", ".").split(".")
    parent = OmegaConf.select(error.parent_node, ".".join(path)) if path else error.parent_node
    known = [str(key) for key in parent if key != "hydra"] if isinstance(parent, DictConfig) else []
    if not known:
        return f"there is no {error.full_key}"
    return f"there is no {error.full_key}{suggestion(name, known) or ':'} there are {', '.join(known)}"


def _meant_for_user(error: Exception) -> bool:
    """Whether `error` speaks about the command line, a file or the machine, rather than about a bug.

    Libraries raise ValueError and RuntimeError for bugs as well; the traceback of one that our own code raises on
    purpose, here or in a worker process, ends with a `raise` in this package (or in Hydra, for the command line).
    """
    if isinstance(error, (OSError, HydraException, OmegaConfBaseException)):
        return True
    # Lightning's, which would take seconds to import, MuJoCo's for want of a display, and those about YAML files.
    if type(error).__name__ in ("MisconfigurationException", "FatalError") or isinstance(error, YAMLError):
        return True
    remote = type(error.__cause__).__name__ == "_RemoteTraceback"
    text = str(error.__cause__) if remote else "".join(traceback.format_tb(error.__traceback__))
    lines = re.findall(r'File "([^"]+)", line \d+, in .*\n\s+(.*)', text)
    if not isinstance(error, (ValueError, RuntimeError, ImportError)) or not lines:
        return False
    file, statement = lines[-1]
    ours = any(Path(file).is_relative_to(folder) for folder in (PACKAGE, Path(hydra.__file__).parent))
    return ours and statement.startswith("raise")


def _require_sweepable(cfg: DictConfig) -> None:
    """Processes that a trainer starts repeat the command line, which under -m would be the whole sweep."""
    choices = HydraConfig.get().runtime.choices
    if HydraConfig.get().mode != RunMode.MULTIRUN or choices["hydra/launcher"] == "submitit_slurm":
        return
    if "trainer" in JOBS.get(cfg.job, ()) and cfg.trainer is not None and _devices(cfg.trainer) > 1:
        raise ValueError(
            "-m cannot train on several devices in this launcher: add trainer.devices=1, "
            "or hydra/launcher=submitit_slurm, which starts every process of a cell by itself"
        )


def _devices(trainer: DictConfig) -> int:
    devices, nodes = trainer.get("devices", "auto"), trainer.get("num_nodes", 1)
    if OmegaConf.is_list(devices):
        return len(devices) * nodes
    if str(devices) not in ("auto", "-1"):
        return (len(devices.split(",")) if "," in str(devices) else int(devices)) * nodes
    if trainer.get("accelerator", "auto") == "cpu":
        return int(nodes)
    from torch.cuda import device_count  # slow to import, and needed in this case only

    return max(device_count(), 1) * nodes


def _remove_unused() -> None:
    """Remove the folder that Hydra made for this run, which goes on in the folder of another one."""
    folder = Path(HydraConfig.get().runtime.output_dir)
    if HydraConfig.get().mode == RunMode.RUN and {path.name for path in folder.iterdir()} <= {".hydra"}:
        shutil.rmtree(folder, ignore_errors=True)


def _do(cfg: DictConfig) -> float | None:
    from vla import jobs

    if cfg.checkpoint is not None or "task" in JOBS.get(cfg.job, ()):
        from vla.tasks.backend import choose_backend

        # Before a check imports MuJoCo, which reads MUJOCO_GL at once; a policy on a robot does not render.
        choose_backend(required=cfg.job != "deploy")
    said = HydraConfig.get().overrides.task
    if cfg.pretrained is not None:
        cfg = start_from(cfg, said)
    if cfg.checkpoint is not None and (cfg.checkpoint == "last" or cfg.resume or cfg.job == "train"):
        if cfg.checkpoint == "last":
            _remove_unused()
        cfg = go_on(cfg, said)
    elif cfg.checkpoint is not None and cfg.job in ADOPTING:
        from vla.policy import read_checkpoint

        cfg = adopt(cfg, read_checkpoint(cfg.checkpoint).config, said)
    _require_sweepable(cfg)  # with the trainer that a checkpoint brings
    check(cfg)
    left = taken_up(cfg) if cfg.job in ("train", "evaluate") else cfg
    return jobs.run(left) if left is not None else None


def _fail(error: Exception) -> NoReturn:
    """Raise the error of a cell, which may be in another process than the sweep and leave its traceback there."""
    cell = Path(HydraConfig.get().runtime.output_dir)
    if _meant_for_user(error):
        note_failure(cell, sentence(error))
    else:
        note_failure(cell, "".join([*traceback.format_exception_only(error), *traceback.format_exception(error)]))
    error.add_note(f"{SWEEP}{cell.parent}")
    raise error


def _end(error: Exception) -> NoReturn:
    for note in getattr(error, "__notes__", ()):
        if note.startswith(SWEEP):
            print(f"error: {failures(Path(note.removeprefix(SWEEP)))}", file=sys.stderr)
            sys.exit(1)
    if os.environ[TRACEBACKS] == "1" or not _meant_for_user(error):
        raise error
    print(f"error: {sentence(error)}", file=sys.stderr)
    sys.exit(1)


@hydra.main(version_base="1.3", config_path=str(CONF), config_name="config")
def _compose(cfg: DictConfig) -> float | None:
    try:
        return _do(cfg)
    except Exception as error:
        if HydraConfig.get().mode == RunMode.MULTIRUN:
            _fail(error)  # a sweeper may want to go on with the next job
        _end(error)


def _menu() -> str:
    """What --help prints. Hydra asks each of its sources for every group anew, several times, which takes most of a
    second."""
    groups: dict[str, list[str]] = {}
    for file in CONF.rglob("*.yaml"):
        group = file.parent.relative_to(CONF)
        if group.parts[:1] not in ((), ("hydra",)):
            groups.setdefault(group.as_posix(), []).append(file.stem)
    lines = [f"{group}: {', '.join(sorted(options))}\n" for group, options in sorted(groups.items())]
    template = OmegaConf.select(OmegaConf.load(CONF / "config.yaml"), "hydra.help.template")
    return Template(template).substitute(APP_CONFIG_GROUPS="".join(lines))


def main() -> None:
    """Do what the command line says; what the user can mend ends in one sentence, unless HYDRA_FULL_ERROR=1."""
    if sys.argv[1:] in (["--help"], ["-h"]):  # with overrides or other folders of options, Hydra looks for itself
        print(_menu())
        return
    os.environ.setdefault(TRACEBACKS, os.environ.get("HYDRA_FULL_ERROR", "0"))
    os.environ["HYDRA_FULL_ERROR"] = "1"  # otherwise Hydra prints errors itself
    sys.argv[1:], ros.arguments[:] = ros.split_arguments(sys.argv[1:])
    try:
        _compose()
    except KeyboardInterrupt:
        sys.exit(130)
    except Exception as error:
        _end(error)


if __name__ == "__main__":
    with swift_end():
        main()
