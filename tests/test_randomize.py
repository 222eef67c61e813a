"""Every axis changes what it should, nothing else, and the same seed draws the same."""

from __future__ import annotations

import copy
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from conftest import make_tabletop

from vla.tasks.randomize import Colours, Placement, stream

if TYPE_CHECKING:
    from vla.tasks.tabletop import Tabletop

AXES = ("colour", "size", "mass", "friction", "placement", "arm", "light", "camera", "table")
VISIBLE = set(AXES) - {"mass", "friction"}


def test_the_default_randomises_every_axis_and_records_it(tabletop: Tabletop) -> None:
    tabletop.reset(0)
    assert set(tabletop.draws) == {"named", *AXES, "language"}


def test_draws_depend_on_the_seed_alone(tabletop: Tabletop) -> None:
    with tabletop.blind():
        tabletop.reset(4)
        first = copy.deepcopy(tabletop.draws)
        tabletop.reset(5)
        assert tabletop.draws != first
        tabletop.reset(4)
    assert tabletop.draws == first


@pytest.mark.parametrize("axis", AXES)
def test_switching_one_axis_off_leaves_the_draws_of_all_others(tabletop: Tabletop, axis: str) -> None:
    tabletop.reset(7)
    full, image = copy.deepcopy(tabletop.draws), tabletop.reset(7).rgb["front"]
    task = tabletop.task
    kept, task.randomize = task.randomize, {**task.randomize, axis: None}
    try:
        without = tabletop.reset(7).rgb["front"]
        reduced = copy.deepcopy(tabletop.draws)
    finally:
        task.randomize = kept
    ignored = {axis, "named"} | ({"language"} if axis == "colour" else set())  # the instruction names a colour
    if axis == "size":
        ignored |= {"placement"}  # room around a block depends on its size
    assert {name: draw for name, draw in full.items() if name not in ignored} == {
        name: draw for name, draw in reduced.items() if name not in ignored
    }
    assert (image != without).any() == (axis in VISIBLE)


def test_without_randomisation_all_episodes_start_alike() -> None:
    environment = make_tabletop("randomize=none")
    first, second = environment.reset(0), environment.reset(1)
    np.testing.assert_array_equal(first.rgb["front"], second.rgb["front"])
    np.testing.assert_array_equal(first.joints, second.joints)
    environment.close()


def test_blocks_and_pad_keep_their_distance(tabletop: Tabletop) -> None:
    with tabletop.blind():
        for seed in range(20):
            tabletop.reset(seed)
            draw: dict[str, Any] = tabletop.draws["placement"]
            centres = np.array([draw["pad"], *draw["blocks"]])
            distances = np.linalg.norm(centres[:, None] - centres[None], axis=-1)
            assert distances[np.triu_indices(len(centres), 1)].min() > 0.08


def test_streams_differ_between_axes_and_seeds() -> None:
    draws = {(seed, axis): stream(seed, axis).uniform() for seed in (0, 1, 2**40) for axis in ("size", "mass")}
    assert len(set(draws.values())) == len(draws)


def test_bad_axes_are_explained(tabletop: Tabletop) -> None:
    with pytest.raises(ValueError, match=r"unknown colours \['mauve'\]"):
        Colours(["mauve"])
    with pytest.raises(ValueError, match="3 blocks need as many colours"):
        Colours(["red"])(tabletop.task.bound, np.random.RandomState(0))
    with pytest.raises(ValueError, match="no room"):
        Placement((0.5, 0.51), (0.0, 0.01))(tabletop.task.bound, np.random.RandomState(0))
