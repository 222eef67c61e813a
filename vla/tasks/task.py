"""The dm_control task: an episode drawn from a seed, driven by actions, watched by a judge."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np
from dm_control import composer, mjcf
from dm_env import specs

from vla.spec import FIRST_SEED, Array
from vla.tasks.bound import BoundScene
from vla.tasks.control import WORKSPACE, CartesianController
from vla.tasks.franka import DAMPING_RATIO, FINGER_SPEED, FINGER_TRAVEL
from vla.tasks.goals.goal import MANNERS, Aim, Facts, Goal
from vla.tasks.goals.mixed import Mixed
from vla.tasks.language import Novelty
from vla.tasks.outcome import Judge
from vla.tasks.randomize.axis import Axis, Streams
from vla.tasks.scene import COLOURS, PADS, Scene

CONTROL_HZ = 10.0
FINGER_STEP = FINGER_SPEED / CONTROL_HZ  # furthest a finger moves in one control period [m]


class BriskEnvironment(composer.Environment):
    """Composer's environment with all substeps in one loop: the hooks around each one take longer than MuJoCo does."""

    def __init__(self, task: TabletopTask) -> None:
        # Compiled once: every reset writes into the compiled model.
        super().__init__(task, recompile_mjcf_every_episode=False)

    def _substep(self, action: Array) -> None:
        self._task.advance(self._physics, self._task.substeps)


class TabletopTask(composer.Task):
    """Blocks on a table, some of them named by an instruction."""

    def __init__(
        self,
        goal: Goal | Mixed,
        randomize: Mapping[str, Axis | None],
        scene: Scene,
        low: Array,
        high: Array,
        time_limit: float,
    ) -> None:
        """Args: what is asked; axis name → axis, or None where it is off; the world; bounds (7,) of an action; length
        of an episode per block that is to be moved [s]."""
        self.goals, self.randomize, self.scene = goal, randomize, scene
        self._time_limit = time_limit
        self._low, self._high = low, high
        self.control_timestep = 1 / CONTROL_HZ
        self.substeps = round(self.control_timestep / self.physics_timestep)
        self.controller = CartesianController(self.control_timestep, *WORKSPACE)
        self.seed: int | None = None  # of the next episode; drawn from dm_control's random state when None
        self.draws: dict[str, Any] = {}
        self.instruction = ""
        self.streams = Streams()

    @property
    def root_entity(self) -> Scene:
        """The world."""
        return self.scene

    @property
    def physics_steps_per_control_step(self) -> int:
        """One, as far as composer is concerned; see `BriskEnvironment`."""
        return 1

    def after_compile(self, physics: mjcf.Physics, random_state: np.random.RandomState) -> None:
        """Find the scene's elements in the compiled model."""
        self.bound = BoundScene(self.scene, physics)

    def initialize_episode(self, physics: mjcf.Physics, random_state: np.random.RandomState) -> None:
        """Randomise the compiled model in place, then choose what to ask for."""
        seed = int(random_state.randint(2**31)) if self.seed is None else self.seed
        self.bound.restore()
        axes = {name: axis for name, axis in self.randomize.items() if axis is not None}
        draws = {name: axis(self.bound, self.streams(seed, name)) for name, axis in axes.items()}
        self.goal = self.goals.draw(self.streams(seed, "goal"))
        self.bound.present = max(self.bound.present, self.goal.blocks)
        self.bound.finish(self.goal.pads)
        physics.forward()
        novelty = self._novelty(seed)
        self.aim = self._choose(novelty, self.streams(seed, "named"))
        self.instruction = self.goal.language.say(self._slots(seed), novelty, self.streams(seed, "language"))
        language = {"instruction": self.instruction, "novelty": novelty or "none"}
        self.draws = {"named": self._named(), **draws, "language": language}
        data = self.bound.data
        self.controller.reset(data.qpos[self.bound.joints])
        self._command = np.append(self.controller.joints, data.qpos[self.bound.fingers].mean())
        data.ctrl[:] = self._command
        self._late: deque[Array] = deque()  # commands under way to the motors
        self._delay = round(self.bound.latency / physics.timestep())
        self._known: tuple[float, Facts] | None = None  # the newest facts, and when they were true
        self._starts, self._lifts = self.bound.block_centres(), np.zeros(self.bound.present)
        self.judge = Judge(self.goal.hold_steps)
        self._periods, self._most_periods = 0, round(self._time_limit * self.goal.moves * CONTROL_HZ)

    def _novelty(self, seed: int) -> Novelty | None:
        """What is new in this episode's instruction: nothing in training, something in some evaluations."""
        if seed < FIRST_SEED:
            return None
        random_state = self.streams(seed, "novelty")
        if random_state.uniform() >= self.bound.novelty:
            return None
        present = set(self.bound.block_names[: self.bound.present])
        possible = present & set(self.goal.language.held_out_colours)
        kinds = [kind for kind in self.goal.language.novelties if kind != "combinations" or possible]
        return kinds[random_state.randint(len(kinds))]

    def _choose(self, novelty: Novelty | None, random_state: np.random.RandomState) -> Aim:
        """Draw whom the instruction names; first a block whose colour it may name."""
        held_out = self.goal.language.held_out_colours
        order = [int(index) for index in random_state.permutation(self.bound.present)]
        # A sort keeps the order among equals: where nothing is held out, it changes nothing.
        order.sort(key=lambda index: (self.bound.block_names[index] in held_out) != (novelty == "combinations"))
        order = order[self.bound.passed_over :] + order[: self.bound.passed_over]
        pads = [int(index) for index in random_state.permutation(self.goal.pads)]
        return Aim(tuple(order[: self.goal.named]), tuple(pads))

    def _slots(self, seed: int) -> dict[str, str]:
        """What the slots of an instruction stand for."""
        blocks = zip(("block", "other"), self.aim.blocks, strict=False)
        pads = zip(("pad", "rest"), self.aim.pads, strict=False)
        slots = {slot: self.bound.block_names[index] for slot, index in blocks}
        if self.goal.absent:
            missing = [name for name in COLOURS if name not in self.bound.block_names[: self.bound.present]]
            slots["absent"] = missing[self.streams(seed, "absent").randint(len(missing))]
        return slots | {slot: list(PADS)[index] for slot, index in pads}

    def _named(self) -> dict[str, Any]:
        """What was drawn for the first block that the instruction names: what success may well depend on."""
        index = self.aim.blocks[0]
        x, y, _ = self.bound.block_centres()[index]
        rotation = self.bound.data.geom_xmat[self.bound.block_geoms[index]].reshape(3, 3)
        return {
            "goal": type(self.goal).__name__,
            "index": index,
            "position": [round(float(x), 5), round(float(y), 5)],
            "colour": self.bound.block_names[index],
            "yaw": round(float(np.arctan2(rotation[1, 0], rotation[0, 0])), 5),
            "half_size": round(float(self.bound.extents[index, 0]), 5),
        }

    def before_step(self, physics: mjcf.Physics, action: Array, random_state: np.random.RandomState) -> None:
        """Turn the action into joint targets, approached evenly over the control period."""
        action = np.clip(action, self._low, self._high)
        grip = self._command[7]
        goal = np.append(self.controller.step(action[:6]), action[6] * FINGER_TRAVEL)
        goal[7] = grip + np.clip(goal[7] - grip, -FINGER_STEP, FINGER_STEP)
        self._increment = (goal - self._command) / self.substeps

    def follow(self, physics: mjcf.Physics, goal: Array, substeps: int) -> None:
        """Step physics while the targets of joints and fingers approach `goal` (8,) [rad], [m] evenly."""
        furthest = FINGER_SPEED * substeps * physics.timestep()
        finger = self._command[7] + np.clip(goal[7] - self._command[7], -furthest, furthest)
        self._increment = (np.append(goal[:7], finger) - self._command) / substeps
        self.advance(physics, substeps)

    def advance(self, physics: mjcf.Physics, substeps: int) -> None:
        """Step physics while the targets move on evenly, each ahead by what the servo's damping takes back: the arm
        then follows without lag."""
        commands = self._command + np.arange(1, substeps + 1)[:, None] * self._increment
        targets = commands.copy()
        targets[:, :7] += DAMPING_RATIO / physics.timestep() * self._increment[:7]
        self._command = commands[-1]
        model, data = physics.model.ptr, physics.data.ptr
        with physics.check_invalid_state():
            for target in targets:
                self._late.append(target)
                if len(self._late) > self._delay:
                    data.ctrl[:] = self._late.popleft()
                mujoco.mj_step2(model, data)
                mujoco.mj_step1(model, data)

    def after_step(self, physics: mjcf.Physics, random_state: np.random.RandomState) -> None:
        """Judge what happened in this control period."""
        self._periods += 1
        self._lifts = np.maximum(self._lifts, (self.bound.block_centres() - self._starts)[:, 2])
        facts = self.facts()
        self.judge.watch(facts, self.goal.subgoals(facts, self.aim), self.aim.blocks)

    def facts(self) -> Facts:
        """The truth about everything on the table now."""
        now = float(self.bound.data.time)
        if self._known is None or self._known[0] != now:
            self._known = now, self._look()
        return self._known[1]

    def _look(self) -> Facts:
        bound, present = self.bound, self.bound.present
        fingers: list[set[int]] = [set() for _ in range(present)]
        for finger, block in bound.touching():
            fingers[block].add(finger)
        velocities = bound.data.qvel[bound.block_velocities[:present, None] + np.arange(3)]  # (B, 3)
        return Facts(
            positions=bound.block_centres(),
            starts=self._starts,
            extents=bound.extents[:present],
            speeds=np.linalg.norm(velocities, axis=1),
            lifts=self._lifts,
            held=np.array([len(touching) == 2 for touching in fingers]),
            touched=np.array([bool(touching) for touching in fingers]),
            pads=bound.data.mocap_pos[bound.zones[: self.goal.pads]].copy(),
            tool=bound.data.site_xpos[bound.tcp].copy(),
            arm_speed=float(np.abs(bound.data.qvel[bound.velocities]).max()),
        )

    def truth(self) -> dict[str, Array]:
        """The state as an expert may see it, by name, about the block whose turn it is; lengths in [m].

        faces: cosine and sine of four times the turn that brings the fingers onto faces of the block, since a cube
        looks the same after a quarter turn.
        """
        bound, facts = self.bound, self.facts()
        subgoals = self.goal.subgoals(facts, self.aim)
        now = next((subgoal for subgoal in subgoals if not subgoal.done), subgoals[-1])
        block = bound.data.geom_xmat[bound.block_geoms[now.block]].reshape(3, 3)
        edge = block[:, int(np.argmin(np.abs(block[2])))]  # one that lies flat, whichever face is up
        gripper = self.controller.pose[:, 0]
        quarters = 4 * (np.arctan2(edge[1], edge[0]) - np.arctan2(gripper[1], gripper[0]))
        return {
            "tcp": facts.tool,
            "block": facts.positions[now.block],
            "destination": now.destination,
            "commanded": self.controller.pose.copy(),  # (4, 4)
            "faces": np.array([np.cos(quarters), np.sin(quarters)]),
            "half_size": facts.extents[now.block],  # (3,)
            "grasped": np.array([float(facts.held[now.block])]),
            "manner": np.array([float(MANNERS.index(now.manner))]),
            "tolerance": np.array([now.tolerance]),
        }

    def get_reward(self, physics: mjcf.Physics) -> float:
        """1 once the goal was reached and held."""
        return float(self.judge.success)

    @property
    def over(self) -> bool:
        """Whether the goal was reached and held, or the time is up."""
        return self.judge.success or self._periods >= self._most_periods

    def should_terminate_episode(self, physics: mjcf.Physics) -> bool:
        """See `over`."""
        return self.over

    def action_spec(self, physics: mjcf.Physics) -> specs.BoundedArray:
        """Bounds of the seven components."""
        return specs.BoundedArray((7,), np.float32, self._low, self._high, name="dx\tdy\tdz\trx\try\trz\tgripper")
