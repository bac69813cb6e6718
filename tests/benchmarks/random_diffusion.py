"""One-step networks of any size with random weights or none, for measuring and testing."""

import math
from functools import lru_cache

import torch
from torch import nn
from turbo_shapes import SD_TURBO

from lidarpainter_models.painter.one_step.architectures import build_tiny, build_unet, build_vae
from lidarpainter_models.painter.one_step.assembly import ADAPTER_MARK, assemble

_POOL = 1 << 20
"""Random numbers that are drawn; larger weights repeat them."""


def random_network(
    config, *, architecture=SD_TURBO, dtype=torch.bfloat16, seed=0, has_adapters=False
):
    """A network of the true size whose weights follow from the seed, for measuring and testing.

    Adapters are random too, so that merging them changes something.
    """
    with torch.device("meta"):
        unet, autoencoder = _parts(config, architecture)
    for part in (unet, autoencoder):
        nn.Module.to(part, dtype).to_empty(device="cpu")
        fill_randomly(part, seed=seed)
    network = assemble(config, unet, autoencoder, has_adapters=has_adapters, seed=seed)
    pool = _pool(seed)
    for name, parameter in network.named_parameters():
        if ADAPTER_MARK in name:
            _fill(parameter, pool, scale=0.02)
    return network.requires_grad_(False)


def empty_network(config, *, has_adapters=False):
    """A network on the meta device: shapes without weights, for counting."""
    with torch.device("meta"):
        unet, autoencoder = _parts(config, SD_TURBO)
        return assemble(config, unet, autoencoder, has_adapters=has_adapters)


def _parts(config, architecture):
    build = build_vae if config.autoencoder == "sd" else build_tiny
    return build_unet(architecture, config.first_layer_channels), build(architecture)


@torch.no_grad()
def fill_randomly(module, *, seed):
    """Weights that keep activations near one: scaled by their inputs, norms one, biases zero."""
    pool = _pool(seed)
    for name, parameter in module.named_parameters():
        if parameter.dim() > 1:
            _fill(parameter, pool, scale=1 / math.sqrt(parameter[0].numel()))
        else:
            parameter.fill_(1.0 if name.endswith("weight") else 0.0)


@lru_cache(maxsize=2)
def _pool(seed):
    return torch.randn(_POOL, generator=torch.Generator().manual_seed(seed))


@torch.no_grad()
def _fill(parameter, pool, *, scale):
    flat = parameter.view(-1)
    scaled = (pool[: flat.numel()] * scale).to(parameter.dtype)
    for first in range(0, flat.numel(), _POOL):
        part = flat[first : first + _POOL]
        part.copy_(scaled[: part.numel()])
