"""Fully sharded data parallel training (FSDP2).

Every function but `shard` accepts models and tensors that are not sharded, and leaves them unchanged.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from torch import Tensor, nn

if TYPE_CHECKING:  # slow to import, and needed only for training
    from torch.distributed.device_mesh import DeviceMesh
    from torch.distributed.fsdp import FSDPModule

MIN_PARAMETERS = 10_000  # of a block with its own shards; for smaller ones the communication costs more than it saves


def shard(model: nn.Module, mesh: DeviceMesh) -> None:
    """Shard the weights over the second dimension of `mesh`, and replicate them over the first.

    Every large element of a `ModuleList`, such as the layers of a transformer or the blocks of an image encoder, is
    gathered for its own computation and freed afterwards. The remaining weights are gathered with the model.
    """
    from torch.distributed.fsdp import fully_shard

    for weight in model.parameters():
        weight.data = weight.data.contiguous()  # channels-last filters cannot be sharded
    for part in reversed([*model.modules()]):  # inner blocks first, as `fully_shard` requires
        for block in part if isinstance(part, nn.ModuleList) else ():
            if sum(weight.numel() for weight in block.parameters()) >= MIN_PARAMETERS:
                fully_shard(block, mesh=mesh)
    fully_shard(model, mesh=mesh)


def reshard(model: nn.Module) -> None:
    """Free gathered weights, so that each process holds only its own shards."""
    for part in _sharded_parts(model):
        part.reshard()


@contextmanager
def gather_weights(model: nn.Module) -> Iterator[None]:
    """Gather all weights in every process, for calls that bypass `forward`; the weights must not be changed."""
    for part in _sharded_parts(model):
        part.unshard()
    try:
        yield
    finally:
        reshard(model)


def _sharded_parts(model: nn.Module) -> Iterator[FSDPModule]:
    from torch.distributed.fsdp import FSDPModule

    return (part for part in model.modules() if isinstance(part, FSDPModule))


def full_tensor(tensor: Tensor) -> Tensor:
    """Gather a sharded tensor on the CPU; a collective call."""
    from torch.distributed.tensor import DTensor

    return tensor.full_tensor().cpu() if isinstance(tensor, DTensor) else tensor


def local_shard(tensor: Tensor) -> Tensor:
    """Return the shard of this process, which shares memory with `tensor`."""
    from torch.distributed.tensor import DTensor

    return tensor.to_local() if isinstance(tensor, DTensor) else tensor
