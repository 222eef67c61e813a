"""Entry point, `python -m vla.run [job=…] [GROUP=OPTION …] [KEY=VALUE …]`: compose a config, check it, run the job."""

from __future__ import annotations

import gc
import logging
import os
import re
import shutil
import sys
import traceback
from collections.abc import Container, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, NoReturn

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import ConfigCompositionException, HydraException, MissingConfigException, OverrideParseException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from vla import jobs
from vla.config.annotations import packages, targets
from vla.config.check import check, devices
from vla.config.compose import CONF, axes, compose, copy_less, offer_axes, substitutes, with_variant
from vla.config.experiment import Experiment
from vla.config.origin import SECRET
from vla.config.packages import config_folders, offer_options, trust
from vla.deploy import ros
from vla.io.errors import UserError, suggestion
from vla.io.files import warn_on_error
from vla.io.printable import escape
from vla.parallel.processes import ease_garbage_collection, spin_briefly, without_triton

log = logging.getLogger("vla.run")  # also if this module is __main__

SWEEP = "in the sweep "  # prefix of a note on a cell's error
PICKLE = "--experimental-rerun"  # option of Hydra
OPTIONS = (PICKLE, "--cfg", "--config-dir", "--config-name", "--config-path", "--info", "--package")  # with values
# Errors of a command line, a file or a machine.
EXPECTED_ERRORS = (UserError, OSError, HydraException, OmegaConfBaseException, YAMLError, RecursionError)
# Jobs that go on where an earlier one ended, in its folder.
RESUMABLE_JOBS = ("collect", "train", "evaluate", "improve")
RANKS = ("RANK", "LOCAL_RANK", "SLURM_PROCID", "JSM_NAMESPACE_RANK")  # variables that Lightning reads on its import
TRACEBACKS = "VLA_TRACEBACKS"  # environment variable that passes the user's HYDRA_FULL_ERROR to child processes


def sentence(error: Exception) -> str:
    """Describe an error in one printable line, with a suggestion where possible."""
    return escape(" ".join(_describe(error).split()))


def _describe(error: Exception) -> str:
    text = str(error).strip() or type(error).__name__
    if isinstance(error, RecursionError):
        return "a value or a folder is nested too deep: HYDRA_FULL_ERROR=1 shows where"
    if isinstance(error, MissingConfigException) and error.missing_cfg_file and error.options is not None:
        group, _, option = error.missing_cfg_file.rpartition("/")
        return f"{group} has no option '{option}'{_choices_hint(option, error.options)}"
    if isinstance(error, OverrideParseException):
        reason = error.message.splitlines()[0]
        return f"cannot read {error.override}: {reason}; quote special characters, as in 'key=\"value\"'"
    if isinstance(error, ConfigCompositionException):
        if "No match in the defaults list" in text:  # such as task/goal of another task
            group = re.split(r"Could not \w+ '", text)[-1].partition("'")[0]
            adds = f"+{group}=OPTION adds it, if the chosen {group.rpartition('/')[0]} takes one"
            return f"the chosen options have no group '{group}': {adds}; --help lists them"
        if text.endswith("appears more than once in the final defaults list"):  # of an option that is there twice
            return f"{text.partition(' ')[0]} comes from two options of one group: leave out the +, or name one of them"
        if text.startswith("Multiple values for "):
            group = text.removeprefix("Multiple values for ").partition(". ")[0]
            return f"{group} has an option already, which {group}=OPTION replaces: leave out the +, or name it once"
        if isinstance(error.__cause__, OmegaConfBaseException) and error.__cause__.full_key:
            return _unknown_key(error.__cause__)
    if isinstance(error, OmegaConfBaseException) and error.full_key:
        _, resolver, reason = text.splitlines()[0].partition("UserError raised while resolving interpolation: ")
        return reason if resolver else f"{error.full_key}: {text.splitlines()[0]}"
    if type(error) is ValueError and text.startswith("invalid literal for int()"):  # by OmegaConf, of a list's key
        return f"{text.rpartition(': ')[2]} is no item of a list: these have numbers, from 0"
    if isinstance(error, OSError) and error.filename:
        return f"{error.filename}: {error.strerror}"
    return text


def _choices_hint(name: str, names: Sequence[str]) -> str:
    """Return which of the known names was probably meant, or all of them."""
    return suggestion(name, names) or f": there are {', '.join(names)}"


def _unknown_key(error: OmegaConfBaseException) -> str:
    key = str(error.full_key)
    if key in jobs.JOBS:
        return f"there is no {key} without job={key}"
    *path, name = str(error.key).replace("/", ".").split(".")
    parent = OmegaConf.select(error.parent_node, ".".join(path)) if path else error.parent_node
    names = [str(key) for key in parent if key not in ("hydra", "_target_")] if isinstance(parent, DictConfig) else []
    group = key.rpartition(".")[0].replace(".", "/")
    if not names and (group in axes() or any((folder / group).is_dir() for folder in config_folders())):
        return f"there is no {key} before {group} is chosen: add {group}=OPTION, see --help"
    hint = _choices_hint(name, names) if names else ""
    # The task of a checkpoint may have other keys than that of the command.
    return f"there is no {key}{hint}" + (f"; +{key}=VALUE adds it" if hint[:1] == ":" or key[:5] == "task." else "")


def _is_mendable(error: Exception) -> bool:
    """Return whether `error` is about the command line, a file or the machine rather than a bug."""
    # Lightning's by name, because its import takes seconds; OmegaConf lets the ValueError of a list's key "x" through.
    lightning = type(error).__name__ == "MisconfigurationException"
    of_list = Path(traceback.extract_tb(error.__traceback__)[-1].filename).name == "omegaconf.py"
    return isinstance(error, EXPECTED_ERRORS) or lightning or of_list


def _require_sweepable(experiment: Experiment, groups: Container[str]) -> None:
    """Refuse a grid without -m or beside another grid, folders of cells that no table finds, or that several cells
    share, and cells on several devices."""
    config = HydraConfig.get()
    pairs = {
        key.lstrip("+"): value for key, _, value in (override.partition("=") for override in config.overrides.task)
    }
    name, params = config.runtime.choices["experiment"], config.sweeper.params or {}
    if config.mode != RunMode.MULTIRUN:
        if params:
            raise UserError(f"experiment={name} is a grid of runs: add -m")
        return
    if not pairs.keys() >= params.keys():
        raise UserError(f"experiment={name} is a grid of its own: run it without other experiments")
    if "${" not in pairs.get("output", "${"):
        raise UserError(f"output={pairs['output']} would be every cell's folder: name the sweep's, hydra.sweep.dir=DIR")
    if Path(config.runtime.output_dir).parent.resolve() != Path(config.sweep.dir).resolve() or not config.output_subdir:
        raise UserError(
            f"hydra.sweep.subdir={config.sweep.subdir} and hydra.output_subdir={config.output_subdir}: a sweep's table "
            "needs a single name for each cell, and a folder of Hydra in it: omit the two"
        )
    slurm = config.runtime.choices["hydra/launcher"] == "submitit_slurm"
    if "trainer" in groups and not slurm and devices(experiment["trainer"]) > 1:
        # Processes that a trainer starts repeat the command line, here the whole sweep.
        raise UserError(
            "-m cannot train on several devices in this launcher: add trainer.devices=1, "
            "or hydra/launcher=submitit_slurm, which starts every process of a cell itself"
        )


@contextmanager
def _without_empty_folders(cfg: DictConfig) -> Iterator[None]:
    """Remove the folder that Hydra created for this run, and a new `output`, if they end with no files but Hydra's."""
    folder, output = Path(HydraConfig.get().runtime.output_dir), Path(str(cfg.output))
    new_folders = [output] if not output.exists() else []
    if HydraConfig.get().mode == RunMode.RUN and folder.resolve() != Path.cwd():
        new_folders.append(folder)
    try:
        yield
    finally:
        for new_folder in new_folders:
            files = (path.relative_to(new_folder) for path in new_folder.rglob("*") if not path.is_dir())
            if {path.parts[0] for path in files} <= {".hydra"}:
                shutil.rmtree(new_folder, ignore_errors=True)


def _run_job(cfg: DictConfig) -> float | None:
    without_triton()
    overrides = list(HydraConfig.get().overrides.task)
    cfg = with_variant(cfg, overrides)
    composed: Any = OmegaConf.to_container(cfg, resolve=False)
    # Before anything is read from a file.
    trust(composed.get("trust"), [composed["job"], *targets(composed)], packages(composed))
    cfg = _merge_saved(cfg, overrides)
    job, option = jobs.find(cfg.job), HydraConfig.get().runtime.choices["job"]
    make_default = partial(compose, f"job={option}")
    experiment = Experiment.from_config(cfg, make_default)
    check(experiment, job)
    _require_sweepable(experiment, job.needs(experiment.nodes))
    if jobs.builds_world(experiment) and (replacements := substitutes(experiment["task"], overrides)):
        overrides += replacements
        experiment = Experiment.from_config(_merge_saved(compose(*overrides), overrides), make_default)
    return jobs.run(experiment)


def _merge_saved(cfg: DictConfig, overrides: list[str]) -> DictConfig:
    """Return `cfg` merged with the run, policy or pretrained weights that it names; raise a UserError if impossible."""
    for key in ("resume", "checkpoint", "pretrained", "output"):
        if not isinstance(cfg[key], str | None) or (key == "output" and not cfg[key]):
            raise UserError(f"{key}={cfg[key]} is not a path: give a folder or file; a number is quoted, {key}=\\'3\\'")
    if cfg.resume is cfg.pretrained is cfg.checkpoint is None:
        return cfg
    from vla.config.adopt import adopt, finetune, resume  # imports PyTorch, as the next one does
    from vla.runs.resume import newest_run

    if cfg.resume is not None:
        run = newest_run(Path(cfg.output).parent) if cfg.resume == "last" else Path(cfg.resume)
        return resume(cfg, run, overrides)
    if cfg.pretrained is not None:
        return finetune(cfg, overrides)
    if not jobs.find(cfg.job).adopts:
        raise UserError(
            f"job={cfg.job} takes no checkpoint: omit it, or train with resume=RUN, which continues a run, or "
            f"pretrained={cfg.checkpoint}, which starts from its weights"
        )
    return adopt(cfg, overrides)


def _fail(error: Exception) -> NoReturn:
    """Save a cell's error in its folder and raise it with a note, because the sweep may run in another process."""
    from vla.runs.sweep import save_failure  # imports libraries, as below

    cell = Path(HydraConfig.get().runtime.output_dir)
    bug = [*traceback.format_exception_only(error), *traceback.format_exception(error)]
    save_failure(cell, sentence(error) if _is_mendable(error) else "".join(bug))
    error.add_note(f"{SWEEP}{cell.parent}")
    # Hydra keeps the errors of all cells until the sweep ends, and a traceback holds the model and data of its cell.
    error.__cause__ = error.__context__ = error.__traceback__ = None
    gc.collect()
    raise error


def _end(error: Exception) -> NoReturn:
    """End the program with an error of one sentence, unless it is a bug or the user wants its traceback."""
    for note in getattr(error, "__notes__", ()):
        if note.startswith(SWEEP):
            from vla.jobs.sweep import write_table
            from vla.runs.sweep import describe_failures

            folder = Path(note.removeprefix(SWEEP))
            with warn_on_error(folder):
                write_table(folder)  # Hydra leaves it to us: see `SweepTable.on_multirun_end`
            print(escape(f"error: {describe_failures(folder)}"), file=sys.stderr)
            sys.exit(1)
    if os.environ[TRACEBACKS] == "1" or not _is_mendable(error):
        raise error
    print(f"error: {sentence(error)}", file=sys.stderr)
    sys.exit(1)


def _say_how_to_continue(cfg: DictConfig) -> None:
    """Log which command continues after an interruption: without `output=` or `resume=` a command gets a new folder.

    Cells of a sweep log nothing: there may be many, each in a process of its own.
    """
    if HydraConfig.get().mode == RunMode.RUN and cfg.job in RESUMABLE_JOBS:
        overrides = HydraConfig.get().overrides
        keys = {override.partition("=")[0] for override in (*overrides.task, *overrides.hydra)}
        has_folder = cfg.job == "collect" or keys & {"output", "resume", "hydra.run.dir"}
        addition = "" if has_folder else f" with output={os.path.relpath(cfg.output)}"
        log.info("interrupted: the same command%s continues", addition)


@hydra.main(version_base="1.3", config_path=str(CONF), config_name="config")
def _compose(cfg: DictConfig) -> float | None:
    try:
        with _without_empty_folders(cfg):
            return _run_job(cfg)
    except KeyboardInterrupt:
        _say_how_to_continue(cfg)
        raise
    except Exception as error:
        if HydraConfig.get().mode == RunMode.MULTIRUN:
            _fail(error)  # a sweeper may continue with the next job
        _end(error)


def _overrides_first(arguments: list[str]) -> list[str]:
    """Move overrides before the options: argparse takes them from one place only, and behind `--info` as its value."""
    overrides, options, before = list[str](), list[str](), ""
    for argument in arguments:
        takers = ("-c", "--c") if "=" in argument else ("-c", "--c", "-i", "--i", "-p", "--p")
        is_value = before.startswith(takers) and "=" not in before  # of an option
        (options if is_value or argument[:1] == "-" else overrides).append(argument)
        before = argument
    return overrides + options


def _require_plain(arguments: list[str]) -> None:
    """Refuse arguments that Hydra would answer with its usage message or a traceback, and its option that loads a
    config from a pickle, which may execute any code; options can be abbreviated."""
    if {"-m", "--multirun"} & {*arguments} and any(word.partition("=")[0] in ("-c", "--cfg") for word in arguments):
        raise UserError("--cfg shows the config of one run: leave out -m, and give every key one value")
    if "--resolve" in arguments and not any(word.startswith(("-c", "--cfg", "-h", "--help")) for word in arguments):
        raise UserError("--resolve goes with --cfg job, which shows the config")
    for name, _, value in (word.partition("=") for word in arguments if "=" in word):
        if name.startswith("--") and not any(option.startswith(name) for option in OPTIONS):
            raise UserError(f"{name} is no option: write {name.strip('-')}={value}, without dashes")
    if any(len(name := word.partition("=")[0]) > 2 and PICKLE.startswith(name) for word in arguments):
        raise UserError(f"{PICKLE} runs whatever a file says: compose the run again from its command line")


def _require_options(arguments: list[str]) -> None:
    """Refuse arguments at which Hydra shows a traceback, such as a value where a group takes an option, or no job, and
    those that the default job would ignore."""
    names = {argument.partition("=")[0].lstrip("+~") for argument in arguments}
    for group in ("deploy", "export"):
        if group in names and not names & {"job", "experiment", "resume"}:
            raise UserError(f"{group}=OPTION goes with job={group}: add that")
    for argument in arguments:
        name, equals, value = argument.partition("=")
        group = name.lstrip("+~").partition("@")[0]
        if argument.startswith("~") and group in ("job", "experiment"):
            raise UserError(f"{argument} leaves no {group}: choose another one, {group}=OPTION")
        if SECRET in argument and value not in ("", "null"):
            raise UserError(
                f"{name}: Hydra would save the {SECRET} in the folder of the run: set the environment variable "
                "VLA_API_KEY instead"
            )
        if equals and not name:
            raise UserError(f"{argument} has no key: write KEY{argument}")
        if group in ("job", "experiment") and value.startswith("["):
            raise UserError(f"{argument} names several: {group} takes one option")
        folders = [path for folder in config_folders() if (path := folder / group).is_dir()]
        is_value = any(re.fullmatch(r"(?i:null|true|false)|[+-]?\d+(\.\d+)?", part) for part in value.split(","))
        if is_value and (folders or "/" in group):
            hint = f", as in {group}=none" if any((path / "none.yaml").is_file() for path in folders) else ""
            dotted = f"; a value has dots, {group.replace('/', '.')}={value}" if "/" in group else ""
            raise UserError(f"{argument}: {group} takes the name of an option{hint}, see --help{dotted}")


def _require_ranks() -> None:
    """Refuse environment variables of process ranks that are not numbers."""
    for name, value in ((name, os.environ.get(name, "0")) for name in RANKS):
        if not value.isdecimal():
            raise UserError(f"the environment variable {name} is {value[:50]!r}, not the number of a process: unset it")


def main() -> None:
    """Run the command line; errors that the user can fix end in one sentence unless HYDRA_FULL_ERROR=1."""
    ease_garbage_collection()
    spin_briefly()
    sys.excepthook = lambda _, bug, __: sys.stderr.write(escape("".join(traceback.format_exception(bug))))
    os.environ.setdefault(TRACEBACKS, os.environ.get("HYDRA_FULL_ERROR", "0"))
    os.environ["HYDRA_FULL_ERROR"] = "1"  # otherwise Hydra prints errors itself
    arguments, ros.arguments[:] = ros.split_arguments(sys.argv[1:])
    sys.argv[1:] = _overrides_first(arguments)
    try:
        _require_plain(sys.argv[1:])
        _require_options(sys.argv[1:])
        _require_ranks()
        offer_options()
        offer_axes()
        copy_less()
        _compose()
    except KeyboardInterrupt:
        sys.exit(130)
    except Exception as error:
        _end(error)


if __name__ == "__main__":
    main()
