"""Times SmolVLA beside LeRobot's own, of equal weights, images, noise and number of threads.

PYTHONPATH=FOLDER_OF_LEROBOT:.:tests python tools/parity/smolvla_speed.py {tiny,small,base} [CAMERAS] [compile]
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Any

import torch
from smolvla import their_network
from tiny_vla import deviation, published
from torch import Tensor

from vla.config.compose import compose
from vla.models.vlm.network import FlowNetwork
from vla.models.vlm.packed_linear import pack
from vla.models.vlm.smolvla import SmolVLA

CHUNK, STEPS, LENGTH, PLANS = 50, 10, 48, 3
SMALL = {  # 0.1 B weights
    **{"width": 480, "layers": 8, "heads": 8, "key_heads": 4, "head_width": 64, "feedforward": 1280},
    **{"vision_width": 384, "vision_layers": 12, "vision_heads": 6, "vision_feedforward": 1536, "resolution": 256},
    **{"expert_width": 360, "expert_feedforward": 1024},
}
SIZES = {"small": SMALL, "base": {}}


def sampled(network: FlowNetwork, noise: Tensor, *observed: Tensor) -> Tensor:
    """A plan of ours."""
    prefix, x = network.prefix(*observed), noise
    for step in range(STEPS):
        x = x - network.velocity(prefix, x, x.new_full((len(x),), 1 - step / STEPS)) / STEPS
    return x


def main(size: str, cameras: int, *options: str) -> None:
    """Print the median time of a plan of both, and the largest difference of their actions."""
    values = compose("model=smolvla").model.network.items()
    sizes = {str(name): value for name, value in values if name[0] != "_"} | SIZES[size]
    theirs, ours = their_network(sizes, CHUNK), SmolVLA(**sizes).eval()
    named = dict(theirs.named_parameters())
    with torch.no_grad():
        for name, weight in published(ours):
            weight.copy_(named[name])
    pack(ours)
    random, resolution = torch.Generator().manual_seed(0), sizes["resolution"]
    images = torch.rand(1, cameras, 3, resolution, resolution, generator=random) * 2 - 1
    tokens, sentence = (
        torch.randint(sizes["vocabulary"], (1, LENGTH), generator=random),
        torch.arange(LENGTH)[None] < 12,
    )
    state, present = torch.randn(1, 32, generator=random), torch.ones(1, cameras, dtype=torch.bool)
    noise = torch.randn(1, CHUNK, 32, generator=random)
    split = [*images.unbind(1)], [*present.unbind(1)], tokens, sentence, state
    said = tokens[:, :16], sentence[:, :16]  # `Prompt` pads no further
    run = torch.compile(sampled) if "compile" in options else sampled
    ways: dict[str, Callable[[], Any]] = {
        "LeRobot": lambda: theirs.sample_actions(*split, noise=noise),
        "vla": lambda: run(ours, noise, images, present, *said, state),
        "vla, prefix alone": lambda: ours.prefix(images, present, *said, state),
    }
    if "bf16" in options:

        def half() -> Tensor:
            with torch.autocast("cpu", torch.bfloat16):
                return run(ours, noise, images, present, *said, state)

        ways["vla, bf16"] = half
    count = sum(weight.numel() for weight in ours.parameters())
    print(
        f"{size}: {count / 1e6:.0f} M weights, cameras {cameras}, {torch.get_num_threads()} threads {' '.join(options)}"
    )
    seconds = {name: list[float]() for name in ways}
    with torch.inference_mode():
        plans = {name: way() for name, way in ways.items()}
        for _ in range(PLANS):
            for name, way in ways.items():
                started = time.perf_counter()
                way()
                seconds[name].append(time.perf_counter() - started)
    best = min(seconds["LeRobot"])
    for name, times in seconds.items():
        off = deviation(plans[name], plans["LeRobot"]) if isinstance(plans[name], Tensor) else float("nan")
        median = sorted(times)[PLANS // 2]
        print(
            f"{name:20} {median:6.3f} s, best {min(times):6.3f} s, {best / min(times):5.2f} as fast, off by {off:.1e}"
        )


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), *sys.argv[3:])
