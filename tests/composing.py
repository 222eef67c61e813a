"""The configuration, composed as the command line composes it."""

from __future__ import annotations

import os
from copy import deepcopy
from functools import cache
from unittest.mock import patch

from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig, OmegaConf

from vla import jobs
from vla.config import check as checking
from vla.config.annotations import packages as packages_in
from vla.config.compose import CONF as CONF
from vla.config.compose import compose, offer_axes
from vla.config.experiment import Experiment, to_plain
from vla.config.packages import TRUSTED, trusted_names

offer_axes()


def composed(*overrides: str) -> DictConfig:
    """What the command line composes.

    Composing takes half a second, so options are composed once, and values set in a copy, as Hydra does it last.
    """
    values = [override for override in overrides if _is_value(override)]
    config = deepcopy(_composed_once(tuple(override for override in overrides if override not in values)))
    for override in OverridesParser.create().parse_overrides(values):
        OmegaConf.update(config, override.key_or_group, override.value(), merge=True)
    return config


def check(config: DictConfig) -> None:
    """Check a configuration as the command line does, for its job, with trust in the packages that it uses."""
    nodes = to_plain(config)
    used = packages_in(nodes)
    with patch.dict(os.environ, {TRUSTED: ",".join([*trusted_names(), *used])}):
        checking.check(Experiment(nodes), jobs.find(config.job))


def _is_value(override: str) -> bool:
    key = override.partition("=")[0]
    composing = key == "variant" or key.startswith("hydra") or "/" in key or (CONF / key).is_dir()
    return key[0] not in "+~" and not composing


@cache
def _composed_once(overrides: tuple[str, ...]) -> DictConfig:
    return compose("output=outputs/runs/now", *overrides)


def run_job(config: DictConfig) -> None:
    """Check and run a job as the command line does."""
    check(config)
    jobs.run(Experiment.from_config(config))
