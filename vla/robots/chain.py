"""Forward kinematics of any serial arm in plain numpy; `vla.models.kinematics` has the one in torch.

Chains are as in `vla.spec.RobotModel`, (J + 1, 7). Shapes: J joints.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike

from vla.spec import Array


def forward_of(chain: Sequence[Sequence[float]]) -> Callable[[Array], tuple[Array, Array]]:
    """Return the function of a chain that `vla.robots.cartesian.Kinematics` needs: joints to pose and Jacobian."""
    links = np.tile(np.eye(4), (len(chain), 1, 1))
    for link, frame in zip(links, chain, strict=True):
        link[:3, :3], link[:3, 3] = _rotation(frame[3:]), frame[:3]
    return forward_through(links)


def forward_through(links: Array) -> Callable[[Array], tuple[Array, Array]]:
    """Return this function of transforms (J + 1, 4, 4): before each joint, which rotates about z, and to the tool."""
    fixed, tool = links[:-1], links[-1]
    x_axes, y_axes = fixed[:, :, 0], fixed[:, :, 1]

    def forward(joints: Array) -> tuple[Array, Array]:
        cosine, sine = np.cos(joints)[:, None], np.sin(joints)[:, None]
        frames = fixed.copy()
        frames[:, :, 0], frames[:, :, 1] = cosine * x_axes + sine * y_axes, cosine * y_axes - sine * x_axes
        for index in range(1, len(frames)):
            frames[index] = frames[index - 1].dot(frames[index])  # half the time of np.matmul for such small matrices
        pose = frames[-1] @ tool
        # A joint's own rotation changes neither its axis nor its origin.
        (ax, ay, az), (x, y, z) = frames[:, :3, 2].T, pose[:3, 3:] - frames[:, :3, 3].T
        # Axis cross lever arm, written out because np.cross would take longer than everything else here.
        return pose, np.array([ay * z - az * y, az * x - ax * z, ax * y - ay * x, ax, ay, az])

    return forward


def _rotation(quaternion: ArrayLike) -> Array:
    """Convert a quaternion wxyz of any length to a (3, 3) rotation matrix."""
    w, x, y, z = np.asarray(quaternion, float) / np.linalg.norm(quaternion)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * w * cross + 2 * cross @ cross
