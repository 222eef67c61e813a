"""π0 and π0.5 against what transformers and LeRobot compute with equal weights, noise and times."""

from __future__ import annotations

import pytest
import torch
from defaults import defaults_of
from tiny_pi import KINDS, inputs, make_network
from tiny_vla import KEYPOINTS, SMOLVLA, deviation, network_results, reference
from tiny_vla import inputs as of_smolvla
from torch import Tensor

from vla.models.lora import LoRA
from vla.models.vlm.network import FlowNetwork, Prefix
from vla.models.vlm.smolvla import SmolVLA

TOLERANCE = 1e-5
each = pytest.mark.parametrize("name", KINDS)


def encoded(network: FlowNetwork, given: dict[str, Tensor]) -> Prefix:
    images, cameras, tokens, sentence = (given[name] for name in ("images", "cameras", "tokens", "sentence"))
    return network.prefix(images, cameras, tokens, sentence, given["state"] if network.state_width else None)


@each
def test_losses_gradients_and_every_step_are_those_of_the_reference(name: str) -> None:
    network, theirs = make_network(name), reference(name)
    names = [key.removeprefix("gradient.") for key in theirs if key.startswith("gradient.")]
    assert len(names) == 3
    ours = network_results(network, inputs(), {weight: network.get_parameter(weight) for weight in names})
    for key, value in ours.items():
        assert deviation(value, theirs[key]) < TOLERANCE, key
    assert max(map(deviation, ours["steps"], theirs["steps"])) < TOLERANCE


@each
def test_what_is_absent_has_no_effect_and_what_is_present_has(name: str) -> None:
    network, given = make_network(name), inputs()

    def result(**changed: Tensor) -> Tensor:
        with torch.no_grad():
            return network.velocity(encoded(network, {**given, **changed}), given["noise"], given["time"])

    images, tokens = given["images"].clone(), given["tokens"].clone()
    images[1, 1], tokens[1, 5:] = 0.3, 7
    assert torch.equal(result(), result(images=images, tokens=tokens))
    images[0, 1], tokens[1, 4] = 0.3, 7
    assert not torch.allclose(result(), result(images=images)) and not torch.allclose(result(), result(tokens=tokens))


@each
def test_a_time_per_action_is_that_of_the_action(name: str) -> None:
    network, given = make_network(name), inputs()
    with torch.no_grad():
        prefix = encoded(network, given)
        together = network.velocity(prefix, given["noise"], given["time"])
        times = given["time"][:, None].repeat(1, given["noise"].shape[1])
        assert deviation(network.velocity(prefix, given["noise"], times), together) < TOLERANCE
        times[:, :3] = 0.0  # a chunk whose beginning is known already
        assert not torch.allclose(network.velocity(prefix, given["noise"], times), together)


@pytest.mark.parametrize("modules", [(), ("q_proj", "v_proj")])
@pytest.mark.parametrize("name", [*KINDS, "smolvla"])
def test_all_that_is_trained_has_a_gradient(name: str, modules: tuple[str, ...]) -> None:
    """Otherwise processes of a training would wait for those of some weights."""
    smolvla = SmolVLA(**SMOLVLA | KEYPOINTS)
    network, given = (smolvla, of_smolvla(SMOLVLA)) if name == "smolvla" else (make_network(name), inputs())
    if modules:
        LoRA(**defaults_of("learner/lora/low_rank", modules=modules)).inject(network)
    network.velocity(encoded(network, given), given["noise"], given["time"]).square().sum().backward()
    assert [name for name, weight in network.named_parameters() if weight.requires_grad and weight.grad is None] == []
