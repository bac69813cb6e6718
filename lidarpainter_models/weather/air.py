"""Air that dims and whitens what is seen through it: fog, and rain as a veil.

Light from a surface at distance d arrives as L t + A (1 - t), with transmittance t = exp(-beta d)
and airlight A (Koschmieder, 1924). The visibility V is where a black object keeps 2 % contrast
against the horizon: beta = ln(50) / V = 3.912 / V.
"""

from math import log

import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.weather.light import luminance

LEAST_CONTRAST = 0.02
"""What the eye can just tell from the horizon, in the definition of visibility."""
FOG_LAYER_M = 120.0
"""Height of a bank of fog above the camera."""
FOG_GREYNESS = 0.85
"""How far the airlight's colour goes from that of the sky to grey: droplets are large."""
FOG_BRIGHTNESS = 0.8
"""Airlight against the light of the horizon in the clear image."""
OVERCAST_TINT = (0.96, 1.0, 1.05)
CLOUD_LIGHT = 0.45
"""Of the overcast sky, in units of display white."""
OVERCAST = 0.62  # daylight under rain clouds against that of a clear day
COLOUR_WITHOUT_SUN = 0.75
"""What is left of colours under clouds."""


def extinction_per_m(visibility_m: float) -> float:
    """Koschmieder's beta."""
    return -log(LEAST_CONTRAST) / visibility_m


def transmittance(
    distance_m: Float[Tensor, "*grid"], visibility_m: float
) -> Float[Tensor, "*grid"]:
    """exp(-beta d)."""
    return torch.exp(-extinction_per_m(visibility_m) * distance_m)


def rain_extinction_per_m(rain_mm_per_h: float) -> float:
    """Of the veil of far drops: 0.312 R^0.67 per km (Rensch and Long, 1970)."""
    return 0.312e-3 * rain_mm_per_h**0.67


def overcast(light: Float[Tensor, "*grid 3"]) -> Float[Tensor, "*grid 3"]:
    """Light of surfaces under rain clouds, by that of a clear day."""
    grey = luminance(light)[..., None]
    dull = OVERCAST * (grey + COLOUR_WITHOUT_SUN * (light - grey))
    return dull * light.new_tensor(OVERCAST_TINT)


def cloud_light(like: Tensor) -> Float[Tensor, "3"]:
    """Of the overcast sky, where another tensor lies."""
    return CLOUD_LIGHT * like.new_tensor(OVERCAST_TINT)
