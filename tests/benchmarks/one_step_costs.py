"""What a wiring costs at full size: parameters, arithmetic and bytes, counted without any weights.

Networks are built on the meta device, so this needs neither memory nor a model. One
multiplication with its addition counts as two operations.
"""

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import torch
from random_diffusion import empty_network
from torch import nn
from torch.utils.flop_counter import FlopCounterMode
from turbo_shapes import SD_TURBO, build_text_encoder

from lidarpainter_models.errors import ConfigError
from lidarpainter_models.painter.one_step.architectures import TEXT_TOKENS
from lidarpainter_models.painter.one_step.assembly import (
    ADAPTER_MARK,
    FIRST_LAYER,
    FUSION,
    SKIPS,
    trained_names,
)
from lidarpainter_models.painter.one_step.autoencoder import CELL_PX
from lidarpainter_models.painter.one_step.config import OneStepConfig
from lidarpainter_models.painter.one_step.latent_fusion import LATENT_CHANNELS
from lidarpainter_models.painter.one_step.network import OneStepNetwork
from lidarpainter_models.painter.one_step.painter import STRIDE_PX
from lidarpainter_models.painter.one_step.prompts import STYLE_TEXTS
from lidarpainter_models.painter.one_step.weights import stored_type

META = torch.device("meta")
TERA = 1e12


def count_parameters(config: OneStepConfig) -> dict[str, int]:
    """Parameters of every part.

    `unet` and `autoencoder` are those of the model underneath; `first_layer_added` is what further
    inputs add to the U-Net's first layer.
    """
    network = _shapes(config, has_adapters=True)
    counts = {name: parameter.numel() for name, parameter in network.named_parameters()}

    def total(prefix: str, *, adapters: bool) -> int:
        return sum(
            count
            for name, count in counts.items()
            if name.startswith(prefix) and (ADAPTER_MARK in name) == adapters
        )

    first = next(
        parameter
        for name, parameter in network.named_parameters()
        if name == FIRST_LAYER + "weight"
    )
    added = first[:, LATENT_CHANNELS:].numel()
    skips = total(SKIPS, adapters=False)
    with META:
        text_encoder = build_text_encoder(SD_TURBO)
    return {
        "unet": total("denoiser.", adapters=False) - added,
        "first_layer_added": added,
        "autoencoder": total("autoencoder.", adapters=False) - skips,
        "skips": skips,
        "fusion": total(FUSION, adapters=False),
        "unet_adapters": total("denoiser.", adapters=True),
        "autoencoder_adapters": total("autoencoder.", adapters=True),
        "text_encoder": _num_parameters(text_encoder),
    }


def count_tflop(config: OneStepConfig, *, height_px: int, width_px: int) -> dict[str, float]:
    """Arithmetic for one view in 10^12 operations, adapters merged; the text is encoded before.

    Raises:
        ConfigError: the view has no pixels.
    """
    if min(height_px, width_px) < 1:
        raise ConfigError(f"a view needs pixels, got {width_px}x{height_px}")
    network = _shapes(config, has_adapters=False).to(META)  # buffers too
    rows, columns = (-(-size // STRIDE_PX) * STRIDE_PX // CELL_PX for size in (height_px, width_px))
    images = torch.empty(len(config.inputs), 1, 3, rows * CELL_PX, columns * CELL_PX, device=META)
    text = torch.empty(1, TEXT_TOKENS, SD_TURBO.text_width, device=META)
    masks = torch.empty(1, 2, rows, columns, device=META) if config.masks else None
    seen = torch.empty(1, config.first_layer_channels, rows, columns, device=META)
    total = _tflop(lambda: network(images, text, masks))
    encode = _tflop(lambda: network.autoencoder.encode(images.flatten(0, 1), num_skipped=0))
    denoise = _tflop(lambda: network.denoiser(seen, text))
    return {
        "encode": encode,
        "denoise": denoise,
        "decode": total - encode - denoise - _fusion_tflop(network, rows, columns),
        "total": total,
    }


def count_bytes(config: OneStepConfig) -> dict[str, int]:
    """Bytes of the weights in bfloat16, and of the tensors in a weights file of ours.

    The file is counted with the prompts of all styles.
    """
    merged = _shapes(config, has_adapters=False)
    network = _shapes(config, has_adapters=True)
    state = dict(network.named_parameters())
    trained = sum(
        state[name].numel() * stored_type(name).itemsize for name in trained_names(network)
    )
    prompts = len(STYLE_TEXTS) * TEXT_TOKENS * SD_TURBO.text_width
    two = torch.bfloat16.itemsize
    return {"weights": two * _num_parameters(merged), "trained_file": trained + two * prompts}


def describe_wiring(config: OneStepConfig, *, height_px: int, width_px: int) -> dict[str, Any]:
    """All of it as JSON types."""
    return {
        "architecture": {"summary": "SD-Turbo in one step, guided by LiDAR", **config.to_dict()},
        "parameters": count_parameters(config),
        "size_px": [width_px, height_px],
        "tflop": count_tflop(config, height_px=height_px, width_px=width_px),
        "bytes": count_bytes(config),
    }


@lru_cache(maxsize=8)
def _shapes(config: OneStepConfig, *, has_adapters: bool) -> OneStepNetwork:
    """A network without weights, kept because building a thousand layers takes a second."""
    return empty_network(config, has_adapters=has_adapters)


def _fusion_tflop(network: OneStepNetwork, rows: int, columns: int) -> float:
    if network.fusion is None:
        return 0.0
    shape = (len(network.config.inputs), 1, LATENT_CHANNELS, rows, columns)
    fusion = network.fusion
    return _tflop(lambda: fusion(torch.empty(shape, device=META)))


def _tflop(run: Callable[[], object]) -> float:
    with FlopCounterMode(display=False) as counter, torch.no_grad():
        run()
    return counter.get_total_flops() / TERA


def _num_parameters(module: nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())
