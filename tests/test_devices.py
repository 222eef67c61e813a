"""What models need of a GPU: device placement, with torch's fake tensors, and compilation as one graph."""

from __future__ import annotations

from functools import partial
from typing import Any

import pytest
import torch
from fake_batch import MODELS as ALL
from fake_batch import make_batch, make_rt1, with_text
from tiny_pi import KINDS, make_policy
from tiny_vla import make_smolvla
from torch import Tensor, nn
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.utils import _pytree
from torch.utils._python_dispatch import TorchDispatchMode

from vla.models.model import Model

DENOISING = {name: partial(ALL[name], steps=2) for name in ("diffusion", "flow")}
MODELS = {**ALL, **DENOISING, "rt1": partial(make_rt1, proprioception=True)}
VLAS = {"smolvla": partial(make_smolvla, steps=2), **{name: partial(make_policy, name, steps=2) for name in KINDS}}


class Call(nn.Module):
    """One method of a model as a module's own."""

    def __init__(self, model: Model, method: str) -> None:
        super().__init__()
        self.model, self.method = model, method

    def forward(self, batch: dict[str, Any]) -> Any:
        """What the method makes of a batch."""
        return getattr(self.model, self.method)(batch)


class OnGpu(TorchDispatchMode):
    """Every operation is one of the GPU: a copy from the CPU would wait until it has finished its work."""

    def __torch_dispatch__(self, function: Any, types: Any, arguments: Any = (), named: Any = None) -> Any:
        """Require that its results are there."""
        found = function(*arguments, **(named or {}))
        made = {each.device.type for each in _pytree.tree_leaves(found) if isinstance(each, Tensor)}
        assert made <= {"cuda"}, function
        return found


@pytest.mark.parametrize("method", ["augment", "loss", "encode", "predict"])
@pytest.mark.parametrize("name", MODELS | VLAS)
def test_nothing_of_a_model_is_on_the_cpu(name: str, method: str) -> None:
    model = (MODELS | VLAS)[name](shift=(64, 64))
    call = Call(model.train(method in ("augment", "loss")), method)
    batch = with_text(model, make_batch(model.history, model.chunk, spec=model.spec))
    with FakeTensorMode() as mode, OnGpu():

        def on_gpu(value: Tensor) -> Tensor:
            return mode.from_tensor(value).to("cuda")

        state = {key: on_gpu(value) for key, value in [*call.named_parameters(), *call.named_buffers()]}
        found = torch.func.functional_call(call, state, (_pytree.tree_map_only(Tensor, on_gpu, batch),))
    results = [value for value in _pytree.tree_leaves(found) if isinstance(value, Tensor)]
    assert all(result.device.type == "cuda" for result in results)
    assert results or method == "encode"  # what keeps nothing of a frame


@pytest.mark.parametrize("name", MODELS)
def test_the_compiled_part_of_a_training_step_is_one_graph(name: str) -> None:
    torch._dynamo.reset()
    model = MODELS[name](shift=(64, 64)).train()
    batch = model.augment(with_text(model, make_batch(model.history, model.chunk)))
    compiled: Any = torch.compile(model, backend="eager", fullgraph=True)  # raises where a graph would break
    assert compiled(batch).keys() == model(batch).keys()
