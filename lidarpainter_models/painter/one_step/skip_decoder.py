"""Stable Diffusion's decoder that also sees the encoder's features.

Skips as in pix2pix-turbo (Parmar et al., 2024): a 1x1 convolution of the encoder's features is
added before each level of the decoder. Diffusers' own decoder takes no such input, so its modules
are called here one by one.
"""

from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

FIRST_WEIGHT = 1e-5
"""Every weight of a skip convolution at the start: the decoder begins as it was trained."""


class SkipDecoder(nn.Module):
    """The modules of a diffusers `Decoder` with skip convolutions beside them."""

    def __init__(
        self,
        decoder: nn.Module,
        widths: Sequence[int],
        *,
        has_skips: bool,
        skip_bias: bool,
    ) -> None:
        """Take the decoder of a diffusers `AutoencoderKL`.

        `widths` are the autoencoder's channels, finest level first; a bias of the skip convolutions
        is zero at first.
        """
        super().__init__()
        self.base = decoder
        # inputs of the encoder's levels, coarsest first, and of the decoder's levels
        sources = [widths[0], *widths[:-1]][::-1]
        targets = [widths[-1], *list(widths)[::-1][:-1]]
        pairs = zip(sources, targets, strict=True) if has_skips else ()
        self.skip_convs = nn.ModuleList(
            nn.Conv2d(source, target, 1, bias=skip_bias) for source, target in pairs
        )
        for name, parameter in self.skip_convs.named_parameters():
            nn.init.constant_(parameter, FIRST_WEIGHT if name.endswith("weight") else 0.0)

    def forward(
        self,
        latents: Float[Tensor, "batch 4 rows columns"],
        skips: tuple[Tensor, ...],
        *,
        is_checkpointed: bool = False,
    ) -> Float[Tensor, "batch 3 height width"]:
        """Decode; `skips` are the encoder's features, coarsest first."""
        base: Any = self.base
        features = base.mid_block(base.conv_in(latents))
        for level, block in enumerate(base.up_blocks):
            if self.skip_convs:
                features = features + self.skip_convs[level](skips[level])
            features = run_block(block, features, is_checkpointed=is_checkpointed)
        return base.conv_out(base.conv_act(base.conv_norm_out(features)))


def run_block(block: nn.Module, features: Tensor, *, is_checkpointed: bool) -> Tensor:
    """Run a module; checkpointed, its inner activations are computed anew in the backward pass."""
    if is_checkpointed and torch.is_grad_enabled():
        return checkpoint(block, features, use_reentrant=False)
    return block(features)
