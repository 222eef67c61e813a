"""Folders of weights that others published, on this machine or on the hub."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from vla.io.documents import lines_of, read_json
from vla.io.errors import UserError
from vla.io.files import require_file
from vla.models.hub import HUB, fetch

CONFIG, WEIGHTS = "config.json", "model*.safetensors"
FILES = (CONFIG, "policy_*", WEIGHTS)
ADVICE = "give the folder of a download, or leave it out for random weights"
FOREIGN_KEYS = ("model_type", "input_features")  # in the config of transformers, and of a policy of LeRobot


def is_trunk(name: str) -> bool:
    """Return whether `name` is a folder of weights that others published, or the name of one on the hub.

    Raises:
        UserError: the hub cannot be reached, there is no such folder, or its config is of an unknown kind.
    """
    if name.startswith(HUB) and "@" not in name:
        return True  # a policy of this project is named with its revision
    folder = fetch(name, CONFIG, advice=ADVICE) if name.startswith(HUB) else Path(name)
    if not folder.exists():
        raise UserError(
            f"there is no policy and no download '{name}': name a run, as in outputs/runs/…, its policy, a folder with "
            f"{CONFIG} and model.safetensors, or {HUB}…"
        )
    if not (folder / CONFIG).is_file():
        return False
    config = read_json(folder / CONFIG, dict[str, Any])
    if config.keys().isdisjoint((*FOREIGN_KEYS, "model")):
        raise UserError(f"{folder / CONFIG} has neither {' nor '.join(FOREIGN_KEYS)}: download the model again")
    return not config.keys().isdisjoint(FOREIGN_KEYS)


def trunk_folder(name: str) -> Path:
    """Return the folder of pretrained weights, downloading what is not cached; a UserError if there is none."""
    if not name.startswith(HUB):
        if not (Path(name) / CONFIG).is_file():
            raise UserError(
                f"model.trunk={name} is no folder with pretrained weights, it has no {CONFIG}: set it, for a trained "
                f"policy in its {CONFIG}, to a folder that has one, or to {HUB}OWNER/NAME"
            )
        return Path(name)
    return fetch(name, *FILES, advice=ADVICE)


@contextmanager
def open_safetensors(path: Path) -> Iterator[Any]:
    """Open a safetensors file, whose header is checked; a UserError if it is damaged, or no file."""
    from safetensors import safe_open

    require_file(path)
    try:
        with safe_open(path, "pt") as file:
            yield file
    except Exception as error:  # safetensors has errors of its own
        raise UserError(f"{path} is damaged: {lines_of(error)[0][:200]}") from error
