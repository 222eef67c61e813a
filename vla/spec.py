"""The contract between task, data, model and robot: what one control step looks like, and who talks to whom.

Everything that passes between the parts of `vla` is one of the types below. The modules on either side import this
file and never each other.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, fields, replace
from typing import Annotated, Any, Literal, Protocol

import numpy as np
from annotated_types import Ge, Le, MaxLen, MinLen, Predicate

from vla.documents import STRICT, parse_json
from vla.types import Count, Positive, unique

Array = np.ndarray

FIRST_SEED = 1_000_000  # of evaluation; collection, which starts at small ones, never gets this far
LONGEST_INSTRUCTION = 1000  # characters


def names_a_file(name: str) -> bool:
    """fit to be a part of a file's name"""
    return re.fullmatch(r"\w[\w.-]*", name) is not None


# What a spec out of a file may hold.
Name = Annotated[str, MinLen(1), MaxLen(100)]
Names = Annotated[tuple[Name, ...], MinLen(1), MaxLen(100), Predicate(unique)]
Camera = Annotated[Name, Predicate(names_a_file)]
Cameras = Annotated[tuple[Camera, ...], MinLen(1), MaxLen(100), Predicate(unique)]
Pixels = Annotated[int, Ge(1), Le(4096)]
Numbers = Annotated[tuple[float, ...], MaxLen(100)]


@dataclass(frozen=True)
class Spec:
    """What one step looks like; stored with episodes and checkpoints and compared wherever the two meet."""

    __pydantic_config__ = STRICT

    cameras: Cameras
    image_size: tuple[Pixels, Pixels]  # height, width [px]
    joints: Names  # base to tip
    action: Names  # (D,) components
    units: Annotated[tuple[Name, ...], MaxLen(100)]  # (D,) "m" | "rad" | "1"
    low: Numbers  # (D,) smallest action
    high: Numbers  # (D,) largest action
    frame: Annotated[str, MaxLen(100)]  # frame in which Cartesian actions are expressed
    control_hz: Positive  # [Hz]
    # simulator state kept as an auxiliary training target: name, size
    truth: Annotated[tuple[tuple[Name, Count], ...], MaxLen(100)] = ()
    # (J + 1, 7) where the frame of each joint, which turns about its z axis, and last that of the tool lies in the
    # frame before: offset [m], quaternion wxyz; nothing where it is not known
    chain: Annotated[tuple[Numbers, ...], MaxLen(101)] = ()

    @property
    def truth_size(self) -> int:
        """Number of scalars in a flattened truth vector."""
        return sum(size for _, size in self.truth)

    @property
    def perceived(self) -> Spec:
        """The same without the truth, which a policy never sees."""
        return replace(self, truth=())

    def to_dict(self) -> dict[str, Any]:
        """Plain lists, numbers and strings, fit for JSON and for a checkpoint loaded with `weights_only=True`."""
        return {name: _plain(value) for name, value in asdict(self).items()}

    @classmethod
    def from_dict(cls, values: Any, name: str = "the spec") -> Spec:
        """The inverse of `to_dict`, of values that anybody may have written; fields that have a default may be missing.

        Raises:
            ValueError: `values`, called `name` in errors, are no spec.
        """
        try:
            text = json.dumps(values)
        except (TypeError, ValueError, RecursionError) as error:
            raise ValueError(f"{name} is damaged or of another kind: {str(error)[:200]}") from error
        spec = parse_json(text, cls, name)
        if problem := next(_contradictions(spec), None):
            raise ValueError(f"{name} is damaged or of another kind: {problem}")
        return spec

    def require(self, other: Spec, what: str, against: str) -> None:
        """Raise a ValueError naming the first field in which the spec of `what` (self) differs from `against`.

        A chain that one of them does not know is no difference.
        """
        for field in fields(self):
            mine, theirs = getattr(self, field.name), getattr(other, field.name)
            if mine != theirs and not (field.name == "chain" and () in (mine, theirs)):
                raise ValueError(f"{what} has {field.name} = {str(mine)[:200]}, but {against} has {str(theirs)[:200]}")


def _plain(value: Any) -> Any:
    return [_plain(item) for item in value] if isinstance(value, (tuple, list)) else value


def _contradictions(spec: Spec) -> Iterator[str]:
    """How fields that fit their types do not fit each other."""
    for name in ("units", "low", "high"):
        if len(getattr(spec, name)) != len(spec.action):
            yield f"{name} has {len(getattr(spec, name))} components, action {len(spec.action)}"
    for name, low, high in zip(spec.action, spec.low, spec.high, strict=False):
        if not low < high:
            yield f"low of {name} is {low}, not less than high, {high}"
    if spec.chain and [len(frame) for frame in spec.chain] != [7] * (len(spec.joints) + 1):
        yield f"chain is not 7 numbers for each of {len(spec.joints)} joints and the tool"
    if not unique([name for name, _ in spec.truth]) or spec.truth_size > 4096:
        yield "truth has a name twice, or more than 4096 numbers"


@dataclass(frozen=True)
class Observation:
    """What an agent is given at one step."""

    rgb: dict[str, Array]  # camera → (H, W, 3) uint8
    depth: dict[str, Array]  # camera → (H, W) uint16 [mm], 0 where there is no return (ROS 16UC1)
    joints: Array  # (7,) float32 [rad]
    velocities: Array  # (7,) float32 [rad/s]
    gripper: float  # opening between the fingers [m]
    instruction: str
    truth: dict[str, Array] | None = None  # simulator only: experts may read it, policies never do


@dataclass(frozen=True)
class Shape:
    """One visible solid, rigidly attached to a body: enough for a recorder to draw the scene."""

    body: str
    name: str
    kind: Literal["mesh", "box", "cylinder", "sphere", "capsule"]
    position: Array  # (3,) in the body [m]
    quaternion: Array  # (4,) wxyz, in the body
    size: Array  # (3,) half sizes [m]; radius first, then half length, for round shapes; unused for meshes
    rgba: Array  # (4,) 0…1
    vertices: Array | None = None  # (V, 3) float32 [m], meshes only
    faces: Array | None = None  # (F, 3) int32, meshes only


def flat(draws: Mapping[str, Any]) -> dict[str, Any]:
    """Dotted name → value of everything that was drawn in an episode."""
    values: dict[str, Any] = {}
    for name, draw in draws.items():
        if isinstance(draw, Mapping):
            values |= {f"{name}.{key}": value for key, value in flat(draw).items()}
        else:
            values[str(name)] = draw
    return values


def leaves(value: Any) -> list[Any]:
    """The numbers and words in a draw, however deep they lie in lists."""
    plain = value.tolist() if isinstance(value, (np.ndarray, np.generic)) else value
    return [leaf for item in plain for leaf in leaves(item)] if isinstance(plain, (list, tuple)) else [plain]


@dataclass
class Episode:
    """One finished rollout of N steps."""

    seed: int
    instruction: str
    outcome: str  # "success" or the name of the failure
    draws: dict[str, Any]  # randomisation axis → what was drawn, JSON-able
    observations: list[Observation]  # N, each one what the agent saw before the action of the same index
    actions: Array  # (N, D) float32, what the agent means to be imitated
    executed: Array  # (N, D) float32, what was sent to the robot: differs where an expert perturbs itself

    @property
    def success(self) -> bool:
        """Whether the goal was reached and held."""
        return self.outcome == "success"


class Environment(Protocol):
    """A world that an agent can act in."""

    spec: Spec
    done: bool  # the goal was reached and held, or the time is up
    outcome: str  # "success" or why it is not (yet) one
    draws: dict[str, Any]  # randomisation axis → what was drawn at the last reset, JSON-able

    def reset(self, seed: int) -> Observation:
        """Start the episode that `seed` names: the same seed gives the same episode, bit for bit."""
        ...

    def step(self, action: Array) -> Observation:
        """Apply one (D,) action for one control period and look again."""
        ...

    def shapes(self) -> list[Shape]:
        """The visible solids of the current episode, for recorders."""
        ...

    def poses(self) -> dict[str, Array]:
        """Body name → (7,) position [m] and quaternion wxyz in the world, for recorders."""
        ...


class Agent(Protocol):
    """Something that acts: an expert, a policy, a person."""

    info: dict[str, Any]  # what a recorder may want to know of the last action: "clean" (D,), "probabilities" (D, K)

    def reset(self, instruction: str, seed: int) -> None:
        """Forget the past; `seed` feeds the agent's own randomness, if it has any."""
        ...

    def act(self, observation: Observation) -> Array:
        """The (D,) float32 action to execute now."""
        ...


class Recorder(Protocol):
    """Somebody who watches a rollout."""

    def start(self, name: str, environment: Environment) -> None:
        """A new episode begins."""
        ...

    def step(self, observation: Observation, action: Array, info: Mapping[str, Any]) -> None:
        """One step was decided: what was seen, and the (D,) action that follows."""
        ...

    def end(self, episode: Episode) -> None:
        """The episode is over."""
        ...


class Exporter(Protocol):
    """Something that writes an episode store, or a policy, in another format."""

    def export(self, source: Any) -> Any:
        """Write all of it; returns the path of what was written."""
        ...


class Deployment(Protocol):
    """A way to put a policy to work; built as `Deployment(**yaml, policy=…, environment=…, output=…)`.

    `policy` and `environment` make the checkpoint's policy and its task's environment, for those who need them;
    `output` is a folder to write to.
    """

    def run(self) -> Any:
        """Work until done or interrupted; what is measured on the way comes back as a `vla.evaluate.Report`."""
        ...
