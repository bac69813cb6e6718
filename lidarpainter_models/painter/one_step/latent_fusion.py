"""Latent attention fusion: how much of each input the denoised latent starts from.

The paper's `z = Att * zA + (1 - Att) * zL` with Att a small convolutional network of both latents.
Given more inputs than two, a softmax takes the place of the sigmoid. At first the render, which is
right nearly everywhere, has a share of 0.92 of two inputs and 0.86 of three.
"""

from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from lidarpainter_models.errors import ConfigError

LATENT_CHANNELS = 4
HIDDEN_CHANNELS = 64
FIRST_LOGIT = 2.5
"""Logit of the render's share at the start."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FusionConfig:
    """The shape of the fusion."""

    kind: Literal["attention", "as-shipped"] = "attention"
    """`attention`: 3x3 convolutions that start at the render; `as-shipped`: two 1x1 convolutions
    with a weight per latent channel, for two inputs, as in the authors' own program."""
    channels: int = 1
    """Weights per latent position: 1, or one for each of the four latent channels."""

    def __post_init__(self) -> None:
        if self.channels not in (1, LATENT_CHANNELS):
            raise ConfigError(f"fusion channels must be 1 or 4, got {self.channels}")
        if self.kind == "as-shipped" and self.channels != LATENT_CHANNELS:
            raise ConfigError(f"the as-shipped fusion has 4 channels, got {self.channels}")


class LatentFusion(nn.Module):
    """Weighs two or more latents against each other, in float32, under autocast too."""

    def __init__(self, config: FusionConfig, num_inputs: int) -> None:
        super().__init__()
        if num_inputs < 2 or (config.kind == "as-shipped" and num_inputs != 2):
            raise ConfigError(f"{config.kind} fusion cannot weigh {num_inputs} inputs")
        self.config = config
        self.num_inputs = num_inputs
        num_logits = config.channels * (1 if num_inputs == 2 else num_inputs)
        in_channels = LATENT_CHANNELS * num_inputs
        if config.kind == "as-shipped":
            self.layers = nn.Sequential(
                nn.Conv2d(in_channels, LATENT_CHANNELS, 1),
                nn.ReLU(),
                nn.Conv2d(LATENT_CHANNELS, num_logits, 1),
            )
            return
        last = nn.Conv2d(HIDDEN_CHANNELS, num_logits, 3, padding=1)
        for parameter in last.parameters():
            nn.init.zeros_(parameter)
        with torch.no_grad():
            last.get_parameter("bias")[: config.channels] = FIRST_LOGIT
        first = nn.Conv2d(in_channels, HIDDEN_CHANNELS, 3, padding=1)
        self.layers = nn.Sequential(first, nn.SiLU(), last)

    def forward(
        self, latents: Float[Tensor, "inputs batch 4 height width"]
    ) -> Float[Tensor, "inputs batch weights height width"]:
        """Shares of the inputs, summing to one."""
        stacked = latents.float().transpose(0, 1).flatten(1, 2)
        with without_autocast(stacked.device):
            logits = self.layers(stacked)
        if self.num_inputs == 2:
            share = torch.sigmoid(logits)
            return torch.stack([share, 1 - share])
        return logits.unflatten(1, (self.num_inputs, -1)).softmax(dim=1).transpose(0, 1)


def mix(
    weights: Float[Tensor, "inputs batch weights height width"],
    images: Float[Tensor, "inputs batch channels height width"],
) -> Float[Tensor, "batch channels height width"]:
    """The weighted sum over the inputs."""
    return (weights * images).sum(dim=0)


def without_autocast(device: torch.device) -> AbstractContextManager[Any]:
    """Layers run inside compute in the type of their weights."""
    if not torch.amp.is_autocast_available(device.type):  # the meta device
        return nullcontext()
    return torch.autocast(device.type, enabled=False)
