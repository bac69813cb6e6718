"""Fog by the law of Koschmieder (1924): what is seen fades into the airlight with distance.

Light from a surface at distance d arrives as L t + A (1 - t), with transmittance t = exp(-beta d)
and airlight A. The visibility V is where a black object keeps 2 % contrast against the horizon:
beta = ln(50) / V = 3.912 / V. The airlight is that of the image's own horizon: fog droplets are
large against the wavelength and scatter all colours alike, so it is nearly grey.
"""

from dataclasses import dataclass
from math import inf, log

import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.painter.styles.light import luminance, to_display, to_linear
from lidarpainter_models.painter.styles.view import StyleView, distances, elevations

LEAST_CONTRAST = 0.02
"""What the eye can just tell from the horizon, in the definition of visibility."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FogConfig:
    """A bank of fog on the ground."""

    visibility_m: float = 120.0
    """Where contrast has fallen to 2 %; below 1000 m it is called fog. Infinity leaves the image
    as it is."""
    layer_m: float = 120.0
    """Height of the fog above the camera: sky at elevation e is seen through layer / sin e of it,
    so that it may shine through at the zenith."""
    greyness: float = 0.85
    """How far the airlight's colour goes from that of the sky to grey."""
    brightness: float = 0.8
    """Airlight against the light of the horizon in the clear image."""


def add_fog(view: StyleView, config: FogConfig | None = None) -> Float[Tensor, "height width 3"]:
    """The view in fog, as displayed."""
    config = config or FogConfig()
    clear = to_linear(view.rgb)
    through = fog_transmittance(view, config)[..., None]
    air = config.brightness * airlight(view, greyness=config.greyness)
    return to_display(clear * through + air * (1 - through))


def extinction_per_m(visibility_m: float) -> float:
    """Koschmieder's beta."""
    return 0.0 if visibility_m == inf else -log(LEAST_CONTRAST) / visibility_m


def transmittance(
    distance_m: Float[Tensor, "height width"], visibility_m: float
) -> Float[Tensor, "height width"]:
    """exp(-beta d)."""
    beta = extinction_per_m(visibility_m)
    return torch.exp(-beta * distance_m) if beta else torch.ones_like(distance_m)


def fog_transmittance(view: StyleView, config: FogConfig) -> Float[Tensor, "height width"]:
    """What comes through of each pixel's light; a pixel at an edge mixes surface and sky."""
    surface = transmittance(distances(view), config.visibility_m)
    if view.camera is None:
        upward = torch.full_like(surface, inf)
    else:
        upward = config.layer_m / elevations(view.camera).clamp_min(1e-3).sin()
    sky = transmittance(upward, config.visibility_m)
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
        far = distance_m >= _quantile(distance_m, 0.9)
        dark = light.amin(dim=-1).flatten()
        hazy = far & (dark >= _quantile(dark[far], 0.9))
        found = light.reshape(-1, 3)[hazy].mean(dim=0)
    return found + greyness * (luminance(found) - found)


def _quantile(values: Float[Tensor, " pixels"], share: float) -> Float[Tensor, ""]:
    """A value that so large a share does not reach; `torch.quantile` takes no large images."""
    return values.kthvalue(max(1, round(share * len(values)))).values
