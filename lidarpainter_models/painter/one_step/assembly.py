"""Putting the parts of a one-step network together, and what of it training changes."""

from typing import Any

import torch
from torch import nn

from lidarpainter_models.painter.one_step.architectures import diffusion_package
from lidarpainter_models.painter.one_step.autoencoder import SkipAutoencoder, TinyAutoencoder
from lidarpainter_models.painter.one_step.config import OneStepConfig
from lidarpainter_models.painter.one_step.denoiser import Denoiser
from lidarpainter_models.painter.one_step.latent_fusion import LatentFusion
from lidarpainter_models.painter.one_step.network import OneStepNetwork

UNET_TARGETS = (
    "to_k",
    "to_q",
    "to_v",
    "to_out.0",
    "conv",
    "conv1",
    "conv2",
    "conv_shortcut",
    "conv_out",
    "proj_in",
    "proj_out",
    "ff.net.2",
    "ff.net.0.proj",
)
AUTOENCODER_TARGETS = (
    "conv1",
    "conv2",
    "conv_in",
    "conv_shortcut",
    "conv",
    "conv_out",
    "to_k",
    "to_q",
    "to_v",
    "to_out.0",
)
ADAPTER_MARK = ".lora_"
"""Stands in the name of every weight of an adapter."""


def add_lora(module: nn.Module, *, rank: int, targets: tuple[str, ...]) -> None:
    """Put adapters beside the layers whose names end like a target; they change nothing at first.

    Scaled by one (`alpha` = rank). Nothing happens at rank 0.
    """
    if rank == 0:
        return
    peft = diffusion_package("peft")
    config = peft.LoraConfig(
        r=rank, lora_alpha=rank, target_modules=list(targets), init_lora_weights="gaussian"
    )
    peft.inject_adapter_in_model(config, module)


@torch.no_grad()
def merge_lora(module: nn.Module) -> None:
    """Add every adapter to the layer beside it and take it away: fewer layers, the same function.

    The sum is taken in float32 and rounded once.
    """
    for parent in list(module.modules()):
        for name, child in list(parent.named_children()):
            if is_adapted(child):
                adapted: Any = child
                base = adapted.get_base_layer()
                for adapter in adapted.active_adapters:
                    adapted.lora_A[adapter].to(torch.float32)  # in place
                    adapted.lora_B[adapter].to(torch.float32)
                    delta = adapted.get_delta_weight(adapter)
                    base.weight.copy_(base.weight.float() + delta)
                setattr(parent, name, base)


def is_adapted(module: nn.Module) -> bool:
    """Whether peft has wrapped a layer."""
    return hasattr(module, "get_base_layer") and hasattr(module, "lora_A")


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
