"""What robosuite and LIBERO themselves do, to compare with: `python reference.py OUT [SUITE …]`.

Runs in the environment of compose.py. Writes per task of a suite OUT/SUITE_NUMBER.npz: random commands from the first
official state with the joints that follow, and disturbed states with the truth of the goal's predicates in them.
"""

from __future__ import annotations

import contextlib
import io
import sys
from pathlib import Path
from typing import Any

import numpy as np
from libero.libero import benchmark, get_libero_path
from libero.libero.envs.env_wrapper import ControlEnv

FIXTURE_SEED = 1  # as in compose.py
SETTLE, COMMANDS, STATES = 10, 100, 100


def commands(random: np.random.Generator) -> np.ndarray:
    """Return commands (SETTLE + COMMANDS, 7): waiting, then random ones, half of them held for ten steps."""
    free = random.uniform(-1, 1, (COMMANDS // 2, 7))
    held = np.repeat(random.uniform(-1, 1, (COMMANDS // 20, 7)), 10, axis=0)
    held[::20, 3:6] = 0  # a rotation of zero keeps the goal before
    return np.concatenate([np.tile([0.0] * 6 + [-1.0], (SETTLE, 1)), free, held])


def disturbed(env: Any, random: np.random.Generator) -> np.ndarray:
    """Return the positions (nq,) of a state in which things are near where the goal wants them, or not."""
    sim = env.sim
    qpos = sim.data.qpos.copy()
    for part in env.parsed_problem["goal_state"]:
        if part[0] in ("on", "in"):
            target = env.object_states_dict[part[2]].get_geom_state()["pos"]
            joint = sim.model.get_joint_qpos_addr(env.objects_dict[part[1]].joints[-1])[0]
            qpos[joint : joint + 3] = target + random.normal(0, (0.03, 0.03, 0.05))
    model = sim.model._model
    for joint in range(9, model.njnt):
        if model.jnt_type[joint] in (2, 3):
            qpos[model.jnt_qposadr[joint]] = random.uniform(*model.jnt_range[joint])
    return qpos


def measured(task: Any, seed: int) -> dict[str, Any]:
    """Play and judge one task."""
    file = Path(get_libero_path("bddl_files")) / task.problem_folder / task.bddl_file
    world = ControlEnv(str(file), has_offscreen_renderer=False, use_camera_obs=False, ignore_done=True, horizon=100000)
    np.random.seed(FIXTURE_SEED)
    world.reset()
    states = np.load(Path(get_libero_path("init_states")) / task.problem_folder / f"{task.init_states_file}.npz")
    world.set_init_state(states["states"][0])
    random, env = np.random.default_rng(seed), world.env
    actions, joints = commands(random), []
    for command in actions:
        world.step(command)
        joints.append(env.sim.data.qpos.copy())
    positions, verdicts = [], []
    start = joints[SETTLE]
    for _ in range(STATES):
        env.sim.data.qpos[:], env.sim.data.qvel[:] = start, 0
        env.sim.forward()
        positions.append(disturbed(env, random))
        env.sim.data.qpos[:] = positions[-1]
        env.sim.forward()
        verdicts.append([env._eval_predicate(part) for part in env.parsed_problem["goal_state"]])
    world.close()
    return {
        "commands": actions,
        "joints": np.array(joints),
        "positions": np.array(positions),
        "holds": np.array(verdicts, bool),
    }


def main() -> None:
    """Measure all tasks of the suites."""
    folder = Path(sys.argv[1])
    suites = sys.argv[2:] or [f"libero_{name}" for name in ("spatial", "object", "goal", "10")]
    folder.mkdir(parents=True, exist_ok=True)
    for name in suites:
        with contextlib.redirect_stdout(io.StringIO()):
            suite = benchmark.get_benchmark_dict()[name]()
        for number in range(suite.get_num_tasks()):
            results = measured(suite.get_task(number), number)
            np.savez_compressed(folder / f"{name}_{number}.npz", allow_pickle=False, **results)
            print(name, number, flush=True)


if __name__ == "__main__":
    main()
