"""The judge names what a person would say who watched the episode."""

from __future__ import annotations

import numpy as np

from vla.tasks.goals import Progress
from vla.tasks.outcome import Judge


def step(judge: Judge, height: float = 0.02, held: bool = False, near: bool = True, reached: bool = False) -> None:
    """One step with the named block's centre at `height`."""
    block = np.array([0.5, 0.0, height])
    progress = Progress(block, np.array([0.5, 0, 0.02]), 0.02, 0.0, held, held, np.array([0.4, 0.1, 0.0]))
    tool = block if near else block + 0.2
    judge.watch(progress, reached, tool, [height > 0.04, False], target=0)


def test_success_must_be_held() -> None:
    judge = Judge(hold_steps=3)
    for reached in (True, True, False, True, True):
        step(judge, reached=reached)
    assert not judge.success
    step(judge, reached=True)
    assert judge.outcome == "success"


def test_failures_are_told_apart() -> None:
    judge = Judge(3)
    step(judge, near=False)
    assert judge.outcome == "never_reached"
    step(judge)
    assert judge.outcome == "missed_grasp"
    step(judge, height=0.12, held=True)
    assert judge.outcome == "timeout"
    step(judge, height=0.10, near=False)
    assert judge.outcome == "dropped"
    step(judge, height=0.05, held=True)
    step(judge, height=0.02)
    assert judge.outcome == "not_placed"


def test_lifting_another_block_is_the_wrong_object() -> None:
    judge = Judge(3)
    progress = Progress(np.array([0.5, 0, 0.02]), np.zeros(3), 0.02, 0.0, False, False, np.zeros(3))
    judge.watch(progress, False, np.array([0.5, 0.2, 0.1]), [False, True], target=0)
    assert judge.outcome == "wrong_object"
