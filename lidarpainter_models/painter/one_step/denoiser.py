"""SD-Turbo's U-Net with a wider first layer, at one fixed time.

The latents of all inputs enter side by side (8 channels for render and LiDAR). Weights of the
first layer for the added channels start at zero, so that the network begins as SD-Turbo on the
render; `copy` repeats the trained weights for each input, as the authors' own program does.
The last layer runs in float32, because the step that follows multiplies its rounding by up to 14.6.
"""

from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from lidarpainter_models.painter.one_step.latent_fusion import LATENT_CHANNELS, without_autocast

FirstLayerStart = Literal["zero", "copy"]


class Float32Layer(nn.Module):
    """A layer that always computes in float32, under autocast too."""

    def __init__(self, layer: nn.Module) -> None:
        super().__init__()
        self.layer = layer.float()

    def forward(self, features: Tensor) -> Tensor:
        """Run the layer on its input in float32."""
        with without_autocast(features.device):
            return self.layer(features.float())


class Denoiser(nn.Module):
    """Predicts, from the latents of all inputs and the text, the noise to take away."""

    timestep: Tensor

    def __init__(self, unet: nn.Module, *, timestep: int) -> None:
        """Take a diffusers `UNet2DConditionModel` of the right number of input channels."""
        super().__init__()
        self.unet = unet
        whole: Any = unet
        whole.conv_out = Float32Layer(whole.conv_out)
        # on the network's device, so that a CUDA graph can be captured
        self.register_buffer("timestep", torch.tensor([timestep]), persistent=False)

    def forward(
        self,
        latents: Float[Tensor, "batch channels rows columns"],
        text: Float[Tensor, "batch tokens features"],
    ) -> Float[Tensor, "batch 4 rows columns"]:
        """The predicted noise, in float32."""
        dtype = self.unet.get_parameter("time_embedding.linear_1.bias").dtype
        answer = self.unet(
            latents.to(dtype),
            self.timestep.expand(len(latents)),
            encoder_hidden_states=text.to(dtype),
            return_dict=False,
        )
        return answer[0]


def widen_first_layer(
    weight: Float[Tensor, "out 4 rows columns"], num_channels: int, start: FirstLayerStart
) -> Float[Tensor, "out channels rows columns"]:
    """The weights of a first layer for more input channels than it was trained for.

    `start` is `zero`, or `copy` for every further latent; channels of masks start at zero.
    """
    wide = weight.new_zeros(weight.shape[0], num_channels, *weight.shape[2:])
    copies = num_channels // LATENT_CHANNELS if start == "copy" else 1
    for copy in range(copies):
        wide[:, copy * LATENT_CHANNELS : (copy + 1) * LATENT_CHANNELS] = weight
    return wide
