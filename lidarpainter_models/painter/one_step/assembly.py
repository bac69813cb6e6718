"""Putting the parts of a one-step network together, and what of it training changes."""

from typing import Any

import torch
from torch import nn

from lidarpainter_models.painter.one_step.autoencoder import SkipAutoencoder, TinyAutoencoder
from lidarpainter_models.painter.one_step.config import OneStepConfig
from lidarpainter_models.painter.one_step.denoiser import Denoiser
from lidarpainter_models.painter.one_step.latent_fusion import LatentFusion
from lidarpainter_models.painter.one_step.lora import (
    ADAPTER_MARK,
    AUTOENCODER_TARGETS,
    UNET_TARGETS,
    add_lora,
    merge_lora,
)
from lidarpainter_models.painter.one_step.network import OneStepNetwork
from lidarpainter_models.painter.one_step.upsampling import phase_upsamplings

FIRST_LAYER = "denoiser.unet.conv_in."
LAST_LAYER = "denoiser.unet.conv_out."
SKIPS = "autoencoder.decoder.skip_convs."
FUSION = "fusion."


def assemble(
    config: OneStepConfig,
    unet: nn.Module,
    autoencoder: Any,  # noqa: ANN401 - diffusers' AutoencoderKL or AutoencoderTiny
    *,
    has_adapters: bool,
    seed: int = 0,
) -> OneStepNetwork:
    """Wire the parts; new weights follow from the seed and have the type of the U-Net's.

    The U-Net has the configured number of input channels; adapters change nothing before they are
    trained.
    """
    dtype = next(unet.parameters()).dtype
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        if has_adapters:
            add_lora(unet, rank=config.unet_rank, targets=UNET_TARGETS)
            add_lora(autoencoder, rank=config.autoencoder_rank, targets=AUTOENCODER_TARGETS)
        fusion = LatentFusion(config.fusion, len(config.inputs)) if config.fusion else None
        parts = _autoencoder_parts(config, autoencoder).to(dtype)
    nn.Module.to(unet, dtype)  # diffusers' own `to` warns about nothing
    denoiser = Denoiser(unet, timestep=config.timestep)
    return OneStepNetwork(config, autoencoder=parts, denoiser=denoiser, fusion=fusion).eval()


def _autoencoder_parts(
    config: OneStepConfig,
    autoencoder: Any,  # noqa: ANN401 - diffusers' AutoencoderKL or AutoencoderTiny
) -> SkipAutoencoder | TinyAutoencoder:
    if config.autoencoder == "taesd":
        return TinyAutoencoder(autoencoder)
    has_skips = config.skips != "none"
    return SkipAutoencoder(autoencoder, has_skips=has_skips, skip_bias=config.skip_bias)


def made_lean(network: OneStepNetwork) -> OneStepNetwork:
    """The same network for use alone, in place: adapters merged, doublings by phases."""
    merge_lora(network)
    phase_upsamplings(network)
    return network


def trained_names(network: OneStepNetwork) -> list[str]:
    """Names of the weights that training changes: adapters, first layer, skips, fusion."""
    whole = (FIRST_LAYER, SKIPS, FUSION)
    return [
        name
        for name, _ in network.named_parameters()
        if name.startswith(whole) or ADAPTER_MARK in name
    ]


def trained_in_float32(network: OneStepNetwork) -> dict[str, nn.Parameter]:
    """The weights that training changes, widened in place: small steps vanish in bfloat16."""
    parameters = dict(network.named_parameters())
    trained = {name: parameters[name] for name in trained_names(network)}
    for parameter in trained.values():
        parameter.data = parameter.data.float()
    return trained
