"""Construction of objects from config nodes.

A node names a class in `_target_`. The signature of its `__init__` is the schema of the node: names, required
arguments, types and allowed values. A node is checked against that signature before anything is built.
"""

from __future__ import annotations

import inspect
import re
import sys
from collections import ChainMap
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, reduce
from importlib import import_module
from operator import or_
from typing import Annotated, Any, Literal

from annotated_types import Ge, Le, MinLen, Predicate
from hydra.errors import InstantiationException
from hydra.utils import instantiate

from vla.config.annotations import (
    MissingLibrary,
    fits,
    format_short,
    install_hint,
    is_node,
    locate,
    mismatch,
    packages,
    require_trusted,
    takes_path,
    targets,
)
from vla.config.packages import MISSING
from vla.io.documents import resolve_config
from vla.io.errors import UserError, suggestion
from vla.io.types import Count, Inherited, Natural, NonNegative, Share

HYDRA_KEYS = ("_target_", "_partial_")
ADDRESSES = ("url", "uri", "host", "address", "api_key")  # arguments that name a server or its key


@dataclass(frozen=True)
class Group:
    """The kind of objects that a config group, or the node of a job, describes."""

    name: str
    makes: tuple[str, ...]  # alternative base classes or protocols
    runtime: tuple[str, ...] = ()  # constructor arguments from the program, never from YAML
    optional: bool = False  # jobs run without it
    several: bool = False  # an option is a mapping of name → node
    plain: bool = False  # nodes among its arguments stay plain
    training: Literal["", "part", "means"] = ""  # used in training: a "part" determines its result


DEMONSTRATIONS = "vla.data.formats.imported_demonstrations.ImportedDemonstrations"
DATA_ARGUMENTS = ("folder", "spec", "history", "chunk", "tokenize", "episodes", "more")
LOGGER = "lightning.pytorch.loggers.Logger"
TOKENIZER = "vla.models.tokenizers.tokenizer.ActionTokenizer"

# A job may declare further groups of its own.
GROUPS = {
    group.name: group
    for group in (
        Group("collect", ("vla.config.nodes.Collection",), plain=True),
        Group("validate", ("vla.config.nodes.Validation",), plain=True),
        Group("evaluate", ("vla.config.nodes.Evaluation",), plain=True),
        Group("task", ("vla.spec.Environment", "vla.spec.SpecOnly"), training="part"),
        Group("expert", ("vla.spec.Agent", DEMONSTRATIONS), ("spec",), training="part"),
        Group("cluster", ("vla.parallel.pool.Cluster",), training="means"),
        Group("data", ("vla.data.datamodule.WindowDataModule",), DATA_ARGUMENTS, training="part"),
        Group("tokenizer", (TOKENIZER,), ("spec", "statistics"), training="part"),
        Group("model", ("vla.models.model.Model",), ("spec", "tokenizer"), training="part"),
        Group("learner", ("vla.models.learner.Learner",), ("model", "spec", "config"), training="part"),
        Group("trainer", ("lightning.Trainer",), ("callbacks", "logger"), training="means"),
        Group("logger", (LOGGER,), ("save_dir",), optional=True, several=True, training="means"),
        Group("policy", ("vla.policy.Policy",), ("model", "spec")),
        Group("agent", ("vla.spec.Agent",), ("spec",), optional=True),
        Group("recorder", ("vla.spec.Recorder",), ("folder",), optional=True),
        Group("export", ("vla.spec.Exporter",)),
        Group("deploy", ("vla.spec.Deployment",), ("policy", "environment", "output")),
    )
}

RUNTIME = {name for group in GROUPS.values() for name in group.runtime}


def device_list(text: str) -> bool:
    """a number of devices, or numbers with commas between them"""
    return re.fullmatch(r"\d+(,\d+)*,?", text) is not None


# Narrower than Lightning's annotations: with other values its trainer fails late, or silently trains nothing.
Devices = Annotated[list[Natural], MinLen(1)] | Annotated[str, Predicate(device_list)]
NARROWER_TYPES: dict[str, dict[str, Any]] = {
    "lightning.Trainer": {
        "max_steps": Literal[-1] | Count,
        "max_epochs": Literal[-1],  # an epoch never ends
        "devices": Literal["auto", -1] | Count | Devices,
        "num_nodes": Count,
        "accumulate_grad_batches": Count,
        "gradient_clip_val": NonNegative | None,
        "val_check_interval": Count,
        "check_val_every_n_epoch": Literal[1] | None,
        "limit_val_batches": Natural | Share | None,
        "limit_train_batches": Annotated[float, Ge(1), Le(1)] | None,  # fewer would end an epoch
        "log_every_n_steps": Count,
        "precision": Literal["fp32", "bf16"],
    }
}


def build(node: Mapping[str, Any], group: str | Group, **runtime: Any) -> Any:
    """Build the object that a plain `node` of a group, given itself or by its name in `GROUPS`, describes.

    Nested nodes are built first; those with `_partial_: true` become factories. `runtime` are the arguments that the
    program adds. Unresolved references such as `${seed}` are refused, so the checked mapping is the one that is built.
    Raises a UserError for a class that is not allowed or of another kind, wrong arguments, a ValueError of the
    constructor, or a library that is not installed.
    """
    group = GROUPS[group] if isinstance(group, str) else group
    node = resolve_config(node, group.name)
    check_node(group.name, node, product_type(group), tuple(runtime))
    try:
        return instantiate(node, _convert_="all", _partial_=True, _recursive_=not group.plain)(**runtime)
    except (InstantiationException, ModuleNotFoundError) as error:
        cause = error.__cause__ if isinstance(error, InstantiationException) else error  # in a nested node, or this one
        if isinstance(cause, ModuleNotFoundError):
            hint = install_hint(str(cause.name))
            raise UserError(f"{group.name} needs a library that is not installed: {cause}{hint}") from error
        if isinstance(cause, ValueError):
            raise UserError(str(cause)) from error
        raise


@cache
def product_type(group: Group) -> Any:
    """Return the class, protocol or union of the objects that a group describes."""
    classes = [getattr(import_module(module), name) for module, _, name in (p.rpartition(".") for p in group.makes)]
    return reduce(or_, classes)


def check_node(key: str, node: Any, expected: Any, runtime: Sequence[str] = ()) -> None:
    """Check a plain node at `key`, "" at the top, against the signature of its class, without `runtime` arguments.

    A factory, a node with `_partial_: true`, may lack the arguments that its caller adds: keyword-only ones, and the
    runtime arguments of groups. It is allowed inside another node only. Raises a UserError if the class is not an
    `expected` one, or a key is unknown, missing or ill-typed, with its dotted name and the allowed values.
    """
    if not is_node(node):
        raise UserError(f"{key} must be a node with a _target_, got {format_short(node)}")
    partial = node.get("_partial_", False)
    if not isinstance(partial, bool) or (partial and expected is not object):
        raise UserError(f"{key}._partial_ must be {'true or false' if expected is object else 'omitted here'}")
    target = locate(f"{key}._target_", node["_target_"])
    if not fits(target, expected):
        kind = " or ".join(alternative.__name__ for alternative in getattr(expected, "__args__", (expected,)))
        raise UserError(f"{key}._target_ must name a class of kind {kind}, got {node['_target_']}")
    _check_arguments(key, node, target, runtime, partial)
    if "package" in node:
        require_trusted(key, node["package"], is_package=True)


def _check_arguments(key: str, node: Mapping[str, Any], target: type, runtime: Sequence[str], partial: bool) -> None:
    """Check the arguments of the class `target` in a node, see `check_node`."""
    values = {name: value for name, value in node.items() if name not in HYDRA_KEYS}
    parameters = arguments(target)
    variadic = [name for name, parameter in parameters.items() if parameter.kind is inspect.Parameter.VAR_KEYWORD]
    names = [name for name in parameters if name not in (*runtime, *variadic)]
    if missing := [name for name in runtime if not variadic and name not in parameters]:
        raise UserError(f"{key}: {target.__name__} must take the arguments {', '.join(missing)}, which the job gives")
    hints = {name: parameter.annotation for name, parameter in parameters.items()}
    hints |= NARROWER_TYPES.get(node["_target_"], {})
    prefix = f"{key}." if key else ""
    for name, value in values.items():
        if not variadic or str(name).startswith("_"):
            require_known(key, name, names, target.__name__)
        if value == MISSING:
            raise UserError(f"{prefix}{name} is missing: the options chosen need {prefix}{name}=VALUE")
        check_value(f"{prefix}{name}", value, hints.get(name, Any))
    for name in names:
        by_caller = partial and (name in RUNTIME or parameters[name].kind is inspect.Parameter.KEYWORD_ONLY)
        if name not in values and not by_caller and parameters[name].default is inspect.Parameter.empty:
            raise UserError(f"{prefix}{name} is missing: {target.__name__} needs it")


def require_trust(config: Mapping[str, Any], names: Iterable[Any], source: object) -> None:
    """Raise a UserError if a node among `names` of the file `source` names a class or package that is not trusted."""
    nodes = [config.get(name) for name in names]
    for target in targets(nodes):
        require_trusted(source, target)
    for package in packages(nodes):
        require_trusted(source, package, is_package=True)


def require_no_paths(
    config: Mapping[str, Any], names: Collection[str], source: object, replaced_nodes: Collection[str] | None = None
) -> None:
    """Raise a UserError if a node of the file `source` names a file, a folder, or an address or key of a connection.

    Args:
        config: plain; the classes of its nodes `names`, where present, must be trusted.
        source: named in the error.
        replaced_nodes: dotted names of nodes that the command line replaces; None: it cannot replace any.
    """
    require_trust(config, names, source)
    for key in (f"{path}.{argument}" for name in names for _, path, argument in _paths_in(config.get(name), name)):
        if not any(f"{key}.".startswith(f"{name}.") for name in replaced_nodes or ()):
            hint = "" if replaced_nodes is None else f"; {key.rpartition('.')[0].replace('.', '/')}=OPTION gives yours"
            raise UserError(
                f"{source} names a path or an address in {key}: such values are taken from your command line only{hint}"
            )


def without_paths(config: Mapping[str, Any], name: str) -> Any:
    """Return the node `name` of a config that was read from a file, with null in place of its paths and addresses.

    If it has a class that may not be built, only its own `_target_` is returned.
    """
    node = resolve_config(config[name], name)  # a copy
    try:
        require_trust(config, [name], name)
        for part, _, argument in list(_paths_in(node, name)):
            part[argument] = None
    except UserError:
        return {"_target_": node["_target_"]} if is_node(node) else None
    return node


def _paths_in(node: Any, key: str) -> Iterator[tuple[dict[str, Any], str, str]]:
    """Yield (part, its dotted name, argument) for every argument of a node at `key` that is a path or an address.

    A class that this machine cannot import yields no paths, because jobs that build it fail in any case.
    """
    if is_node(node):
        try:
            parameters = arguments(locate(f"{key}._target_", node["_target_"]))
        except MissingLibrary:
            return
        for name, value in node.items():
            if value and name in parameters and (name in ADDRESSES or takes_path(parameters[name].annotation)):
                yield node, key, name
    for name, part in _parts(node):
        yield from _paths_in(part, f"{key}.{name}")


def _parts(value: Any) -> Iterable[tuple[Any, Any]]:
    """Return (key or index, item) for the items of a mapping or list; nothing for other values."""
    return value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()


def check_value(key: str, value: Any, annotation: Any) -> None:
    """Raise a UserError with the dotted name `key` if a value does not match an annotation."""
    _check_nodes(key, value)  # first, because an error within a node is more specific
    if problem := mismatch(key, value, annotation):
        raise UserError(problem)


def _check_nodes(key: str, value: Any) -> None:
    """Check all nodes in a value against their signatures."""
    if is_node(value):
        return check_node(key, value, object)
    for name, child in _parts(value):
        _check_nodes(f"{key}.{name}" if isinstance(value, dict) else f"{key}[{name}]", child)
    return None


def require_known(key: str, name: str, names: Collection[str], owner: str) -> None:
    """Raise a UserError for a name that `owner` does not take; it suggests a similar name, or lists all."""
    if name not in names:
        hint = suggestion(name, names) or f": {owner} takes {', '.join(names) or 'no arguments'}"
        raise UserError(f"{f'{key}.' if key else ''}{name} is unknown{hint}")


def arguments(target: type) -> dict[str, inspect.Parameter]:
    """Return name → constructor argument of a class, with evaluated annotations.

    `**inherited: Inherited` is replaced by the arguments of the next base class with a constructor.
    """
    parameters: dict[str, inspect.Parameter] = {}
    for base in (base for base in target.__mro__[:-1] if "__init__" in vars(base)):
        own_parameters = _parameters(base)
        parameters = {**own_parameters, **parameters}
        if all(parameter.annotation is not Inherited for parameter in own_parameters.values()):
            break
    return {name: parameter for name, parameter in parameters.items() if parameter.annotation is not Inherited}


@cache
def _parameters(target: type) -> Mapping[str, inspect.Parameter]:
    """Return the arguments of a class's own constructor without `self`."""
    init: Any = vars(target)["__init__"]
    # The constructor of a dataclass also has annotations from the modules of its base classes.
    bases = (vars(sys.modules[base.__module__]) for base in target.__mro__[:-1])
    scope = ChainMap(inspect.unwrap(init).__globals__, *bases)
    parameters = {}
    for name, parameter in list(inspect.signature(init).parameters.items())[1:]:
        annotation = parameter.annotation
        if isinstance(annotation, str):
            try:
                annotation = eval(annotation, {}, scope)
            except NameError:  # imported for type checking only
                annotation = Any
        parameters[name] = parameter.replace(annotation=annotation)
    return parameters
