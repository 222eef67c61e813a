"""The page on Python: its programs run one after the other, and trust is an argument."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path

import numpy as np
import pytest
from documented import ROOT

from vla.api import load_environment, load_policy
from vla.config import packages
from vla.envs.gym import GymEnvironment
from vla.policy import Policy
from vla.spec import Observation

PAGE = (ROOT / "docs/python.md").read_text(encoding="utf-8")
CHECKPOINT = "run"


def test_the_page_is_short_and_its_programs_run(
    home: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert len(PAGE.splitlines()) <= 80
    monkeypatch.chdir(home)
    store = next(path for path in home.rglob("index.jsonl")).parent
    names: dict[str, object] = {}
    blocks = re.findall(r"^```python\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL)
    assert len(blocks) == 3
    for block in blocks:
        exec(block.replace("RUN", "run").replace("STORE", str(store)), names)
    assert (home / "loss.png").stat().st_size > 10_000
    printed = capsys.readouterr().out
    assert re.search(r" of \d+, \d+-\d+ %", printed) and "Dict(" in printed and len(printed) < 5000
    world, policy = names["world"], names["policy"]
    assert isinstance(world, GymEnvironment) and isinstance(policy, Policy)
    world.close()
    with pytest.raises(ValueError, match=r"^the observation has state, but lacks front, wrist, instruction$"):
        policy.act({"state": np.zeros(3)})


def test_the_policy_acts_in_the_world_as_it_was_evaluated(home: Path) -> None:
    policy, world = load_policy(home / CHECKPOINT), load_environment(home / CHECKPOINT)
    observation, _ = world.reset(seed=1_000_000)
    policy.reset(observation["instruction"], 1_000_000)
    same = Observation.from_mapping(observation, policy.spec)
    acted = policy.act(observation)
    policy.reset(observation["instruction"], 1_000_000)
    np.testing.assert_array_equal(acted, policy.act(same))
    observation, _ = world.reset(seed=1_000_000)
    policy.reset(observation["instruction"], 1_000_000)
    steps, over = 0, False
    while not over:
        observation, _, terminated, truncated, _ = world.step(policy.act(observation))
        steps, over = steps + 1, terminated or truncated
    first = json.loads((home / "run/report.json").read_text())["per_episode"][0]
    assert (world.environment.outcome, steps) == (first["outcome"], first["steps"])
    world.close()
    changed = load_environment(home / CHECKPOINT, changes={"time_limit": 0.1})
    changed.reset(seed=1_000_000)
    assert changed.step(acted)[3]  # truncated
    changed.close()


def test_trust_is_an_argument_of_packages(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(packages.TRUSTED, "")
    for load in (load_policy, load_environment):
        with pytest.raises(
            ValueError, match=r"^trust cannot name 'torch': give the name by which a package is imported"
        ):
            load(home / CHECKPOINT, trust=["torch"])
        with pytest.raises(ValueError, match=r"^trust must be a list of packages"):
            load(home / CHECKPOINT, trust="documented")
    load_policy(home / CHECKPOINT, trust=["documented"])  # without a distribution, as a module of one's own
    assert os.environ[packages.TRUSTED] == ""
