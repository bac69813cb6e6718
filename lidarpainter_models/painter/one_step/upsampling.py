"""Doubling an image's size and convolving it, in 16 multiplications where there were 36.

Autoencoder and U-Net double their features by repeating every value and run a 3x3 convolution over
the result. Of its nine weights several then meet the same value: an output in an even row sees two
rows of the input, weighted `w0` and `w1 + w2`; in an odd row `w0 + w1` and `w2`. So each of the
four phases of the output is a 2x2 convolution of the input itself (the polyphase identity; see
Vaidyanathan, "Multirate Systems and Filter Banks", 1993, section 4.3). The same function up to the
rounding of the summed weights.
"""

from itertools import product
from typing import Any

import torch
import torch.nn.functional as F  # noqa: N812 - the name everyone knows
from jaxtyping import Float
from torch import Tensor, nn

PHASES = (0, 1)


class PhasedUpsampling(nn.Module):
    """Doubles height and width and convolves, by one 2x2 convolution per phase of the output."""

    weights: Tensor
    bias: Tensor | None

    def __init__(self, conv: nn.Conv2d) -> None:
        """Take the 3x3 convolution that follows the doubling."""
        super().__init__()
        weights = phase_weights(conv.weight.detach().float()).to(conv.weight.dtype)
        self.weights = nn.Parameter(weights, requires_grad=False)
        bias = conv.bias
        self.bias = None if bias is None else nn.Parameter(bias.detach(), requires_grad=False)

    def forward(
        self,
        features: Float[Tensor, "batch channels height width"],
        output_size: tuple[int, int] | None = None,  # noqa: ARG002 - diffusers' twice the input
    ) -> Float[Tensor, "batch out doubled_height doubled_width"]:
        """The doubled and convolved features."""
        batch, _, height, width = features.shape
        out = torch.empty(
            (batch, len(self.weights) // 4, 2 * height, 2 * width),
            dtype=features.dtype,
            device=features.device,
            memory_format=torch.channels_last,
        )
        places = product(PHASES, PHASES)
        for (row, column), weight in zip(places, self.weights.chunk(4), strict=True):
            # the padded side is the one the phase looks beyond
            padded = F.pad(features, (1 - column, column, 1 - row, row))
            out[:, :, row::2, column::2] = F.conv2d(padded, weight, self.bias)
        return out


def phase_weights(
    weight: Float[Tensor, "out channels 3 3"],
) -> Float[Tensor, "4*out channels 2 2"]:
    """Weights of the four phases one after the other: even and odd rows by such columns."""
    phases = [_phase(_phase(weight, 2, row), 3, column) for row, column in product(PHASES, PHASES)]
    return torch.cat(phases)


def _phase(weight: Tensor, axis: int, phase: int) -> Tensor:
    first, middle, last = weight.unbind(axis)
    pair = (first, middle + last) if phase == 0 else (first + middle, last)
    return torch.stack(pair, dim=axis)


def phase_upsamplings(module: nn.Module) -> nn.Module:
    """Replace, in place, every doubling with a 3x3 convolution; adapters must be merged before."""
    for parent in list(module.modules()):
        for name, child in list(parent.named_children()):
            doubling: Any = child
            if type(child).__name__ == "Upsample2D" and _can_be_phased(doubling):
                setattr(parent, name, PhasedUpsampling(doubling.conv))
    return module


def _can_be_phased(upsampling: Any) -> bool:  # noqa: ANN401 - diffusers' Upsample2D
    conv = getattr(upsampling, "conv", None)
    return (
        isinstance(conv, nn.Conv2d)
        and upsampling.use_conv
        and not upsampling.use_conv_transpose
        and getattr(upsampling, "norm", None) is None
        and upsampling.interpolate
        and (conv.kernel_size, conv.padding, conv.stride) == ((3, 3), (1, 1), (1, 1))
    )
