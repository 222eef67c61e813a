"""Forward kinematics of any serial arm in plain numpy; `vla.models.kinematics` has that of networks.

Chains are as in `vla.spec.RobotModel`, (J + 1, 7).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike

from vla.spec import Array


def frame_positions(chain: Sequence[Sequence[float]], joints: ArrayLike) -> Array:
    """Return (J + 2, 3) positions [m] of the base, of every joint's frame and of the tool, in the base frame.

    Args:
        chain: as in `vla.spec.RobotModel`, (J + 1, 7).
        joints: (J,) [rad].
    """
    rotation, position = np.eye(3), np.zeros(3)
    positions = [position]
    for frame, angle in zip(chain, [*np.asarray(joints), 0.0], strict=True):
        position = position + rotation @ np.asarray(frame[:3])
        rotation = rotation @ _rotation(frame[3:]) @ _rotation((np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2)))
        positions.append(position)
    return np.array(positions)


def forward_of(chain: Sequence[Sequence[float]]) -> Callable[[Array], tuple[Array, Array]]:
    """Return the function of a chain that `vla.robots.cartesian.Kinematics` needs: joints to pose and Jacobian."""
    links = np.tile(np.eye(4), (len(chain), 1, 1))
    for link, frame in zip(links, chain, strict=True):
        link[:3, :3], link[:3, 3] = _rotation(frame[3:]), frame[:3]

    def forward(joints: Array) -> tuple[Array, Array]:
        pose, frames = np.eye(4), []
        for link, cosine, sine in zip(links[:-1], np.cos(joints), np.sin(joints), strict=True):
            pose = pose @ link
            frames.append(pose)
            turn = np.eye(4)
            turn[:2, :2] = (cosine, -sine), (sine, cosine)
            pose = pose @ turn
        pose = pose @ links[-1]
        axes, origins = np.array(frames)[:, :3, 2], np.array(frames)[:, :3, 3]
        return pose, np.concatenate([np.cross(axes, pose[:3, 3] - origins), axes], 1).T

    return forward


def _rotation(quaternion: ArrayLike) -> Array:
    """Convert a quaternion wxyz of any length to a (3, 3) rotation matrix."""
    w, x, y, z = np.asarray(quaternion, float) / np.linalg.norm(quaternion)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * w * cross + 2 * cross @ cross
