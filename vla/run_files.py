"""What the JSON and YAML files in a run's folder hold, as types that are validated when the files are read."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

from pydantic import ConfigDict, StringConstraints

from vla.documents import STRICT
from vla.evaluate import Result
from vla.types import Count, Natural, NonNegative, Positive, Share

Node = dict[str, Any]
CheckpointName = Annotated[str, StringConstraints(pattern=r"^\w[\w.-]*\.ckpt$")]  # in the run's own folder


@dataclass(frozen=True)
class Change:
    """An entry of changes.yaml: a key that is not as by default."""

    __pydantic_config__ = STRICT

    key: str
    here: Any
    default: Any


@dataclass(frozen=True)
class Training:
    """training.json: how large the model is, and how its training went."""

    __pydantic_config__ = STRICT

    parameters: Natural
    steps: Natural
    seconds: NonNegative
    ended: str  # "done", "interrupted", or what went wrong
    collection_s: NonNegative | None = None  # how long the demonstrations took, if that is known
    checkpoint: CheckpointName | None = None  # chosen to be evaluated


@dataclass(frozen=True)
class Summary:
    """How often a policy succeeded, see `vla.report.summary`."""

    __pydantic_config__ = ConfigDict(strict=True, extra="ignore", allow_inf_nan=False)

    success: Share
    ci_low: Share
    ci_high: Share
    episodes: Natural
    successes: Natural
    errors: Natural
    taxonomy: dict[str, Natural]
    goals: dict[str, Summary]


@dataclass(frozen=True)
class Condition(Summary):
    """The same under another condition, on the same seeds."""

    outcomes: list[str]


@dataclass(frozen=True)
class ReportFile(Summary):
    """report.json, see `vla.report.write_report`; the names of chosen options are left out."""

    seeds: list[int]
    checkpoint: str | None
    conditions: dict[str, Condition]
    config: Node
    per_episode: list[Result]
    parameters: Count | None = None
    latency_ms: Positive | None = None
    budget_s: NonNegative | None = None

    def __post_init__(self) -> None:
        """Every part is about the same episodes."""
        if [result.seed for result in self.per_episode] != self.seeds:
            raise ValueError("per_episode is about other episodes than seeds")
        for name, condition in self.conditions.items():
            if len(condition.outcomes) != len(self.seeds):
                raise ValueError(f"conditions.{name} has {len(condition.outcomes)} outcomes of {len(self.seeds)} seeds")
