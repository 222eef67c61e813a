"""The Franka tabletop as the environment that agents, recorders and robots know."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any, Literal

import dm_env
import numpy as np

from vla.spec import Array, Observation, Shape, Spec
from vla.tasks.franka import CHAIN, FINGER_TRAVEL
from vla.tasks.goals.goal import Goal
from vla.tasks.goals.mixed import Mixed
from vla.tasks.randomize.axis import Axis
from vla.tasks.render import Renderer
from vla.tasks.scene import COLOURS, Scene
from vla.tasks.task import CONTROL_HZ, BriskEnvironment, TabletopTask
from vla.types import Count, ImageSize, Names, Positive

TRANSLATION = 0.04  # largest translation per step [m]
ROTATION = 0.25  # largest rotation per step [rad]


class Tabletop:
    """`TabletopTask` as a `vla.spec.Environment`: seeds in, observations with cameras out."""

    def __init__(
        self,
        goal: Goal | Mixed,
        randomize: Mapping[str, Axis | None],
        blocks: Count = 4,
        image_size: ImageSize = (96, 96),
        cameras: Names = ("front", "wrist"),
        time_limit: Positive = 10.0,
        meshes: Literal["light", "full"] = "light",
        shadows: bool = True,
    ) -> None:
        """Build and compile the scene.

        Args:
            goal: what is asked for.
            randomize: axis name → axis, or None where it is off.
            blocks: most blocks on the table, the named ones included; the axis `distractors` says how many.
            image_size: height and width of every camera's images [px].
            cameras: which of "front" and "wrist" to look through.
            time_limit: length of an episode that does not succeed, per block that is to be moved [s].
            meshes: draw the robot with few faces ("light") or all of them ("full", much slower on a CPU).
            shadows: whether the lamp casts shadows.

        Raises:
            ValueError: an unknown camera, or more blocks than there are colours to name them by.
        """
        if min(image_size) < 1:
            raise ValueError(f"task.image_size is a height and a width of at least 1 pixel, not {list(image_size)}")
        most = len(COLOURS) - goal.absent
        if not goal.blocks <= blocks <= most:
            raise ValueError(f"task.blocks is from {goal.blocks} to {most}, one colour each, not {blocks}")
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
            chain=CHAIN,
        )
        task = TabletopTask(
            goal, randomize, Scene(blocks=blocks, meshes=meshes, shadows=shadows), low, high, time_limit
        )
        self.dm_env = BriskEnvironment(task)
        self.task = task
        unknown = sorted(set(cameras) - set(task.bound.cameras))
        if unknown or not cameras:
            raise ValueError(f"unknown cameras {unknown}; task.cameras may list {sorted(task.bound.cameras)}")
        self.done, self.outcome = True, "timeout"
        self.draws: dict[str, Any] = {}
        self._rendering: Renderer | None = None
        self._blind = False

    def reset(self, seed: int) -> Observation:
        """Start the episode that `seed` names."""
        self.task.seed = seed
        self.dm_env.reset()
        # Two streams: an episode that is replayed without images feels the same.
        self._feeling, self._seeing = self.task.streams(seed, "joint noise"), np.random.default_rng([seed, 1])
        self.done, self.outcome, self.draws = False, self.task.judge.outcome, self.task.draws
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
        self.done, self.outcome = self.task.over, self.task.judge.outcome

    def look(self) -> Observation:
        """What there is to see and feel now."""
        return self._observe()

    def posture(self) -> tuple[Array, Array, float]:
        """Measured joints (7,) float32 [rad], their velocities [rad/s] and the gripper's opening [m]."""
        bound, noise = self.task.bound, self.task.bound.noise
        joints, velocities = bound.data.qpos[bound.joints], bound.data.qvel[bound.velocities]
        opening = float(bound.data.qpos[bound.fingers].sum())
        if noise.joints or noise.gripper:
            joints = joints + noise.joints * self._feeling.randn(len(joints))
            opening = max(0.0, opening + noise.gripper * float(self._feeling.randn()))
        return joints.astype(np.float32), velocities.astype(np.float32), opening

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
            self.renderer.take_over(bound.stale_textures)
            for name in self.spec.cameras:
                rgb[name], depth[name] = self.renderer.render(bound.data, bound.cameras[name])
                if bound.noise.image:
                    grain = self._seeing.standard_normal(rgb[name].shape, dtype=np.float32)
                    rgb[name] = np.clip(rgb[name] + bound.noise.image * grain, 0, 255).astype(np.uint8)
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
