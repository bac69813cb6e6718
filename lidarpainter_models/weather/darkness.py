"""Light at night in a town: a dark blue sky, its glow, dipped beams, and what surfaces make of it.

The brightness of a daylight picture relative to its sunlit surfaces stands for reflectance. The
colour shift under skylight follows the night tonal reproduction of Jensen et al. (2000).
"""

import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.weather.light import luminance

SKYLIGHT_RGB = (0.55, 0.75, 1.25)
"""The blue of what is left when the sun is gone, of luminance about 0.75."""
SKYGLOW_RGB = (1.0, 0.76, 0.58)
"""Town light thrown back by the air near the horizon."""
COLOUR_LEFT = 0.4
"""Of a surface's own colour under skylight (the eye's cones no longer see it)."""
AMBIENT = 0.055  # skylight against daylight; a camera at night is exposed far longer than the eye
SKY_GLOW = 0.022  # radiance of the sky at the horizon, in units of display white
SHADOW_SOFTENING = 0.75  # power of reflectance: below 1 the sun's shadows fade
WARM_RGB = (1.0, 0.72, 0.38)
"""A lamp of about 2900 kelvin, brightest channel 1."""
WINDOW_RADIANCE, WINDOW_POWER = 0.55, 0.25
"""Of a lit window, and its irradiance a metre away, in units of display white."""
LIT_SHARE = 0.4
"""Of the windows."""
HEADLAMP_HEIGHT_M = 0.65
HEADLAMP_AHEAD_M = 1.2
"""Of a camera behind the windscreen."""
BEAM_RGB = (1.0, 0.93, 0.78)
BEAM = 280.0
"""Irradiance of a low beam at a metre, in units of display white."""
BEAM_ACROSS_RAD = 0.26
"""Deviation of the low beam to the sides."""
BEAM_CUT_RAD = -0.008
"""The cut-off: half a degree below the horizon."""
BEAM_DOWN_RAD = 0.09
BEAM_EDGE_RAD = 0.012
STRAY_LIGHT = 0.03
"""Of a beam above its cut-off."""
LEAST_GRAZING = 0.12
"""Share of a grazing beam that rough asphalt still sends back."""
FACING = 0.15
"""Share that surfaces above the ground send back; few face the lamp."""
NEAREST_M2 = 2.0
"""Square of a distance that is added to all: a lamp lights what stands beside it little more."""


def night_reflectance(day: Float[Tensor, "*grid 3"], white: float) -> Float[Tensor, "*grid 3"]:
    """Daylight over that of the brightest surfaces, contrast softened."""
    relative = (luminance(day) / white).clamp(1e-4, 1.5)
    return day / white * (relative ** (SHADOW_SOFTENING - 1))[..., None] * 0.8


def by_skylight(reflectance: Float[Tensor, "*grid 3"]) -> Float[Tensor, "*grid 3"]:
    """Surfaces under the sky alone; so little light has hardly any colour of its own."""
    grey = luminance(reflectance)[..., None]
    tint = reflectance.new_tensor(SKYLIGHT_RGB)
    return AMBIENT * tint * (grey + COLOUR_LEFT * (reflectance - grey))


def night_sky(elevation_rad: Float[Tensor, "*grid"]) -> Float[Tensor, "*grid 3"]:
    """Glow that fades upwards over a dark blue."""
    tints = elevation_rad.new_tensor([SKYGLOW_RGB, SKYLIGHT_RGB])
    glow = torch.exp(-elevation_rad.clamp_min(0) / 0.15)[..., None]
    return SKY_GLOW * glow * tints[0] + 0.2 * AMBIENT * tints[1]


def dipped_beam(
    azimuth_rad: Float[Tensor, "*grid"],
    elevation_rad: Float[Tensor, "*grid"],
    *,
    stray: float | Float[Tensor, "*grid"] = STRAY_LIGHT,
) -> Float[Tensor, "*grid"]:
    """Relative intensity of a low beam by direction from its lamp, as in UN Regulation 112.

    Bright below a sharp cut-off, fading downwards and to the sides, with stray light above.
    """
    below = BEAM_CUT_RAD - elevation_rad
    soft = stray + (1 - stray) * torch.exp(-0.5 * (below / BEAM_EDGE_RAD) ** 2)
    beam = torch.where(below > 0, torch.exp(-below / BEAM_DOWN_RAD), soft)
    return beam * torch.exp(-0.5 * (azimuth_rad / BEAM_ACROSS_RAD) ** 2)
