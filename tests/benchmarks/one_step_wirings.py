"""The same painter wired plainly and wired well, at full size, to measure what the wiring costs.

`plain` is the paper's network as one would first write it: two encodings, adapters beside their
layers, the text encoder run for every view, weights built in float32 and then rounded. `lean` is
how `OneStepPainter` runs: one batch through the encoder, adapters merged, the text encoded
before, channels last, weights built in bfloat16. `taesd` is `lean` with the tiny autoencoder. All
three have the same random weights.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Literal, get_args

import torch
from jaxtyping import Float
from random_diffusion import fill_randomly, random_network
from torch import Tensor, nn
from turbo_shapes import SD_TURBO, WholeModel, build_text_encoder

from lidarpainter_models.painter.one_step.architectures import TEXT_TOKENS
from lidarpainter_models.painter.one_step.assembly import merge_lora
from lidarpainter_models.painter.one_step.config import FAST, PAPER
from lidarpainter_models.painter.one_step.prompts import run_text_encoder

Wiring = Literal["plain", "lean", "taesd"]
WIRINGS: tuple[Wiring, ...] = get_args(Wiring)
_SEED = 0

Paint = Callable[
    [Float[Tensor, "inputs batch 3 height width"]], Float[Tensor, "batch 3 height width"]
]


def build_wiring(wiring: Wiring, architecture: WholeModel = SD_TURBO) -> Paint:
    """A function that paints images in [0, 1] whose sides are multiples of 64."""
    if wiring == "plain":
        return _plain(architecture)
    # the tiny autoencoder has no adapters; time and fusion are those of `paper` in all three
    config = PAPER if wiring == "lean" else replace(FAST, timestep=PAPER.timestep)
    network = random_network(config, architecture=architecture, seed=_SEED, has_adapters=True)
    merge_lora(network)
    # torch's stub lacks memory_format
    network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    text = _text(_text_encoder(architecture, torch.bfloat16))

    def paint(
        images: Float[Tensor, "inputs batch 3 height width"],
    ) -> Float[Tensor, "batch 3 height width"]:
        with torch.inference_mode():
            return network(images, text)

    return paint


def _plain(architecture: WholeModel) -> Paint:
    network = random_network(
        PAPER, architecture=architecture, dtype=torch.float32, seed=_SEED, has_adapters=True
    )
    for part in (network.autoencoder, network.denoiser):
        nn.Module.to(part, torch.bfloat16)
    network.denoiser.unet.get_submodule("conv_out").float()
    encoder = nn.Module.to(_text_encoder(architecture, torch.float32), torch.bfloat16)

    def paint(
        images: Float[Tensor, "inputs batch 3 height width"],
    ) -> Float[Tensor, "batch 3 height width"]:
        with torch.no_grad():
            return network(images, _text(encoder), encodes_at_once=False)

    return paint


def _text_encoder(architecture: WholeModel, dtype: torch.dtype) -> nn.Module:
    before = torch.get_default_dtype()
    torch.set_default_dtype(dtype)
    try:
        encoder = build_text_encoder(architecture)
    finally:
        torch.set_default_dtype(before)
    fill_randomly(encoder, seed=_SEED)
    return encoder.requires_grad_(False)


def _text(encoder: nn.Module) -> Float[Tensor, "1 tokens features"]:
    return run_text_encoder(encoder, torch.ones(1, TEXT_TOKENS, dtype=torch.long))[None].clone()
