"""Classes of the config nodes that tell jobs what to do: as for every node, the fields are the schema.

They are light to import, because a config is checked before its job is.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Annotated, Any, Literal

from annotated_types import Ge, Gt, Lt, MinLen, Predicate

from vla.io.errors import UserError
from vla.io.types import Count, Images, Natural, Quality, Seed, Share, Text, unique
from vla.spec import FIRST_SEED, IN_DISTRIBUTION

if TYPE_CHECKING:
    from vla.data.header import Codec

Changes = dict[str, object]  # overrides of the task node
UnseenSeed = Annotated[Seed, Ge(FIRST_SEED)]
OpenShare = Annotated[float, Gt(0), Lt(1)]

NEAREST = "nearest"  # condition of an evaluation in which a demonstration is replayed


@dataclass(frozen=True)
class Settings:
    """The values at the top of a config, beside its nodes."""

    job: Text
    seed: Seed  # of training
    checkpoint: Text | None  # the policy to use
    pretrained: Text | None  # the policy that initialises a training
    resume: Text | None  # the run to continue
    trust: list[str]
    output: Text
    chosen: dict[str, str | None]  # group → option, for reports


@dataclass(frozen=True)
class Collection:
    """Number and seeds of demonstrations, and the store that holds them."""

    episodes: Count  # successful ones
    seed: Seed  # of the first episode; the others follow it
    folder: Text  # of the store
    more: list[Text] | None  # further stores to train on
    images: Images | None  # codec of a new store; None: the one that suits the size of the images
    quality: Quality  # of JPEG

    @property
    def codec(self) -> Codec | None:
        """Codec of the images of a new store; None: the one that suits their size."""
        from vla.data.header import Codec

        return self.images and Codec(self.images, self.quality if self.images == "jpeg" else None)


@dataclass(frozen=True)
class Validation:
    """Episodes that a policy in training plays in every validation."""

    episodes: Natural  # 0: none
    seed: UnseenSeed  # of the first episode
    changes: Changes  # to the task

    @property
    def seeds(self) -> range:
        """Seeds of the episodes."""
        return range(self.seed, self.seed + self.episodes)


@dataclass(frozen=True)
class Evaluation:
    """Episodes of an evaluation, what they are to decide, and further conditions on the same seeds."""

    episodes: Count  # with `until`, at most
    seed: UnseenSeed  # of the first episode
    until: Literal["decided"] | None  # stop as soon as `bar` and `against` are, and conditions as differences are
    bar: OpenShare | None  # success rate to compare with
    against: Text | None  # run to compare with on the same episodes
    margin: OpenShare  # loss of success that counts as not worse
    recordings: Literal["all", "failures"] | Natural  # episodes to record; failures: also ten successes
    conditions: dict[str, Changes]  # name → overrides of the task
    one_by_one: dict[str, dict[str, Changes]]  # level → overrides of the task, each part of which is a condition
    without: Annotated[list[Literal["images", "instruction", "both"]], Predicate(unique)]  # what the policy lacks
    nearest: Text | None  # store of demonstrations, the most similar one of which is replayed in a condition
    networks: dict[str, Changes]  # nodes of `vla.rollouts.realtime.Network`

    def __post_init__(self) -> None:
        """Raise a UserError if two conditions have the same name."""
        names = [*self.conditions, *(name for name, _ in _split_levels(self.one_by_one))]
        for name, count in Counter([IN_DISTRIBUTION, *names, *self.agent_conditions]).items():
            if count > 1:
                raise UserError(f"evaluate has {count} conditions with the name {name}: rename one")

    @property
    def seeds(self) -> range:
        """Seeds of the episodes."""
        return range(self.seed, self.seed + self.episodes)

    @cached_property
    def changes(self) -> dict[str, dict[str, Any]]:
        """Condition → overrides of the task node."""
        return conditions(self.conditions, self.one_by_one)

    @property
    def agent_conditions(self) -> list[str]:
        """The conditions that change the agent rather than the task."""
        return [*(f"without_{name}" for name in self.without), *self.networks, *([NEAREST] if self.nearest else [])]


@dataclass(frozen=True)
class Rounds:
    """Rounds of `job=improve`, in which the expert labels what the policy sees."""

    rounds: Count
    episodes: Count  # in every round
    seed: Seed  # of the first episode; the others follow it, round by round
    steps: Count  # of training after every round
    changes: Changes  # to the task in these episodes

    @property
    def seeds(self) -> range:
        """Seeds of the episodes of all rounds."""
        return range(self.seed, self.seed + self.rounds * self.episodes)


@dataclass(frozen=True)
class Preview:
    """Episodes of the expert that `job=preview` shows."""

    episodes: Count
    seed: Seed


@dataclass(frozen=True)
class ReportedRuns:
    """Runs that `job=report` compares."""

    runs: list[Text]


@dataclass(frozen=True)
class Power:
    """Success rates that `job=plan` is to tell apart, and with which probability."""

    rates: tuple[OpenShare, OpenShare]
    power: OpenShare  # the probability
    discordant: Share | None  # share of episodes in which only one of two policies succeeds
    runs: tuple[Text, Text] | None  # from which to take that share


@dataclass(frozen=True)
class Inspection:
    """Stores that `job=inspect` verifies and describes, and the new store that it makes of them."""

    folder: Text
    stores: Annotated[list[Text], MinLen(1)] | None  # to merge, instead of `folder`
    where: dict[str, Any] | None  # filter of the episodes of a new store
    repair: bool  # write a store without the damaged episodes
    into: Text | None  # folder of the new store
    episode: Natural | None  # seed of an episode to replay


@dataclass(frozen=True)
class Benchmark:
    """Stages that `job=benchmark` measures, and how often."""

    names: Annotated[list[Literal["collect", "loader", "train", "policy", "evaluate"]], MinLen(1)]
    episodes: Count  # of the expert
    batches: Count  # of windows
    steps: Count  # of training and of the policy
    rounds: Count  # of training, interleaved
    precisions: Annotated[list[Literal["fp32", "bf16"]], MinLen(1)]
    compile: Annotated[list[bool], MinLen(1)]
    peer: dict[str, object] | None  # factory of a function of the model's input, which predicts the same actions


def conditions(together: Mapping[str, Changes], one_by_one: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Return condition → overrides of the task node: those of `together`, then each part of `one_by_one`.

    The latter is level → argument of the task → part → value. A part at a level is named `part_level`, or `part` if all
    levels are equal; it is left out if null at every level.
    """
    return {**together, **dict(_split_levels(one_by_one))}


def _split_levels(one_by_one: Mapping[str, Any]) -> list[tuple[str, dict[str, Any]]]:
    """Return name and overrides of every part; names may repeat."""
    levels: dict[tuple[str, str], dict[str, Any]] = {}
    for level, overrides in one_by_one.items():
        for argument, parts in overrides.items():
            for part, value in parts.items():
                levels.setdefault((argument, part), {})[level] = value
    pairs = list[tuple[str, dict[str, Any]]]()
    for (argument, part), values in levels.items():
        if all(value is None for value in values.values()):
            continue
        if len(values) > 1 and len({repr(value) for value in values.values()}) == 1:
            values = {"": next(iter(values.values()))}
        pairs += [(f"{part}_{level}" if level else part, {argument: {part: value}}) for level, value in values.items()]
    return pairs


def with_changes(node: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return a node merged with changes, key by key; a mapping that names a class replaces the old one."""
    merged = dict(node)
    for name, change in changes.items():
        old = merged.get(name)
        if isinstance(old, Mapping) and isinstance(change, Mapping) and "_target_" not in change:
            change = with_changes(old, change)
        merged[name] = change
    return merged
