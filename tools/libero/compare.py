"""Compare `task=libero` with what reference.py wrote: `python compare.py OUT`, in the environment of `vla`.

Prints, per task, the largest difference of the arm's joints and of all positions after the same commands, and how many
judgements of the goal's predicates agree.
"""

from __future__ import annotations

import sys
from pathlib import Path

import mujoco
import numpy as np

from vla.tasks.libero.controller import Controller
from vla.tasks.libero.goal import Goal
from vla.tasks.libero.package import tasks_of
from vla.tasks.libero.scene import Detail, load_scene
from vla.tasks.libero.starts import Starts, set_start

DETAIL = Detail(6000, 2500, 3000, 256)  # of the pictures, which is to leave physics as it is


def main() -> None:
    """Compare every task of a folder."""
    worst, agreements, total = 0.0, 0, 0
    for file in sorted(Path(sys.argv[1]).glob("*.npz")):
        suite, _, number = file.stem.removeprefix("libero_").rpartition("_")  # of 10_swap: long_swap
        task, reference = tasks_of(suite.replace("10", "long"))[int(number)], np.load(file)
        model = load_scene(task.scene, ["nothing"], DETAIL)
        data, controller, goal = mujoco.MjData(model), Controller(model), Goal(model, task.goal)
        set_start(model, data, Starts(model, task).official(0))
        controller.reset()
        joints = []
        for command in reference["commands"]:
            controller.step(data, command)
            joints.append(data.qpos.copy())
        difference = np.abs(np.array(joints) - reference["joints"])
        verdicts = []
        for positions in reference["positions"]:
            data.qpos[:], data.qvel[:] = positions, 0
            mujoco.mj_forward(model, data)
            verdicts.append([goal.holds(data, *part) for part in task.goal])
        matches = np.array(verdicts) == reference["holds"]
        worst, agreements, total = max(worst, difference[:, :7].max()), agreements + matches.sum(), total + matches.size
        print(
            f"{task.name:10} arm {difference[:, :7].max():.1e} rad, all {difference.max():.1e}; "
            f"{matches.sum()} of {matches.size} judgements, {reference['holds'].mean(axis=0).round(2)} hold"
        )
    print(f"arm within {worst:.1e} rad; {agreements} of {total} judgements agree")


if __name__ == "__main__":
    main()
