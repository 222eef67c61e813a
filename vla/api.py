"""Policies and their worlds for programs of one's own; everything else is `python -m vla.run`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vla.config.build import require_no_paths
from vla.config.check import with_changes
from vla.config.experiment import make_environment, make_policy
from vla.config.packages import trusting
from vla.envs.gym import GymEnvironment
from vla.models.checkpoint import read_header

if TYPE_CHECKING:
    from vla.policy import Policy


def load_policy(
    checkpoint: Path | str, *, device: str = "auto", precision: str = "fp32", lanes: int = 1, trust: Sequence[str] = ()
) -> Policy:
    """Load the policy in a checkpoint.

    A checkpoint contains no code, but names classes: of other packages only those are built that are trusted, here or
    by `VLA_TRUST`. What was trusted in a training of this user is trusted for its checkpoints.

    Args:
        checkpoint: the file.
        device: such as "cpu" or "cuda"; "auto": a GPU if there is one.
        precision: "fp32" or "bf16".
        lanes: rows of every pass through the model, for as many worlds side by side: `policy.act(observations, lanes)`.
        trust: names of further packages.

    Raises:
        ValueError: there is no such file, it is damaged, or it names a class that is not trusted.
    """
    options = {"device": device, "precision": precision, "compile": False, "lanes": lanes}
    with trusting(trust, Path(checkpoint)):
        return make_policy({"_target_": "vla.policy.Policy", **options}, Path(checkpoint))


def load_environment(
    checkpoint: Path | str,
    *,
    changes: dict[str, Any] | None = None,
    trust: Sequence[str] = (),
    render_mode: str | None = None,
) -> GymEnvironment:
    """Make the world in which the policy of a checkpoint was trained, as an environment of gymnasium.

    Args:
        checkpoint: the file.
        changes: to the task, as in the conditions of an evaluation, such as {"time_limit": 20.0}.
        trust: as of `load_policy`.
        render_mode: "rgb_array", or None.

    Raises:
        ValueError: as `load_policy`, the file names a path, or there are recordings only, in which nothing can act.
    """
    task = {"task": read_header(checkpoint).config["task"]}
    with trusting(trust, Path(checkpoint)):
        require_no_paths(task, ["task"], checkpoint)
        return GymEnvironment(make_environment(with_changes(task["task"], changes or {})), render_mode)
