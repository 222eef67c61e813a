"""Time of an episode, length of the tool's path, and its smoothness."""

from __future__ import annotations

from dataclasses import dataclass
from math import log

import numpy as np

from vla.spec import Array, Episode


@dataclass(frozen=True)
class Motion:
    """Motion of an episode; less of each is better: duration, path length and jerk."""

    time_s: float
    path_m: float | None = None  # of the tool; None if the world does not tell where it is
    jerk: float | None = None  # see `log_dimensionless_jerk`


AMOUNTS = {"time_s": "time [s]", "path_m": "path [m]", "jerk": "log jerk"}  # field of `Motion` → head of a table


def motion_of(episode: Episode, control_hz: float) -> Motion:
    """Measure an episode; `control_hz` is the number of its steps per second."""
    seconds = round(len(episode.observations) / control_hz, 4)
    if episode.tool is None:
        return Motion(seconds)
    path, jerk = path_length(episode.tool), log_dimensionless_jerk(episode.tool, control_hz)
    return Motion(seconds, round(path, 5), None if jerk is None else round(jerk, 4))


def path_length(positions: Array) -> float:
    """Return the length [m] of the polyline through positions (T, 3) [m]."""
    return float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum())


def log_dimensionless_jerk(positions: Array, hz: float) -> float | None:
    """Return ln(D³ / v² ∫ |jerk|² dt), with duration D and peak speed v; None below four positions, or without jerk.

    N. Hogan, D. Sternad, "Sensitivity of smoothness measures to movement duration, amplitude, and arrests", Journal of
    Motor Behavior 41 (2009). It depends neither on the size nor on the pace of a motion, and grows with every stop and
    tremor; the smoothest motion from rest to rest has ln 204.8 = 5.3. Its negative is the measure of smoothness of
    S. Balasubramanian et al., "On the analysis of movement smoothness", Journal of NeuroEngineering and Rehabilitation
    12 (2015). Derivatives are differences, so what happens between two positions does not count.

    Positions are (T, 3) [m], `hz` of them per second.
    """
    speed = float(np.linalg.norm(np.diff(positions, axis=0), axis=1).max(initial=0.0)) * hz
    if len(positions) < 4 or speed == 0:
        return None
    jerk = np.diff(positions, 3, axis=0) * hz**3
    squared = float(np.square(jerk).sum()) / hz
    return log(((len(positions) - 1) / hz) ** 3 / speed**2 * squared) if squared else None
