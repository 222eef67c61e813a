"""Control steps per second of robosuite's Lift with a Panda and two RGB-D cameras; needs robosuite and nothing of vla.

python robosuite_lift.py HEIGHT WIDTH SECONDS      prints the rate
"""

from __future__ import annotations

import sys
import time

import numpy as np
import robosuite


def steps_per_second(height: int, width: int, seconds: float) -> float:
    """Return the rate with random actions at 20 Hz and a soft reset every 100 steps, after five steps of warm-up."""
    environment = robosuite.make(
        "Lift",
        robots="Panda",
        has_renderer=False,
        has_offscreen_renderer=True,
        use_camera_obs=True,
        camera_names=["frontview", "robot0_eye_in_hand"],
        camera_heights=height,
        camera_widths=width,
        camera_depths=True,
        control_freq=20,
        hard_reset=False,
        horizon=10_000,
    )
    low, high = environment.action_spec
    random = np.random.default_rng(0)
    environment.reset()
    for _ in range(5):
        environment.step(random.uniform(low, high))
    steps, started = 0, time.perf_counter()
    while time.perf_counter() - started < seconds:
        if steps % 100 == 0:
            environment.reset()
        environment.step(random.uniform(low, high))
        steps += 1
    return steps / (time.perf_counter() - started)


if __name__ == "__main__":
    print(steps_per_second(int(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3])))
