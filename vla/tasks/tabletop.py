"""The Franka tabletop: a dm_control task, and the environment around it that agents, recorders and robots know."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any, Literal

import dm_env
import numpy as np
from dm_control import composer, mjcf
from dm_env import specs

from vla.spec import Array, Observation, Shape, Spec
from vla.tasks.bound import BoundScene
from vla.tasks.control import WORKSPACE, CartesianController
from vla.tasks.franka import DAMPING_RATIO, FINGER_SPEED, FINGER_TRAVEL
from vla.tasks.goals import Goal, Progress
from vla.tasks.language import instruction
from vla.tasks.outcome import Judge
from vla.tasks.randomize import Axis, stream
from vla.tasks.render import Renderer
from vla.tasks.scene import COLOURS, Scene

CONTROL_HZ = 10.0
TRANSLATION = 0.04  # largest translation per step [m]
ROTATION = 0.25  # largest rotation per step [rad]
FINGER_STEP = FINGER_SPEED / CONTROL_HZ  # furthest a finger moves in one control period [m]


class TabletopTask(composer.Task):
    """Blocks on a table, one of them named by an instruction."""

    def __init__(self, goal: Goal, randomize: Mapping[str, Axis | None], scene: Scene, low: Array, high: Array) -> None:
        """Args: what is asked; axis name → axis, or None where it is off; the world; bounds (7,) of an action."""
        self.goal, self.randomize, self.scene = goal, randomize, scene
        self._low, self._high = low, high
        self.control_timestep = 1 / CONTROL_HZ
        self.controller = CartesianController(self.control_timestep, *WORKSPACE)
        self.seed: int | None = None  # of the next episode; drawn from dm_control's random state when None
        self.draws: dict[str, Any] = {}
        self.instruction = ""

    @property
    def root_entity(self) -> Scene:
        """The world."""
        return self.scene

    def after_compile(self, physics: mjcf.Physics, random_state: np.random.RandomState) -> None:
        """Find the scene's elements in the compiled model."""
        self.bound = BoundScene(self.scene, physics)

    def initialize_episode(self, physics: mjcf.Physics, random_state: np.random.RandomState) -> None:
        """Randomise the compiled model in place, then choose what to ask for."""
        seed = int(random_state.randint(2**31)) if self.seed is None else self.seed
        self.bound.restore()
        self.draws = {
            name: axis(self.bound, stream(seed, name)) for name, axis in self.randomize.items() if axis is not None
        }
        self.bound.finish()
        physics.forward()
        words = stream(seed, "language")
        self.target = int(words.randint(len(self.bound.block_geoms)))
        self.instruction = instruction(self.goal.templates, words, block=self.bound.block_names[self.target])
        self.draws = {"named": self._named(), **self.draws, "language": {"instruction": self.instruction}}
        data = self.bound.data
        self.controller.reset(data.qpos[self.bound.joints])
        self._command = np.append(self.controller.joints, data.qpos[self.bound.fingers].mean())
        data.ctrl[:] = self._command
        self._start = self.bound.block_position(self.target)
        self.judge = Judge(self.goal.hold_steps)

    def _named(self) -> dict[str, Any]:
        """What was drawn for the block that the instruction names: what success may well depend on."""
        geom = self.bound.block_geoms[self.target]
        x, y, _ = self.bound.block_position(self.target)
        rotation = self.bound.data.geom_xmat[geom].reshape(3, 3)
        return {
            "index": self.target,
            "position": [round(float(x), 5), round(float(y), 5)],
            "colour": self.bound.block_names[self.target],
            "yaw": round(float(np.arctan2(rotation[1, 0], rotation[0, 0])), 5),
            "half_size": round(float(self.bound.model.geom_size[geom, 0]), 5),
        }

    def before_step(self, physics: mjcf.Physics, action: Array, random_state: np.random.RandomState) -> None:
        """Turn the action into joint targets, approached evenly over the control period."""
        action = np.clip(action, self._low, self._high)
        grip = self._command[7]
        goal = np.append(self.controller.step(action[:6]), action[6] * FINGER_TRAVEL)
        goal[7] = grip + np.clip(goal[7] - grip, -FINGER_STEP, FINGER_STEP)
        self._increment = (goal - self._command) / self.physics_steps_per_control_step

    def follow(self, physics: mjcf.Physics, goal: Array, substeps: int) -> None:
        """Step physics while the targets of joints and fingers approach `goal` (8,) [rad], [m] evenly."""
        furthest = FINGER_SPEED * substeps * physics.timestep()
        finger = self._command[7] + np.clip(goal[7] - self._command[7], -furthest, furthest)
        self._increment = (np.append(goal[:7], finger) - self._command) / substeps
        for _ in range(substeps):
            self._move_targets(physics)
            physics.step()

    def before_substep(self, physics: mjcf.Physics, action: Array, random_state: np.random.RandomState) -> None:
        """Move the joint targets on."""
        self._move_targets(physics)

    def _move_targets(self, physics: mjcf.Physics) -> None:
        """One time step on, and ahead by what the servo's damping takes back: the arm then follows without lag."""
        self._command = self._command + self._increment
        lead = DAMPING_RATIO / physics.timestep() * self._increment
        physics.data.ctrl[:] = self._command
        physics.data.ctrl[:7] += lead[:7]

    def after_step(self, physics: mjcf.Physics, random_state: np.random.RandomState) -> None:
        """Judge what happened."""
        progress = self.progress()
        lifted = [
            self.bound.block_position(index)[2] > self.bound.model.geom_size[geom, 2] + 0.02
            for index, geom in enumerate(self.bound.block_geoms)
        ]
        tcp = self.bound.data.site_xpos[self.bound.tcp]
        self.judge.watch(progress, self.goal.reached(progress), tcp, lifted, self.target)

    def progress(self) -> Progress:
        """The truth about the named block now."""
        bound, geom = self.bound, self.bound.block_geoms[self.target]
        pads = {pad for pad, block in bound.touching() if block == self.target}
        speed = bound.data.qvel[bound.block_velocities[self.target] :][:3]
        return Progress(
            block=bound.block_position(self.target),
            start=self._start,
            half_size=float(bound.model.geom_size[geom, 0]),
            speed=float(np.linalg.norm(speed)),
            held=len(pads) == 2,
            touched=bool(pads),
            pad=bound.data.mocap_pos[bound.pad].copy(),
        )

    def truth(self) -> dict[str, Array]:
        """The state as an expert may see it, by name; lengths in [m].

        faces: cosine and sine of four times the turn that brings the fingers onto faces of the block, since a cube
        looks the same after a quarter turn.
        """
        bound, progress = self.bound, self.progress()
        block = bound.data.geom_xmat[bound.block_geoms[self.target]].reshape(3, 3)
        edge = block[:, int(np.argmin(np.abs(block[2])))]  # one that lies flat, whichever face is up
        gripper = self.controller.pose[:, 0]
        quarters = 4 * (np.arctan2(edge[1], edge[0]) - np.arctan2(gripper[1], gripper[0]))
        return {
            "tcp": bound.data.site_xpos[bound.tcp].copy(),
            "block": progress.block,
            "destination": self.goal.destination(progress),
            "commanded": self.controller.pose.copy(),  # (4, 4)
            "faces": np.array([np.cos(quarters), np.sin(quarters)]),
            "half_size": np.array([progress.half_size]),
            "grasped": np.array([float(progress.held)]),
            "reached": np.array([float(self.goal.reached(progress))]),
            "releases": np.array([float(self.goal.releases)]),
        }

    def get_reward(self, physics: mjcf.Physics) -> float:
        """1 once the goal was reached and held."""
        return float(self.judge.success)

    def should_terminate_episode(self, physics: mjcf.Physics) -> bool:
        """At success."""
        return self.judge.success

    def action_spec(self, physics: mjcf.Physics) -> specs.BoundedArray:
        """Bounds of the seven components."""
        return specs.BoundedArray((7,), np.float32, self._low, self._high, name="dx\tdy\tdz\trx\try\trz\tgripper")


class Tabletop:
    """`TabletopTask` as a `vla.spec.Environment`: seeds in, observations with cameras out."""

    def __init__(
        self,
        goal: Goal,
        randomize: Mapping[str, Axis | None],
        blocks: int = 3,
        image_size: tuple[int, int] = (96, 96),
        cameras: tuple[str, ...] = ("front", "wrist"),
        time_limit: float = 10.0,
        meshes: Literal["light", "full"] = "light",
        shadows: bool = True,
    ) -> None:
        """Build and compile the scene.

        Args:
            goal: what is asked for.
            randomize: axis name → axis, or None where it is off.
            blocks: number of blocks, the named one included.
            image_size: height and width of every camera's images [px].
            cameras: which of "front" and "wrist" to look through.
            time_limit: length of an episode that does not succeed [s].
            meshes: draw the robot with few faces ("light") or all of them ("full", much slower on a CPU).
            shadows: whether the lamp casts shadows.

        Raises:
            ValueError: an unknown camera, or more blocks than there are colours to name them by.
        """
        if min(image_size) < 1:
            raise ValueError(f"task.image_size is a height and a width of at least 1 pixel, not {list(image_size)}")
        if not 1 <= blocks <= len(COLOURS):
            raise ValueError(f"task.blocks is from 1 to {len(COLOURS)}, one colour each, not {blocks}")
        low = np.array([-TRANSLATION] * 3 + [-ROTATION] * 3 + [0.0])
        high = np.array([TRANSLATION] * 3 + [ROTATION] * 3 + [1.0])
        self.spec = Spec(
            cameras=tuple(cameras),
            image_size=(image_size[0], image_size[1]),
            joints=tuple(f"panda_joint{index}" for index in range(1, 8)),
            action=("dx", "dy", "dz", "rx", "ry", "rz", "gripper"),
            units=("m", "m", "m", "rad", "rad", "rad", "1"),
            low=tuple(low.tolist()),
            high=tuple(high.tolist()),
            frame="panda_link0",
            control_hz=CONTROL_HZ,
            truth=(("tcp", 3), ("block", 3), ("destination", 3), ("faces", 2)),
        )
        task = TabletopTask(goal, randomize, Scene(blocks=blocks, meshes=meshes, shadows=shadows), low, high)
        # The scene is compiled once: every reset writes into the compiled model.
        self.dm_env = composer.Environment(task, time_limit=time_limit, recompile_mjcf_every_episode=False)
        self.task = task
        unknown = sorted(set(cameras) - set(task.bound.cameras))
        if unknown or not cameras:
            raise ValueError(f"unknown cameras {unknown}; task.cameras may list {sorted(task.bound.cameras)}")
        self.done, self.outcome, self.periods = True, "timeout", 0
        self._time_limit = time_limit
        self.draws: dict[str, Any] = {}
        self._rendering: Renderer | None = None
        self._blind = False

    def reset(self, seed: int) -> Observation:
        """Start the episode that `seed` names."""
        self.task.seed = seed
        self.dm_env.reset()
        self.done, self.outcome, self.draws, self.periods = False, self.task.judge.outcome, self.task.draws, 0
        return self._observe()

    def step(self, action: Array) -> Observation:
        """Apply one (7,) action, clipped to the spec's bounds, for one control period."""
        if self.done:
            raise ValueError("the episode is over; call reset(seed) before step(action)")
        timestep: dm_env.TimeStep = self.dm_env.step(action)
        self.done, self.outcome = timestep.last(), self.task.judge.outcome
        return self._observe()

    def drive(self, joints: Array, opening: float, seconds: float) -> None:
        """Move towards joint targets (7,) [rad] and an opening 0…1 for a stretch of time, as a robot's own interface
        does; whoever drives calls `judge` once per control period."""
        physics = self.dm_env.physics
        substeps = round(seconds / physics.timestep())
        self.task.follow(physics, np.append(joints, opening * FINGER_TRAVEL), substeps)

    def judge(self) -> None:
        """Note one control period of driving, which may end the episode."""
        self.task.after_step(self.dm_env.physics, self.dm_env.random_state)
        self.periods += 1
        self.outcome = self.task.judge.outcome
        self.done = self.task.judge.success or self.periods >= round(self._time_limit * CONTROL_HZ)

    def look(self) -> Observation:
        """What there is to see and feel now."""
        return self._observe()

    def posture(self) -> tuple[Array, Array, float]:
        """Measured joints (7,) float32 [rad], their velocities [rad/s] and the gripper's opening [m]."""
        bound = self.task.bound
        joints, velocities = bound.data.qpos[bound.joints], bound.data.qvel[bound.velocities]
        return joints.astype(np.float32), velocities.astype(np.float32), float(bound.data.qpos[bound.fingers].sum())

    def shapes(self) -> list[Shape]:
        """The visible solids of the current episode."""
        return self.task.bound.shapes()

    def poses(self) -> dict[str, Array]:
        """Body name → (7,) position [m] and quaternion wxyz in the world."""
        return self.task.bound.poses()

    @contextmanager
    def blind(self) -> Iterator[None]:
        """Within this context observations carry no images, which is several times faster."""
        self._blind = True
        try:
            yield
        finally:
            self._blind = False

    def close(self) -> None:
        """Free physics and GL."""
        if self._rendering is not None:
            self._rendering.close()
            self._rendering = None
        self.dm_env.close()

    @property
    def renderer(self) -> Renderer:
        """The renderer, made when first needed: blind environments need no GL."""
        if self._rendering is None:
            self._rendering = Renderer(self.task.bound.model, *self.spec.image_size)
        return self._rendering

    def _observe(self) -> Observation:
        bound = self.task.bound
        rgb, depth = {}, {}
        if not self._blind:
            for name in self.spec.cameras:
                rgb[name], depth[name] = self.renderer.render(bound.data, bound.cameras[name])
        joints, velocities, gripper = self.posture()
        return Observation(
            rgb=rgb,
            depth=depth,
            joints=joints,
            velocities=velocities,
            gripper=gripper,
            instruction=self.task.instruction,
            truth=self.task.truth(),
        )
