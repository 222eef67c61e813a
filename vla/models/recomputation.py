"""Gradient checkpointing: activations within a layer are recomputed in the backward pass instead of being kept."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import torch
from torch import nn
from torch.utils.checkpoint import checkpoint

from vla.io.errors import UserError
from vla.models.fsdp import MIN_PARAMETERS

LISTS = (nn.ModuleList, nn.Sequential)


def recompute_layers(model: nn.Module) -> None:
    """Make every layer keep only its input for the backward pass, in place; results and names do not change.

    Layers are the large elements of lists: those of transformers here, in torch, in timm and of Hugging Face, whose own
    gradient checkpointing would not do: it is off in evaluation mode, in which trunks run, and drops the keys and
    values that an expert reads. Layers with buffers, as of batch normalisation, are left out: they would update twice.

    Raises:
        UserError: there are no such layers.
    """
    layers = list(_layers(model))
    if not layers:
        raise UserError(f"learner.checkpointing=true finds no layers to recompute in {type(model).__name__}: omit it")
    for layer in layers:
        layer.forward = partial(_recompute, layer.forward)


def _layers(module: nn.Module) -> Iterator[nn.Module]:
    """Yield the innermost layers."""
    for child in module.children():
        inner_layers, weights = list(_layers(child)), dict(child.named_parameters())
        composed = any("." in name for name in weights) and child.state_dict().keys() == weights.keys()
        large = sum(weight.numel() for weight in weights.values()) >= MIN_PARAMETERS
        yield from inner_layers or ([child] if isinstance(module, LISTS) and composed and large else [])


def _recompute(forward: Callable[..., Any], *arguments: Any, **keywords: Any) -> Any:
    if not torch.is_grad_enabled():
        return forward(*arguments, **keywords)
    return checkpoint(forward, *arguments, use_reentrant=False, **keywords)
