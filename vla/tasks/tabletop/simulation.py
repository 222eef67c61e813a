"""Simulation of the tabletop: episodes sampled from a seed, stepped by actions, with a classified outcome."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np

from vla.io.errors import UserError
from vla.robots.cartesian import CartesianController, solve
from vla.spec import FIRST_SEED, Array, Spec
from vla.tasks.tabletop.compiled_scene import CompiledScene
from vla.tasks.tabletop.disturber import PUSH_STEP, Disturber
from vla.tasks.tabletop.goals.goal import SKILLS, Goal, Referents, WorldState, current_subgoal
from vla.tasks.tabletop.goals.several import Chain, Mixed
from vla.tasks.tabletop.language import HeldOutKind
from vla.tasks.tabletop.outcome import OutcomeClassifier
from vla.tasks.tabletop.randomize.episode import paraphrase
from vla.tasks.tabletop.randomize.randomizer import Randomizer
from vla.tasks.tabletop.scene import COLOURS, PADS
from vla.tasks.world import Streams

CONTROL_HZ = 10.0
WORKSPACE = ((0.25, -0.40, 0.008), (0.75, 0.40, 0.50))  # corners of the box that bounds the tool point [m]


@dataclass(frozen=True)
class Request:
    """Goal, named objects and words of one instruction."""

    goal: Goal
    referents: Referents
    instruction: str
    held_out: str  # held-out part of the instruction: a kind, "names" for replaced names, or "none"


class Simulation:
    """Manipulation of blocks on a table by one instruction, or by several in a row.

    Attributes:
        requests: what the instructions of the episode ask for, in their order.
        current: index of the one to carry out now.
        goal: of the current request, like `referents`, `instruction` and `classifier`.
    """

    def __init__(
        self,
        goal: Goal | Mixed | Chain,
        randomize: Mapping[str, Randomizer | None],
        compiled: CompiledScene,
        spec: Spec,
        time_limit: float,
    ) -> None:
        """Store the parts, as in `Tabletop`; no episode has begun."""
        self.goals, self.randomize, self.compiled = goal, randomize, compiled
        self._spec, self._time_limit = spec, time_limit
        self._timestep = compiled.model.opt.timestep
        self.substeps = round(1 / CONTROL_HZ / self._timestep)
        self.controller = CartesianController(compiled.robot.kinematics, 1 / CONTROL_HZ, *WORKSPACE)
        self.disturber: Disturber | None = None
        self.streams = Streams()

    def reset(self, seed: int) -> None:
        """Start the episode of `seed`: randomise the compiled model in place, then draw goal and instruction."""
        compiled, data = self.compiled, self.compiled.data
        compiled.restore()
        axes = {name: axis for name, axis in self.randomize.items() if axis is not None}
        draws = {name: axis(compiled, self.streams(seed, name)) for name, axis in axes.items()}
        goal = self.goals.draw(self.streams(seed, "goal"))
        compiled.present = max(compiled.present, goal.blocks)
        if "distractors" in draws:
            draws["distractors"] = {"count": compiled.present - 1}  # a goal may need more than were drawn
        self._pads = goal.pads
        compiled.finish(goal.pads)
        mujoco.mj_forward(compiled.model, data)
        self.name, self.requests = goal.name, self._requests(goal, seed)
        self.controller.reset(data.qpos[compiled.joints])
        self._command = np.append(self.controller.joints, compiled.grip)
        data.ctrl[:] = compiled.controls(self._command[None])[0]
        delay = round(compiled.latency / self._timestep)
        self._late_controls = np.tile(data.ctrl, (delay, 1))  # controls that are delayed by the latency, oldest first
        self._axes = draws
        self._start()
        compiled.forward_without_servos()

    def _requests(self, goal: Goal | Chain, seed: int) -> list[Request]:
        """Draw what the instructions of the episode ask for."""
        if not isinstance(goal, Chain):
            return [self._request(goal, None, seed)]
        present, skip = self.compiled.present, self.compiled.skip
        links = [
            (link, replace(referents, blocks=tuple((block + skip) % present for block in referents.blocks)))
            for link, referents in goal.plan(present, self.streams(seed, "chain"))
        ]
        return [self._request(*link, seed, f" {number}") for number, link in enumerate(links, start=1)]

    def _request(self, goal: Goal, referents: Referents | None, seed: int, stream: str = "") -> Request:
        """Draw an instruction and, unless given, what it names; `stream` is added to the names of random streams."""
        held_out = self._draw_held_out(goal, self.streams(seed, f"novelty{stream}"), seed)
        if referents is None:
            referents = self._choose(goal, held_out, self.streams(seed, "named"), seed)
            if self.compiled.skip and not goal.absent:  # another block may change whether its colour is held out
                held_out = self._adapt_held_out(goal, referents, held_out)
        words = self._slots(goal, referents, seed)
        instruction = goal.language.say(words, held_out, self.streams(seed, f"language{stream}"))
        if self.compiled.paraphrases and seed >= FIRST_SEED and instruction:
            return Request(goal, referents, paraphrase(instruction, self.compiled.paraphrases, words.values()), "names")
        return Request(goal, referents, instruction, held_out or "none")

    def _start(self) -> None:
        """Start the episode with its first request, and describe its draws."""
        self._steps, disturbance = 0, self.compiled.disturbance
        self.disturber, self._shove = Disturber(disturbance, self.compiled) if disturbance else None, np.zeros(3)
        self._begin(0)
        first_request, *later_requests = self.requests
        language: dict[str, Any] = {"instruction": first_request.instruction, "held_out": first_request.held_out}
        if later_requests:
            language["then"] = [request.instruction for request in later_requests]
        self.draws = {"named": self._describe_named(), **self._axes, "language": language}

    def _begin(self, number: int) -> None:
        """Start the clock of a request, with the blocks where they are now."""
        self.current, request = number, self.requests[number]
        self.goal, self.referents, self.instruction = request.goal, request.referents, request.instruction
        self._state: WorldState | None = None  # of this moment, where it was measured
        self._starts, self._lifts = self.compiled.block_centres(), np.zeros(self.compiled.present)
        self.classifier = OutcomeClassifier(self.goal.hold_steps)
        self._periods, self._most_periods = 0, round(self._time_limit * self.goal.moves * CONTROL_HZ)

    def isolate(self) -> None:
        """Make the current request the only one of the episode, which begins with it."""
        self.name, self.requests = self.goal.name, [self.requests[self.current]]
        self._start()

    def _draw_held_out(self, goal: Goal, random_state: np.random.RandomState, seed: int) -> HeldOutKind | None:
        """Draw which part of the instruction is held out; None in training and in the rest of an evaluation."""
        if seed < FIRST_SEED or random_state.uniform() >= self.compiled.held_out:
            return None
        colours = set() if goal.absent else set(self.compiled.block_names[: self.compiled.present])
        candidates = colours & set(goal.language.held_out_colours)
        kinds = [kind for kind in goal.language.held_out_kinds if kind != "combinations" or candidates]
        return kinds[random_state.randint(len(kinds))] if kinds else None

    def _adapt_held_out(self, goal: Goal, referents: Referents, kind: HeldOutKind | None) -> HeldOutKind | None:
        """Adapt the drawn kind of held-out instruction to another named block, so that exactly one kind applies."""
        novel = self.compiled.block_names[referents.blocks[0]] in goal.language.held_out_colours
        if novel == (kind == "combinations"):
            return kind
        return "combinations" if novel else next((k for k in goal.language.held_out_kinds if k != "combinations"), None)

    def _choose(
        self, goal: Goal, held_out: HeldOutKind | None, random_state: np.random.RandomState, seed: int
    ) -> Referents:
        """Draw the named blocks and pads; the first block has a colour that the instruction may name."""
        colours, names = goal.language.held_out_colours, self.compiled.block_names
        order = [int(index) for index in random_state.permutation(self.compiled.present)]
        # The sort is stable: without held-out colours it changes nothing.
        order.sort(key=lambda index: (names[index] in colours) != (held_out == "combinations"))
        if held_out != "combinations" and names[order[0]] in colours:
            raise UserError(
                "task.goal.language.held_out_colours: all blocks of a scene have such a colour, so none can be named: "
                "hold out fewer, or raise task.randomize.distractors.count"
            )
        # In training only among those that may be named.
        count = len(order) if seed >= FIRST_SEED else sum(names[index] not in colours for index in order)
        skip = self.compiled.skip % count
        order = [*order[skip:count], *order[:skip], *order[count:]]
        return Referents(tuple(order[: goal.named]), tuple(random_state.permutation(goal.pads).tolist()))

    def _slots(self, goal: Goal, referents: Referents, seed: int) -> dict[str, str]:
        """Return the words that fill the goal's slots of an instruction."""
        names = self.compiled.block_names
        slots = {slot: names[index] for slot, index in zip(("block", "other"), referents.blocks, strict=False)}
        if goal.absent:
            exclusions = {*names[: self.compiled.present], *goal.language.held_out_colours}
            candidates = [name for name in COLOURS if name not in exclusions]
            slots["absent"] = candidates[self.streams(seed, "absent").randint(len(candidates))]
        return slots | {slot: list(PADS)[index] for slot, index in zip(("pad", "rest"), referents.pads, strict=False)}

    def _describe_named(self) -> dict[str, Any]:
        """Return the draws of the first named block, for reports on what success depends on."""
        index, compiled = self.referents.blocks[0], self.compiled
        x, y, _ = compiled.block_centres()[index]
        rotation = compiled.data.geom_xmat[compiled.block_geoms[index]].reshape(3, 3)
        return {
            "goal": type(self.goal).__name__,
            "index": index,
            "position": [round(float(x), 5), round(float(y), 5)],
            "colour": compiled.block_names[index],
            "yaw": round(float(np.arctan2(rotation[1, 0], rotation[0, 0])), 5),
            "half_size": round(float(compiled.extents[index, 0]), 5),
        }

    def step(self, action: Array) -> None:
        """Simulate one control period, with targets interpolated linearly to those of the (7,) action."""
        action = np.clip(action, self._spec.low, self._spec.high)
        if self.disturber:
            action = self.disturber.override(action)
        self._advance(self.controller.step(action[:6]), action[6], self.substeps)
        self.judge()

    def follow(self, joints: Array, opening: float, seconds: float) -> None:
        """Step physics for `seconds` with targets interpolated linearly to `joints` (J,) [rad] and an opening 0…1.

        After a push the arm returns to these targets, because its driver does not know of the push. Raises a UserError
        if `seconds` is no whole number of physics steps.
        """
        substeps = round(seconds / self._timestep)
        if not math.isclose(substeps * self._timestep, seconds):
            raise UserError(
                f"the arm cannot be driven at {1 / seconds:g} Hz, as physics runs at {1 / self._timestep:g} Hz: set "
                "joints_hz of the simulator to a whole fraction of that"
            )
        if self.disturber:
            joints, opening = self._disturb(self.disturber, joints, opening, seconds)
        self._advance(joints, opening, substeps)

    def _disturb(self, disturber: Disturber, joints: Array, opening: float, seconds: float) -> tuple[Array, float]:
        """Return joint targets and opening under the disturbance; the tool is pushed no faster than by an action."""
        max_shift = PUSH_STEP * CONTROL_HZ * seconds
        self._shove += np.clip(disturber.offset - self._shove, -max_shift, max_shift)
        if self._shove.any():
            kinematics = self.compiled.robot.kinematics
            start = kinematics.forward(joints)
            target = start[0].copy()
            target[:3, 3] = np.clip(target[:3, 3] + self._shove, *WORKSPACE)
            joints = solve(kinematics, target, joints, start)
        return joints, 1.0 if disturber.opens else opening

    def _advance(self, joints: Array, opening: float, substeps: int) -> None:
        """Step physics with targets interpolated to joints [rad] and, as fast as fingers are, to an opening 0…1."""
        model, data, robot = self.compiled.model, self.compiled.data, self.compiled.robot
        grip, furthest = self._command[-1], robot.finger_speed * substeps * self._timestep
        finger = grip + np.clip(opening * robot.travel - grip, -furthest, furthest)
        increment = (np.append(joints, finger) - self._command) / substeps
        commands = self._command + np.arange(1, substeps + 1)[:, None] * increment
        targets = commands.copy()
        # A lead compensates the damping of the servos, so that the arm does not lag.
        targets[:, :-1] += robot.lead / self._timestep * increment[:-1]
        self._command, self._state = commands[-1], None
        controls = np.concatenate([self._late_controls, self.compiled.controls(targets)])
        self._late_controls = controls[substeps:]
        ctrl = data.ctrl
        for row in controls[:substeps]:
            ctrl[:] = row
            mujoco.mj_step2(model, data)
            mujoco.mj_step1(model, data)
        self.compiled.require_stable()

    def judge(self) -> None:
        """Update the outcome after a control period; the next request, if there is one, follows a success."""
        self._periods += 1
        self._steps += 1
        self._lifts = np.maximum(self._lifts, (self.compiled.block_centres() - self._starts)[:, 2])
        state = self.world_state()
        subgoals = self.goal.subgoals(state, self.referents)
        self.classifier.update(state, subgoals, self.referents.blocks)
        if self.classifier.success and self.current + 1 < len(self.requests):
            self._begin(self.current + 1)
            subgoals = self.goal.subgoals(state, self.referents)
        if self.disturber and not self.is_over and self.disturber.update(self._steps, state, current_subgoal(subgoals)):
            mujoco.mj_step1(self.compiled.model, self.compiled.data)  # poses and contacts after the move
            self._state = None

    def world_state(self) -> WorldState:
        """Return the current true state."""
        self._state = self._state or self._measure()
        return self._state

    def _measure(self) -> WorldState:
        compiled, data, present = self.compiled, self.compiled.data, self.compiled.present
        fingers: list[set[int]] = [set() for _ in range(present)]
        for finger, block in compiled.touching():
            fingers[block].add(finger)
        velocities = data.qvel[compiled.block_velocities[:present, None] + np.arange(3)]  # (B, 3)
        return WorldState(
            positions=compiled.block_centres(),
            starts=self._starts,
            extents=compiled.extents[:present],
            speeds=np.linalg.norm(velocities, axis=1),
            lifts=self._lifts,
            held=np.array([len(sides) == 2 for sides in fingers]),
            touched=np.array([bool(sides) for sides in fingers]),
            pads=data.mocap_pos[compiled.zones[: self._pads]].copy(),
            tool=data.site_xpos[compiled.tcp].copy(),
            arm_speed=float(np.abs(data.qvel[compiled.velocities]).max()),
        )

    def truth(self) -> dict[str, Array]:
        """Return the privileged state for experts, by name, of the current subgoal and its block; lengths in [m].

        faces: cosine and sine of four times the yaw from the fingers to the block's faces, invariant to quarter turns.
        """
        compiled, state, pose = self.compiled, self.world_state(), self.controller.pose
        subgoal = current_subgoal(self.goal.subgoals(state, self.referents))
        block = compiled.data.geom_xmat[compiled.block_geoms[subgoal.block]].reshape(3, 3)
        edge = block[:, int(np.argmin(np.abs(block[2])))]  # the most horizontal edge, for any face up
        quarters = 4 * (np.arctan2(edge[1], edge[0]) - np.arctan2(pose[1, 0], pose[0, 0]))
        return {
            "tcp": state.tool,
            "block": state.positions[subgoal.block],
            "destination": subgoal.destination,
            "commanded": pose.copy(),  # (4, 4)
            "commanded_position": pose[:3, 3].copy(),
            "faces": np.array([np.cos(quarters), np.sin(quarters)]),
            "half_size": state.extents[subgoal.block],  # (3,)
            "grasped": np.array([float(state.held[subgoal.block])]),
            "skill": np.array([float(SKILLS.index(subgoal.skill))]),
            "tolerance": np.array([subgoal.tolerance]),
            "widest": np.array([compiled.robot.widest]),  # opening of the gripper
            "tip": np.array(compiled.robot.tip),  # (4,) as of `TabletopRobot`
        }

    @property
    def is_over(self) -> bool:
        """True if the goal was reached and held, or its time is up."""
        return self.classifier.success or self._periods >= self._most_periods
