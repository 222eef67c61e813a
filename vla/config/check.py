"""Validation of a composed config before any work: its nodes against the signatures of their classes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import nullcontext, suppress
from dataclasses import dataclass, fields
from inspect import Parameter
from typing import Any

from vla.config.annotations import MissingLibrary, fits, locate
from vla.config.build import GROUPS, Group, arguments, check_node, product_type, require_known
from vla.config.differences import ABSENT, value_at
from vla.config.experiment import Experiment
from vla.config.nodes import Rounds, Settings, with_changes
from vla.config.packages import config_folders
from vla.io.documents import read_yaml
from vla.io.errors import UserError

OF_EVERY_JOB = ("collect", "validate", "evaluate")
TRAINING = tuple(group.name for group in GROUPS.values() if group.training)
# Keys that trainings read, though Lightning has defaults for them.
REQUIRED_KEYS = {"trainer": ("max_steps", "precision", "accumulate_grad_batches", "val_check_interval")}


@dataclass(frozen=True)
class Job:
    """Requirements of a job: only what it builds is checked and imported."""

    groups: tuple[str | Group, ...]  # that it builds: names in `GROUPS`, or groups of its own
    adopts: bool = False  # takes checkpoint=RUN
    without_agent: tuple[str, ...] = ()  # groups also needed without agent=OPTION
    without_checkpoint: tuple[str, ...] = ()  # groups also needed without agent=OPTION and checkpoint=RUN
    stored: tuple[str, ...] = ()  # groups whose libraries may be missing: a complete episode store takes their place

    def needs(self, config: Mapping[str, Any]) -> dict[str, Group]:
        """Return name → group for every group that the job builds from a config."""
        names = [*self.groups]
        if config.get("agent") is None:
            names += self.without_agent
            if config.get("checkpoint") is None:
                names += self.without_checkpoint
        groups = (GROUPS[name] if isinstance(name, str) else name for name in names)
        return {group.name: group for group in groups}


def check(experiment: Experiment, job: Job) -> None:
    """Check every node of an experiment that its `job` will build against the signature of its class.

    Raises a UserError for an unknown, missing or ill-typed key, with its dotted name and the allowed values; the error
    also says if the chosen experiment sets that value.
    """
    try:
        _check(experiment, job)
    except UserError as error:
        if hint := _experiment_hint(experiment.nodes, str(error)):
            raise UserError(f"{error}; {hint}") from error
        raise


def _check(experiment: Experiment, job: Job) -> None:
    config = experiment.nodes
    values = {field.name: config[field.name] for field in fields(Settings) if field.name in config}
    groups = {name: GROUPS[name] for name in OF_EVERY_JOB} | job.needs(config)
    files = (file for folder in config_folders() for file in (folder / "job").glob("*.yaml"))
    job_names = {file.stem for file in files}  # an experiment may have options of another job
    for name in (name for name in config if name not in job_names):
        require_known("", name, {**values, **GROUPS, **groups}, "the config")
    check_node("", {"_target_": "vla.config.nodes.Settings", **values}, Settings)
    settings = experiment.settings
    if config.get("agent") is not None:
        if "agent" not in groups:
            raise UserError(f"job={settings.job} takes no agent: agent=OPTION goes with job=evaluate and deploy")
        for name in ("checkpoint", "pretrained", "resume"):
            if config.get(name) is not None:
                raise UserError(f"agent=OPTION and {name}=RUN are two policies: omit one of them")
    for name, group in groups.items():
        if config.get(name) is not None:
            _check_group(config[name], group, may_lack=name in job.stored)
            if missing_keys := [key for key in REQUIRED_KEYS.get(name, ()) if key not in config[name]]:
                raise UserError(f"{name}.{missing_keys[0]} is missing: trainings need it")
        elif not group.optional:
            raise UserError(f"job={settings.job} needs {name}=OPTION; --help lists the options")
    if "model" in groups:
        kinds = [locate(f"{group}._target_", config[group]["_target_"]) for group in ("tokenizer", "model")]
        _require_together(*kinds)
        if chunking := (config.get("policy") or {}).get("chunking"):
            from vla.models.chunking import require_chunking  # imports PyTorch, as models do

            method = locate("policy.chunking._target_", chunking["_target_"])
            require_chunking(method, kinds[1], config["model"].get("prefix", 0))
        model, initial_policy = config["model"], settings.pretrained or settings.checkpoint
        if model.get("statistics") == "pretrained" and model.get("trunk", "") is None and not initial_policy:
            raise UserError("model.statistics=pretrained needs a published policy: add pretrained=… or omit the option")
    _check_contents(experiment, groups)


def _experiment_hint(config: Mapping[str, Any], error: str) -> str:
    """Return how to override the chosen experiment at the key that an error begins with; "" if it does not set that."""
    name, key = value_at(config, "chosen.experiment"), error.partition(" ")[0]
    if "." not in key or config.get("checkpoint") is not None:  # which has an experiment of its own
        return ""
    for content in _experiments(str(name)):
        if value_at(content, key) not in (ABSENT, {}) and value_at(content, key) == value_at(config, key):
            way_out = f"~{key} removes it" if f"{key} is unknown" in error else f"{key}=VALUE replaces it"
            return f"experiment={name} sets it: {way_out}"
    return ""


def _experiments(name: str) -> Iterator[dict[str, Any]]:
    """Yield the content of an experiment's file, and of those that it extends."""
    files = (folder / "experiment" / f"{name}.yaml" for folder in config_folders())
    if file := next((file for file in files if file.is_file()), None):
        with suppress(UserError):  # YAML that only Hydra reads, such as aliases: the error then has no hint
            content = read_yaml(file, dict[str, Any])
            yield content
            for option in content.get("defaults") or ():
                if isinstance(option, str) and option != "_self_":
                    yield from _experiments(option)


def _check_group(node: Any, group: Group, may_lack: bool) -> None:
    """Check the node of a group, whose library this machine `may_lack`."""
    nodes = {f"{group.name}.{key}": part for key, part in node.items()} if group.several else {group.name: node}
    for key, child in nodes.items():
        with suppress(MissingLibrary) if may_lack else nullcontext():
            check_node(key, child, product_type(group), group.runtime)


def _check_contents(experiment: Experiment, groups: Mapping[str, Group]) -> None:
    """Check that values are compatible, and the task under every condition and with all other changes."""
    settings, validate, evaluate = experiment.settings, experiment.validate, experiment.evaluate
    one, other = validate.seeds, evaluate.seeds
    trains = "learner" in groups and settings.checkpoint is None  # with a checkpoint, the seeds of its training count
    if trains and range(max(one.start, other.start), min(one.stop, other.stop)):
        raise UserError(
            f"validate.seed={one.start} and evaluate.seed={other.start} share episodes, but episodes that select the "
            "weights must not evaluate them: change one of the two"
        )
    conditions = {}
    if settings.job in ("evaluate", "improve"):
        conditions = {f"evaluate.conditions.{name}": changes for name, changes in evaluate.changes.items()}
    if trains and validate.episodes:
        conditions["validate.changes"] = validate.changes
        # Episodes of a validation take the policy's lanes and precision, and need none of its libraries.
        _check_group(experiment.nodes.get("policy"), GROUPS["policy"], may_lack=True)
    if "improve" in groups:
        conditions["improve.changes"] = experiment.options(Rounds).changes
    for name, changes in conditions.items():
        if changes:
            check_node(f"task ({name})", with_changes(experiment["task"], changes), product_type(GROUPS["task"]))


def devices(trainer: Mapping[str, Any]) -> int:
    """Return how many devices a trainer node asks for, on all of its machines."""
    choice, nodes = trainer.get("devices", "auto"), trainer.get("num_nodes", 1)
    if isinstance(choice, list):
        return len(choice) * nodes
    if str(choice) not in ("auto", "-1"):
        return (len(choice.rstrip(",").split(",")) if "," in str(choice) else int(choice)) * nodes
    if trainer.get("accelerator", "auto") == "cpu":
        return nodes
    from torch.cuda import device_count  # slow to import

    return max(device_count(), 1) * nodes


def _require_together(tokenizer: type, model: type) -> None:
    parameter = arguments(model).get("tokenizer")
    if parameter is None:
        raise UserError(f"{model.__name__} needs the argument tokenizer: end its arguments with **inherited: Inherited")
    if parameter.annotation not in (Any, Parameter.empty) and not fits(tokenizer, parameter.annotation):
        raise UserError(
            f"{model.__name__} predicts one token per action component, and {tokenizer.__name__} does not make one per "
            "component: choose another tokenizer, such as tokenizer=uniform, or model=decoder, which takes any"
        )
