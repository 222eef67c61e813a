"""Compare LeRobot's evaluation of a policy on Meta-World with that of this project, episode by episode.

    python tools/parity/metaworld_loops.py RUN 1000000 FOLDER...

The folders are the `--output_dir` of `lerobot-eval --env.type=metaworld --seed=1000000`, which plays episode i of every
task with the seed 1000000 + i, or the OUTPUT of `metaworld_client.py`; a further folder of the same tasks goes on with
the next seed. Here the policy plays the same in the world that it was trained in.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from vla.api import load_environment, load_policy
from vla.models.policy_folder import read_policy
from vla.policy import Policy
from vla.rollouts.comparison import Pairs, compare_pairs
from vla.rollouts.rollout import rollout
from vla.rollouts.statistics import wilson_interval


def theirs(folder: Path) -> Iterator[tuple[str, list[bool]]]:
    """Yield the tasks of an evaluation by LeRobot, with the success of each episode."""
    for group in json.loads((folder / "eval_info.json").read_text(encoding="utf-8"))["per_task"]:
        if not group["task_group"].endswith("-v3"):
            raise SystemExit(f"{folder} has the group {group['task_group']}: evaluate tasks by name, such as reach-v3")
        yield group["task_group"].removesuffix("-v3"), group["metrics"]["successes"]


def ours(run: str, policy: Policy, task: str, seeds: range) -> list[bool]:
    """Return the success of each episode here."""
    world = load_environment(run, changes={"tasks": [task]})
    successes = [rollout(world.environment, policy, seed).success for seed in seeds]
    world.close()
    return successes


def main(run: str, first: str, *folders: str) -> None:
    """Print the successes in both, by task, and compare them in pairs."""
    tiers: dict[str, Any] = read_policy(run).config["task"]["tiers"]
    outcomes: dict[str, tuple[list[bool], list[bool]]] = {}
    policy = load_policy(run, device="cpu")
    for folder in folders:
        for task, lerobot in theirs(Path(folder)):
            previous = outcomes.setdefault(task, ([], []))
            seed = int(first) + len(previous[0])
            local = ours(run, policy, task, range(seed, seed + len(lerobot)))
            outcomes[task] = previous[0] + local, previous[1] + lerobot
            print(f"{task:28} here {sum(local)}, in LeRobot {sum(lerobot)} of {len(lerobot)}", flush=True)
    for number, place in enumerate(("here", "in LeRobot")):
        wins = [success for pair in outcomes.values() for success in pair[number]]
        low, high = wilson_interval(sum(wins), len(wins))
        means = [
            np.mean([np.mean(outcomes[task][number]) for task in tasks if task in outcomes])
            for tasks in tiers.values()
            if {*tasks} & {*outcomes}
        ]
        print(
            f"{place}: {sum(wins)} of {len(wins)}, {100 * low:.1f}-{100 * high:.1f} %, tiers {100 * np.mean(means):.1f}"
        )
    episodes = [pair for local, lerobot in outcomes.values() for pair in zip(local, lerobot, strict=True)]
    both_won, losses, wins = (
        sum(pair == kind for pair in episodes) for kind in ((True, True), (True, False), (False, True))
    )
    result = compare_pairs(Pairs(both_won, losses, wins, len(episodes) - both_won - losses - wins))
    print(
        f"in LeRobot minus here: {100 * result.difference:.1f} points ({100 * result.ci_low:.1f} to "
        f"{100 * result.ci_high:.1f}), {wins} won, {losses} lost, p = {result.p:.3f}"
    )


if __name__ == "__main__":
    if len(sys.argv) < 4:
        sys.exit(__doc__)
    main(*sys.argv[1:])
