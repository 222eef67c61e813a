"""The contract between task, data, model and robot: what one control step looks like, and who talks to whom.

Everything that passes between the parts of `vla` is one of the types below. The modules on either side import this
file and never each other.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, asdict, dataclass, fields, replace
from typing import Any, Literal, Protocol

import numpy as np

Array = np.ndarray

FIRST_SEED = 1_000_000  # of evaluation; collection, which starts at small ones, never gets this far
LONGEST_INSTRUCTION = 1000  # characters


@dataclass(frozen=True)
class Spec:
    """What one step looks like; stored with episodes and checkpoints and compared wherever the two meet."""

    cameras: tuple[str, ...]
    image_size: tuple[int, int]  # height, width [px]
    joints: tuple[str, ...]  # names, base to tip
    action: tuple[str, ...]  # (D,) component names
    units: tuple[str, ...]  # (D,) "m" | "rad" | "1"
    low: tuple[float, ...]  # (D,) smallest action
    high: tuple[float, ...]  # (D,) largest action
    frame: str  # frame in which Cartesian actions are expressed
    control_hz: float  # [Hz]
    truth: tuple[tuple[str, int], ...] = ()  # simulator state kept as an auxiliary training target: name, size
    # (J + 1, 7) where the frame of each joint, which turns about its z axis, and last that of the tool lies in the
    # frame before: offset [m], quaternion wxyz; nothing where it is not known
    chain: tuple[tuple[float, ...], ...] = ()

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
    def from_dict(cls, values: Mapping[str, Any]) -> Spec:
        """The inverse of `to_dict`; fields that have a default may be missing.

        Raises:
            ValueError: a field is missing or unknown.
        """
        names = {field.name for field in fields(cls)}
        optional = {field.name for field in fields(cls) if field.default is not MISSING}
        if not names - optional <= set(values) <= names:
            raise ValueError(f"a spec has the fields {sorted(names)}, this one has {sorted(values)}")
        return cls(**{name: _tuples(value) for name, value in values.items()})

    def require(self, other: Spec, what: str, against: str) -> None:
        """Raise a ValueError naming the first field in which the spec of `what` (self) differs from `against`.

        A chain that one of them does not know is no difference.
        """
        for field in fields(self):
            mine, theirs = getattr(self, field.name), getattr(other, field.name)
            if mine != theirs and not (field.name == "chain" and () in (mine, theirs)):
                raise ValueError(f"{what} has {field.name} = {mine}, but {against} has {theirs}")


def _plain(value: Any) -> Any:
    return [_plain(item) for item in value] if isinstance(value, (tuple, list)) else value


def _tuples(value: Any) -> Any:
    return tuple(_tuples(item) for item in value) if isinstance(value, (tuple, list)) else value


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
