"""What the tests compare with: computed by a network of LeRobot, and written."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from safetensors.torch import load_file, save_file
from tiny_vla import REFERENCE, deviation
from torch import Tensor

TOLERANCE = 1e-5


def lerobot_results(
    network: Any, names: Sequence[str], batch: Mapping[str, Tensor], gradients: Mapping[str, str]
) -> dict[str, Tensor]:
    """Return losses, (B, k, A), their gradients, and the actions at the beginning of every step and after the last.

    `names`: inputs besides images and cameras. `gradients`: names here → names in LeRobot.
    """
    images, cameras = ([*batch[name].unbind(1)] for name in ("images", "cameras"))
    observation = (images, cameras, *(batch[name] for name in names))
    losses = network(*observation, batch["actions"], batch["noise"], batch["time"])
    losses.mean().backward()
    parameters, steps, denoise = dict(network.named_parameters()), list[Tensor](), network.denoise_step

    def recorded(**values: Any) -> Tensor:
        steps.append(values["x_t"])
        return denoise(**values)

    network.denoise_step = recorded
    with torch.no_grad():
        steps.append(network.sample_actions(*observation, noise=batch["noise"]))
    network.denoise_step = denoise
    found = {f"gradient.{name}": parameters[theirs].grad for name, theirs in gradients.items()}
    return {"losses": losses.detach(), "steps": torch.stack(steps), **found}


def write(name: str, results: dict[str, Tensor]) -> None:
    """Write results, and compare them with those that were there; delete these before what is compared changes."""
    path = REFERENCE / f"{name}.safetensors"
    for key, reference in load_file(path).items() if path.exists() else ():
        error = deviation(results[key].detach(), reference)
        print(f"{name}: {key:70} {error:.1e}")
        assert error <= TOLERANCE, key
    save_file({key: value.detach().contiguous().clone() for key, value in results.items()}, path)
