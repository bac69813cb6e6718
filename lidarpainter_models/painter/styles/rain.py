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
from jaxtyping import Bool, Float
from torch import Generator, Tensor

from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.painter.styles.view import (
    SKY_M,
    Ground,
    StyleView,
    distances,
    fit_ground,
    open_sky,
    ray_directions,
    surface_points,
)
from lidarpainter_models.weather.air import cloud_light, overcast, rain_extinction_per_m
from lidarpainter_models.weather.light import to_display, to_linear
from lidarpainter_models.weather.water import (
    FILM_SHINE,
    PUDDLE_SHARE,
    RAIN_MM_PER_H,
    WETNESS,
    fresnel,
    puddles,
    wet_reflectance,
)

GROUND_HEIGHT_M = 0.2
"""Surfaces up to this height are ground."""
FARTHEST_STEP_M = 200.0
NUM_STEPS = 80
FILM_ROUGHNESS_RAD = 0.012
"""Blur of a reflection along the column: waves smear it towards the viewer."""


def ground_pixels(
    points_m: Float[Tensor, "height width 3"], ground: Ground, surface: Bool[Tensor, "height width"]
) -> Float[Tensor, "height width"]:
    """Share of every pixel that is ground, soft along its rim."""
    low = surface & (ground.heights(points_m).abs() < GROUND_HEIGHT_M)
    opened = cv2.morphologyEx(low.numpy().astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3)))
    closed = cv2.morphologyEx(opened, cv2.MORPH_CLOSE, np.ones((5, 5)))
    return torch.from_numpy(cv2.GaussianBlur(closed.astype(np.float32), (0, 0), 1.0))


def mirrored(
    light: Float[Tensor, "height width 3"],
    sky_light: Float[Tensor, "3"],
    camera: Camera,
    points_m: Float[Tensor, "height width 3"],
    on_ground: Bool[Tensor, "height width"],
) -> Float[Tensor, "height width 3"]:
    """What each ground pixel mirrors, blurred along the column as by a rough film.

    `light` is linear, world z up; points are metres from the camera's centre, sky at infinity.
    `sky_light` stands in where the image does not show what is mirrored.
    """
    starts = points_m[on_ground]
    directions = torch.nn.functional.normalize(starts, dim=-1) * torch.tensor([1.0, 1.0, -1.0])
    camera_from_world = camera.world_from_camera[:3, :3].T.float()
    depth_m = (points_m @ camera_from_world.T)[..., 2]
    found = sky_light.expand(len(starts), 3).clone()
    waiting = torch.ones(len(starts), dtype=torch.bool)
    reaches = torch.logspace(-0.5, math.log10(FARTHEST_STEP_M), NUM_STEPS)
    for reach_m in (*reaches.tolist(), SKY_M):
        ray = (starts + reach_m * directions) @ camera_from_world.T
        row, column, inside = _pixel(camera, ray)
        behind_m = ray[:, 2] - depth_m[row, column]
        # steps grow with reach, and surfaces are taken to be as thick as a step is long
        hit = (behind_m > 0) & (behind_m < 0.5 + 0.35 * reach_m)
        hit &= ~on_ground[row, column]  # a plane does not mirror itself; its rows are far apart
        if reach_m == SKY_M:
            hit |= True  # nothing was met: what stands there is the horizon
        hit &= inside & waiting
        found[hit] = light[row[hit], column[hit]]
        waiting &= ~hit
    image = torch.zeros_like(light)
    image[on_ground] = found
    return _smeared(image, on_ground, camera)


def _pixel(camera: Camera, ray: Float[Tensor, "rays 3"]) -> tuple[Tensor, Tensor, Tensor]:
    """Row and column that camera-frame points fall into, and whether they do."""
    depth = ray[:, 2].clamp_min(1e-3)
    column = (ray[:, 0] / depth * camera.fx_px + camera.cx_px).long()
    row = (ray[:, 1] / depth * camera.fy_px + camera.cy_px).long()
    inside = (row >= 0) & (row < camera.height_px) & (column >= 0) & (column < camera.width_px)
    inside &= ray[:, 2] > 1e-3
    return row.clamp(0, camera.height_px - 1), column.clamp(0, camera.width_px - 1), inside


def _smeared(
    image: Float[Tensor, "height width 3"], known: Bool[Tensor, "height width"], camera: Camera
) -> Float[Tensor, "height width 3"]:
    sigma_px = max(FILM_ROUGHNESS_RAD * camera.fy_px, 0.5)
    weight = known.numpy().astype(np.float32)
    blurred = cv2.GaussianBlur(image.numpy(), (0, 0), sigma_px / 4, sigmaY=sigma_px)
    share = cv2.GaussianBlur(weight, (0, 0), sigma_px / 4, sigmaY=sigma_px)
    return torch.from_numpy(blurred / np.maximum(share, 1e-3)[..., None])


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
    dull, clouds = overcast(dry), cloud_light(dry)
    walls = wet_reflectance(dull, 0.5 * WETNESS)
    light = walls + open_sky(view)[..., None] * (clouds - walls)
    distance_m = distances(view)
    light = _with_wet_road(light, dull, view, distance_m, place)
    through = torch.exp(-rain_extinction_per_m(RAIN_MM_PER_H) * distance_m)
    through = torch.where(view.surface, through, 1.0)[..., None]
    return light * through + clouds * (1 - through)


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
    mirror = mirrored(light, cloud_light(light), camera, points_m, share > 0.01)
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
