"""Forward kinematics of any serial arm in plain numpy; `vla.models.kinematics` has the one in torch.

Chains are as in `vla.spec.RobotModel`, (J + 1, 7).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike

from vla.spec import Array


def forward_of(chain: Sequence[Sequence[float]]) -> Callable[[Array], tuple[Array, Array]]:
    """Return the function of a chain that `vla.robots.cartesian.Kinematics` needs: joints to pose and Jacobian."""
    links = _links(chain)

    def forward(joints: Array) -> tuple[Array, Array]:
        frames = _frames(links, joints)
        pose = frames[-1]
        (ax, ay, az), (x, y, z) = frames[:-1, :3, 2].T, pose[:3, 3:] - frames[:-1, :3, 3].T
        # Axis cross lever arm, written out because np.cross takes half as long as everything else here.
        return pose, np.stack([ay * z - az * y, az * x - ax * z, ax * y - ay * x, ax, ay, az], 1).T

    return forward


def _links(chain: Sequence[Sequence[float]]) -> Array:
    """Return the (J + 1, 4, 4) transforms of a chain."""
    links = np.tile(np.eye(4), (len(chain), 1, 1))
    for link, frame in zip(links, chain, strict=True):
        link[:3, :3], link[:3, 3] = _rotation(frame[3:]), frame[:3]
    return links


def _frames(links: Array, joints: ArrayLike) -> Array:
    """Return the (J + 1, 4, 4) poses of every joint's frame, without its own rotation, and of the tool."""
    frames = [links[0]]
    for link, cosine, sine in zip(links[1:], np.cos(joints), np.sin(joints), strict=True):
        turn = np.eye(4)
        turn[:2, :2] = (cosine, -sine), (sine, cosine)
        frames.append(frames[-1] @ turn @ link)
    return np.array(frames)


def _rotation(quaternion: ArrayLike) -> Array:
    """Convert a quaternion wxyz of any length to a (3, 3) rotation matrix."""
    w, x, y, z = np.asarray(quaternion, float) / np.linalg.norm(quaternion)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * w * cross + 2 * cross @ cross
