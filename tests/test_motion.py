"""Time, path and jerk: of motions whose answers are known, of a world that tells its tool, and compared."""

from __future__ import annotations

from dataclasses import replace
from math import log
from pathlib import Path

import numpy as np
import pytest
import toy

from vla.reports.evaluation import write_report
from vla.reports.run_page import write_page
from vla.rollouts.comparison import SUCCESS, compare_conditions
from vla.rollouts.evaluate import evaluate
from vla.rollouts.motion import Motion, log_dimensionless_jerk, path_length
from vla.rollouts.results import Report
from vla.runs.folder import read_run
from vla.spec import FIRST_SEED, Array

SEEDS = range(FIRST_SEED, FIRST_SEED + 20)


class Traced(toy.ToyEnvironment):
    """The toy world, which tells where its point is."""

    @property
    def tool(self) -> Array:
        return np.array([*self._point, 0.0])


def a_minimum_jerk_motion(duration: float, length: float, hz: float) -> Array:
    share = np.arange(round(duration * hz) + 1) / round(duration * hz)
    return length * np.outer(10 * share**3 - 15 * share**4 + 6 * share**5, [0.6, 0.0, 0.8])


def test_the_smoothest_motion_has_the_known_jerk_at_any_size_and_pace() -> None:
    # ∫ jerk² = 720 L² / D⁵ and v = 15/8 L / D
    for duration, length in ((2.0, 0.3), (9.0, 1.0)):
        positions = a_minimum_jerk_motion(duration, length, 500.0)
        assert log_dimensionless_jerk(positions, 500.0) == pytest.approx(log(720 / (15 / 8) ** 2), abs=0.02)
        assert path_length(positions) == pytest.approx(length)
    stop = np.concatenate([positions, np.repeat(positions[-1:], 500, axis=0)])
    assert (log_dimensionless_jerk(stop, 500.0) or 0) > (log_dimensionless_jerk(positions, 500.0) or 0) + 0.3
    assert log_dimensionless_jerk(positions[:3], 500.0) is None
    assert log_dimensionless_jerk(np.zeros((9, 3)), 10.0) is None


def test_every_world_has_a_time_and_one_with_a_tool_a_path() -> None:
    plain = evaluate(toy.make_environment, toy.make_expert, None, SEEDS[:2])
    assert [result.motion for result in plain.results] == [Motion(result.steps / 10) for result in plain.results]
    assert list(plain.medians) == ["time_s"] and "medians of the successes, 95 % CI: time [s] " in str(plain)
    motion = evaluate(Traced, toy.make_expert, None, SEEDS[:1]).results[0].motion
    assert motion is not None and motion.path_m is not None and motion.jerk is not None
    environment = Traced()
    environment.reset(SEEDS[0])
    apart = float(np.linalg.norm(environment._target - environment._point))
    assert apart - 0.02 < motion.path_m < 2 * apart


def test_conditions_are_compared_in_motion_and_milestones(tmp_path: Path) -> None:
    first = evaluate(Traced, toy.make_expert, None, SEEDS)
    slow = Report(
        tuple(
            replace(each, milestones=(), motion=replace(each.motion, time_s=each.motion.time_s + 0.5))
            for each in first.results
            if each.motion
        )
    )
    reports = {"seen": first, "slow": slow}
    compared = compare_conditions(reports, 0.02)
    found = compared["slow"]
    assert {name: each.verdict for name, each in found.items()} == {
        **{SUCCESS: "open", "time_s": "more", "near": "less"},
        **{"path_m": "open", "jerk": "open"},
    }
    assert (found["time_s"].difference, found["time_s"].episodes) == (pytest.approx(0.5), first.successes)
    stayed = Report(tuple(replace(each, task="stay", milestones=()) for each in first.results))
    assert "near" not in compare_conditions({"seen": first, "empty": stayed}, 0.02)["empty"]  # another task
    # Pairs that never differ cannot find anything: of four comparisons two count.
    assert found["near"].p_holm == pytest.approx(2 * found["near"].p)
    write_report(first, tmp_path / "report.json", None, {}, None, {"slow": slow}, compared)
    read = read_run(tmp_path)
    assert [each.motion for each in read.reports["slow"].results] == [each.motion for each in slow.results]
    assert read.report is not None and read.reports["seen"].medians == first.medians
    assert read.report.conditions["slow"].compared == found
    page = write_page(tmp_path).read_text()
    assert "+0.5 * (" in page and "log jerk" in page and "-100.0 * (" in page
