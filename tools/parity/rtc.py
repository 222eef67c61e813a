"""What LeRobot's real-time chunking computes, to compare with: the inputs, and for every case the guided velocity.

PYTHONPATH=.venv/parity/lerobot-0.4.4 python tools/parity/rtc.py tests/rtc_reference.npz
"""

from __future__ import annotations

import sys

import lerobot_modules  # first: it makes the imports of LeRobot possible  # noqa: F401
import numpy as np
import torch
from lerobot.configs.types import RTCAttentionSchedule
from lerobot.policies.rtc.configuration_rtc import RTCConfig
from lerobot.policies.rtc.modeling_rtc import RTCProcessor
from torch import Tensor

SEED, BATCH, CHUNK, COMPONENTS = 0, 2, 8, 3
# Actions that are over when the plan arrives, actions that remain, time from 1 for noise to 0 for actions, β.
CASES = [
    (delay, rest, time, limit)
    for delay, rest in ((0, 5), (2, 6), (3, 3), (3, 8))
    for time, limit in ((1.0, 10.0), (0.7, 10.0), (0.1, 5.0))
]


def main(path: str) -> None:
    """Write the inputs and LeRobot's results."""
    random = torch.Generator().manual_seed(SEED)
    matrix = torch.randn(COMPONENTS, COMPONENTS, generator=random)
    noisy, previous = (torch.randn(BATCH, CHUNK, COMPONENTS, generator=random) for _ in range(2))
    results = {"linear": list[Tensor](), "exponential": list[Tensor]()}
    for decay, schedule in (("linear", RTCAttentionSchedule.LINEAR), ("exponential", RTCAttentionSchedule.EXP)):
        for delay, length, time, limit in CASES:
            config = RTCConfig(True, schedule, max_guidance_weight=limit, execution_horizon=CHUNK)
            prefix, instant = previous[:, :length], torch.tensor(time)
            velocity = RTCProcessor(config).denoise_step(
                noisy, prefix, delay, instant, lambda actions, instant=instant: (actions @ matrix + instant).tanh()
            )
            results[decay].append(velocity)
    arrays = {"matrix": matrix, "noisy": noisy, "previous": previous, "cases": torch.tensor(CASES)}
    arrays |= {decay: torch.stack(velocities) for decay, velocities in results.items()}
    np.savez_compressed(path, allow_pickle=False, **{name: values.numpy() for name, values in arrays.items()})


if __name__ == "__main__":
    main(sys.argv[1])
