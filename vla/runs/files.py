"""Schemas of the JSON and YAML files in a run's folder, validated on reading."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Annotated, Any

from pydantic import AfterValidator

from vla.config.annotations import mismatch
from vla.config.build import arguments
from vla.config.differences import ABSENT, value_at
from vla.config.nodes import Evaluation, conditions, with_changes
from vla.config.origin import Origin
from vla.io.documents import LENIENT, STRICT
from vla.io.errors import UserError
from vla.io.types import Count, Natural, NonNegative, Positive
from vla.rollouts.comparison import Comparison
from vla.rollouts.motion import Motion
from vla.rollouts.results import Report, Result
from vla.spec import IN_DISTRIBUTION

Node = dict[str, Any]
# Values of a config that reports use, key → type; everything else is only shown.
PARSED_KEYS: dict[str, Any] = {"task": dict[str, object], "task.tiers": dict[str, list[str]] | None}
PARSED_KEYS |= {"evaluate": dict[str, object]}
PARSED_KEYS |= {f"evaluate.{name}": each.annotation for name, each in arguments(Evaluation).items()}


def readable_config(config: Node) -> Node:
    """Return a config that reports can read; raise a UserError if a value that they use has the wrong type."""
    for key, kind in PARSED_KEYS.items():
        if (value := value_at(config, key)) != ABSENT and (problem := mismatch(f"config.{key}", value, kind)):
            raise UserError(problem)
    return config


Config = Annotated[Node, AfterValidator(readable_config)]


@dataclass(frozen=True)
class Change:
    """An entry of changes.yaml: a key whose value differs from the default."""

    __pydantic_config__ = STRICT

    key: str
    here: Any
    default: Any


@dataclass(frozen=True)
class Training:
    """training.json: size of the model and result of its training."""

    __pydantic_config__ = STRICT

    parameters: Natural
    steps: Natural
    seconds: NonNegative
    ended: str  # "done", "interrupted", or an error
    origins: list[Origin] = field(default_factory=list)  # of its beginning, and of what continued it


@dataclass(frozen=True)
class ComponentError:
    """Mean absolute error of an action component over episodes, with its confidence interval."""

    __pydantic_config__ = STRICT

    name: str
    unit: str
    error: NonNegative
    ci_low: NonNegative
    ci_high: NonNegative | None  # None: unbounded
    constant: NonNegative  # error of the mean action of the training episodes


@dataclass(frozen=True, kw_only=True)
class ErrorsFile:
    """errors.json, written by `vla.reports.open_loop.write_errors`."""

    __pydantic_config__ = LENIENT

    seeds: list[Natural]
    components: list[ComponentError]
    relative: NonNegative
    checkpoint: str | None
    config: Node
    origin: Origin | None = None
    parameters: Count | None = None
    latency_ms: Positive | None = None


@dataclass(frozen=True, kw_only=True)
class Condition:
    """Episodes under another condition, on the same seeds."""

    __pydantic_config__ = LENIENT

    # Per episode; with `anytime`, perhaps of the first seeds only.
    outcomes: list[str]
    reached: list[tuple[str, ...]]  # milestones
    motions: list[Motion | None]
    compared: dict[str, Comparison] = field(default_factory=dict)  # with the training condition, metric → comparison
    anytime: bool = False  # intervals are valid whatever the reason to stop playing

    def report(self, seeds: Sequence[int], tasks: Sequence[str], tiers: Mapping[str, Sequence[str]]) -> Report:
        """Return the report on episodes of these seeds and tasks, without draws and instructions."""
        results = (
            Result(seed, outcome, task=task, milestones=milestones, motion=motion)
            for seed, task, outcome, milestones, motion in zip(
                seeds, tasks, self.outcomes, self.reached, self.motions, strict=False
            )
        )
        return Report(tuple(results), tiers, self.anytime)


@dataclass(frozen=True, kw_only=True)
class ReportFile:
    """report.json, written by `vla.reports.evaluation.write_report`, without values derived from its episodes."""

    __pydantic_config__ = LENIENT

    seeds: list[int]
    checkpoint: str | None
    conditions: dict[str, Condition]
    config: Config
    per_episode: list[Result]
    anytime: bool = False  # see `Condition`
    parameters: Count | None = None
    latency_ms: Positive | None = None
    versions: dict[str, str] = field(default_factory=dict)  # library → version
    statements: list[str] = field(default_factory=list)  # on what the evaluation was to decide
    origin: Origin | None = None
    recorded: list[int] = field(default_factory=list)  # seeds of the episodes in the recording
    weights: str | None = None  # SHA-256 of those of the policy

    def __post_init__(self) -> None:
        """Require the same episodes in every part."""
        if [result.seed for result in self.per_episode] != self.seeds:
            raise UserError("per_episode has other episodes than seeds")
        if not self.seeds or len(set(self.seeds)) < len(self.seeds):
            raise UserError("seeds is empty, or has the same seed twice")
        for name, condition in self.conditions.items():
            count = len(condition.outcomes)
            if count > len(self.seeds) or (count < len(self.seeds) and not condition.anytime):
                raise UserError(f"conditions.{name} has {count} outcomes of {len(self.seeds)} seeds")
            if not count == len(condition.reached) == len(condition.motions):
                raise UserError(f"conditions.{name} has other episodes in reached or motions than in outcomes")

    @cached_property
    def reports(self) -> dict[str, Report]:
        """Condition → report, the training condition first; it is also that of conditions that change nothing."""
        tiers = value_at(self.config, "task.tiers", None) or {}  # also with tasks that were not played
        # Without tiers a condition may change the task of an episode; in a benchmark the task follows from the seed.
        tasks = [result.task if tiers else "" for result in self.per_episode]
        training, task = Report(tuple(self.per_episode), tiers, self.anytime), value_at(self.config, "task", {})
        equal = {name for name, changes in self.changes.items() if with_changes(task, changes) == task}
        others = {
            name: training if name in equal else part.report(self.seeds, tasks, tiers)
            for name, part in self.conditions.items()
        }
        return {IN_DISTRIBUTION: training, **others}

    @cached_property
    def changes(self) -> dict[str, dict[str, Any]]:
        """Condition that changes the task → its changes."""
        evaluate = value_at(self.config, "evaluate", {})
        return conditions(evaluate.get("conditions", {}), evaluate.get("one_by_one", {}))
