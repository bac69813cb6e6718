"""The one-step network: encode every input, predict the noise, fuse, take one step, decode.

Pix2pix-turbo's wiring (Parmar et al., 2024) with the paper's second input. With a fusion that
trusts the render alone and a first layer that is zero for the LiDAR latent it *is* pix2pix-turbo on
the render, bit for bit. Nothing random is drawn and nothing is kept between calls.
"""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from lidarpainter_models.painter.one_step.autoencoder import (
    SkipAutoencoder,
    Skips,
    TinyAutoencoder,
    mix_skips,
)
from lidarpainter_models.painter.one_step.config import OneStepConfig
from lidarpainter_models.painter.one_step.denoiser import Denoiser
from lidarpainter_models.painter.one_step.latent_fusion import LatentFusion, mix
from lidarpainter_models.painter.one_step.schedule import denoise, denoising_step


class OneStepNetwork(nn.Module):
    """Autoencoder, denoiser and fusion, wired as a `OneStepConfig` says."""

    def __init__(
        self,
        config: OneStepConfig,
        *,
        autoencoder: SkipAutoencoder | TinyAutoencoder,
        denoiser: Denoiser,
        fusion: LatentFusion | None,
    ) -> None:
        super().__init__()
        self.config = config
        self.autoencoder = autoencoder
        self.denoiser = denoiser
        self.fusion = fusion
        self.step = denoising_step(config.timestep)

    def forward(
        self,
        images: Float[Tensor, "inputs batch 3 height width"],
        text: Float[Tensor, "batch tokens features"],
        masks: Float[Tensor, "batch masks rows columns"] | None = None,
        *,
        encodes_at_once: bool = True,
    ) -> Float[Tensor, "batch 3 height width"]:
        """Repair every view.

        Images are the inputs in the configured order, rgb in [0, 1], height and width multiples of
        64; masks are shares of hits per latent position, if the configuration has them. Encoding
        one input after the other needs less memory and more time.

        Returns:
            Images in [0, 1] where the decoder keeps to its range; not clamped, so that gradients
            pass.
        """
        latents, skips = self._encode(images, encodes_at_once=encodes_at_once)
        weights = self._weights(latents)
        fused = mix(weights, latents.float())
        seen = fused
        if self.config.denoiser_sees != "fused":
            seen = latents.transpose(0, 1).flatten(1, 2)  # side by side
        if masks is not None:
            seen = torch.cat([seen, masks.to(seen.dtype)], dim=1)
        predicted = self.denoiser(seen, text)
        clean = denoise(fused, predicted, self.step, self.config.denoise)
        if self.config.skips == "fused":
            skips = mix_skips(skips, weights)
        decoded = self.autoencoder.decode(clean.to(latents.dtype), skips)
        return 0.5 * decoded.float() + 0.5

    def _encode(
        self, images: Float[Tensor, "inputs batch 3 height width"], *, encodes_at_once: bool
    ) -> tuple[Float[Tensor, "inputs batch 4 rows columns"], Skips]:
        """Latents of all inputs; skips of the first input, or of one input after the other."""
        dtype = next(self.autoencoder.parameters()).dtype
        flat = (2 * images - 1 if self.config.is_signed else images).to(dtype)
        num_skipped = {"none": 0, "render": 1, "fused": len(flat)}[self.config.skips]
        if encodes_at_once:
            batch = flat.shape[1]
            latents, skips = self.autoencoder.encode(
                flat.flatten(0, 1), num_skipped=num_skipped * batch
            )
            return latents.unflatten(0, (len(flat), batch)), skips
        found = [
            self.autoencoder.encode(one, num_skipped=len(one) if index < num_skipped else 0)
            for index, one in enumerate(flat)
        ]
        levels = zip(*(skips for _, skips in found if skips), strict=True)
        return torch.stack([latent for latent, _ in found]), tuple(map(torch.cat, levels))

    def _weights(
        self, latents: Float[Tensor, "inputs batch 4 rows columns"]
    ) -> Float[Tensor, "inputs batch weights rows columns"]:
        if self.fusion is not None:
            return self.fusion(latents)
        weights = torch.zeros_like(latents[:, :, :1], dtype=torch.float32)
        weights[0] = 1
        return weights
