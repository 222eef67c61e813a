"""The room that the hand needs, and how far it reaches."""

from __future__ import annotations

import numpy as np

from vla.spec import Array
from vla.tasks.libero.situation import PALM, Situation

HAND = 0.10  # half of the width of the hand over the fingers [m]
CLEAR = 0.045  # distance between a finger or the hand and anything else [m]
ARM = (0.34, 0.75)  # horizontal distances from the base between which the arm neither folds up nor stretches [m]


def clearance(spots: Array, yaws: Array, obstacles: Array, leans: Array | float = 0.0) -> Array:
    """Return the horizontal distances (K,) [m], 1 at most, of the nearest point from hand and fingers, gap included.

    Args:
        spots: (K, 3) of the point between the fingertips [m].
        yaws: (K,) of the fingers [rad].
        obstacles: points (N, 3) on what must not be touched [m].
        leans: (K,) of the hand about the axis along which the fingers close [rad].
    """
    obstacles = obstacles[obstacles[:, 2] > spots[:, 2].min() - 0.02]
    offset = obstacles[None, :, :2] - spots[:, None, :2]
    sine, cosine = np.sin(yaws)[:, None], np.cos(yaws)[:, None]
    closing_offset = np.abs(offset[..., 1] * cosine - offset[..., 0] * sine)
    heights = obstacles[:, 2] - spots[:, 2:]
    shift = np.tan(np.broadcast_to(leans, len(spots)))[:, None] * np.maximum(heights, 0)
    cross_offset = np.abs(offset[..., 0] * cosine + offset[..., 1] * sine + shift)
    hand = np.where(heights > PALM, np.hypot(np.maximum(closing_offset - HAND, 0), cross_offset), 1.0)
    fingers = np.where(heights > -0.02, np.hypot(np.maximum(closing_offset - 0.05, 0), cross_offset), 1.0)
    return np.minimum(hand, fingers).min(axis=1, initial=1.0)


def reach_costs(situation: Situation, spots: Array) -> Array:
    """Return costs (K,) of places (K, 3) [m] for which the arm must stretch or fold up."""
    distance = np.linalg.norm(spots[:, :2] - situation.base[:2], axis=1)
    return 3 * np.maximum(0, np.maximum(distance - ARM[1], ARM[0] - distance))


def axes(yaw: float) -> tuple[Array, Array]:
    """Return the horizontal directions (2,) in which the fingers close, and across it."""
    return np.array([-np.sin(yaw), np.cos(yaw)]), np.array([np.cos(yaw), np.sin(yaw)])
