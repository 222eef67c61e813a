"""Checkpoints: a trained model with the config and the spec of its training, read as data."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

from vla.io.documents import lines_of, resolved
from vla.models.model import Model
from vla.models.pickles import read_archive
from vla.spec import Spec

REQUIRED_NODES = ("task", "tokenizer", "model")  # of the config in a checkpoint
OPTIONAL_NODES = ("chosen", "expert", "collect", "data", "learner", "trainer", "validate")
TRUTH_MODULES = ("truth_head", "truth_scale")  # modules of a model used in training only


@dataclass(frozen=True)
class Header:
    """A checkpoint without its weights."""

    path: Path
    config: dict[str, Any]  # of the training
    spec: Spec
    finished: bool  # the training was completed
    steps: int  # optimiser steps
    windows: str  # digest of the demonstrations, empty if unknown


@dataclass(frozen=True)
class Checkpoint(Header):
    """A checkpoint with the weights of its model."""

    state: dict[str, Tensor]  # of the model

    def restore(self, model: torch.nn.Module) -> None:
        """Load the weights into `model`; `TensorBudget` also limits tensors that loading creates, as of a text encoder.

        Raises:
            ValueError: they belong to another model.
        """
        try:
            with TensorBudget(self.path):
                model.load_state_dict(self.state)
        except Exception as error:  # whatever modules raise for a state that is not theirs
            first = lines_of(error)[-1].strip()[:200]
            raise ValueError(f"{self.path} does not fit the model of its own configuration: {first}") from error

    def initialize(self, model: Model) -> None:
        """Load the weights for fine-tuning; the truth head keeps its initial weights if the truth differs.

        Raises:
            ValueError: they belong to another model.
        """
        state = self.state
        if self.spec.truth != model.spec.truth:
            state = {name: value for name, value in state.items() if name.partition(".")[0] not in TRUTH_MODULES}
            for part, module in model.named_children():
                if part in TRUTH_MODULES:
                    state |= {f"{part}.{name}": value for name, value in module.state_dict().items()}
        replace(self, state=state).restore(model)


def read_header(path: str | Path) -> Header:
    """Read a checkpoint without its weights, which takes the same time for any size.

    Raises:
        ValueError: there is no file, it is damaged, or it is not a checkpoint of this project.
        OSError: the file cannot be read.
    """
    return _header(Path(path), read_content(Path(path), weights=False))


def read_checkpoint(path: str | Path) -> Checkpoint:
    """Read a checkpoint as data: no code in it runs, and its configuration holds resolved plain values.

    Raises:
        ValueError: there is no file, it is damaged, or it is not a checkpoint of this project.
        OSError: the file cannot be read.
    """
    content = read_content(Path(path))
    header = _header(Path(path), content)
    state = content.get("state_dict")
    if not isinstance(state, dict) or not all(isinstance(key, str) for key in state):
        raise ValueError(f"{path} holds no weights: copy it again from where it is whole")
    prefix = "model."
    state = {key[len(prefix) :]: value for key, value in state.items() if key.startswith(prefix)}
    return Checkpoint(**vars(header), state=state)


def require_unseen(path: Path, key: str, seeds: range) -> None:
    """Refuse to evaluate the weights in a checkpoint on episodes that selected them, in validations of its training.

    Args:
        path: the checkpoint.
        key: the dotted key that sets the first of the seeds, for the error.
        seeds: of the episodes that are to evaluate.

    Raises:
        ValueError: an episode is among those of the validations; or as of `read_header`.
    """
    validated = read_header(path).config.get("validate", {})
    first, count = (validated.get(name) for name in ("seed", "episodes"))
    if not isinstance(first, int) or not isinstance(count, int):  # unknown
        return
    if shared := range(max(first, seeds.start), min(first + count, seeds.stop)):
        raise ValueError(
            f"{key}={seeds.start}: episodes {shared.start} to {shared.stop - 1} selected the weights in {path} when it "
            f"was trained, and cannot evaluate them: set {key}={first + count} or another"
        )


def _header(path: Path, content: dict[str, Any]) -> Header:
    config, spec, steps = (content.get(name) for name in ("config", "spec", "global_step"))
    if config is None or spec is None:
        raise ValueError(f"{path} is no checkpoint of this project: it carries no configuration and spec")
    config, spec = resolved(config, f"the configuration in {path}"), resolved(spec, f"{path}: spec")
    nodes = config if isinstance(config, dict) else {}
    present = [nodes[name] for name in (*REQUIRED_NODES, *OPTIONAL_NODES) if name in nodes]
    if not nodes.keys() >= {*REQUIRED_NODES} or not all(isinstance(node, dict) for node in present):
        raise ValueError(
            f"{path} is no checkpoint of this project: its configuration lacks {', '.join(REQUIRED_NODES)}"
        )
    finished = content.get("finished") is True
    states = [part for part in content.values() if isinstance(part, dict)]  # that of the data module among them
    windows = next((part["windows"] for part in states if isinstance(part.get("windows"), str)), "")
    return Header(
        path,
        config,
        Spec.from_dict(spec, f"{path}: spec"),
        finished,
        steps if isinstance(steps, int) else 0,
        windows,
    )


def read_content(path: Path, weights: bool = True) -> dict[Any, Any]:
    """Read a checkpoint as plain values and tensors; without `weights` the tensors have no numbers.

    Raises:
        ValueError: there is no file, or it is damaged or something else.
        OSError: the file cannot be read.
    """
    if path.is_dir():
        files = [str(file) for pattern in ("*.ckpt", "checkpoints/*.ckpt") for file in sorted(path.glob(pattern))]
        raise ValueError(f"{path} is a folder, a checkpoint is a file; it has {' and '.join(files) or 'none'}")
    if not path.is_file():
        raise ValueError(f"there is no checkpoint {path}: those of a run lie in outputs/runs/…/checkpoints")
    try:
        with path.open("rb") as file:
            content = read_archive(file, path.stat().st_size, weights)
    except OSError:
        raise
    except Exception as error:  # a damaged pickle can raise nearly anything
        raise ValueError(f"{path} cannot be read as a checkpoint, it is damaged or something else") from error
    return content if isinstance(content, dict) else {}


class TensorBudget(TorchFunctionMode):
    """Context that limits the total size of created tensors to what the weights in a checkpoint could fill.

    A config that requires more is refused at the first tensor above the limit, before it is allocated.
    """

    FACTORIES: tuple[Any, ...] = (
        *(torch.empty, torch.zeros, torch.ones, torch.full, torch.rand, torch.randn, torch.randint, torch.randperm),
        *(torch.arange, torch.linspace, torch.eye),
    )

    def __init__(self, checkpoint: Path) -> None:
        super().__init__()
        self._path, self._remaining = checkpoint, 2 * checkpoint.stat().st_size + 2**26

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Call `func` after subtracting the size of its result from the budget.

        Raises:
            ValueError: the budget is exceeded.
        """
        kwargs = kwargs or {}
        if func in self.FACTORIES:
            described = {name: value for name, value in kwargs.items() if name not in ("generator", "out")}
            try:
                self._remaining -= func(*args, **(described | {"device": "meta", "pin_memory": False})).nbytes
            except RuntimeError as error:  # a size beyond any address
                raise self._error() from error
            if self._remaining < 0:
                raise self._error()
        return func(*args, **kwargs)

    def _error(self) -> ValueError:
        return ValueError(f"{self._path} describes a model that is larger than the file, which does not hold it")
