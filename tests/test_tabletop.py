"""The simulated task: reproducible, physical, and what its spec says."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from conftest import make_tabletop
from replaying import played, same

from vla.tasks.tabletop.environment import Tabletop
from vla.tasks.tabletop.robot import look_at


def test_observations_are_what_the_spec_says(tabletop: Tabletop) -> None:
    observation = tabletop.reset(3)
    spec = tabletop.spec
    for camera in spec.cameras:
        assert observation.rgb[camera].shape == (*spec.image_size, 3) and observation.rgb[camera].dtype == np.uint8
        assert observation.depth[camera].shape == spec.image_size and observation.depth[camera].dtype == np.uint16
    assert tabletop.task == "pick_place" and tabletop.milestones == frozenset()
    assert observation.state.shape == (15,) == (len(spec.state),) and observation.state.dtype == np.float32
    assert observation.truth is not None
    assert {name: observation.truth[name].size for name, _ in spec.truth} == dict(spec.truth)


def test_the_same_seed_and_actions_give_the_same_episode_bit_for_bit(tabletop: Tabletop) -> None:
    first = played(tabletop, 11, 8)
    played(tabletop, 12, 1)  # another episode in between leaves nothing behind
    assert same(played(tabletop, 11, 8), first)
    fresh = make_tabletop()
    assert same(played(fresh, 11, 8), first)
    fresh.close()


def test_depth_is_the_distance_along_the_optical_axis() -> None:
    """The table, seen through the middle of the image, lies where the camera's geometry puts it."""
    environment = make_tabletop("task/randomize=none")
    environment.reset(0)
    compiled = environment.simulation.compiled
    # Look at bare table, far from everything.
    position, spot = np.array([0.9, -0.6, 0.5]), np.array([0.7, -0.6, 0.0])
    camera = compiled.cameras["front"]
    compiled.model.cam_pos[camera] = position
    quaternion = np.empty(4)
    mujoco.mju_mat2Quat(quaternion, look_at(position, spot, (0, 0, 1)).ravel())
    compiled.model.cam_quat[camera] = quaternion
    mujoco.mj_forward(compiled.model, compiled.data)
    depth = environment.look().depth["front"]
    height, width = depth.shape
    middle = depth[height // 2 - 1 : height // 2 + 1, width // 2 - 1 : width // 2 + 1].mean()
    assert middle == pytest.approx(1000 * np.linalg.norm(position - spot), abs=3)
    environment.close()


def test_blocks_rest_and_the_arm_holds_still(tabletop: Tabletop) -> None:
    """Resizing and reweighing blocks must not make physics explode: nothing moves when nobody moves."""
    with tabletop.blind():
        for seed in range(10):
            tabletop.reset(seed)
            compiled = tabletop.simulation.compiled
            start = compiled.block_centres()
            joints = compiled.data.qpos[compiled.joints].copy()
            for _ in range(10):
                tabletop.step(np.array([0, 0, 0, 0, 0, 0, 1.0]))
            assert np.abs(compiled.block_centres() - start).max() < 1e-3
            assert np.abs(compiled.data.qpos[compiled.joints] - joints).max() < 1e-3


def test_the_arm_follows_what_is_commanded(tabletop: Tabletop) -> None:
    with tabletop.blind():
        tabletop.reset(0)
        for _ in range(4):
            truth = tabletop.step(np.array([0.02, 0.02, 0.02, 0, 0, 0.1, 1.0])).truth
            assert truth is not None
            assert np.linalg.norm(truth["commanded"][:3, 3] - truth["tcp"]) < 0.004


def test_an_episode_without_success_ends_at_the_time_limit_and_says_why(tabletop: Tabletop) -> None:
    with tabletop.blind():
        tabletop.reset(5)
        steps = 0
        while not tabletop.done:
            tabletop.step(np.array([0, 0, 0, 0, 0, 0, 1.0]))
            steps += 1
    assert steps == pytest.approx(100, abs=1)  # 10 s at 10 Hz
    assert tabletop.outcome == "never_reached"
    with pytest.raises(ValueError, match="reset"):
        tabletop.step(np.zeros(7))


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["task.blocks=7"], r"task\.blocks must be from 2 to 6"),
        (["task.blocks=6", "task/goal=stay"], r"task\.blocks must be from 2 to 5"),
        # An impossible instruction names a colour that neither a block nor the held-out part has.
        (["task.blocks=5", "task/goal=mixed", "task.goal.impossible=0.1"], r"task\.blocks must be from 3 to 4"),
    ],
)
def test_what_the_scene_cannot_have_is_refused(overrides: list[str], message: str) -> None:
    with pytest.raises(Exception, match=message):
        make_tabletop(*overrides)


def test_shapes_and_poses_describe_the_scene(tabletop: Tabletop) -> None:
    tabletop.reset(0)
    shapes, poses = tabletop.shapes(), tabletop.poses()
    assert {shape.body for shape in shapes} <= set(poses)
    assert {"mesh", "box", "cylinder"} == {shape.kind for shape in shapes}
    names = [*poses, *(shape.name for shape in shapes)]
    assert not any(name.endswith("/") or "//" in name for name in names)  # nothing is of PyMJCF's own
    block = next(shape for shape in shapes if shape.name == "block0")
    assert block.size[0] == pytest.approx(tabletop.draws["size"]["half_size"][0], abs=1e-4)


def test_the_robot_can_be_drawn_with_all_its_faces(tabletop: Tabletop) -> None:
    full = make_tabletop("task.meshes=full")
    faces = [sum(len(shape.faces) for shape in env.shapes() if shape.faces is not None) for env in (tabletop, full)]
    assert faces[0] < 5_000 and faces[1] > 100_000
    np.testing.assert_array_equal(full.reset(0).state, tabletop.reset(0).state)
    full.close()
