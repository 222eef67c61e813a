"""The state of a robot as models use it, and forward kinematics of a serial arm."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from vla.models.layers import Batch, exact_product
from vla.spec import Spec


class RobotState(nn.Module):
    """The robot state without rates of change, and with the pose of the tool if the kinematics are known.

    Velocities are left out because a policy that observes them learns that an arm at rest stays at rest.

    Args:
        spec: observation and action spaces.
    """

    pose: Tensor  # indices of the state components that are not rates
    joints: Tensor  # indices of the joint positions in the state

    def __init__(self, spec: Spec) -> None:
        super().__init__()
        robot = spec.robot
        self.kinematics = ForwardKinematics(robot.chain) if robot and robot.chain else None
        joints = spec.indices(robot.joints) if robot else []
        for name, indices in (("pose", spec.pose), ("joints", joints)):
            self.register_buffer(name, torch.tensor(indices, dtype=torch.long), persistent=False)
        self.width = len(spec.pose) + (ForwardKinematics.WIDTH if self.kinematics else 0)

    def forward(self, batch: Batch) -> Tensor:
        """Return (B, T, width), given (B, T, P) "state"."""
        pose = batch["state"].index_select(-1, self.pose)
        if self.kinematics is None:
            return pose
        return torch.cat([pose, self.kinematics(batch["state"].index_select(-1, self.joints))], -1)


class ForwardKinematics(nn.Module):
    """Pose of the tool in the base frame, by multiplying the transforms of a chain of revolute joints.

    A network that learned it from the joint angles of a hundred demonstrations was off by centimetres.

    Args:
        chain: (J + 1, 7) poses of the joint frames and, last, of the tool frame, each in the frame before it: offset
            [m] and quaternion wxyz. Joints rotate about their z axis.
    """

    fixed: Tensor  # (J, 4, 4), the transform of a joint is this + cos·cosine + sin·sine
    cosine: Tensor
    sine: Tensor
    WIDTH = 9  # of the output

    def __init__(self, chain: tuple[tuple[float, ...], ...]) -> None:
        super().__init__()
        rows = torch.tensor(chain, dtype=torch.float64)
        # Not torch.eye, which would import PyTorch's compiler within a `TensorBudget`.
        links = torch.zeros(len(rows), 4, 4, dtype=torch.float64)
        links[:, :3, :3], links[:, :3, 3], links[:, 3, 3] = _rotation(rows[:, 3:]), rows[:, :3], 1
        fixed, cosine, sine = (torch.zeros(len(rows) - 1, 4, 4, dtype=torch.float64) for _ in range(3))
        fixed[:, :, 2:] = links[:-1, :, 2:]
        cosine[:, :, :2] = links[:-1, :, :2]
        sine[:, :, 0], sine[:, :, 1] = links[:-1, :, 1], -links[:-1, :, 0]
        for name, part in (("fixed", fixed), ("cosine", cosine), ("sine", sine)):
            part[-1] = part[-1] @ links[-1]  # the tool moves with the last joint
            self.register_buffer(name, part.float(), persistent=False)

    def forward(self, joints: Tensor) -> Tensor:
        """Map (…, J) joint positions [rad] to (…, 9): position [m] and x and y axes of the tool, float32."""
        angles = joints.float()[..., None, None]
        transforms = self.fixed + angles.cos() * self.cosine + angles.sin() * self.sine  # (…, J, 4, 4)
        while (count := transforms.shape[-3]) > 1:  # all products of neighbours at once
            # In bfloat16 the error would be millimetres.
            pairs = exact_product(transforms[..., 0 : count - 1 : 2, :, :], transforms[..., 1:count:2, :, :])
            transforms = torch.cat([pairs, transforms[..., count - 1 :, :, :]], -3) if count % 2 else pairs
        pose = transforms[..., 0, :3, :]
        return torch.cat([pose[..., 3], pose[..., 0], pose[..., 1]], -1)


def _rotation(quaternions: Tensor) -> Tensor:
    """Convert (N, 4) quaternions wxyz of any length to (N, 3, 3) rotation matrices."""
    w, x, y, z = (quaternions / quaternions.norm(dim=-1, keepdim=True)).unbind(-1)
    rows = [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)]
    rows += [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)]
    rows += [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]
    return torch.stack(rows, -1).unflatten(-1, (3, 3))
