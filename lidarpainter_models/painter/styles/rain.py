"""Rain: an overcast sky, a veil of far drops, streaks of near ones, and a wet road.

The veil is Koschmieder's with the extinction of rain, 0.312 R^0.67 per km at R mm an hour (Rensch
and Long, 1970). Drops in front of the lens are streaks as in Garg and Nayar (2007): a drop of
diameter D falls at 9.65 - 10.3 exp(-0.6 D) m/s (D in mm; Atlas et al., 1973), so that during the
exposure it draws a line; it refracts a wide view of the surroundings, so it is about as bright as
their mean. `wet_ground.py` wets the road.
"""

import math

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Generator, Tensor

from lidarpainter_models.painter.styles.view import (
    StyleView,
    distances,
    fit_ground,
    open_sky,
    ray_directions,
    surface_points,
)
from lidarpainter_models.painter.styles.wet_ground import ground_pixels, mirrored
from lidarpainter_models.weather.air import (
    CLOUD_LIGHT,
    COLOUR_WITHOUT_SUN,
    OVERCAST,
    OVERCAST_TINT,
    rain_extinction_per_m,
)
from lidarpainter_models.weather.light import luminance, to_display, to_linear
from lidarpainter_models.weather.water import (
    FILM_SHINE,
    PUDDLE_SHARE,
    RAIN_MM_PER_H,
    WETNESS,
    fresnel,
    puddles,
    wet_reflectance,
)

STREAK_RANGE_M = (1.5, 12.0)
"""Nearer drops are blurs the lens does not resolve, farther ones belong to the veil."""
DROP_RANGE_MM = (1.2, 3.5)
EXPOSURE_S = 0.012

STREAK_CONTRAST = 4.0
"""Drops show the bright sky above more than the rest: how much more their light counts."""
STREAK_BRIGHTNESS = 1.6
"""Of a drop against the mean of the view."""
WIND = 0.06
"""Streaks lean by so much of their length."""
_LINE_BITS = 3  # of a pixel's fraction in drawn lines


def add_rain(
    view: StyleView, generator: Generator, strength: float = 1.0, *, place_seed: int = 0
) -> Float[Tensor, "height width 3"]:
    """The view in steady rain by day, as displayed; the generator draws drops, the seed puddles.

    Views of one place and one seed show the same puddles. Between the strengths 0, which is dry,
    and 1, the light of both is mixed.
    """
    dry = to_linear(view.rgb)
    rain = _streaked(_wet(view, dry, Generator().manual_seed(place_seed)), view, generator)
    return to_display(dry + strength * (rain - dry))


def fall_speed_mps(diameter_mm: Float[Tensor, " drops"]) -> Float[Tensor, " drops"]:
    """Terminal speed of drops."""
    return 9.65 - 10.3 * torch.exp(-0.6 * diameter_mm)


def _wet(
    view: StyleView, dry: Float[Tensor, "height width 3"], place: Generator
) -> Float[Tensor, "height width 3"]:
    """Everything but the streaks."""
    tint = torch.tensor(OVERCAST_TINT)
    grey = luminance(dry)[..., None]
    dull = OVERCAST * (grey + COLOUR_WITHOUT_SUN * (dry - grey)) * tint
    walls = wet_reflectance(dull, 0.5 * WETNESS)
    light = walls + open_sky(view)[..., None] * (CLOUD_LIGHT * tint - walls)
    distance_m = distances(view)
    light = _with_wet_road(light, dull, view, distance_m, place)
    through = torch.exp(-rain_extinction_per_m(RAIN_MM_PER_H) * distance_m)
    through = torch.where(view.surface, through, 1.0)[..., None]
    return light * through + CLOUD_LIGHT * tint * (1 - through)


def _with_wet_road(
    light: Float[Tensor, "height width 3"],
    dull: Float[Tensor, "height width 3"],
    view: StyleView,
    distance_m: Float[Tensor, "height width"],
    place: Generator,
) -> Float[Tensor, "height width 3"]:
    """Darker ground that mirrors what stands on it; the view as it is where no ground is seen."""
    camera = view.camera
    points_m = None if camera is None else surface_points(camera, distance_m)
    ground = None if points_m is None else fit_ground(points_m, view.surface)
    if camera is None or points_m is None or ground is None:
        return light
    share = ground_pixels(points_m, ground, view.surface)
    points_m = ground.flattened(points_m)
    cloud = CLOUD_LIGHT * torch.tensor(OVERCAST_TINT)
    mirror = mirrored(light, cloud, camera, points_m, share > 0.01)
    centre_m = camera.world_from_camera[:3, 3].float()
    still = puddles(points_m + centre_m, place, share=PUDDLE_SHARE)
    shine = fresnel(-ray_directions(camera)[..., 2])
    shine = shine * (FILM_SHINE + (1 - FILM_SHINE) * still) * WETNESS
    road = wet_reflectance(dull, WETNESS)
    wet_road = road + shine[..., None] * (mirror - road)
    return light + share[..., None] * (wet_road - light)


def _streaked(
    light: Float[Tensor, "height width 3"], view: StyleView, generator: Generator
) -> Float[Tensor, "height width 3"]:
    """Streaks of drops drawn evenly over the volume before the lens."""
    near_m, far_m = STREAK_RANGE_M
    height_px, width_px = light.shape[:2]
    cubes = far_m**3 - near_m**3
    volume_m3 = cubes / 3 * height_px * width_px / view.focal_px**2
    slope = 4.1 * RAIN_MM_PER_H**-0.21
    # drops large enough to be seen singly, after Marshall and Palmer (1948)
    drops_per_m3 = 8000 / slope * math.exp(-slope * DROP_RANGE_MM[0])
    count = round(volume_m3 * drops_per_m3)
    drawn = torch.rand(count, 4, generator=generator)
    depth_m = (near_m**3 + drawn[:, 0] * cubes) ** (1 / 3)
    diameter_mm = DROP_RANGE_MM[0] - torch.log1p(-0.999 * drawn[:, 1]) / slope
    diameter_mm = diameter_mm.clamp_max(DROP_RANGE_MM[1])
    fallen_m = fall_speed_mps(diameter_mm) * EXPOSURE_S
    width_px_each = diameter_mm * 1e-3 / depth_m * view.focal_px
    # a drop covers a pixel for the share of the exposure in which it falls by its own height
    opacity = diameter_mm * 1e-3 / fallen_m * width_px_each.clamp_max(1) * STREAK_CONTRAST
    streaks = torch.stack(
        [
            drawn[:, 2] * width_px,
            drawn[:, 3] * height_px,
            fallen_m / depth_m * view.focal_px,
            width_px_each,
            opacity.clamp_max(0.35),
        ],
        dim=-1,
    )
    covered = _lines(streaks, height_px, width_px)[..., None]
    return light + covered * (STREAK_BRIGHTNESS * light.reshape(-1, 3).mean(dim=0) - light)


def _lines(
    streaks: Float[Tensor, "drops 5"], height_px: int, width_px: int
) -> Float[Tensor, "height width"]:
    """How much of every pixel is covered; a streak is column, row, length, width and opacity."""
    canvas = np.zeros((height_px, width_px), np.float32)
    fine = 1 << _LINE_BITS
    for column, row, length, width, opacity in streaks.tolist():
        start = round(column * fine), round(row * fine)
        end = round((column + WIND * length) * fine), round((row + length) * fine)
        cv2.line(canvas, start, end, opacity, max(1, round(width)), cv2.LINE_AA, _LINE_BITS)
    return torch.from_numpy(cv2.GaussianBlur(canvas, (0, 0), 0.6))
