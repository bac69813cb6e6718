"""Low-rank adapters (Hu et al., 2022) put into the networks by peft, and merged into them for use.

Targets as in pix2pix-turbo. The U-Net's first layer is trained whole, so it needs no adapter.
"""

from typing import Any

import torch
from torch import nn

from lidarpainter_models.painter.one_step.architectures import diffusion_package

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
