"""Where the tool is follows from the joints alone, and exactly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from fake_batch import make_batch, make_bc, with_text
from toy import SPEC

from vla.models.kinematics import ForwardKinematics
from vla.spec import Spec
from vla.tasks.control import JOINT_HIGH, JOINT_LOW, forward
from vla.tasks.franka import CHAIN


@pytest.mark.parametrize("autocast", [False, True])
def test_it_is_what_the_controller_calculates(autocast: bool) -> None:
    joints = np.random.default_rng(0).uniform(JOINT_LOW, JOINT_HIGH, (2, 50, 7))
    with torch.autocast("cpu", torch.bfloat16, enabled=autocast):
        poses = ForwardKinematics(CHAIN)(torch.tensor(joints, dtype=torch.float32))
    exact = np.stack([forward(each)[0][:3, [3, 0, 1]].T.reshape(9) for each in joints.reshape(-1, 7)])
    assert poses.shape == (2, 50, ForwardKinematics.WIDTH)
    np.testing.assert_allclose(poses.reshape(-1, 9).numpy(), exact, atol=1e-6)


def test_a_model_is_told_only_where_the_chain_is_known() -> None:
    batch = with_text(make_bc(), make_batch(1))
    without, told = make_bc(spec=replace(SPEC, chain=())), make_bc(spec=replace(SPEC, chain=CHAIN))
    joints = [*range(7), 14]  # of positions, velocities and the opening
    assert torch.equal(without.posture(batch), batch["proprio"][..., joints])
    assert torch.equal(told.posture(batch)[..., :8], without.posture(batch))
    assert torch.equal(told.posture(batch)[..., 8:], ForwardKinematics(CHAIN)(batch["proprio"][..., :7]))


def test_a_chain_travels_and_one_that_is_not_known_is_no_difference() -> None:
    known, unknown = replace(SPEC, chain=CHAIN), replace(SPEC, chain=())
    assert Spec.from_dict(known.to_dict()) == known
    old = unknown.to_dict()
    del old["chain"]
    assert Spec.from_dict(old) == unknown
    known.require(unknown, "one", "the other")
    unknown.require(known, "one", "the other")
    with pytest.raises(ValueError, match="one has chain"):
        known.require(replace(SPEC, chain=CHAIN[:-1]), "one", "the other")
