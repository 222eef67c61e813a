"""Trained policies and their worlds, for use in Python programs; everything else is `python -m vla.run`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vla.config.build import require_no_paths
from vla.config.experiment import make_environment, make_policy
from vla.config.nodes import with_changes
from vla.config.packages import trusting
from vla.envs.gym import GymEnvironment
from vla.models.policy_folder import policy_folder, read_policy

if TYPE_CHECKING:
    from vla.policy import Policy


def load_policy(
    checkpoint: Path | str, *, device: str = "auto", precision: str = "fp32", lanes: int = 1, trust: Sequence[str] = ()
) -> Policy:
    """Load a trained policy.

    Its folder contains no code, but names classes: those of other packages must be trusted, here or by `VLA_TRUST`.

    Args:
        checkpoint: the folder of a policy, or of a run that has one, or hub:owner/name@revision.
        device: such as "cpu" or "cuda"; "auto": a GPU if there is one.
        precision: "fp32" or "bf16".
        lanes: batch size of the model, for as many worlds side by side: `policy.act(observations, lanes)`.
        trust: names of further packages whose classes may be loaded.

    Raises:
        UserError: there is no such policy, it is damaged, or it names a class that is not trusted.
    """
    options = {"device": device, "precision": precision, "compile": False, "lanes": lanes}
    folder = policy_folder(checkpoint)
    with trusting(trust):
        return make_policy({"_target_": "vla.policy.Policy", **options}, folder)


def load_environment(
    checkpoint: Path | str,
    *,
    changes: dict[str, Any] | None = None,
    trust: Sequence[str] = (),
    render_mode: str | None = None,
) -> GymEnvironment:
    """Make the world in which a policy was trained, as an environment of gymnasium.

    Args:
        checkpoint: as in `load_policy`.
        changes: to the task, as in the conditions of an evaluation, such as {"time_limit": 20.0}.
        trust: as in `load_policy`.
        render_mode: "rgb_array", or None.

    Raises:
        UserError: as in `load_policy`, the policy's task names a path, or it consists of recordings only.
    """
    saved_policy = read_policy(checkpoint)
    task = {"task": saved_policy.config["task"]}
    with trusting(trust):
        require_no_paths(task, ["task"], checkpoint)
        return GymEnvironment(make_environment(with_changes(task["task"], changes or {})), render_mode)
