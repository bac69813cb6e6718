"""Night by relighting: daylight is taken out, lamps are put in.

The image's brightness relative to its sunlit surfaces stands for reflectance. It is lit anew by a
dark blue sky, whose colour shift follows the night tonal reproduction of Jensen et al. (2000), by a
low beam of the car that looks on, and by the lamps found in the image (`lamps.py`), each with the
inverse square of the distance. Around lamps light scatters in lens and air: the point spread is a
sum of Gaussians (after Spencer et al., "Physically-based glare effects", 1995). The sensor adds
shot and read noise. Shadows of the sun stay where they are, only weaker: nothing tells reflectance
and shadow apart.
"""

import cv2
import torch
from jaxtyping import Float
from torch import Generator, Tensor

from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.painter.styles.lamps import Lamp, LampKind, Place, find_lamps
from lidarpainter_models.painter.styles.view import (
    StyleView,
    distances,
    elevations,
    fit_ground,
    open_sky,
    quantile,
    ray_directions,
    surface_points,
)
from lidarpainter_models.weather.darkness import (
    BEAM,
    BEAM_RGB,
    FACING,
    HEADLAMP_AHEAD_M,
    HEADLAMP_HEIGHT_M,
    LEAST_GRAZING,
    LIT_SHARE,
    NEAREST_M2,
    WINDOW_POWER,
    WINDOW_RADIANCE,
    by_skylight,
    dipped_beam,
    night_reflectance,
    night_sky,
)
from lidarpainter_models.weather.light import luminance, to_display, to_linear

HEADLAMP_SIDE_M = 0.6
GLARE_SIGMAS_RAD = ((0.0015, 0.5), (0.006, 0.3), (0.025, 0.14), (0.09, 0.06))
"""Width and share of the Gaussians of the point spread; the rest passes straight."""
RADIANCE: dict[LampKind, float] = {"signal": 1.6, "window": WINDOW_RADIANCE, "street": 6.0}
"""Of a lamp's own pixels, in units of display white."""
POWER: dict[LampKind, float] = {"signal": 0.02, "window": WINDOW_POWER, "street": 4.0}
"""Irradiance a metre away, in the same units."""
MOST_SOURCES = 60
NOISE = 0.012
"""Deviation of the sensor's noise at a tenth of display white."""


def turn_to_night(
    view: StyleView, generator: Generator, strength: float = 1.0
) -> Float[Tensor, "height width 3"]:
    """The view at night, as displayed; the generator lights windows and draws noise.

    Between the strengths 0, which is day, and 1, the light of both is mixed.
    """
    day = to_linear(view.rgb)
    night = _relit(view, day, generator)
    return to_display(day + strength * (night - day))


def place_of(view: StyleView) -> tuple[Place, Float[Tensor, "height width 3"] | None]:
    """What lamps are looked for in, and where its surfaces lie, metres from the camera."""
    distance_m = _without_specks(distances(view))
    points_m = None if view.camera is None else surface_points(view.camera, distance_m)
    ground = None if points_m is None else fit_ground(points_m, view.surface)
    if points_m is not None and ground is not None:
        points_m = ground.flattened(points_m)
    place = Place(
        light=to_linear(view.rgb),
        display=view.rgb,
        distance_m=distance_m,
        height_m=None if points_m is None or ground is None else ground.heights(points_m),
        surface=view.surface,
        focal_px=view.focal_px,
    )
    return place, points_m


def sunlit_white(view: StyleView) -> float:
    """Daylight of the brightest tenth of the surfaces."""
    grey = luminance(to_linear(view.rgb))
    seen = grey[view.surface] if bool(view.surface.any()) else grey.flatten()
    return max(float(quantile(seen, 0.9)), 1e-3)


def _relit(
    view: StyleView, day: Float[Tensor, "height width 3"], generator: Generator
) -> Float[Tensor, "height width 3"]:
    """Night light of the whole view, with glare and noise."""
    place, points_m = place_of(view)
    lamps = find_lamps(place, lit_share=LIT_SHARE, generator=generator)
    reflectance = night_reflectance(day, sunlit_white(view))
    surface = by_skylight(reflectance)
    irradiance = torch.zeros_like(day)
    if view.camera is not None and points_m is not None and place.height_m is not None:
        irradiance += BEAM * low_beam(view.camera, points_m, place.height_m)
    irradiance += lamp_irradiance(lamps, points_m, place)
    surface = surface + reflectance * irradiance
    light = surface + open_sky(view)[..., None] * (_night_sky(view) - surface)
    glowing = add_glare(light + _emission(lamps, day), view.focal_px)
    return _with_noise(glowing, generator)


def _without_specks(distance_m: Float[Tensor, "height width"]) -> Float[Tensor, "height width"]:
    """The median of five by five pixels: light falls off smoothly on a road."""
    return 1 / torch.from_numpy(cv2.medianBlur((1 / distance_m).numpy(), 5))


def _night_sky(view: StyleView) -> Float[Tensor, "height width 3"]:
    """Glow that fades upwards over a dark blue; without a camera the image's rows stand in."""
    if view.camera is None:
        rows = torch.linspace(0.6, 0.0, len(view.rgb))[:, None]
        elevation = rows.expand(view.rgb.shape[:2])
    else:
        elevation = elevations(view.camera)
    return night_sky(elevation)


def low_beam(
    camera: Camera,
    points_m: Float[Tensor, "height width 3"],
    height_m: Float[Tensor, "height width"],
) -> Float[Tensor, "height width 3"]:
    """Irradiance of two dipped headlamps under the camera, 1 a metre ahead of one on its axis.

    Bright below a sharp cut-off and fading downwards and to the sides, as in UN Regulation 112;
    the ground is lit at the grazing angle at which it lies, all else as if it faced the lamp.
    """
    ahead = ray_directions(camera)[camera.height_px // 2, camera.width_px // 2].clone()
    ahead[2] = 0
    ahead = torch.nn.functional.normalize(ahead, dim=0)
    left = torch.stack([-ahead[1], ahead[0], ahead[2]])
    forward = points_m @ ahead - HEADLAMP_AHEAD_M
    sideways = points_m @ left
    found = torch.zeros_like(height_m)
    for side_m in (HEADLAMP_SIDE_M, -HEADLAMP_SIDE_M):
        across, up = sideways - side_m, height_m - HEADLAMP_HEIGHT_M
        distance = (forward**2 + across**2 + up**2).sqrt().clamp_min(1.0)
        level = forward.clamp_min(0.1)
        azimuth, elevation = torch.atan2(across, level), torch.atan2(up, level)
        beam = dipped_beam(azimuth, elevation) * (forward > 0)
        grazing = (HEADLAMP_HEIGHT_M / distance).clamp_min(LEAST_GRAZING)
        facing = grazing + ((height_m - 0.15) / 0.5).clamp(0, 1) * (FACING - grazing)
        found += beam * facing / distance**2
    return torch.nan_to_num(found)[..., None] * torch.tensor(BEAM_RGB)


def lamp_irradiance(
    lamps: list[Lamp], points_m: Float[Tensor, "height width 3"] | None, place: Place
) -> Float[Tensor, "height width 3"]:
    """What the strongest lamps throw onto the surfaces around them."""
    found = torch.zeros_like(place.light)
    if points_m is None:
        return found
    points = torch.where(place.surface[..., None], points_m, 1e6)
    strongest = sorted(lamps, key=lambda lamp: -POWER[lamp.kind] / lamp.distance_m)
    for lamp in strongest[:MOST_SOURCES]:
        where = points_m[lamp.window][lamp.patch].median(dim=0).values
        squared = (points - where).square().sum(dim=-1)
        found += (POWER[lamp.kind] / (squared + NEAREST_M2))[..., None] * lamp.colour
    return found


def _emission(
    lamps: list[Lamp], day: Float[Tensor, "height width 3"]
) -> Float[Tensor, "height width 3"]:
    """Light of the lamps' own pixels; a lamp keeps the texture that it has by day."""
    found = torch.zeros_like(day)
    for lamp in lamps:
        texture = luminance(day[lamp.window]).clamp_min(1e-4)
        texture = (texture / texture[lamp.patch].mean()).clamp(0.3, 1.5)
        own = RADIANCE[lamp.kind] * (texture * lamp.patch)[..., None] * lamp.colour
        found[lamp.window] = torch.maximum(found[lamp.window], own)
    return found


def add_glare(
    light: Float[Tensor, "height width 3"], focal_px: float
) -> Float[Tensor, "height width 3"]:
    """Spread what is brighter than the display; the total light stays the same."""
    bright = (light - 0.5).clamp_min(0)
    spread = torch.zeros_like(light)
    rest = 1.0
    for sigma_rad, share in GLARE_SIGMAS_RAD:
        sigma_px = max(sigma_rad * focal_px, 0.3)
        spread += share * torch.from_numpy(cv2.GaussianBlur(bright.numpy(), (0, 0), sigma_px))
        rest -= share
    return light - bright + rest * bright + spread


def _with_noise(
    light: Float[Tensor, "height width 3"], generator: Generator
) -> Float[Tensor, "height width 3"]:
    """Shot noise that grows with the root of light, over a third as much read noise."""
    drawn = torch.randn(light.shape, generator=generator)
    shot = (light.clamp_min(0) / 0.1 + 0.1).sqrt()
    return light + NOISE * 0.1 * shot * drawn
