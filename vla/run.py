"""Entry point, `python -m vla.run [job=…] [GROUP=OPTION …] [KEY=VALUE …]`: compose a config, check it, run the job."""

from __future__ import annotations

import os
import re
import shutil
import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from string import Template
from typing import Any, NoReturn

import hydra
from hydra import compose
from hydra.core.hydra_config import HydraConfig
from hydra.errors import ConfigCompositionException, HydraException, MissingConfigException, OverrideParseException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException
from yaml import YAMLError

from vla import jobs
from vla.config.annotations import packages, targets
from vla.config.check import Job, check, devices
from vla.config.compose import CONF, axes, offer_axes, with_variant  # registers the resolver `jobs` of --help
from vla.config.experiment import Experiment, plain
from vla.config.packages import config_folders, offer_options, trust, trust_own
from vla.config.substitutes import builds_world, with_substitutes
from vla.deploy import ros
from vla.io.errors import UserError
from vla.io.printable import printable
from vla.io.suggestion import suggestion
from vla.parallel.processes import ease_garbage_collection, spin_briefly, without_triton
from vla.runs.cells import describe_failures, save_failure

PACKAGE = Path(__file__).resolve().parent
SWEEP = "in the sweep "  # prefix of a note on a cell's error
PICKLE = "--experimental-rerun"  # option of Hydra
MENDABLE = (UserError, OSError, HydraException, OmegaConfBaseException, YAMLError, RecursionError)
TRACEBACKS = "VLA_TRACEBACKS"  # environment variable that passes the user's HYDRA_FULL_ERROR to child processes


def sentence(error: Exception) -> str:
    """Describe an error in one printable line, with a suggestion where possible."""
    return printable(" ".join(_described(error).split()))


def _described(error: Exception) -> str:
    cause = error.__cause__
    if isinstance(error, RecursionError):
        return "a value or a folder is nested too deep: HYDRA_FULL_ERROR=1 shows where"
    if isinstance(error, MissingConfigException) and error.missing_cfg_file and error.options is not None:
        group, _, option = error.missing_cfg_file.rpartition("/")
        hint = suggestion(option, error.options) or ":"
        return f"{group} has no option {option}{hint} there are {', '.join(error.options)}"
    if isinstance(error, OverrideParseException):
        reason = error.message.splitlines()[0]
        return f"cannot read {error.override}: {reason}; quote special characters, as in 'key=\"value\"'"
    if isinstance(error, ConfigCompositionException) and "No match in the defaults list" in str(error):
        return _unmatched(re.split(r"Could not \w+ '", str(error))[-1].partition("'")[0])
    if isinstance(error, ConfigCompositionException) and isinstance(cause, OmegaConfBaseException) and cause.full_key:
        return _unknown_key(cause)
    if isinstance(error, MissingMandatoryValue) and error.full_key:
        return f"{error.full_key} is missing: the options chosen need {error.full_key}=VALUE"
    if isinstance(error, OmegaConfBaseException) and error.full_key:
        line = str(error).splitlines()[0]
        _, resolver, reason = line.partition("UserError raised while resolving interpolation: ")
        return reason if resolver else f"{error.full_key}: {line}"
    if isinstance(error, OSError) and error.filename:
        return f"{error.filename}: {error.strerror}"
    if type(error).__name__ == "FatalError" and "OpenGL" in str(error):
        backend = os.environ.get("MUJOCO_GL", "glfw")
        return f"MuJoCo cannot render here with MUJOCO_GL={backend}: set it to egl, or osmesa"
    text = str(error).strip()
    if "failed to map segment" in text:
        return f"the memory that this process may use is too little to load its libraries ({text}): raise ulimit -v"
    return text or type(error).__name__


def _unmatched(group: str) -> str:
    """Describe a choice from a group that the chosen options do not have, such as task/goal of another task."""
    parent, _, name = group.rpartition("/")
    if not parent:
        return f"there is no group {group}; --help lists them"
    return (
        f"the option chosen for {parent} has no {name}: choose another {parent}, or add a new part with "
        f"+{group}=OPTION; --help lists them"
    )


def _unknown_key(error: OmegaConfBaseException) -> str:
    *path, name = str(error.key).replace("/", ".").split(".")
    parent = OmegaConf.select(error.parent_node, ".".join(path)) if path else error.parent_node
    known = [str(key) for key in parent if key != "hydra"] if isinstance(parent, DictConfig) else []
    if not known:
        return f"there is no {error.full_key}"
    if str(error.full_key).rpartition(".")[0].endswith(".images"):
        return f"there is no {error.full_key}: add a camera with +{error.full_key}=VALUE; there are {', '.join(known)}"
    adopted = str(error.full_key).startswith("task.") and any(part.startswith("checkpoint=") for part in sys.argv)
    hint = f"; a key of the checkpoint's own task is set by +{error.full_key}=VALUE" if adopted else ""
    return f"there is no {error.full_key}{suggestion(name, known) or ':'} there are {', '.join(known)}{hint}"


def _meant_for_user(error: Exception) -> bool:
    """Return whether `error` is about the command line, a file or the machine rather than a bug."""
    # By name, because importing Lightning takes seconds; MuJoCo raises FatalError without a display.
    by_name = type(error).__name__ in ("MisconfigurationException", "FatalError")
    # OmegaConf lets the ValueError of a list's key that is no number through.
    list_key = Path(traceback.extract_tb(error.__traceback__)[-1].filename).name == "omegaconf.py"
    return by_name or list_key or isinstance(error, MENDABLE)


def _require_sweepable(cfg: DictConfig, job: Job) -> None:
    """Refuse -m with several devices: processes that a trainer starts repeat the command line, here the whole sweep."""
    choices = HydraConfig.get().runtime.choices
    if HydraConfig.get().mode != RunMode.MULTIRUN or choices["hydra/launcher"] == "submitit_slurm":
        return
    if "trainer" in job.needs(cfg) and cfg.trainer is not None and devices(plain(cfg.trainer)) > 1:
        raise UserError(
            "-m cannot train on several devices in this launcher: add trainer.devices=1, "
            "or hydra/launcher=submitit_slurm, which starts every process of a cell itself"
        )


def _require_swept() -> None:
    """Refuse grids of which only one cell would run, and cells that share a folder."""
    hydra_config = HydraConfig.get()
    parts = [override.partition("=") for override in hydra_config.overrides.task]
    given = {key: value for key, _, value in parts}
    choices, swept = hydra_config.runtime.choices, hydra_config.mode == RunMode.MULTIRUN
    if not swept and hydra_config.sweeper.params:
        raise UserError(f"experiment={choices['experiment']} is a grid of runs: add -m")
    if not given.keys() >= (hydra_config.sweeper.params or {}).keys():
        raise UserError(f"experiment={choices['experiment']} is a grid of its own: name no other one beside it")
    if swept and "${" not in given.get("output", "${"):
        raise UserError("with -m every cell has a folder of its own: name that of the sweep, hydra.sweep.dir=DIR")


@contextmanager
def _without_empty_folders(cfg: DictConfig) -> Iterator[None]:
    """Remove the folder that Hydra created for this run, and `output` if it is new, if nothing is in them at the end.

    Files of Hydra count as nothing.
    """
    folder, output = Path(HydraConfig.get().runtime.output_dir), Path(str(cfg.output))
    created = [output] if not output.exists() else []
    if HydraConfig.get().mode == RunMode.RUN and folder.resolve() != Path.cwd():
        created.append(folder)
    try:
        yield
    finally:
        for each in created:
            files = (path.relative_to(each) for path in each.rglob("*") if not path.is_dir())
            if {path.parts[0] for path in files} <= {".hydra"}:
                shutil.rmtree(each, ignore_errors=True)


def _do(cfg: DictConfig) -> float | None:
    _require_swept()
    without_triton()
    overrides = HydraConfig.get().overrides.task
    cfg = with_variant(cfg, overrides)
    composed: Any = OmegaConf.to_container(cfg, resolve=False)
    # Before anything is read from a file.
    trust(composed.get("trust"), [composed["job"], *targets(composed)], packages(composed))
    cfg = _adopted(cfg, overrides)
    job = jobs.find(cfg.job).JOB
    check(cfg, job)
    _require_sweepable(cfg, job)  # with the trainer that a run brings
    if builds_world(cfg, job.needs(cfg)):
        cfg = with_substitutes(cfg, overrides)
    default = compose("config", [f"job={HydraConfig.get().runtime.choices['job']}"])
    return jobs.run(Experiment.of(cfg, default))


def _adopted(cfg: DictConfig, overrides: list[str]) -> DictConfig:
    """Return `cfg` merged with the run, policy or pretrained weights that it names.

    Raises:
        UserError: a value is no path, or the named file cannot be used.
    """
    for key in ("resume", "checkpoint", "pretrained", "output"):
        if not isinstance(cfg[key], str | None) or (key == "output" and not cfg[key]):
            raise UserError(f"{key}={cfg[key]} is not a path: give a folder or file; a number is quoted, {key}=\\'3\\'")
    if cfg.resume is cfg.pretrained is cfg.checkpoint is None:
        return cfg
    for file in (cfg.resume, cfg.pretrained, cfg.checkpoint):
        if file is not None:
            trust_own(Path(file))
    from vla.config.adopt import adopt, finetune, resume  # imports PyTorch, as the next one does
    from vla.runs.resume import interrupted_run

    if cfg.resume is not None:
        run = interrupted_run(Path(cfg.output).parent) if cfg.resume == "last" else Path(cfg.resume)
        return resume(cfg, run, overrides)
    if cfg.pretrained is not None:
        return finetune(cfg, overrides)
    if not jobs.find(cfg.job).JOB.adopts:
        raise UserError(
            f"job={cfg.job} takes no checkpoint: resume=RUN continues a run, pretrained={cfg.checkpoint} starts a new "
            "training from its weights"
        )
    return adopt(cfg, overrides)


def _fail(error: Exception) -> NoReturn:
    """Save a cell's error in its folder and raise it with a note, because the sweep may run in another process."""
    cell = Path(HydraConfig.get().runtime.output_dir)
    if _meant_for_user(error):
        save_failure(cell, sentence(error))
    else:
        save_failure(cell, "".join([*traceback.format_exception_only(error), *traceback.format_exception(error)]))
    error.add_note(f"{SWEEP}{cell.parent}")
    raise error


def _end(error: Exception) -> NoReturn:
    for note in getattr(error, "__notes__", ()):
        if note.startswith(SWEEP):
            print(printable(f"error: {describe_failures(Path(note.removeprefix(SWEEP)))}"), file=sys.stderr)
            sys.exit(1)
    if os.environ[TRACEBACKS] == "1" or not _meant_for_user(error):
        raise error
    print(f"error: {sentence(error)}", file=sys.stderr)
    sys.exit(1)


@hydra.main(version_base="1.3", config_path=str(CONF), config_name="config")
def _compose(cfg: DictConfig) -> float | None:
    try:
        with _without_empty_folders(cfg):
            return _do(cfg)
    except Exception as error:
        if HydraConfig.get().mode == RunMode.MULTIRUN:
            _fail(error)  # a sweeper may continue with the next job
        _end(error)


def _menu() -> str:
    """Return the text of --help; Hydra's own search through its config sources takes most of a second."""
    groups: dict[str, list[str]] = {}
    for folder in config_folders():
        for file in folder.rglob("*.yaml"):
            group = file.parent.relative_to(folder)
            if group.parts[:1] not in ((), ("hydra",)):
                groups.setdefault(group.as_posix(), []).append(file.stem)
    for group, options in axes().items():
        groups.setdefault(group, []).extend(options)
    lines = [f"{group}: {', '.join(sorted({*options}))}\n" for group, options in sorted(groups.items())]
    template = OmegaConf.select(OmegaConf.load(CONF / "config.yaml"), "hydra.help.template")
    return Template(template).substitute(APP_CONFIG_GROUPS="".join(lines))


def _require_no_pickle(arguments: list[str]) -> None:
    """Refuse Hydra's option that takes a config from a pickle, which may run anything; it can be abbreviated."""
    if any(len(name := each.partition("=")[0]) > 2 and PICKLE.startswith(name) for each in arguments):
        raise UserError(f"{PICKLE} runs whatever a file says: compose the run again from its command line")


def main() -> None:
    """Run the command line; errors that the user can fix end in one sentence unless HYDRA_FULL_ERROR=1."""
    ease_garbage_collection()
    spin_briefly()
    sys.excepthook = lambda _, bug, __: sys.stderr.write(printable("".join(traceback.format_exception(bug))))
    os.environ.setdefault(TRACEBACKS, os.environ.get("HYDRA_FULL_ERROR", "0"))
    os.environ["HYDRA_FULL_ERROR"] = "1"  # otherwise Hydra prints errors itself
    sys.argv[1:], ros.arguments[:] = ros.split_arguments(sys.argv[1:])
    try:
        _require_no_pickle(sys.argv[1:])
        if sys.argv[1:] in (["--help"], ["-h"]):  # with further arguments Hydra composes the help itself
            print(_menu())
            return
        offer_options()
        offer_axes()
        _compose()
    except KeyboardInterrupt:
        sys.exit(130)
    except Exception as error:
        _end(error)


if __name__ == "__main__":
    main()
