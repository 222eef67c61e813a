"""Compare the pictures of `task=libero` with MuJoCo's own: `python pictures.py [SHEET.webp [TASK …]] [task.OPTION=…]`.

MuJoCo's are of robosuite's scene with all faces, texels and reflections: what LIBERO hands out. Prints the mean
difference in grey levels of both cameras in the first official state of every task, after it has settled; SHEET shows
the pictures of some tasks, MuJoCo's on the left, ours on the right.
"""

from __future__ import annotations

import os
import sys
from contextlib import closing

os.environ.setdefault("MUJOCO_GL", "egl")  # before MuJoCo is imported

import mujoco
import numpy as np
from PIL import Image

from vla.config.compose import compose
from vla.config.experiment import Experiment
from vla.spec import FIRST_SEED, Array
from vla.tasks.libero.environment import Libero
from vla.tasks.libero.package import scene_xml, tasks_of
from vla.tasks.libero.scene import VISIBLE


class Original:
    """The scenes as MuJoCo draws them; each is compiled when first needed, and only the newest is kept."""

    def __init__(self) -> None:
        self._name = ""

    def pictures(self, name: str, environment: Libero) -> list[Array]:
        """Draw what the cameras of `environment` see now in the scene `name`, (H, W, 3) uint8 each."""
        if name != self._name:
            self._name, self._model = name, mujoco.MjSpec.from_string(scene_xml(name)).compile()
        model, light, data = self._model, environment._scene.model, mujoco.MjData(self._model)
        model.body_pos[:], model.body_quat[:] = light.body_pos, light.body_quat
        model.site_rgba[:, 3] = light.site_rgba[:, 3]
        data.qpos[:] = environment._scene.data.qpos
        mujoco.mj_forward(model, data)
        option = mujoco.MjvOption()
        option.geomgroup[:] = [group == VISIBLE for group in range(mujoco.mjNGROUP)]
        option.sitegroup[:] = 1
        with closing(mujoco.Renderer(model, *environment.spec.image_size)) as renderer:
            pictures = []
            for camera in environment.spec.cameras:
                renderer.update_scene(data, camera, option)
                pictures.append(renderer.render()[:, ::-1])  # mirrored, as published
        return pictures


def main() -> None:
    """Compare all tasks, or those of the sheet that are named."""
    options = [argument for argument in sys.argv[1:] if "=" in argument]
    sheet, *names = [argument for argument in sys.argv[1:] if argument not in options] or [None]
    original, rows, differences = Original(), [], []
    with closing(
        Experiment.from_config(compose("task=libero", "output=none", *options)).make_environment()()
    ) as environment:
        assert isinstance(environment, Libero)
        if unknown := {*names} - {*environment.tasks}:
            raise SystemExit(f"there are no tasks {', '.join(map(str, unknown))}; there is {environment.tasks[0]}")
        for number, name in enumerate(environment.tasks):
            suite, _, place = name.rpartition("_")
            observation = environment.reset(FIRST_SEED + (number - FIRST_SEED) % len(environment.tasks))
            originals = original.pictures(tasks_of(suite)[int(place)].scene, environment)
            pictures = [observation.rgb[camera] for camera in environment.spec.cameras]
            pairs = list(zip(originals, pictures, strict=True))
            differences.append([np.abs(picture.astype(int) - reference).mean() for picture, reference in pairs])
            print(f"{name:10}", " ".join(f"{difference:5.2f}" for difference in differences[-1]), flush=True)
            if name in (names or environment.tasks):
                rows.append(np.concatenate([*originals, *pictures], axis=1))
    print(f"mean {np.mean(differences):.2f}, worst task {np.max(np.mean(differences, axis=1)):.2f}")
    if sheet:
        Image.fromarray(np.concatenate(rows)).save(sheet, quality=90)


if __name__ == "__main__":
    main()
