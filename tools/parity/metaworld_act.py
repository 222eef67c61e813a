"""Evaluate a policy that LeRobot trained on an export of `experiment=metaworld` in LeRobot's own loop.

    python tools/parity/metaworld_act.py RUN FOLDER 1000000 2 OUTPUT [TASK,...]

In an environment with `lerobot[metaworld]`, `plugins/lerobot_policy_vla` and MuJoCo 3.3.0. RUN, of this project, says
where the images of the export lie in LeRobot's picture; FOLDER is what `lerobot-train` wrote; episode i of every task
has the seed 1000000 + i. OUTPUT gets the `eval_info.json` that `metaworld_loops.py` reads.
"""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.envs.configs import MetaworldEnv
from lerobot.envs.factory import make_env
from lerobot.policies import get_policy_class, make_pre_post_processors
from lerobot.scripts.lerobot_eval import eval_policy_all
from lerobot.utils.constants import ACTION

from vla.envs.lerobot import TASK, arrays, observations
from vla.models.policy_folder import read_policy

UNITS = np.array([100, 100, 100, -1], np.float32)  # LeRobot's actions are in cm, and 1 closes


def main(run: str, folder: str, seed: str, episodes: str, output: str, tasks: str = "") -> None:
    """Play the episodes of all tasks, or of the named ones, without videos, and write their successes."""
    torch.set_num_threads(1)
    saved_policy = read_policy(run)
    spec = saved_policy.spec
    task_names = (f"{name}-v3" for names in saved_policy.config["task"]["tiers"].values() for name in names)
    config = PreTrainedConfig.from_pretrained(folder, local_files_only=True)
    config.device, config.pretrained_path = "cpu", Path(folder)
    policy = get_policy_class(config.type).from_pretrained(folder, config=config).eval()
    preprocessor, postprocessor = make_pre_post_processors(config, folder)

    def see(batch: dict[str, Any]) -> dict[str, Any]:
        inputs = {key: value.numpy() if isinstance(value, torch.Tensor) else value for key, value in batch.items()}
        rows = [arrays(replace(step, rgb={**spec.images(step)}), spec) for step in observations(inputs, spec)]
        return {key: torch.from_numpy(np.stack([step[key] for step in rows])) for key in rows[0]} | {TASK: batch[TASK]}

    def act(batch: dict[str, Any]) -> dict[str, Any]:
        low, high = torch.tensor(spec.low), torch.tensor(spec.high)
        return {ACTION: batch[ACTION].clamp(low, high) * torch.from_numpy(UNITS)}

    info = eval_policy_all(
        envs=make_env(MetaworldEnv(task=tasks or ",".join(task_names))),
        policy=policy,
        env_preprocessor=see,
        env_postprocessor=act,
        preprocessor=preprocessor,
        postprocessor=postprocessor,
        n_episodes=int(episodes),
        start_seed=int(seed),
    )
    Path(output).mkdir(parents=True, exist_ok=True)
    (Path(output) / "eval_info.json").write_text(json.dumps(info, indent=2), encoding="utf-8")
    print(info["overall"])


if __name__ == "__main__":
    if not 6 <= len(sys.argv) <= 7:
        sys.exit(__doc__)
    main(*sys.argv[1:])
