"""`job=survey`: what is measured at the start of episodes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from vla.config.build import Group, build
from vla.config.check import Job
from vla.config.experiment import Experiment
from vla.io.types import Count, Positive, Seed
from vla.spec import Observation


class Metric(Protocol):
    """A number of an observation."""

    def measure(self, observation: Observation) -> float:
        """Measure an observation."""
        ...


class Distance:
    """Distance of the point from its target.

    Args:
        unit: of the distance [m].
    """

    def __init__(self, unit: Positive) -> None:
        self._unit = unit

    def measure(self, observation: Observation) -> float:
        """Measure the first observation of an episode."""
        assert observation.truth is not None
        return float(np.linalg.norm(observation.truth["target"] - observation.state)) / self._unit


@dataclass(frozen=True)
class Survey:
    """Episodes whose start is measured."""

    episodes: Count
    seed: Seed


METRIC = Group("metric", ("mypackage.survey.Metric",))
JOB = Job(("task", METRIC, Group("survey", ("mypackage.survey.Survey",))))


def run(experiment: Experiment) -> float:
    """Print and return the mean over the episodes."""
    environment, metric = experiment.make_environment()(), build(experiment["metric"], METRIC)
    survey = experiment.options(Survey)
    seeds = range(survey.seed, survey.seed + survey.episodes)
    mean = float(np.mean([metric.measure(environment.reset(seed)) for seed in seeds]))
    environment.close()
    print(f"mean {mean:.3f}")
    return mean
