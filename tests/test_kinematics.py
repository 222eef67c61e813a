"""Where the tool is follows from the joints alone, and exactly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from fake_batch import make_batch, make_bc, with_text
from toy import ARM, ARM_SPEC

from vla.models.kinematics import ForwardKinematics
from vla.robots.chain import forward_of
from vla.robots.panda import CHAIN, HOME, JOINT_HIGH, JOINT_LOW, forward
from vla.spec import Spec


@pytest.mark.parametrize("autocast", [False, True])
@pytest.mark.parametrize("gpu", [False, True])
def test_it_is_what_the_controller_calculates(autocast: bool, gpu: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    kinematics = ForwardKinematics(CHAIN)
    if gpu:  # where training rounds products of matrices
        monkeypatch.setattr(torch.Tensor, "is_cuda", True)
        monkeypatch.setattr(torch.Tensor, "__matmul__", None)
    joints = np.random.default_rng(0).uniform(JOINT_LOW, JOINT_HIGH, (2, 50, 7))
    with torch.autocast("cpu", torch.bfloat16, enabled=autocast):
        poses = kinematics(torch.tensor(joints, dtype=torch.float32))
    exact = np.stack([forward(each)[0][:3, [3, 0, 1]].T.reshape(9) for each in joints.reshape(-1, 7)])
    assert poses.shape == (2, 50, ForwardKinematics.WIDTH)
    np.testing.assert_allclose(poses.reshape(-1, 9).numpy(), exact, atol=1e-6)


def with_chain(*frames: tuple[float, ...]) -> Spec:
    return replace(ARM_SPEC, robot=replace(ARM, chain=frames))


def test_a_model_is_told_only_where_the_chain_is_known() -> None:
    without, told = make_bc(spec=with_chain()), make_bc(spec=with_chain(*CHAIN))
    batch = with_text(without, make_batch(1, spec=ARM_SPEC))
    pose = [*range(7), 14]  # of positions, velocities and the opening
    assert torch.equal(without.robot_state(batch), batch["state"][..., pose])
    assert torch.equal(told.robot_state(batch)[..., :8], without.robot_state(batch))
    assert torch.equal(told.robot_state(batch)[..., 8:], ForwardKinematics(CHAIN)(batch["state"][..., :7]))


def test_the_kinematics_of_a_chain_are_those_of_the_panda() -> None:
    of_chain, joints = forward_of(CHAIN), HOME + np.random.default_rng(0).uniform(-0.4, 0.4, (5, 7))
    for each in joints:
        for found, expected in zip(of_chain(each), forward(each), strict=True):
            np.testing.assert_allclose(found, expected, atol=1e-9)


def test_a_chain_travels_and_one_that_is_not_known_is_no_difference() -> None:
    known, unknown = with_chain(*CHAIN), with_chain()
    assert Spec.from_dict(known.to_dict()) == known
    old = unknown.to_dict()
    del old["robot"]["chain"]
    assert Spec.from_dict(old) == unknown
    known.require(unknown, "one", "the other")
    unknown.require(known, "one", "the other")
    with pytest.raises(ValueError, match=r"one has robot\.chain"):
        known.require(with_chain(*CHAIN[:-1]), "one", "the other")
    with pytest.raises(ValueError, match=r"one has robot = an arm, but the other has None"):
        known.require(replace(known, robot=None), "one", "the other")
