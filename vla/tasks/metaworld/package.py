"""The package `metaworld`, made to work with a current MuJoCo, and the names of its tasks.

Task names are those of the package without their version: "push-back" is `push-back-v3`.
"""

from __future__ import annotations

import warnings
from typing import Any

import mujoco
from metaworld import env_dict
from metaworld.sawyer_xyz_env import SawyerMocapBase

VERSION = "-v3"
# Data of a weld: anchor (3), relative position (3) and quaternion (4), torque scale. In a current MuJoCo the row has a
# twelfth number, so that upstream's row of eleven does not fit.
WELD = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, 5.0)


def _reset_welds(simulator: Any) -> None:
    model = simulator.model
    model.eq_data[model.eq_type == mujoco.mjtEq.mjEQ_WELD, : len(WELD)] = WELD


SawyerMocapBase.reset_mocap_welds = _reset_welds
warnings.filterwarnings("ignore", r"Constant\(s\) may be too high", module=r"metaworld\.policies")  # clipped here


def tasks_of(benchmark: str) -> tuple[str, ...]:
    """Return the names of the tasks of a benchmark, "mt1", "mt10", "mt25" or "mt50", in the package's order.

    MT1 is any single task; here it is the one in Meta-World's own example.
    """
    if benchmark == "mt1":
        return ("reach",)
    return tuple(name.removesuffix(VERSION) for name in getattr(env_dict, f"{benchmark.upper()}_V3"))


def simulator(task: str) -> Any:
    """Make the simulator of a task; its resets draw object and goal with the random generator that `seed` seeds."""
    environment = env_dict.ALL_V3_ENVIRONMENTS[task + VERSION]()
    # Like `set_task` of the benchmark MT1, but without freezing the positions of object and goal.
    environment._partially_observable = False  # the goal is part of the observation, which only the expert sees
    environment.__dict__.pop("sawyer_observation_space", None)  # cached, and depends on it
    environment._set_task_called = True
    environment._freeze_rand_vec, environment.seeded_rand_vec = False, True
    # Published results are from MuJoCo 3.3.0, where multiple contacts per pair of meshes were off by default.
    environment.model.opt.disableflags |= getattr(mujoco.mjtDisableBit, "mjDSBL_MULTICCD", 0)
    return environment


def stop_sliding(simulator: Any) -> None:
    """Stop the thermos of the tasks with a stick, after a reset.

    Upstream means to, but clears the velocities at the indices of its position. With MuJoCo 3.3.0 the thermos stands
    still all the same; with a current one it slides to its goal at 0.58 m/s, so that no stick is needed to push it.
    """
    model, data = simulator.model, simulator.data
    for name in ("obj_slidex", "obj_slidey"):
        if (joint := mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, name)) >= 0:
            data.qvel[model.jnt_dofadr[joint]] = 0.0
