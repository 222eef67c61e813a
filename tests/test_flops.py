"""What a training step costs, counted by hand, and what a device can do."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from fake_batch import make_act, make_batch, make_bc, make_decoder, make_rt1, with_text
from torch import nn

from vla.models.compile_cache import set_compile_cache
from vla.models.flops import matmul_flops, peak_flops, training_flops
from vla.models.model import Model

CPU = torch.device("cpu")


class Linear(nn.Module):
    """Just enough of a model: one matrix."""

    def __init__(self) -> None:
        super().__init__()
        self.matrix = nn.Linear(3, 5)

    def loss(self, batch: Any) -> Any:
        return {"loss": self.matrix(batch["action"]).square().mean()}


def test_a_matrix_takes_a_product_forward_and_one_for_its_gradient() -> None:
    """The action needs no gradient, which would take another."""
    flops = training_flops(Linear(), {"action": torch.randn(6, 3), "deeper": {"list": [""] * 6}})  # type: ignore[arg-type]
    assert flops == 2 * (2 * 6 * 3 * 5)


@pytest.mark.parametrize(("groups", "products"), [(1, 8 * 8), (4, 8 * 2), (8, 8)])
def test_channels_in_groups_meet_only_their_own(groups: int, products: int) -> None:
    """3 by 3 weights at each of 5 by 5 places, forward and for the gradients of weights and images."""

    class Convolution(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.first = nn.Parameter(torch.ones(()))  # so that the images need a gradient
            self.layer = nn.Conv2d(8, 8, 3, padding=1, groups=groups)

        def loss(self, batch: Any) -> Any:
            return {"loss": self.layer(batch["action"] * self.first).sum()}

    flops = training_flops(Convolution(), {"action": torch.randn(2, 8, 5, 5)})  # type: ignore[arg-type]
    assert flops == 3 * 2 * (2 * 5 * 5 * 9 * products)


@pytest.mark.parametrize(
    "model", [make_bc(), make_rt1(), make_decoder(), make_act()], ids=["bc", "rt1", "decoder", "act"]
)
def test_counting_changes_nothing_and_grows_with_the_batch(model: Model) -> None:
    batch = with_text(model, make_batch(model.history, model.chunk, 4))
    before = {name: value.clone() for name, value in model.state_dict().items()}
    state = torch.random.get_rng_state()
    flops = training_flops(model, batch)
    assert flops > 1e5
    assert torch.equal(state, torch.random.get_rng_state())
    assert all(torch.equal(value, before[name]) for name, value in model.state_dict().items())
    assert all(parameter.grad is None for parameter in model.parameters())
    half = with_text(model, make_batch(model.history, model.chunk, 2))
    assert flops == 2 * training_flops(model, half)


def test_a_compiled_model_is_counted_like_any_other() -> None:
    model = make_bc()
    batch = with_text(model, make_batch(1))
    flops = training_flops(model, batch)
    set_compile_cache()
    model.compile()
    assert training_flops(model, batch) == flops


@pytest.mark.parametrize(
    ("name", "half", "tensor_float"),
    [
        ("NVIDIA H100 80GB HBM3", 989e12, 494e12),
        ("NVIDIA H100 PCIe", 756e12, 378e12),
        ("NVIDIA H200", 989e12, 494e12),
        ("NVIDIA A100-SXM4-40GB", 312e12, 156e12),
        ("NVIDIA H100 80GB HBM3 MIG 1g.10gb", None, None),
        ("NVIDIA RTX A1000", None, None),
    ],
)
def test_peaks_are_those_of_the_data_sheets(
    name: str, half: float | None, tensor_float: float | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda device: name)
    device = torch.device("cuda")
    assert peak_flops(device, "bf16-mixed") == half
    monkeypatch.setattr(torch, "get_float32_matmul_precision", lambda: "high")
    assert peak_flops(device, "32-true") == tensor_float


def test_a_processor_has_no_peak_but_a_rate() -> None:
    assert peak_flops(CPU, "32-true") is None
    assert 0 < matmul_flops(CPU, "32-true", 0.01) < float("inf")


def test_mixed_precision_has_the_better_rate_of_both_and_products_that_take_too_long_are_left_out(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """On a device that takes a minute for a large product in 16 bits, and on every clock: the products are counted."""
    now, sizes = 0.0, []

    def multiply(self: torch.Tensor, other: torch.Tensor) -> None:
        nonlocal now
        sizes.append(len(self))
        now += 2 * len(self) ** 3 / {torch.float32: 1e11, torch.bfloat16: 1e9}[self.dtype]

    monkeypatch.setattr(torch.Tensor, "__matmul__", multiply)
    monkeypatch.setattr("vla.models.flops.time.perf_counter", lambda: now)
    assert matmul_flops(CPU, "bf16-mixed", 0.2) == pytest.approx(1e11)
    assert max(sizes) == 1024 and now < 1
    assert matmul_flops(CPU, "bf16-true", 0.2) == pytest.approx(1e9)
