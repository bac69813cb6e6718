"""The two autoencoders: Stable Diffusion's with skips from encoder to decoder, and the tiny TAESD.

Images are (batch, 3, height, width) in [-1, 1], latents (batch, 4, height / 8, width / 8) in the
units of the noise schedule. Encoding takes the mode of the posterior, so nothing is random. What
the encoder passes to the decoder is returned as values: no module keeps anything between calls.
"""

from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from lidarpainter_models.errors import ConfigError

FIRST_WEIGHT = 1e-5
"""Every weight of a skip convolution at the start: the decoder begins as it was trained."""
CELL_PX = 8
"""Side of the pixel block that one latent position stands for."""

Skips = tuple[Tensor, ...]
"""Features of the encoder, coarsest first; empty without skips."""


class SkipDecoder(nn.Module):
    """The modules of a diffusers `Decoder` with skip convolutions beside them.

    Skips as in pix2pix-turbo (Parmar et al., 2024): a 1x1 convolution of the encoder's features is
    added before each level of the decoder. Diffusers' own decoder takes no such input, so its
    modules are called here one by one.
    """

    def __init__(
        self, decoder: nn.Module, widths: Sequence[int], *, has_skips: bool, skip_bias: bool
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


class SkipAutoencoder(nn.Module):
    """Stable Diffusion's autoencoder; the decoder may see the encoder's features."""

    def __init__(self, vae: Any, *, has_skips: bool, skip_bias: bool = False) -> None:  # noqa: ANN401
        """Take the parts of a diffusers `AutoencoderKL`.

        Its modules are used, its own `forward` is not. `has_skips` adds the four skip convolutions.

        Raises:
            ConfigError: the autoencoder does not reduce images eightfold to four channels.
        """
        super().__init__()
        self.encoder: nn.Module = vae.encoder
        self.quant_conv: nn.Module = vae.quant_conv or nn.Identity()
        self.post_quant_conv: nn.Module = vae.post_quant_conv or nn.Identity()
        self.decoder = SkipDecoder(
            vae.decoder, vae.config.block_out_channels, has_skips=has_skips, skip_bias=skip_bias
        )
        self.scaling_factor = float(vae.config.scaling_factor)
        self.is_checkpointed = False
        check_latents(len(vae.config.block_out_channels) - 1, vae.config.latent_channels)

    def encode(
        self, images: Float[Tensor, "batch 3 height width"], *, num_skipped: int
    ) -> tuple[Float[Tensor, "batch 4 rows columns"], Skips]:
        """Latents of all images, and the inputs of the encoder's levels for the first ones."""
        encoder: Any = self.encoder
        features = encoder.conv_in(images)
        skips: list[Tensor] = []
        for block in encoder.down_blocks:
            if num_skipped:
                # a copy of a part lets the rest go
                kept = features[:num_skipped]
                skips.insert(0, kept.clone() if num_skipped < len(features) else kept)
            features = run_block(block, features, is_checkpointed=self.is_checkpointed)
        features = encoder.mid_block(features)
        moments = encoder.conv_out(encoder.conv_act(encoder.conv_norm_out(features)))
        mean, _ = self.quant_conv(moments).chunk(2, dim=1)
        return mean * self.scaling_factor, tuple(skips)

    def decode(
        self, latents: Float[Tensor, "batch 4 rows columns"], skips: Skips
    ) -> Float[Tensor, "batch 3 height width"]:
        """Images of latents, not clamped."""
        features = self.post_quant_conv(latents / self.scaling_factor)
        return self.decoder(features, skips, is_checkpointed=self.is_checkpointed)


class TinyAutoencoder(nn.Module):
    """TAESD: 2.4 million parameters in place of 83.7, without skips.

    Its latents have no posterior and are in the schedule's units already.
    """

    def __init__(self, tiny: Any) -> None:  # noqa: ANN401 - diffusers' AutoencoderTiny
        super().__init__()
        self.encoder: nn.Module = tiny.encoder
        self.decoder: nn.Module = tiny.decoder
        self.scaling_factor = float(tiny.config.scaling_factor)
        check_latents(len(tiny.config.encoder_block_out_channels) - 1, tiny.config.latent_channels)

    def encode(
        self,
        images: Float[Tensor, "batch 3 height width"],
        *,
        num_skipped: int,  # noqa: ARG002 - none: `OneStepConfig` allows no skips here
    ) -> tuple[Float[Tensor, "batch 4 rows columns"], Skips]:
        """Latents of all images."""
        return self.encoder(images) * self.scaling_factor, ()

    def decode(
        self,
        latents: Float[Tensor, "batch 4 rows columns"],
        skips: Skips,  # noqa: ARG002 - the tiny decoder takes none
    ) -> Float[Tensor, "batch 3 height width"]:
        """Images of latents, not clamped."""
        return self.decoder(latents / self.scaling_factor)


def check_latents(num_halvings: int, num_channels: int) -> None:
    """Refuse an autoencoder of other latents than Stable Diffusion's.

    Raises:
        ConfigError: the latents are not an eighth of the size with four channels.
    """
    if 2**num_halvings != CELL_PX or num_channels != 4:
        raise ConfigError(
            f"an autoencoder must reduce images {CELL_PX} times to 4 channels, this one reduces "
            f"them {2**num_halvings} times to {num_channels}"
        )


def mix_skips(skips: Skips, weights: Float[Tensor, "inputs batch weights rows columns"]) -> Skips:
    """The skips of several inputs as one, weighed as the latents were.

    Their batch holds one input after the other; the weights are at the latents' size, and their
    mean over channels counts.
    """
    num_inputs = len(weights)
    shares = weights.mean(dim=2)
    mixed = []
    for features in skips:
        scaled = nn.functional.interpolate(
            shares, size=features.shape[2:], mode="bilinear", align_corners=False
        )
        parts = features.unflatten(0, (num_inputs, -1))
        mixed.append(torch.einsum("ib...,ibc...->bc...", scaled.to(features.dtype), parts))
    return tuple(mixed)
