"""A model whose weights are shared out among the processes that train it (FSDP2).

Every function leaves a model that is not shared out as it is.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

if TYPE_CHECKING:  # slow to import, and of no use to those who only act
    from torch.distributed.device_mesh import DeviceMesh
    from torch.distributed.fsdp import FSDPModule

SMALLEST = 10_000  # weights; gathering fewer by themselves costs more than keeping them


def shard(model: nn.Module, mesh: DeviceMesh) -> None:
    """Share the weights out over the second dimension of `mesh`, as many copies of each as its first is long.

    Every large element of a list of modules, such as the layers of a transformer or the blocks of an image encoder, is
    gathered when it computes and given back after it; what is left is gathered with the model.
    """
    from torch.distributed.fsdp import fully_shard

    for weight in model.parameters():
        weight.data = weight.data.contiguous()  # filters may lie with their channels last, which cannot be shared out
    for part in list(model.modules()):
        for block in part if isinstance(part, nn.ModuleList) else ():
            if sum(weight.numel() for weight in block.parameters()) >= SMALLEST:
                fully_shard(block, mesh=mesh)
    fully_shard(model, mesh=mesh)


def give_back(model: nn.Module) -> None:
    """Free what was gathered of the weights, so that each process holds its own share of them and nothing else."""
    for part in _sharded(model):
        part.reshard()


@contextmanager
def gathered(model: nn.Module) -> Iterator[None]:
    """Within, all weights are in every process, for what does not go through `forward`; nothing may change them."""
    for part in _sharded(model):
        part.unshard()
    yield
    give_back(model)


def _sharded(model: nn.Module) -> Iterator[FSDPModule]:
    from torch.distributed.fsdp import FSDPModule

    return (part for part in model.modules() if isinstance(part, FSDPModule))


def whole(tensor: Tensor) -> Tensor:
    """All of a tensor, of which this process may hold a share; all processes must ask for it."""
    from torch.distributed.tensor import DTensor

    return tensor.full_tensor().cpu() if isinstance(tensor, DTensor) else tensor


def share(tensor: Tensor) -> Tensor:
    """What this process holds of a tensor: the same memory."""
    from torch.distributed.tensor import DTensor

    return tensor.to_local() if isinstance(tensor, DTensor) else tensor


def summed(tensor: Tensor) -> Tensor:
    """The sum of a tensor over all processes that train together, in place."""
    if torch.distributed.is_available() and torch.distributed.is_initialized():
        torch.distributed.all_reduce(tensor)
    return tensor
