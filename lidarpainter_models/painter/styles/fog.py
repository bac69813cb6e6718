"""Fog by the law of Koschmieder (1924): what is seen fades into the airlight with distance.

Light from a surface at distance d arrives as L t + A (1 - t), with transmittance t = exp(-beta d)
and airlight A. The visibility V is where a black object keeps 2 % contrast against the horizon:
beta = ln(50) / V = 3.912 / V. The airlight is that of the image's own horizon: fog droplets are
large against the wavelength and scatter all colours alike, so it is nearly grey. Sky at elevation e
is seen through layer / sin e of fog, so that it may shine through at the zenith.
"""

from math import inf

import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.painter.styles.view import StyleView, distances, elevations, quantile
from lidarpainter_models.weather.air import FOG_BRIGHTNESS, FOG_GREYNESS, FOG_LAYER_M, transmittance
from lidarpainter_models.weather.light import luminance, to_display, to_linear
from lidarpainter_models.weather.mix import FOG_VISIBILITY_M


def add_fog(
    view: StyleView, visibility_m: float = FOG_VISIBILITY_M
) -> Float[Tensor, "height width 3"]:
    """The view in a bank of fog on the ground, as displayed."""
    clear = to_linear(view.rgb)
    through = fog_transmittance(view, visibility_m)[..., None]
    air = FOG_BRIGHTNESS * airlight(view, greyness=FOG_GREYNESS)
    return to_display(clear * through + air * (1 - through))


def fog_transmittance(view: StyleView, visibility_m: float) -> Float[Tensor, "height width"]:
    """What comes through of each pixel's light; a pixel at an edge mixes surface and sky."""
    surface = transmittance(distances(view), visibility_m)
    if view.camera is None:
        upward = torch.full_like(surface, inf)
    else:
        upward = FOG_LAYER_M / elevations(view.camera).clamp_min(1e-3).sin()
    sky = transmittance(upward, visibility_m)
    surface = torch.where(view.surface, surface, sky)
    return view.sky * sky + (1 - view.sky) * surface


def airlight(view: StyleView, *, greyness: float) -> Float[Tensor, "3"]:
    """The light of the horizon: the lowest quarter of the sky, or the brightest far surfaces.

    Without sky the haziest pixels stand for it: those of the largest dark channel (He et al.,
    2009), their darkest colour, among the farthest tenth.
    """
    light = to_linear(view.rgb)
    sky = view.sky > 0.9
    rows = torch.arange(len(light))[:, None].expand_as(sky)[sky].float()
    if len(rows) >= 0.002 * sky.numel():
        horizon = sky & (torch.arange(len(light))[:, None] >= rows.quantile(0.75))
        found = light[horizon].mean(dim=0)
    else:
        distance_m = distances(view).flatten()
        far = distance_m >= quantile(distance_m, 0.9)
        dark = light.amin(dim=-1).flatten()
        hazy = far & (dark >= quantile(dark[far], 0.9))
        found = light.reshape(-1, 3)[hazy].mean(dim=0)
    return found + greyness * (luminance(found) - found)
