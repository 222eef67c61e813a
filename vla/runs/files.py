"""Schemas of the JSON and YAML files in a run's folder, validated on reading."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import repeat
from typing import Annotated, Any

from pydantic import ConfigDict, StringConstraints

from vla.io.documents import STRICT
from vla.io.types import Count, Natural, NonNegative, Positive, Share
from vla.rollouts.comparison import Comparison
from vla.rollouts.evaluate import Median, Result
from vla.rollouts.motion import Motion

Node = dict[str, Any]
CheckpointName = Annotated[str, StringConstraints(pattern=r"^\w[\w.-]*\.ckpt$")]  # in the run's own folder


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
    collection_s: NonNegative | None = None  # duration of the collection, if known
    checkpoint: CheckpointName | None = None  # selected for evaluation


@dataclass(frozen=True)
class Round:
    """Round of `job=improve`: episodes that the expert labelled, and the training that followed."""

    __pydantic_config__ = STRICT

    episodes: Natural  # 0: training on demonstrations alone
    successes: Natural  # of these episodes, by the policy before this training
    collection_s: NonNegative  # duration of the episodes
    training_s: NonNegative
    validation: Share | None  # success rate in the last validation; None without one

    def __str__(self) -> str:
        """Format the successes before and after the training."""
        acted = f"{self.successes} of {self.episodes} labelled episodes were successes"
        after = "" if self.validation is None else f"{100 * self.validation:.0f} % in validation afterwards"
        return ", ".join(part for part in (acted if self.episodes else "", after) if part) or "trained"


@dataclass(frozen=True)
class Milestone:
    """Rate of a milestone, regardless of the outcome."""

    __pydantic_config__ = STRICT

    rate: Share
    ci_low: Share
    ci_high: Share
    episodes: Natural  # that reached it


@dataclass(frozen=True)
class Mean:
    """Mean of several success rates, with its confidence interval."""

    __pydantic_config__ = STRICT

    rate: Share
    ci_low: Share
    ci_high: Share


@dataclass(frozen=True)
class MeanInARow:
    """Mean number of instructions completed in a row, with its confidence interval."""

    __pydantic_config__ = STRICT

    number: NonNegative
    ci_low: NonNegative
    ci_high: NonNegative


@dataclass(frozen=True, kw_only=True)
class Summary:
    """Success statistics, written by `vla.reports.evaluation.summary`."""

    __pydantic_config__ = ConfigDict(strict=True, extra="ignore", allow_inf_nan=False)

    success: Share
    ci_low: Share
    ci_high: Share
    episodes: Natural
    successes: Natural
    errors: Natural
    taxonomy: dict[str, Natural]
    milestones: dict[str, Milestone]
    tasks: dict[str, Summary]
    motion: dict[str, Median] = field(default_factory=dict)  # field of `vla.rollouts.motion.Motion` → over successes
    in_a_row: dict[str, Milestone] = field(default_factory=dict)  # "1/4" → at least one of four instructions
    mean_in_a_row: MeanInARow | None = None
    tiers: dict[str, Summary] = field(default_factory=dict)
    mean_over_tiers: Mean | None = None
    anytime: bool = False  # intervals are valid whatever the reason to stop playing


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

    __pydantic_config__ = ConfigDict(strict=True, extra="ignore", allow_inf_nan=False)

    seeds: list[Natural]
    components: list[ComponentError]
    relative: NonNegative
    checkpoint: str | None
    config: Node
    parameters: Count | None = None
    latency_ms: Positive | None = None
    wall_time_s: NonNegative | None = None


@dataclass(frozen=True, kw_only=True)
class Condition(Summary):
    """Success statistics under another condition, on the same seeds."""

    outcomes: list[str]  # with `anytime`, of the first seeds
    comparison: Comparison | None = None  # with the training condition
    course: dict[str, Comparison] = field(default_factory=dict)  # milestone or field of `Motion` → the same
    # Per episode, as `outcomes`; empty in reports of before they were kept.
    reached: list[tuple[str, ...]] = field(default_factory=list)  # milestones
    motions: list[Motion | None] = field(default_factory=list)

    def results(self, seeds: Sequence[int]) -> tuple[Result, ...]:
        """Return what is known of the episodes of these seeds."""
        reached, motions = self.reached or repeat(()), self.motions or repeat(None)
        return tuple(
            Result(seed, outcome, milestones=milestones, motion=motion)
            for seed, outcome, milestones, motion in zip(seeds, self.outcomes, reached, motions, strict=False)
        )


@dataclass(frozen=True, kw_only=True)
class ReportFile(Summary):
    """report.json, written by `vla.reports.evaluation.write_report`, without the names of chosen options."""

    seeds: list[int]
    checkpoint: str | None
    conditions: dict[str, Condition]
    config: Node
    per_episode: list[Result]
    parameters: Count | None = None
    latency_ms: Positive | None = None
    wall_time_s: NonNegative | None = None
    rounds: list[Round] = field(default_factory=list)  # of job=improve
    statements: list[str] = field(default_factory=list)  # on what the evaluation was to decide

    def __post_init__(self) -> None:
        """Require the same episodes in every part."""
        if [result.seed for result in self.per_episode] != self.seeds:
            raise ValueError("per_episode has other episodes than seeds")
        for name, condition in self.conditions.items():
            played = len(condition.outcomes)
            if played > len(self.seeds) or (played < len(self.seeds) and not condition.anytime):
                raise ValueError(f"conditions.{name} has {played} outcomes of {len(self.seeds)} seeds")
            if any(len(each) not in (0, played) for each in (condition.reached, condition.motions)):
                raise ValueError(f"conditions.{name} has other episodes in reached or motions than in outcomes")
