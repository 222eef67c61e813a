"""Every axis changes what it should, nothing else, and the same seed draws the same."""

from __future__ import annotations

import copy
from contextlib import nullcontext
from typing import Any

import numpy as np
import pytest
from conftest import make_tabletop

from vla.config.compose import axes
from vla.spec import Array
from vla.tasks.tabletop.environment import Tabletop
from vla.tasks.tabletop.randomize.blocks import Colours, Distractors, Masses, Placement, ShapeName, Shapes
from vla.tasks.tabletop.randomize.robot import Latency
from vla.tasks.world import Streams

DEFAULT = {"distractors", "colour", "size", "mass", "friction", "placement", "arm", "light", "camera", "table"}
# What is asked for, which "naming" changes, is no draw, and a disturbance is no property of the scene.
AXES = sorted({group.rpartition("/")[2] for group in axes()} - {"naming", "disturbance"})
INVISIBLE = {"mass", "friction", "gain", "latency", "phrasing"}  # until something moves, or speaks


@pytest.fixture(scope="module")
def hard() -> Any:
    """The tabletop with every axis at its hardest."""
    environment = make_tabletop("task/randomize=hard")
    yield environment
    environment.close()


def seen(environment: Tabletop, seed: int, **axes: Any) -> tuple[Array, dict[str, Any]]:
    """Both cameras' first images and the draws, with some axes replaced."""
    task = environment.simulation
    kept, task.randomize = task.randomize, {**task.randomize, **axes}
    try:
        images = environment.reset(seed).rgb
        return np.stack(list(images.values())), copy.deepcopy(environment.draws)
    finally:
        task.randomize = kept


def test_the_default_randomises_its_axes_and_records_them(tabletop: Tabletop) -> None:
    tabletop.reset(0)
    assert set(tabletop.draws) == {"named", *DEFAULT, "language"}


def test_the_hardest_randomises_every_axis_that_there_is(hard: Tabletop) -> None:
    hard.reset(0)
    assert set(hard.draws) == {"named", *AXES, "language"}


def test_draws_depend_on_the_seed_alone(hard: Tabletop) -> None:
    first = seen(hard, 4)
    assert seen(hard, 5)[1] != first[1]
    again = seen(hard, 4)
    np.testing.assert_array_equal(again[0], first[0])
    assert again[1] == first[1]


@pytest.mark.parametrize("axis", AXES)
def test_switching_one_axis_off_shows_and_leaves_the_draws_of_all_others(hard: Tabletop, axis: str) -> None:
    (image, full), (without, reduced) = seen(hard, 7), seen(hard, 7, **{axis: None})
    ignored = {axis, "named"} | ({"language"} if axis in ("colour", "distractors", "phrasing") else set())
    for name in set(full) - ignored:
        assert full[name] == reduced[name], name
    assert (image != without).any() == (axis not in INVISIBLE)


def test_without_randomisation_all_episodes_start_alike() -> None:
    environment = make_tabletop("task/randomize=none")
    first, second = environment.reset(0), environment.reset(1)
    np.testing.assert_array_equal(first.rgb["front"], second.rgb["front"])
    np.testing.assert_array_equal(first.state, second.state)
    environment.close()


def test_blocks_and_pads_keep_their_distance(tabletop: Tabletop) -> None:
    with tabletop.blind():
        for seed in range(20):
            tabletop.reset(seed)
            draw: dict[str, Any] = tabletop.draws["placement"]
            centres = np.array([*draw["pads"], *draw["blocks"]])
            distances = np.linalg.norm(centres[:, None] - centres[None], axis=-1)
            assert distances[np.triu_indices(len(centres), 1)].min() > 0.08


def test_what_is_not_there_is_nowhere_to_be_seen(hard: Tabletop) -> None:
    compiled = hard.simulation.compiled
    two, _ = seen(hard, 3, distractors=Distractors((2, 2)))
    assert len(compiled.block_centres()) == 3
    one, draws = seen(hard, 3, distractors=Distractors((1, 1)))
    assert draws["distractors"] == {"count": 1} and len(compiled.block_centres()) == 2
    assert (one != two).any()
    with hard.blind():
        for _ in range(5):
            hard.step(np.zeros(7))
    away = compiled.data.geom_xpos[compiled.block_geoms[2:]]
    assert (away[:, 2] < -2).all() and np.abs(compiled.data.qvel[compiled.block_velocities[2]]) < 1e-6


def test_every_shape_stands_on_the_table_and_weighs_what_its_volume_says() -> None:
    environment = make_tabletop("task/randomize=none")
    expected: dict[ShapeName, float] = {"cube": 8.0, "cylinder": 2 * np.pi, "tall": 8 * 1.25, "flat": 8 * 0.75}
    with environment.blind():
        for name, volume in expected.items():
            environment.simulation.randomize = {"mass": Masses((2.0, 2.0)), "shape": Shapes([name])}
            environment.reset(0)
            compiled = environment.simulation.compiled
            masses = compiled.model.body_mass[compiled.block_bodies[:3]]
            np.testing.assert_allclose(masses, 2 * 600.0 * volume * 0.02**3)  # whatever is drawn first
            start = compiled.block_centres()
            for _ in range(5):
                environment.step(np.array([0, 0, 0, 0, 0, 0, 1.0]))
            assert np.abs(compiled.block_centres() - start).max() < 1e-3
    environment.close()


def test_commands_reach_the_motors_late(tabletop: Tabletop) -> None:
    up = np.array([0, 0, 0.04, 0, 0, 0, 1.0])
    task = tabletop.simulation
    kept, heights = task.randomize, []
    with tabletop.blind():
        for seconds in (0.0, 0.1):
            task.randomize = {**kept, "latency": Latency((seconds, seconds))}
            before = tabletop.reset(0).truth
            after = tabletop.step(up).truth
            assert before is not None and after is not None
            heights.append(float((after["tcp"] - before["tcp"])[2]))
    task.randomize = kept
    assert heights[0] > 0.03 and abs(heights[1]) < 0.002


def test_noise_of_images_is_normal_and_new_in_every_image() -> None:
    environment = make_tabletop("task/randomize=hard", "task.image_size=[64,64]")
    environment.reset(2)
    compiled = environment.simulation.compiled
    clean = environment.renderer.render(compiled.data)[0].astype(float)
    inside = (clean > 60) & (clean < 195)  # where nothing is cut off
    first, second = (np.stack(list(environment.look().rgb.values())) - clean for _ in range(2))
    environment.close()
    deviation = compiled.noise.image
    assert inside.sum() > 2000 and 6 <= deviation <= 15
    for noise in (first[inside], second[inside]):
        assert abs(noise.mean()) < 0.1 * deviation and noise.std() == pytest.approx(deviation, rel=0.06)
        assert (np.abs(noise) < deviation).mean() == pytest.approx(0.683, abs=0.06)
    assert abs(np.corrcoef(first[inside], second[inside])[0, 1]) < 0.1


def test_noise_is_the_same_after_steps_without_images() -> None:
    environment = make_tabletop("task/randomize=hard", "task.image_size=[64,64]")
    seen, action = [], np.array([0.01, 0, 0, 0, 0, 0, 1.0])
    for context in (nullcontext, environment.blind):
        environment.reset(2)
        with context():
            state = environment.step(action).state
        seen.append((state, environment.step(np.zeros(7))))
    compiled = environment.simulation.compiled
    assert 0 < np.abs(seen[1][1].state[:7] - compiled.data.qpos[compiled.joints]).max() < 0.05
    environment.close()
    np.testing.assert_array_equal(seen[0][0], seen[1][0])
    for name in environment.spec.cameras:
        np.testing.assert_array_equal(seen[0][1].rgb[name], seen[1][1].rgb[name])


def test_streams_differ_between_axes_and_seeds() -> None:
    streams = Streams()
    draws = {(seed, axis): streams(seed, axis).normal() for seed in (0, 1, 2**40) for axis in ("size", "mass")}
    assert len(set(draws.values())) == len(draws)
    assert all(Streams()(*place).normal() == draw for place, draw in draws.items())  # whatever was drawn before


def test_bad_axes_are_explained(tabletop: Tabletop) -> None:
    compiled = tabletop.simulation.compiled
    with pytest.raises(ValueError, match=r"task\.blocks=4 needs as many task\.randomize\.colour\.names, not 1"):
        Colours(["red"], jitter=0.0)(compiled, np.random.RandomState(0))
    with pytest.raises(ValueError, match="no room"):
        Placement((0.5, 0.51), (0.0, 0.01), yaw=(0.0, 0.0), clearance=0.03)(compiled, np.random.RandomState(0))
    with pytest.raises(ValueError, match=r"distractors\.count=\[.*, 5\] needs task\.blocks=6 or more"):
        Distractors((1, 5))(compiled, np.random.RandomState(0))
