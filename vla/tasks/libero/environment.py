"""LIBERO as a `vla.spec.Environment`, under the protocol of LeRobot and openpi."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Annotated, Literal

import mujoco
import numpy as np
from annotated_types import Ge, Le, MinLen, Predicate

from vla.io.errors import UserError
from vla.io.types import ImageSize, Names, Natural, unique
from vla.spec import FIRST_SEED, Array, Observation, Spec
from vla.tasks.libero.controller import REACH, Controller
from vla.tasks.libero.goal import Goal
from vla.tasks.libero.package import ALL, STATES, Task, folders, suites_of, tasks_of
from vla.tasks.libero.scene import BURNER, VISIBLE, Detail, load_scene
from vla.tasks.libero.starts import Randomize, Starts, set_start
from vla.tasks.rendering.renderer import LazyRenderer, RendererFactory, Views
from vla.tasks.world import MultitaskWorld, command_of

CONTROL_HZ = 20.0
STATE = ("x", "y", "z", "rotation_x", "rotation_y", "rotation_z", "finger_1", "finger_2")
ACTION = ("dx", "dy", "dz", "turn_x", "turn_y", "turn_z", "gripper")
# Steps of an episode by suite, without those in which it settles: LeRobot's and openpi's limits.
STEPS = {
    "lerobot": {"spatial": 280, "object": 280, "goal": 300, "long": 520},
    "openpi": {"spatial": 220, "object": 280, "goal": 300, "long": 520},
}
WAIT = np.array([0.0] * 6 + [-1.0])  # the command while things settle: stay, and open the gripper
END = 2 * FIRST_SEED  # of the seeds with official states; the seeds that select weights follow
TINTED = 0.5  # probability that a thing has another colour, in starts with other colours
TINT = 0.2, 1.0  # range of the factors of red, green and blue

Numbers = Annotated[list[Annotated[int, Ge(0), Le(9)]], MinLen(1), Predicate(unique)]


class Libero(MultitaskWorld):
    """Tasks of a Panda on a table, a floor or in a kitchen, one of them per episode: seeds cycle through them.

    An episode ends at the first step that LIBERO counts as a success, or when its steps are used up. The state is the
    position of the grip and the rotation vector of the hand in the world's frame, and the fingers' positions. An
    action is a displacement and a rotation vector of the hand, in the world's axes and relative to where it is, and the
    gripper's opening; the controller reaches about a quarter of a displacement within a step.
    """

    def __init__(
        self,
        suite: Names | str,
        tasks: Numbers | None,
        renderer: RendererFactory,
        image_size: ImageSize,
        cameras: Names,
        mirror: bool,
        detail: Detail,
        randomize: Randomize,
        steps: Literal["lerobot", "openpi"],
        settle: Natural,
        tiers: Mapping[str, Names],
    ) -> None:
        """Find the files; scenes are compiled when first played.

        Args:
            suite: a suite of LIBERO, "spatial", "object", "goal" or "long", or of LIBERO-PRO, such as "spatial_swap", a
                list of these, or "all", the four of LIBERO, or "all_swap".
            tasks: numbers of the tasks in each suite; None: all ten.
            renderer: renderer of the images.
            image_size: height and width of every camera's images [px].
            cameras: names of cameras, such as "agentview" and "robot0_eye_in_hand".
            mirror: whether images are mirrored left to right, like those that published policies were trained on.
            detail: of meshes and textures.
            randomize: what else differs between drawn starts.
            steps: whose limits on the steps of an episode apply, LeRobot's or openpi's.
            settle: steps before the first observation, in which things come to rest.
            tiers: suite → tasks, or patterns such as goal*_3, for reports.

        Raises a UserError if the wheels are missing, or there is no such suite.
        """
        super().__init__()
        folders()  # raise now, because an evaluation attributes an error in `reset` to that episode
        numbers = range(10) if tasks is None else tasks
        suites = dict.fromkeys(
            name for group in ([suite] if isinstance(suite, str) else suite) for name in suites_of(group)
        )
        self._tasks = [tasks_of(name)[number] for name in suites for number in numbers]
        self.tasks = tuple(task.name for task in self._tasks)
        self._limits, self._settle, self._mirror = STEPS[steps], settle, mirror
        self._randomize, self._renderer, self._detail = randomize, renderer, detail
        self.spec = Spec(
            cameras=tuple(cameras),
            image_size=(image_size[0], image_size[1]),
            state=STATE,
            state_units=("m",) * 3 + ("rad",) * 3 + ("m",) * 2,
            action=ACTION,
            units=("m",) * 3 + ("rad",) * 3 + ("1",),
            low=(*(-REACH).tolist(), -1.0),
            high=(*REACH.tolist(), 1.0),
            control_hz=CONTROL_HZ,
            truth=(("object", 3), ("goal", 3)),
        )

    def distinct(self, seeds: Iterable[int]) -> int:
        """Return the number of distinct episodes of seeds: each task has only `STATES` official states."""
        count = STATES * len(self._tasks)
        return len({FIRST_SEED + seed % count if FIRST_SEED <= seed < END else seed for seed in seeds})

    @property
    def tool(self) -> Array:
        """(3,) position of the grip in the world [m]."""
        return self._scene.data.site_xpos[self._scene.controller.site].copy()

    def reset(self, seed: int) -> Observation:
        """Start the episode of `seed`."""
        number = seed % len(self._tasks)
        task = self._task = self._tasks[number]
        self.task, self.done, self.outcome, self._steps_taken = task.name, False, "timeout", 0
        scene = self._scene = self._scene_of(task.scene, lambda: Scene(task, self._renderer, self.spec, self._detail))
        starts, self._goal = scene.starts_and_goal(task)
        state = (seed - FIRST_SEED) // len(self._tasks) % STATES if FIRST_SEED <= seed < END else None
        # One generator each, so that changing a share does not change the other draws.
        random, places, colours = (np.random.default_rng(key) for key in (seed, [seed, 4], [seed, 5]))
        exchanged = state is None and starts.can_exchange and places.random() < self._randomize.places
        coloured = state is None and colours.random() < self._randomize.colours
        start = starts.draw(random, exchanged) if state is None else starts.official(state)
        self.draws = {
            "start": {"official": -1 if state is None else state, "exchanged": exchanged, "coloured": coloured}
        }
        set_start(scene.model, scene.data, start)
        scene.colour(colours if coloured else None)
        scene.controller.reset()
        for _ in range(self._settle):
            scene.controller.step(scene.data, WAIT)
        return self._look()

    def step(self, action: Array) -> Observation:
        """Apply one (7,) action, clipped to the spec's bounds, for one control period."""
        self._require_running()
        action = np.clip(action, self.spec.low, self.spec.high)
        self._scene.controller.step(self._scene.data, command_of(action, REACH))
        self._steps_taken += 1
        if self._goal.is_reached(self._scene.data):
            self.outcome = "success"
        self.done = self.outcome == "success" or self._steps_taken == self._limits[self._task.suite.partition("_")[0]]
        return self._look()

    def _look(self) -> Observation:
        scene = self._scene
        pictures = () if self._blind else scene.pictures(self._mirror)
        subgoal = (*self._goal.unmet_predicates(scene.data), *self._goal.parts)[0]  # what is to be done next
        truth = {
            "object": scene.position(subgoal.thing),
            "goal": scene.position(subgoal.place or subgoal.thing),
            "reach": self.tool - scene.base,  # the surface that things stand on is at the height of the base
            "task": np.array([ALL.index(self._task.suite), self._task.number]),
            "positions": scene.data.qpos.copy(),
            "fixtures": scene.fixtures(self._task),
            "opening": np.array([scene.controller.opening]),
        }
        return Observation(
            rgb=dict(zip(self.spec.cameras, pictures, strict=False)),
            state=scene.state(),
            instruction=self._task.instruction,
            truth=truth,
        )


class Scene:
    """Physics of a scene, its controller, its renderer, and the starts and goals of its tasks."""

    def __init__(self, task: Task, renderer: RendererFactory, spec: Spec, detail: Detail) -> None:
        """Compile the scene of a task, for the cameras of the world's spec; a UserError if it lacks one of them."""
        self.model = model = load_scene(task.scene, _things(task), detail)
        self.data = mujoco.MjData(model)
        self._starts: dict[str, tuple[Starts, Goal]] = {}
        self.controller = Controller(model)
        camera_names = [model.camera(number).name for number in range(model.ncam)]
        if unknown_cameras := [name for name in spec.cameras if name not in camera_names]:
            raise UserError(f"task.cameras names {', '.join(unknown_cameras)}; LIBERO has {', '.join(camera_names)}")
        model.mat_reflectance[:] = 0  # no renderer draws reflections
        burners = [site for site in map(model.site, range(model.nsite)) if site.name.endswith(BURNER)]
        self._knobs = {  # burner → where the state has its knob
            site.id: model.joint(f"{site.name.removesuffix(BURNER)}_button").qposadr[0] for site in burners
        }
        model.site_rgba[:, 3] = 0  # sites only mark regions
        self._colours, self._materials = model.mat_rgba.copy(), _materials(model, task)
        cameras = [camera_names.index(name) for name in spec.cameras]
        views = Views(cameras, *spec.image_size, geom_groups=(VISIBLE,), site_groups=tuple(range(6)))
        self._renderer = LazyRenderer(renderer, model, views)
        self.base = model.body("robot0_base").pos.copy()  # of the arm (3,) [m]
        self._hand = model.body("robot0_right_hand").id
        address = model.joint("gripper0_finger_joint1").qposadr[0]
        self._fingers = slice(address, address + 2)

    def starts_and_goal(self, task: Task) -> tuple[Starts, Goal]:
        """Return starts and goal of one of the tasks in this scene."""
        if task.name not in self._starts:
            self._starts[task.name] = Starts(self.model, task), Goal(self.model, task.goal)
        return self._starts[task.name]

    def colour(self, random: np.random.Generator | None) -> None:
        """Tint about half of the things; None: give all their own colours."""
        self.model.mat_rgba[:] = self._colours
        if random is not None:
            for materials in self._materials:
                if random.random() < TINTED:
                    self.model.mat_rgba[materials, :3] *= random.uniform(*TINT, 3)
        self._renderer.changed = True

    def position(self, thing: str) -> Array:
        """Return the position (3,) of a thing or region in the world [m]."""
        body = mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_BODY, f"{thing}_main")
        return (self.data.xpos[body] if body >= 0 else self.data.site(thing).xpos).copy()

    def fixtures(self, task: Task) -> Array:
        """Return position [m] and quaternion wxyz of the bodies of all fixtures (F, 7), in the order of the task."""
        bodies = [self.model.body(fixture["body"]) for fixture in task.fixtures.values()]
        return np.array([[*body.pos, *body.quat] for body in bodies]).reshape(-1, 7)

    def state(self) -> Array:
        """Return the state (8,) float32."""
        quaternion = self.data.xquat[self._hand]
        sine = float(np.linalg.norm(quaternion[1:]))
        # The angle is 0…2 pi and not reduced, as in robosuite's quat2axisangle.
        angle = 2 * np.arccos(np.clip(quaternion[0], -1, 1))
        turn = quaternion[1:] / sine * angle if sine > 1e-9 else np.zeros(3)
        grip = self.data.site_xpos[self.controller.site]
        return np.concatenate([grip, turn, self.data.qpos[self._fingers]]).astype(np.float32)

    def pictures(self, mirror: bool) -> Array:
        """Draw every camera's picture (cameras, H, W, 3) uint8."""
        for burner, knob in self._knobs.items():
            glow = float(self.data.qpos[knob] >= 0.5)
            self._renderer.changed |= bool(self.model.site_rgba[burner, 3] != glow)
            self.model.site_rgba[burner, 3] = glow
        pictures = self._renderer.render(self.data)[0]
        return pictures[:, :, ::-1] if mirror else pictures

    def close(self) -> None:
        """Free the renderer."""
        self._renderer.close()


def _materials(model: mujoco.MjModel, task: Task) -> list[list[int]]:
    """Return the materials of each movable thing and fixture."""
    bodies = [f"{thing}_main" for thing in sorted(_things(task))] + [entry["body"] for entry in task.fixtures.values()]
    roots = model.body_rootid[model.geom_bodyid]
    groups = [set(model.geom_matid[roots == model.body_rootid[model.body(name).id]].tolist()) for name in bodies]
    return [sorted(materials - {-1}) for materials in groups]


def _things(task: Task) -> set[str]:
    """Return the names of the movable things in a scene."""
    return {part[1] for part in task.initial if part[0] in ("on", "in")} - task.fixtures.keys()
