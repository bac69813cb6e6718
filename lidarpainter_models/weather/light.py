"""Between displayed colours and light: styles add and attenuate light, not display values.

The curve is that of sRGB (IEC 61966-2-1); luminance weighs linear rgb as Rec. 709 does.
"""

import torch
from jaxtyping import Float
from torch import Tensor

REC_709 = (0.2126, 0.7152, 0.0722)


def to_linear(rgb: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Light in units of display white, from displayed rgb in [0, 1]."""
    steep = ((rgb.clamp_min(0) + 0.055) / 1.055) ** 2.4
    return torch.where(rgb <= 0.04045, rgb / 12.92, steep)


def to_display(light: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Displayed rgb in [0, 1]; brighter light than white is cut off."""
    light = light.clamp(0, 1)
    steep = 1.055 * light.clamp_min(0.0031308) ** (1 / 2.4) - 0.055
    return torch.where(light <= 0.0031308, 12.92 * light, steep)


def luminance(light: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
    """Brightness of linear rgb."""
    return light @ torch.tensor(REC_709, dtype=light.dtype, device=light.device)
