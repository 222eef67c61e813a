"""The Franka tabletop as a `vla.spec.Environment`."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from statistics import NormalDist
from typing import Annotated, Literal

import mujoco
import numpy as np
from annotated_types import Le, MinLen, Predicate

from vla.io.errors import UserError
from vla.io.types import Count, ImageSize, Point, Positive, unique
from vla.spec import FIRST_SEED, Array, Observation, Shape, Spec
from vla.tasks.gl import require_backend
from vla.tasks.rendering.renderer import LazyRenderer, RendererFactory, Views
from vla.tasks.rendering.shapes import mesh_triangles
from vla.tasks.tabletop.compiled_scene import CompiledScene
from vla.tasks.tabletop.expert import Waypoint
from vla.tasks.tabletop.file_robot import FileRobot
from vla.tasks.tabletop.goals.goal import Goal
from vla.tasks.tabletop.goals.several import Chain, Mixed
from vla.tasks.tabletop.panda import Panda
from vla.tasks.tabletop.randomize.randomizer import Randomizer
from vla.tasks.tabletop.robot import VISIBLE
from vla.tasks.tabletop.robot_file import RobotFile
from vla.tasks.tabletop.scene import COLOURS
from vla.tasks.tabletop.simulation import CONTROL_HZ, Simulation
from vla.tasks.world import World

TRANSLATION = 0.04  # largest translation per step [m]
ROTATION = 0.25  # largest rotation per step [rad]
MILLIMETRES = 1000.0  # of a metre
SHAPES = ("mesh", "box", "cylinder", "sphere", "capsule")  # kinds of geoms that `shapes` returns
QUANTILES = np.array([NormalDist().inv_cdf((index + 0.5) / 256) for index in range(256)])  # of the normal distribution


class Tabletop(World):
    """`Simulation` as an `Environment` with camera observations, also `HasScene` and `TakesJointTargets`,
    with events, a tool and instructions.

    An episode of a chain below `FIRST_SEED` is one of its instructions, drawn from the seed: the scripted expert
    carries out those before it, unseen, and the episode begins where it stopped. A demonstration thus has one
    instruction, and starts where a policy would be when it is given that instruction.
    """

    viewpoint: tuple[Point, Point] = ((1.2, -0.7, 0.75), (0.38, 0.0, 0.2))

    def __init__(
        self,
        goal: Goal | Mixed | Chain,
        randomize: Mapping[str, Randomizer | None],
        renderer: RendererFactory,
        blocks: Count,
        image_size: ImageSize,
        cameras: Annotated[tuple[Literal["front", "wrist"], ...], MinLen(1), Predicate(unique)],
        time_limit: Annotated[Positive, Le(3600)],
        meshes: Literal["light", "full"],
        shadows: bool,
        robot: RobotFile | None = None,
    ) -> None:
        """Build and compile the scene.

        Args:
            goal: goal, mixture of goals, or chain of goals.
            randomize: axis name → randomizer, or None to disable the axis.
            renderer: renderer of the images.
            blocks: maximum number of blocks on the table; the axis `distractors` draws the number.
            image_size: height and width of every camera's images [px].
            time_limit: maximum time for an instruction, per block to be moved [s].
            meshes: robot meshes with few faces ("light") or all of them ("full", much slower on a CPU).
            shadows: whether the lamp casts shadows.
            robot: an arm from a file; None: the Panda.

        Raises a UserError for more blocks than colours, a robot that does not work, or a machine that cannot render.
        """
        super().__init__()
        require_backend()
        max_blocks = len(COLOURS) - goal.absent
        if not goal.blocks <= blocks <= max_blocks:
            raise UserError(f"task.blocks must be from {goal.blocks} to {max_blocks}, one colour each, got {blocks}")
        scene = CompiledScene(FileRobot(robot, meshes) if robot else Panda(meshes), blocks, shadows)
        arm, joints = scene.robot.arm, len(scene.joints)
        motion = (TRANSLATION,) * 3 + (ROTATION,) * 3
        self.spec = Spec(
            cameras=tuple(cameras),
            image_size=(image_size[0], image_size[1]),
            state=arm.components,
            state_units=("rad",) * joints + ("rad/s",) * joints + ("m",),
            action=("dx", "dy", "dz", "rx", "ry", "rz", "gripper"),
            units=("m", "m", "m", "rad", "rad", "rad", "1"),
            low=(*(-limit for limit in motion), 0.0),
            high=(*motion, 1.0),
            control_hz=CONTROL_HZ,
            depth=tuple(cameras),
            truth=(("tcp", 3), ("block", 3), ("destination", 3), ("faces", 2)),
            robot=arm,
        )
        self.simulation = Simulation(goal, randomize, scene, self.spec, time_limit)
        views = Views([scene.cameras[name] for name in cameras], *self.spec.image_size, geom_groups=(VISIBLE,))
        self.renderer = LazyRenderer(renderer, scene.model, views, scene.stale_textures)

    def reset(self, seed: int) -> Observation:
        """Start the episode of `seed`."""
        self.simulation.reset(seed)
        if self.simulation.name == Chain.name and seed < FIRST_SEED:
            self._skip_to(int(self.simulation.streams(seed, "start").randint(len(self.simulation.requests))))
        self.renderer.changed = True
        # Separate streams, so that a replay without images has the same joint noise.
        self._joint_noise = self.simulation.streams(seed, "joint noise")
        self._image_noise = np.random.default_rng([seed, 1])
        self.task, self.draws = self.simulation.name, self.simulation.draws
        self._update_outcome(done=False)
        return self.look()

    def _skip_to(self, number: int) -> None:
        """Let the scripted expert carry out the instructions before the one of index `number`, then the only one.

        If the expert fails at one of them, the episode has that one instead.
        """
        task, expert = self.simulation, Waypoint(self.spec)
        self._joint_noise, self._image_noise = np.random.RandomState(0), np.random.default_rng(0)
        task.disturber = None  # disturbances are for the agent of the episode
        with self.blind():
            while task.current < number and not task.is_over:
                task.step(expert.act(self.look()))
        task.isolate()

    def step(self, action: Array) -> Observation:
        """Apply one (7,) action, clipped to the spec's bounds, for one control period."""
        self._require_running()
        self.simulation.step(action)
        self._update_outcome(self.simulation.is_over)
        return self.look()

    def drive(self, joints: Array, opening: float, seconds: float) -> None:
        """See `TakesJointTargets`."""
        self.simulation.follow(joints, opening, seconds)

    def judge(self) -> None:
        """See `TakesJointTargets`."""
        self.simulation.judge()
        self._update_outcome(self.simulation.is_over)

    def _update_outcome(self, done: bool) -> None:
        classifier = self.simulation.classifier
        self.done, self.outcome, self.milestones = done, classifier.outcome, classifier.milestones
        self.instructions = len(self.simulation.requests)
        self.completed = self.simulation.current + classifier.success
        if self.events:
            self.milestones |= {"disturbed"}

    @property
    def events(self) -> list[tuple[int, str]]:
        """Control step and description of every disturbance so far in this episode."""
        disturber = self.simulation.disturber
        return disturber.events if disturber else []

    @property
    def tool(self) -> Array:
        """(3,) true position of the tool centre point in the world frame [m]."""
        compiled = self.simulation.compiled
        return compiled.data.site_xpos[compiled.tcp].copy()

    def _state(self) -> Array:
        """Measure (2 J + 1,) float32: joint positions [rad], their velocities [rad/s] and the gripper's opening [m]."""
        compiled, noise = self.simulation.compiled, self.simulation.compiled.noise
        joints, velocities = compiled.data.qpos[compiled.joints], compiled.data.qvel[compiled.velocities]
        opening = compiled.robot.opening(compiled.model, compiled.data)
        if noise.joints or noise.gripper:
            joints = joints + noise.joints * self._joint_noise.randn(len(joints))
            opening = max(0.0, opening + noise.gripper * float(self._joint_noise.randn()))
        return np.array([*joints, *velocities, opening], np.float32)

    def shapes(self) -> list[Shape]:
        """Return the visible shapes of the current episode."""
        model, shapes = self.simulation.compiled.model, []
        for geom in np.flatnonzero(model.geom_group == VISIBLE):
            kind = mujoco.mjtGeom(model.geom_type[geom]).name.removeprefix("mjGEOM_").lower()
            if kind not in SHAPES:
                continue
            vertices = faces = None
            if kind == "mesh":
                vertices, faces = (values.copy() for values in mesh_triangles(model, int(model.geom_dataid[geom])))
            name = model.geom(geom).name or f"geom{geom}"
            body = model.body(model.geom_bodyid[geom]).name
            place = (model.geom_pos[geom].copy(), model.geom_quat[geom].copy(), model.geom_size[geom].copy())
            shapes.append(Shape(body, name, kind, *place, model.geom_rgba[geom].copy(), vertices, faces))
        return shapes

    def poses(self) -> dict[str, Array]:
        """Return body name → (7,) position [m] and quaternion wxyz in the world frame."""
        model, data = self.simulation.compiled.model, self.simulation.compiled.data
        pose = np.concatenate([data.xpos, data.xquat], axis=1)
        return {model.body(body).name: pose[body] for body in range(model.nbody)}

    def minimal_step(self) -> dict[str, Callable[[], object]]:
        """Return name → minimal work of a control step from the current state, as functions for benchmarks to time."""
        compiled = self.simulation.compiled
        copy = mujoco.MjData(compiled.model)

        def step() -> None:
            mujoco.mj_copyData(copy, compiled.model, compiled.data)  # takes a hundredth of the steps
            mujoco.mj_step(compiled.model, copy, self.simulation.substeps)

        return {"physics": step, "rendering": lambda: self.renderer.render(compiled.data)}

    def close(self) -> None:
        """Close the renderer."""
        self.renderer.close()

    def look(self) -> Observation:
        """Return the current observation."""
        compiled, rgb, depth = self.simulation.compiled, {}, {}
        if not self._blind:
            pictures, metres = self.renderer.render(compiled.data)
            if compiled.noise.image:
                pictures = self._add_grain(pictures)
            millimetres = np.rint(metres * np.float32(MILLIMETRES)).astype(np.uint16)
            rgb = dict(zip(self.spec.cameras, pictures, strict=True))
            depth = dict(zip(self.spec.cameras, millimetres, strict=True))
        elif compiled.noise.image:  # draw the noise of the omitted images, so that later images do not change
            self._image_noise.bytes(3 * len(self.spec.cameras) * math.prod(self.spec.image_size))
        return Observation(rgb, self._state(), self.simulation.instruction, depth, self.simulation.truth())

    def _add_grain(self, pictures: Array) -> Array:
        """Add normal noise to pictures (cameras, H, W, 3), in whole grey levels up to 127.

        A random byte selects one of 256 equally probable values, in an eighth of the time of drawing normal numbers.
        """
        levels = np.rint(self.simulation.compiled.noise.image * QUANTILES).clip(-127, 127).astype(np.int8)
        grain = self._image_noise.bytes(pictures.size).translate(levels.tobytes())
        noise = np.frombuffer(grain, np.int8).reshape(pictures.shape)
        return np.add(pictures, noise, dtype=np.int16).clip(0, 255).astype(np.uint8)
