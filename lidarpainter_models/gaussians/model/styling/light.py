"""How light a scene's Gaussians and its sky are under a style, apart from what moves."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.gaussians.model.gaussian_set import GaussianSet
from lidarpainter_models.gaussians.model.sky import SkyTexture
from lidarpainter_models.gaussians.model.styling.lamps import fixed_lamps
from lidarpainter_models.gaussians.model.styling.scene_style import SceneStyle, StyledPlace
from lidarpainter_models.gaussians.model.styling.traits import SurfaceTraits
from lidarpainter_models.kernels.scene_light import LEAST_BASE, Appearance, Surroundings, irradiance
from lidarpainter_models.weather.air import (
    FOG_BRIGHTNESS,
    FOG_GREYNESS,
    FOG_LAYER_M,
    cloud_light,
    extinction_per_m,
    overcast,
    rain_extinction_per_m,
)
from lidarpainter_models.weather.darkness import (
    WARM_RGB,
    WINDOW_RADIANCE,
    by_skylight,
    night_reflectance,
    night_sky,
)
from lidarpainter_models.weather.light import luminance, to_display, to_linear
from lidarpainter_models.weather.water import (
    FILM_SHINE,
    PUDDLE_SHARE,
    RAIN_MM_PER_H,
    WETNESS,
    puddles,
    wet_reflectance,
)

MIRRORED_SKY_RAD = 0.4
"""Elevation of the night sky that a wet road shows."""


@dataclass(frozen=True, kw_only=True, eq=False)
class StyledLight:
    """A scene under styles of certain strengths."""

    strengths: Mapping[str, float]
    appearance: Appearance
    surroundings: Surroundings
    sky: SkyTexture


def fixed_irradiance(traits: SurfaceTraits, place: StyledPlace) -> Float[Tensor, "gaussians 3"]:
    """What lamps that stand throw onto the street, and it can send back."""
    lamps = fixed_lamps(place)
    bodies = int(traits.surfaces.body_index.max()) + 1 if len(traits.day_light) else 1
    here = torch.eye(4, dtype=torch.float64).expand(bodies, 4, 4)
    is_street = (traits.surfaces.body_index == 0)[:, None]
    return irradiance(traits.surfaces, here, lamps) * is_street


def styled_light(
    gaussians: GaussianSet,
    sky: SkyTexture,
    traits: SurfaceTraits,
    style: SceneStyle,
    strengths: Mapping[str, float],
    lamp_light: Float[Tensor, "gaussians 3"],
) -> StyledLight:
    """First everything gets wet, then dark, then fog comes up.

    `sky` is that of a clear day; `strengths` are of every style that changes anything; for
    `lamp_light` see `fixed_irradiance`.
    """
    rain, night = strengths.get("rain", 0.0), strengths.get("night", 0.0)
    wetness = WETNESS * (0.5 + 0.5 * traits.ground)[:, None]
    by_day = traits.day_light + rain * (_overcast(traits.day_light, wetness) - traits.day_light)
    dry_or_wet = traits.day_light
    if rain:
        dry_or_wet = _wetted(traits.day_light, rain * wetness)
    reflectance = night_reflectance(dry_or_wet, float(style.place.white))
    windows = WINDOW_RADIANCE * traits.window[:, None] * by_day.new_tensor(WARM_RGB)
    by_night = by_skylight(reflectance) + reflectance * lamp_light + windows
    still = puddles(
        traits.surfaces.means, torch.Generator().manual_seed(style.seed), share=PUDDLE_SHARE
    )
    appearance = Appearance(
        light=by_day + night * (by_night - by_day),
        reflectance=night * reflectance,
        harmonics=gaussians.sh_rest.detach(),
        per_base=1 / traits.base_rgb.clamp_min(LEAST_BASE),
        shine=rain * WETNESS * traits.ground * (FILM_SHINE + (1 - FILM_SHINE) * still),
        skyline=traits.skylines.of_surface,
    )
    return StyledLight(
        strengths=strengths,
        appearance=appearance,
        surroundings=_surroundings(traits, style, strengths),
        sky=_styled_sky(sky, style, strengths),
    )


def _overcast(
    light: Float[Tensor, "*grid 3"], wetness: Float[Tensor, "*#grid 1"]
) -> Float[Tensor, "*grid 3"]:
    """Wet surfaces under clouds."""
    return _wetted(overcast(light), wetness)


def _wetted(
    light: Float[Tensor, "*grid 3"], wetness: Float[Tensor, "*#grid 1"]
) -> Float[Tensor, "*grid 3"]:
    """Each surface as far as it is wet."""
    return light + wetness * (wet_reflectance(light, 1.0) - light)


def _fog_extinction(style: SceneStyle, strengths: Mapping[str, float]) -> float:
    return strengths.get("foggy", 0.0) * extinction_per_m(style.mix.visibility_m)


def _airlight(style: SceneStyle, strengths: Mapping[str, float]) -> Float[Tensor, "3"]:
    """Light of the air: of the horizon, of clouds in rain, of the town at night."""
    horizon = style.place.horizon_light
    grey = horizon + FOG_GREYNESS * (luminance(horizon) - horizon)
    day = FOG_BRIGHTNESS * grey
    day = day + strengths.get("rain", 0.0) * (cloud_light(horizon) - day)
    return day + strengths.get("night", 0.0) * (night_sky(horizon.new_zeros(())) - day)


def _surroundings(
    traits: SurfaceTraits, style: SceneStyle, strengths: Mapping[str, float]
) -> Surroundings:
    rain, night = strengths.get("rain", 0.0), strengths.get("night", 0.0)
    horizon = style.place.horizon_light
    clouds = cloud_light(horizon)
    overhead = clouds + night * (night_sky(horizon.new_tensor(MIRRORED_SKY_RAD)) - clouds)
    around = _overcast(traits.skylines.day_light, horizon.new_tensor([[[0.5 * WETNESS]]]))
    reflectance = night_reflectance(traits.skylines.day_light, float(style.place.white))
    around = around + night * (by_skylight(reflectance) - around)
    veil = rain * rain_extinction_per_m(RAIN_MM_PER_H)
    return Surroundings(
        extinction_per_m=_fog_extinction(style, strengths) + veil,
        airlight=_airlight(style, strengths),
        sky_light=overhead,
        skylines=torch.cat([around, traits.skylines.slope[..., None]], dim=-1),
    )


def _styled_sky(sky: SkyTexture, style: SceneStyle, strengths: Mapping[str, float]) -> SkyTexture:
    """Every texel behind clouds, at night, and through the fog that lies along its direction."""
    layout, rgb = sky.layout, sky.rgb.detach()
    rows = torch.arange(layout.rows, device=rgb.device, dtype=rgb.dtype) + 0.5
    elevation = layout.elevation_top_rad - rows * layout.texel_rad
    light = to_linear(rgb)
    light = light + strengths.get("rain", 0.0) * (cloud_light(rgb) - light)
    light = light + strengths.get("night", 0.0) * (night_sky(elevation)[:, None] - light)
    path_m = FOG_LAYER_M / elevation.clamp(1e-3, math.pi / 2).sin()
    through = torch.exp(-_fog_extinction(style, strengths) * path_m)[:, None, None]
    light = light * through + _airlight(style, strengths) * (1 - through)
    return replace(sky, rgb=to_display(light))
