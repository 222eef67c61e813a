"""The contract between task, data, model and robot: the layout of one control step, and the interfaces between them.

Tasks, data and models exchange only the types below: they import this module and never each other.
"""

from __future__ import annotations

import json
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass, field, replace
from typing import Annotated, Any, Literal, Protocol, runtime_checkable

import numpy as np
from annotated_types import Ge, Le, MaxLen, MinLen, Predicate

from vla.io.documents import STRICT, parse_plain
from vla.io.errors import UserError
from vla.io.parts import PICTURE, Camera, Name, Part, with_parts
from vla.io.types import Count, Point, Positive, unique

Array = np.ndarray

IN_DISTRIBUTION = "seen"  # name of the unchanged condition of an evaluation, which a policy is trained for
FIRST_SEED = 1_000_000  # smallest seed of evaluations; collection uses smaller seeds only
LONGEST_INSTRUCTION = 1000  # characters
MAX_SAMPLE = 2**18  # largest number of actions in a sample
# Beside the images in a batch, or in an observation of gymnasium.
INPUTS = ("state", "instruction", "text", "present", "tokens", "noise", "running", "remaining", "delay")


# Limits of a spec that is read from a file.
Names = Annotated[tuple[Name, ...], MinLen(1), MaxLen(100), Predicate(unique)]
Cameras = Annotated[tuple[Camera, ...], MinLen(1), MaxLen(100), Predicate(unique)]
Pixels = Annotated[int, Ge(1), Le(4096)]
Units = Annotated[tuple[Name, ...], MaxLen(100)]
Numbers = Annotated[tuple[float, ...], MaxLen(100)]


@dataclass(frozen=True)
class RobotModel:
    """Arm whose joints are part of the state; kinematics and deployment need it."""

    __pydantic_config__ = STRICT

    joints: Names  # names of the joint positions in the state, base to tip; [rad], or as `state_units` says
    frame: Annotated[str, MaxLen(100)]  # reference frame of Cartesian actions and of the chain
    velocities: Annotated[tuple[Name, ...], MaxLen(100), Predicate(unique)] = ()  # joint velocities, in the same order
    gripper: Name | None = None  # gripper opening [m] in the state
    # (J + 1, 7) pose of each joint frame, and of the tool frame, in the frame before: offset [m], quaternion wxyz.
    # Joints rotate about z. Empty if unknown.
    chain: Annotated[tuple[Numbers, ...], MaxLen(101)] = ()
    home: Numbers = ()  # (J,) posture that the arm keeps close to while its tool moves [rad]; empty if unknown

    @property
    def components(self) -> tuple[str, ...]:
        """Names of all state components of the robot."""
        return (*self.joints, *self.velocities, *([self.gripper] if self.gripper else []))


@dataclass(frozen=True)
class Spec:
    """Layout of one step; stored with episodes and checkpoints, which must agree."""

    __pydantic_config__ = STRICT

    cameras: Cameras
    image_size: tuple[Pixels, Pixels]  # height, width [px]
    state: Names  # (P,) measured components besides the images
    state_units: Units  # (P,) such as "m", "rad", "deg", "m/s", "rad/s" or "1"
    action: Names  # (D,) components
    units: Units  # (D,) of the action components
    low: Numbers  # (D,) smallest action
    high: Numbers  # (D,) largest action
    control_hz: Positive  # [Hz]
    depth: Annotated[tuple[Camera, ...], MaxLen(100), Predicate(unique)] = ()  # the cameras that also give depth
    parts: Annotated[tuple[Part, ...], MaxLen(100)] = ()  # where cameras show parts of a larger picture
    # simulator state kept as an auxiliary training target: name, size
    truth: Annotated[tuple[tuple[Name, Count], ...], MaxLen(100)] = ()
    robot: RobotModel | None = None  # None: no kinematics and no deployment

    @property
    def cut(self) -> tuple[str, ...]:
        """The cameras whose images are parts of a larger picture."""
        return tuple(part.camera for part in self.parts)

    @property
    def truth_size(self) -> int:
        """Number of scalars in the flattened truth vector."""
        return sum(size for _, size in self.truth)

    @property
    def without_truth(self) -> Spec:
        """The spec without simulator truth, which is never an input of a policy."""
        return replace(self, truth=())

    @property
    def rates(self) -> list[int]:
        """Indices of the state components that are rates of change, by their units."""
        return [index for index, unit in enumerate(self.state_units) if unit.endswith("/s")]

    @property
    def pose(self) -> list[int]:
        """Indices of the state components that are not rates of change."""
        return [index for index in range(len(self.state)) if index not in self.rates]

    def indices(self, names: Iterable[str]) -> list[int]:
        """Return the indices of state components by name."""
        return [self.state.index(name) for name in names]

    def require_robot(self, user: str) -> RobotModel:
        """Return the robot; if there is none, a UserError says that `user` needs one."""
        if self.robot is None:
            raise UserError(
                f"{user} needs a robot, and the spec of this world has none (robot=None): before training, name its "
                "joints, in the spec of the world's class, or for a recording with task.joints"
            )
        return self.robot

    def require_cut(self, camera: str, shape: Sequence[int], image: str) -> None:
        """Raise a UserError if the `image` (H, W, …) may be a whole picture of which `camera` shows a part."""
        if camera in self.cut and (shape[0], shape[1]) != tuple(self.image_size):
            height, width = self.image_size
            raise UserError(
                f"{image} has {shape[1]} by {shape[0]} pixels, but {camera} shows a part of a larger picture: give "
                f'that as "{PICTURE}", or the part in {width} by {height} pixels'
            )

    def required_images(self, names: Container[str]) -> list[str]:
        """Return the images to provide: all cameras, or, if `names` contains it, `PICTURE` in place of the cut ones."""
        uses_picture = self.parts and PICTURE in names
        return [PICTURE, *(name for name in self.cameras if name not in self.cut)] if uses_picture else [*self.cameras]

    def size(self, image: str) -> tuple[int, int]:
        """Return the height and width [px] at which an image is as detailed as the images in training."""
        if image != PICTURE or not self.parts:
            return self.image_size
        heights, widths = zip(*(part.picture_size(self.image_size) for part in self.parts), strict=True)
        return max(heights), max(widths)

    def images(self, observation: Observation) -> Mapping[str, Array]:
        """Return camera → image; missing parts are cut out of the whole picture if the observation contains it."""
        if PICTURE not in observation.rgb:
            return observation.rgb
        state = dict(zip(self.state, observation.state, strict=False))
        return with_parts(observation.rgb, state, self.parts, self.image_size)

    def random_observation(self, random: np.random.Generator) -> Observation:
        """Return an observation of noise, with a fixed instruction and no truth."""
        rgb = {camera: random.integers(256, size=(*self.image_size, 3), dtype=np.uint8) for camera in self.cameras}
        depth = {camera: random.integers(2**16, size=self.image_size, dtype=np.uint16) for camera in self.depth}
        state = random.uniform(-1, 1, len(self.state)).astype(np.float32)
        return Observation(rgb, state, "do what is to be done", depth)

    def to_dict(self) -> dict[str, Any]:
        """Return plain lists, numbers and strings, for JSON and for checkpoints loaded with `weights_only=True`."""
        values: dict[str, Any] = json.loads(json.dumps(asdict(self), default=lambda number: number.tolist()))
        return values

    @classmethod
    def from_dict(cls, values: Any, name: str = "the spec") -> Spec:
        """Invert `to_dict` for untrusted values; if they are not a valid spec, a UserError calls them `name`."""
        spec = parse_plain(values, cls, name)
        if problem := next(_contradictions(spec), None):
            raise UserError(f"{name} is not valid: {problem}")
        return spec

    def require(self, other: Spec, owner: str, other_owner: str) -> None:
        """Raise a UserError naming the first field in which the spec of `owner` (self) differs from `other_owner`.

        A chain, home posture or parts that only one of them knows are not a difference.
        """
        fields, other_fields = _fields(self), _fields(other)
        for name, value in fields.items():
            unknown = name in ("robot.chain", "robot.home", "parts") and () in (value, other_fields.get(name))
            if value != other_fields.get(name) and not unknown:
                raise UserError(
                    f"{owner} has {name} = {str(value)[:200]}, but {other_owner} has "
                    f"{str(other_fields.get(name))[:200]}"
                )

    def require_input(self, other: Spec, owner: str, other_owner: str) -> None:
        """Like `require`, for the inputs and outputs of a policy: truth and the size of uncut images are ignored."""
        spec, reference = self.without_truth, other.without_truth
        (spec if self.parts else replace(spec, image_size=reference.image_size)).require(reference, owner, other_owner)


def _fields(spec: Spec) -> dict[str, Any]:
    """Return field → value, with the fields of the robot under dotted names."""
    spec = parse_plain(spec.to_dict(), Spec, "the spec")  # with tuples, where a world has lists or arrays
    robot = {f"robot.{name}": value for name, value in vars(spec.robot).items()} if spec.robot else {}
    return {**vars(spec), "robot": "an arm" if spec.robot else None, **robot}


def _contradictions(spec: Spec) -> Iterator[str]:
    """Yield the inconsistencies between fields that are valid on their own."""
    for name, counterpart in (("state_units", "state"), ("units", "action"), ("low", "action"), ("high", "action")):
        if len(getattr(spec, name)) != len(getattr(spec, counterpart)):
            yield f"{name} has {len(getattr(spec, name))} components, {counterpart} {len(getattr(spec, counterpart))}"
    for name, low, high in zip(spec.action, spec.low, spec.high, strict=False):
        if not low < high:
            yield f"low of {name} is {low}, not less than high, {high}"
    if inputs := [camera for camera in spec.cameras if camera in INPUTS]:
        yield f"cameras names {', '.join(inputs)}, as another input of policies is called"
    if unknown_names := [camera for camera in spec.depth if camera not in spec.cameras]:
        yield f"depth names {', '.join(unknown_names)}, which is not among the cameras"
    if not unique(spec.cut):
        yield "parts names a camera twice"
    for part in spec.parts:
        yield from part.problems(spec.cameras, spec.state)
    if not unique([name for name, _ in spec.truth]) or spec.truth_size > 4096:
        yield "truth has a name twice, or more than 4096 numbers"
    if robot := spec.robot:
        joints = len(robot.joints)
        if unknown_names := [name for name in robot.components if name not in spec.state]:
            yield f"robot names {', '.join(unknown_names)}, which is not in the state"
        for name in ("velocities", "home"):
            if len(getattr(robot, name)) not in (0, joints):
                yield f"robot has {joints} joints, but {len(getattr(robot, name))} entries in {name}"
        if robot.chain and [len(frame) for frame in robot.chain] != [7] * (joints + 1):
            yield f"chain is not 7 numbers for each of {joints} joints and the tool"


@dataclass(frozen=True)
class RunningPlan:
    """The rest of the plan that is executed while the next one is computed."""

    actions: Array  # (n, D), the first of which begins at the time of the observation
    delay: int  # how many of them, at most n, will be over when the next plan arrives


@dataclass(frozen=True)
class Observation:
    """Input of an agent at one step."""

    rgb: dict[str, Array]  # camera → (H, W, 3) uint8
    state: Array  # (P,) float32
    instruction: str
    # camera → (H, W) uint16 [mm], 0: nothing is there, not even a sky (ROS 16UC1)
    depth: dict[str, Array] = field(default_factory=dict)
    truth: dict[str, Array] | None = None  # simulator only: for experts, never for policies
    running: RunningPlan | None = None  # for policies that continue it

    def require_truth(self, user: str) -> dict[str, Array]:
        """Return the truth; if there is none, a UserError says that `user` needs it."""
        if self.truth is None:
            raise UserError(f"{user} needs the simulator's truth, which this observation lacks")
        return self.truth

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any], spec: Spec) -> Observation:
        """Convert a gymnasium observation: images by camera, "state", "instruction"; a UserError if one is missing."""
        cameras = spec.required_images(values)
        if missing_keys := [name for name in (*cameras, "state", "instruction") if name not in values]:
            raise UserError(f"the observation has {', '.join(map(str, values))}, but lacks {', '.join(missing_keys)}")
        rgb = {camera: np.asarray(values[camera]) for camera in cameras}
        instruction = np.asarray(values["instruction"])  # an array in dm_env
        if instruction.shape or not isinstance(instruction.item(), str):
            raise UserError(f"the observation's instruction must be a text, got {str(values['instruction'])[:50]}")
        return cls(rgb, np.asarray(values["state"]), instruction.item())


@dataclass(frozen=True)
class ActionStatistics:
    """Bounds and a sample of the actions of all steps of several episodes, on which tokenizers are fitted."""

    actions: Array  # (N, D) float32, memory-mapped
    ends: Array  # (E,) the row after the last of every episode

    @property
    def low(self) -> Array:
        """(D,) smallest values."""
        return self.actions.min(0)

    @property
    def high(self) -> Array:
        """(D,) largest values."""
        return self.actions.max(0)

    def chunks(self, length: int) -> Array:
        """Return chunks of actions, (M, length, D) float32, that start at evenly spaced steps, or at every step if few.

        Beyond the end of an episode its last action is repeated, as in training windows.
        """
        count = min(len(self.actions), max(MAX_SAMPLE // length, 1))
        rows = np.linspace(0, len(self.actions) - 1, count).round().astype(np.int64)
        last_rows = self.ends[self.ends.searchsorted(rows, side="right")] - 1
        return self.actions[np.minimum(rows[:, None] + np.arange(length), last_rows[:, None])]


@dataclass(frozen=True)
class Shape:
    """Visible solid, rigidly attached to a body, as a recorder draws it."""

    body: str
    name: str
    kind: Literal["mesh", "box", "cylinder", "sphere", "capsule"]
    position: Array  # (3,) in the body [m]
    quaternion: Array  # (4,) wxyz, in the body
    size: Array  # (3,) half sizes [m]; radius first, then half length, for round shapes; unused for meshes
    rgba: Array  # (4,) 0…1
    vertices: Array | None = None  # (V, 3) float32 [m], meshes only
    faces: Array | None = None  # (F, 3) int32, meshes only


def _no_rows() -> Array:
    return np.empty((0, 0), np.float32)


@dataclass
class Episode:
    """Finished rollout of N steps."""

    seed: int
    task: str  # as in `Environment`
    instruction: str  # the first one
    outcome: str  # "success" or the name of the failure
    milestones: frozenset[str] = frozenset()  # as in `Environment`
    draws: dict[str, Any] = field(default_factory=dict)  # randomisation axis → drawn values, JSON-able
    observations: list[Observation] = field(default_factory=list)  # N, each one before the action of the same index
    actions: Array = field(default_factory=_no_rows)  # (N, D) float32, labels for imitation
    executed: Array = field(default_factory=_no_rows)  # (N, D) float32, sent to the robot; see `Stage.step`
    completed: tuple[int, int] | None = None  # instructions completed, of how many; None if there is only one
    tool: Array | None = None  # (N + 1, 3) tool positions [m], the last one at the end; None if the world has none

    @property
    def success(self) -> bool:
        """True if the goal was reached and held."""
        return self.outcome == "success"


class Environment(Protocol):
    """World that an agent acts in.

    It may also have
        tool: (3,) true position of the tool centre point in a fixed frame [m]; reports then have path and smoothness,
        events: (step, description) of what the agent did not cause, such as disturbances; recordings mark them,
        instructions, completed: number of instructions in the current episode, each given when the previous one is
            completed, and number completed; the episode succeeds when all are completed, and fails when one fails,
        distinct: a method, seeds → number of distinct episodes, if some seeds give the same episode.
    """

    spec: Spec
    task: str  # name of the task of this episode, such as "pick_place"; reports group by it
    done: bool  # the goal was reached and held, or the time is up
    outcome: str  # "success", "failure" if the episode ends because it can no longer be one, or why it is not (yet) one
    milestones: frozenset[str]  # reached so far in this episode, such as "grasped"
    draws: dict[str, Any]  # randomisation axis → values drawn at the last reset, JSON-able

    def reset(self, seed: int) -> Observation:
        """Start the episode of `seed`: the same seed gives the same episode, bit for bit."""

    def step(self, action: Array) -> Observation:
        """Apply one (D,) action for one control period and return the next observation."""

    def blind(self) -> AbstractContextManager[None]:
        """Return a context in which observations carry no images, which makes steps cheap.

        Later images do not depend on whether the context was used.
        """

    def close(self) -> None:
        """Free the resources of the environment."""


class SpecOnly:
    """Base class of worlds of which only recordings exist: they have a spec, but nothing can act in them."""

    spec: Spec


@runtime_checkable
class Multitask(Protocol):
    """Environment that knows the task of a seed before its episode, so that collection can balance the tasks."""

    tasks: tuple[str, ...]

    def task_of(self, seed: int) -> str:
        """Return the task of the episode of `seed`; every task in `tasks` recurs within a few consecutive seeds."""


@runtime_checkable
class HasScene(Protocol):
    """Environment that a recorder can draw in three dimensions."""

    viewpoint: tuple[Point, Point]  # position of the viewer and the point looked at [m]

    def shapes(self) -> list[Shape]:
        """Return the visible solids of the current episode."""

    def poses(self) -> dict[str, Array]:
        """Return body name → (7,) position [m] and quaternion wxyz in the world."""


@runtime_checkable
class TakesJointTargets(Protocol):
    """Environment whose arm also takes joint targets, independently of control periods, like a robot driver."""

    def drive(self, joints: Array, opening: float, seconds: float) -> None:
        """Move towards joint targets (J,) [rad] and a gripper opening 0…1 for `seconds` [s].

        Raises a UserError if `seconds` is not a whole number of physics steps.
        """

    def judge(self) -> None:
        """Update the outcome after one control period of driving; the episode may end."""

    def look(self) -> Observation:
        """Return the current observation."""


class Agent(Protocol):
    """Source of actions: an expert, a policy, a person.

    An agent may also have `looks`, whether its next action may depend on the images; if not, none are rendered. It is
    False while a planned chunk is executed and no new instruction discards it, and always for experts that read the
    truth. An expert with `memoryless = True` may also label states that another agent reaches: its action, or the label
    in `info["clean"]`, depends on the observation alone.
    """

    @property
    def info(self) -> dict[str, Any]:
        """What is known about the last action, for recorders: "clean" (D,), "probabilities" (D, K)."""

    def reset(self, instruction: str, seed: int) -> None:
        """Start an episode, or a new instruction within it, without history; `seed` initialises the random generator of
        the agent, if it has one."""

    def act(self, observation: Observation, /) -> Array:
        """Return the (D,) float32 action to execute now."""


@runtime_checkable
class Agents(Protocol):
    """Agents in several worlds side by side, one per lane, that share computation, such as `vla.policy.Policy`."""

    def reset(self, instruction: str, seed: int, lane: int) -> None:
        """Start an episode, or a new instruction within it, in a lane; as in `Agent`."""

    def act(self, observations: Sequence[Observation], lanes: Sequence[int], /) -> Array:
        """Return the actions (n, D) float32 to execute now in n lanes, given what each of them sees.

        Raises a UserError if an observation does not fit the spec; then no lane has acted.
        """

    def about(self, lane: int) -> dict[str, Any]:
        """Return what is known about the last action of a lane, as `Agent.info`."""

    def looking(self, lane: int) -> bool:
        """Return whether the next action of a lane may depend on the images, as `looks` of an `Agent`."""


class Recorder(Protocol):
    """Observer of a rollout."""

    def start(self, environment: Environment) -> None:
        """Begin an episode; one that has not ended is discarded."""

    def step(self, observation: Observation, action: Array, info: Mapping[str, Any]) -> None:
        """Record one step: the observation and the (D,) action chosen for it."""

    def end(self, episode: Episode) -> None:
        """Finish the episode."""


class Exporter(Protocol):
    """Writer of demonstrations, or with `of_policies = True` of a policy, in another format."""

    def export(self, source: Any, cluster: Any, /) -> Any:
        """Write a `vla.data.episodes.EpisodeStore` with a `vla.parallel.pool.Cluster`, or a `vla.policy.Policy` alone.

        Returns the path of the export.
        """


class Deployment(Protocol):
    """Execution of a policy outside training; built as `Deployment(**yaml, policy=…, environment=…, output=…)`.

    `policy` and `environment` are factories of the checkpoint's policy and its task's environment, `output` a folder. A
    class with `needs_policy = False` runs without a checkpoint, one with `needs_environment = True` builds the world.
    """

    def run(self) -> Any:
        """Run until finished or interrupted; returns a `vla.rollouts.results.Report` if success was measured."""
