"""A trained policy as a folder of plain data: JSON, safetensors, and a card that a person reads.

config.json has the resolved config nodes of the training, spec.json its spaces, model.safetensors the EMA weights
except those of trunks, under the names of the modules, and training.json how they were made. None of it is code.
"""

from __future__ import annotations

import copy
import hashlib
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import torch
from torch.overrides import TorchFunctionMode

from vla.io.documents import SHA256, STRICT, lines_of, mappings, parse_json, parse_plain, read_resolved
from vla.io.errors import UserError
from vla.io.types import Natural, Seed
from vla.models.hub import HUB, fetch
from vla.models.model import Model
from vla.models.trunk import Source, require_trunks, whole_state
from vla.models.trunk_folder import open_safetensors
from vla.parallel.limits import free_memory
from vla.spec import Spec

POLICY, BEST = "policy", "policy_best"  # in the folder of a run: its policy, and the best one in validation
CONFIG, SPEC, WEIGHTS, TRAINING, CARD = "config.json", "spec.json", "model.safetensors", "training.json", "README.md"
MODULE_STATE = "state"  # key in the metadata of the weights: state of modules that is no tensor, as JSON
REQUIRED_NODES = ("task", "tokenizer", "model")  # of the config
OPTIONAL_NODES = ("policy", "chosen", "expert", "collect", "data", "learner", "trainer", "validate")
TRUTH_MODULES = ("truth_head", "truth_scale")  # modules of a model used in training only
REPOSITORY = re.compile(HUB + r"[\w.-]+/[\w.-]+@[\w./-]+")
FACTORIES: tuple[Any, ...] = (
    *(torch.empty, torch.zeros, torch.ones, torch.full, torch.rand, torch.randn, torch.randint, torch.randperm),
    *(torch.arange, torch.linspace, torch.eye),
)


@dataclass(frozen=True)
class Training:
    """training.json: how the weights were made."""

    __pydantic_config__ = STRICT

    steps: Natural  # of the optimiser
    windows: str  # digest of the demonstrations, empty if unknown
    seed: int | None
    validation: tuple[Seed, Natural] | None  # first seed and number of the episodes that selected the weights
    weights: SHA256  # of their file
    versions: dict[str, str]  # library → version
    figures: dict[str, float]  # of the last validation
    trunks: dict[str, Source] = field(default_factory=dict)  # part → origin of its weights, which the file lacks


@dataclass(frozen=True)
class SavedPolicy:
    """A policy in a folder; its weights are read at the first access."""

    folder: Path
    config: dict[str, Any]  # of the training
    spec: Spec
    training: Training

    @cached_property
    def state(self) -> dict[str, Any]:
        """Name → weights of the model, on the CPU, and the further state of its modules.

        Raises:
            UserError: the file is damaged, or not the one that `TRAINING` describes.
        """
        path = _file(self.folder, WEIGHTS)
        with path.open("rb") as file:
            if hashlib.file_digest(file, "sha256").hexdigest() != self.training.weights:
                raise UserError(f"{path} is damaged, or not the file that {TRAINING} describes: copy the folder again")
        with open_safetensors(path) as weights:
            names: list[str] = weights.keys()  # it is no mapping
            further_state = parse_json((weights.metadata() or {}).get(MODULE_STATE, "{}"), dict[str, Any], str(path))
            return further_state | {name: weights.get_tensor(name) for name in names}

    def initialize(self, model: Model) -> None:
        """Load the weights for fine-tuning, see `restore`; if the truth differs, the truth head of `model` is kept."""
        state = self.state
        if self.spec.truth != model.spec.truth:
            state = {name: value for name, value in state.items() if name.partition(".")[0] not in TRUTH_MODULES}
            for part, module in model.named_children():
                if part in TRUTH_MODULES:
                    state |= {f"{part}.{name}": value for name, value in module.state_dict().items()}
        self.restore(model, state)

    def restore(self, model: torch.nn.Module, state: dict[str, Any] | None = None) -> None:
        """Load the weights, or another `state`, into `model`.

        Raises:
            UserError: they belong to another model, or one of its trunks is not available.
        """
        state = self.state if state is None else state
        saved_names = {*state}  # without the weights of trunks, which are stored elsewhere
        require_trunks(model, self.training.trunks, self.folder)
        try:
            state = whole_state(model, state, self.training.trunks)
            with self.budget():
                model.load_state_dict(state)
            for name, value in (*model.named_parameters(), *model.named_buffers()):
                if name in state and state[name].dtype != value.dtype:
                    raise UserError(f"{name} has numbers of {state[name].dtype}, not {value.dtype}")
                if name in saved_names and value.is_floating_point() and not value.isfinite().all():
                    raise UserError(f"{name} has numbers that are not finite")
        except Exception as error:  # modules may raise anything for a state that does not fit
            reason = lines_of(error)[-1].strip()[:200]
            raise UserError(f"{self.folder} does not fit the model of its own configuration: {reason}") from error

    def budget(self) -> TensorBudget:
        """Return a context that limits a model built in it to what the weights file and the named trunks can fill.

        Raises:
            UserError: the trunks are larger than the memory.
        """
        size = sum(source.size for source in {*self.training.trunks.values()})
        if size > (free_size := free_memory()):
            raise UserError(
                f"{self.folder} needs weights of {size / 1e9:.1f} GB, and {free_size / 1e9:.1f} GB of memory are free"
            )
        return TensorBudget(self.folder, _file(self.folder, WEIGHTS).stat().st_size + size)


def policy_folder(name: str | Path) -> Path:
    """Return the folder of a policy.

    Args:
        name: the folder of a policy, the folder of a run that has one, or hub:owner/name@revision.

    Raises:
        UserError: there is none.
    """
    if str(name).startswith(HUB):
        return _fetch_policy(str(name))
    path = Path(name)
    for folder in (path, path / POLICY):
        if (folder / SPEC).is_file():
            return folder
    if path.suffix == ".ckpt":
        run = path.parent.parent
        raise UserError(f"{path} serves only to resume its own training: name the folder of the run, {run}")
    if path.is_dir():
        hint = f"; the best so far is {path / BEST}" if (path / BEST).exists() else ""
        raise UserError(f"{path} is neither a policy nor a run with one, there is no {path / POLICY / SPEC}{hint}")
    raise UserError(f"there is no policy '{path}': name a run, as in outputs/runs/…, its folder {POLICY}, or {HUB}…")


@cache
def _fetch_policy(name: str) -> Path:
    """Return the folder of a policy on the hub, downloading what is not cached; each name is looked up only once."""
    if REPOSITORY.fullmatch(name) is None:
        raise UserError(
            f"{name} does not name a policy on the hub: write {HUB}OWNER/NAME@REVISION, with a tag, branch or commit; "
            f"a policy of LeRobot is fine-tuned by job=train model=smolvla pretrained={name}"
        )
    return fetch(name, CONFIG, SPEC, WEIGHTS, TRAINING, CARD)


def read_policy(name: str | Path) -> SavedPolicy:
    """Read a policy, except for its weights, as data: no code in it runs, and it holds plain, resolved values.

    Args:
        name: see `policy_folder`.

    Raises:
        UserError: there is none, or a file is missing, damaged, or not of this project.
        OSError: a file cannot be read.
    """
    folder = policy_folder(name)
    config, spec, training = (read_resolved(_file(folder, file)) for file in (CONFIG, SPEC, TRAINING))
    nodes = config if isinstance(config, dict) else {}
    present_nodes = [nodes[name] for name in (*REQUIRED_NODES, *OPTIONAL_NODES) if name in nodes]
    if not nodes.keys() >= {*REQUIRED_NODES} or not all(isinstance(node, dict) for node in present_nodes):
        raise UserError(f"{folder / CONFIG} is of no policy of this project: it needs {', '.join(REQUIRED_NODES)}")
    with open_safetensors(_file(folder, WEIGHTS)):
        pass  # safetensors checks that the sizes of weights in the header match that of the file
    record = parse_plain(training, Training, str(folder / TRAINING))
    return SavedPolicy(folder, nodes, Spec.from_dict(spec, str(folder / SPEC)), record)


def _file(folder: Path, name: str) -> Path:
    """Return a file of a folder.

    Raises:
        UserError: there is none, or it is a link out of the folder; in the hub's cache, links may lead to its blobs.
    """
    path, root = folder / name, folder.resolve()
    blobs = root.parents[1] / "blobs" if root.parent.name == "snapshots" else root
    if not any(path.resolve().is_relative_to(place) for place in (root, blobs)):
        raise UserError(f"{path} is a link that leaves the folder: copy the policy from where it is whole")
    if not path.is_file():
        raise UserError(f"{folder} has no {name}: copy the policy from where it is whole")
    return path


def require_unseen(name: str | Path, key: str, seeds: range) -> None:
    """Raise a UserError if `seeds`, set by the dotted `key`, include episodes that selected the weights of a policy."""
    first_seed, count = read_policy(name).training.validation or (0, 0)
    if clash := range(max(first_seed, seeds.start), min(first_seed + count, seeds.stop)):
        raise UserError(
            f"{key}={seeds.start}: episodes {clash.start} to {clash.stop - 1} selected the weights in {name} when it "
            f"was trained, and cannot evaluate them: set {key}={first_seed + count} or another"
        )


class TensorBudget(TorchFunctionMode):
    """Context that limits the total size of created tensors to about twice `size` [bytes], the weights in a `folder`.

    A config that requires more is refused at the first tensor above the limit, before it is allocated. Building the
    model on the device "meta" would show its size, too, but importing PyTorch's compiler for that takes seconds.
    """

    def __init__(self, folder: Path, size: int) -> None:
        super().__init__()
        self._folder, self._remaining = folder, 2 * size + 2**26

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Call `func` after subtracting the size of its result from the budget; a UserError if it is exceeded."""
        kwargs = kwargs or {}
        on_meta = str(kwargs.get("device")) == "meta"  # takes no memory until a library such as transformers fills it
        if func in FACTORIES and not on_meta:
            options = {name: value for name, value in kwargs.items() if name not in ("generator", "out")}
            try:
                self._remaining -= func(*args, **(options | {"device": "meta", "pin_memory": False})).nbytes
            except RuntimeError:  # a size beyond any address
                self._remaining = -1
            if self._remaining < 0:
                raise UserError(f"{self._folder} describes a model that is larger than its weights")
        return func(*args, **kwargs)


def with_absolute_paths(model: Mapping[str, Any]) -> dict[str, Any]:
    """Return the node of a model with absolute paths of weights, files or folders, valid in any working directory."""
    model_copy = copy.deepcopy({**model})
    encoders = ((node, "pretrained", Path.is_file) for node in mappings(model_copy))
    parts = [(model_copy, "trunk", Path.is_dir), (model_copy.get("text"), "name", Path.is_dir), *encoders]
    for node, key, is_there in parts:
        if isinstance(node, dict) and isinstance(name := node.get(key), str) and is_there(Path(name)):
            node[key] = str(Path(name).absolute())  # links are not resolved: the suffix of their name tells the format
    return model_copy
