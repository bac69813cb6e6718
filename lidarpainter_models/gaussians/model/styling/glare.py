"""Lamps as a lens sees them: bright points and the light that scatters around them.

The point spread is a sum of Gaussians (after Spencer et al., "Physically-based glare effects",
1995). How much of a lamp is seen is read off the rendered depth around it, so alpha and depth of a
view are those of the clear scene.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lidarpainter_models.gaussians.model.styling.lamps import LampHeads
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.weather.light import to_display

NARROW_RAD = ((0.0015, 0.5), (0.006, 0.3))
WIDE_RAD = ((0.025, 0.14), (0.09, 0.06))
"""Width and share of the Gaussians of the point spread."""
COARSE = 8
"""Wide glare is reckoned on a grid so much coarser."""
LEAST_SIGMA_PX = 0.7
PATCH_SIGMAS = 3.0
LARGEST_PATCH_PX = 24
FARTHEST_M = 200.0
HIDING_M, SOFT_M = 0.8, 0.3
"""What is nearer than a lamp by so much hides it; a car's own paint does not."""
LEAST_LIGHT = 1e-3


def add_glare(
    rgb: Float[Tensor, "height width 3"],
    depth_m: Float[Tensor, "height width"],
    camera: Camera,
    heads: LampHeads,
    *,
    strength: float,
    extinction_per_m: float,
) -> Float[Tensor, "height width 3"]:
    """The displayed image with lamps in it.

    `depth_m` is camera z of what is seen, 0 for sky; `strength` is the night's; the extinction is
    that of the air before the lamps.
    """
    pixels, power = _seen_power(depth_m, camera, heads, extinction_per_m)
    power = strength * power
    kept = power.amax(dim=1) * _peak(NARROW_RAD) > LEAST_LIGHT
    if not bool(kept.any()):
        return rgb
    pixels, power = pixels[kept], power[kept]
    out = _with_wide(rgb, pixels, power, camera)
    places, light = _narrow(pixels, power, camera)
    found = torch.zeros_like(out).view(-1, 3).index_add_(0, places, light)
    lit = places.unique()
    flat = out.view(-1, 3)
    flat[lit] = flat[lit] + (1 - flat[lit].clamp(max=1)) * to_display(found[lit])
    return out


def _seen_power(
    depth_m: Tensor, camera: Camera, heads: LampHeads, extinction_per_m: float
) -> tuple[Float[Tensor, "seen 2"], Float[Tensor, "seen 3"]]:
    """Pixel of every lamp in view, and its light: radiance times solid angle that is not hidden."""
    pixels, z = camera.project(heads.position_world)
    offset = heads.position_world - camera.centre_world.to(heads.position_world)
    away_m = offset.norm(dim=-1).clamp_min(1.0)
    cosine = -(offset * heads.heading_world).sum(dim=-1) / away_m
    is_round = (heads.heading_world == 0).all(dim=-1)
    towards = torch.where(is_round, torch.ones_like(cosine), cosine.clamp_min(0) ** 2)
    inside = camera.contains(pixels, z, near_m=0.5) & (away_m < FARTHEST_M)
    solid_angle = torch.pi * (heads.radius_m / away_m) ** 2
    dimmed = towards * solid_angle * torch.exp(-extinction_per_m * away_m)
    rows = inside.nonzero()[:, 0]
    open_share = _open_share(depth_m, pixels[rows], z[rows])
    power = heads.radiance_rgb[rows] * (dimmed[rows] * open_share)[:, None]
    return pixels[rows], power


def _open_share(
    depth_m: Tensor, pixels: Float[Tensor, "seen 2"], z: Float[Tensor, " seen"]
) -> Float[Tensor, " seen"]:
    """Share of the 5 x 5 pixels around each lamp before which nothing stands."""
    height, width = depth_m.shape
    steps = torch.arange(-2, 3, device=pixels.device)
    rows = (pixels[:, 1].long()[:, None] + steps).clamp(0, height - 1)
    columns = (pixels[:, 0].long()[:, None] + steps).clamp(0, width - 1)
    around = depth_m[rows[:, :, None], columns[:, None, :]]
    around = torch.where(around > 0, around, torch.full_like(around, torch.inf))
    open_m = (around - z[:, None, None] + HIDING_M) / SOFT_M
    return open_m.clamp(0, 1).mean(dim=(1, 2))


def _peak(widths: tuple[tuple[float, float], ...]) -> float:
    return sum(share / (2 * torch.pi * sigma**2) for sigma, share in widths)


def _narrow(
    pixels: Float[Tensor, "seen 2"], power: Float[Tensor, "seen 3"], camera: Camera
) -> tuple[Int[Tensor, " places"], Float[Tensor, "places 3"]]:
    """Flat pixel numbers near the lamps and the light that falls there."""
    places, lights = [], []
    for sigma_rad, share in NARROW_RAD:
        sigma_px = max(sigma_rad * camera.fx_px, LEAST_SIGMA_PX)
        reach = min(int(PATCH_SIGMAS * sigma_px) + 1, LARGEST_PATCH_PX)
        steps = torch.arange(-reach, reach + 1, device=pixels.device)
        columns, rows = (pixels[:, axis].long()[:, None] + steps for axis in (0, 1))
        across, down = (
            torch.exp(-0.5 * ((line + 0.5 - pixels[:, axis, None]) / sigma_px) ** 2)
            for axis, line in ((0, columns), (1, rows))
        )
        height = share * (camera.fx_px / sigma_px) ** 2 / (2 * torch.pi)
        light = height * (down[:, :, None] * across[:, None, :])[..., None] * power[:, None, None]
        inside = ((rows >= 0) & (rows < camera.height_px))[:, :, None]
        inside = inside & ((columns >= 0) & (columns < camera.width_px))[:, None, :]
        number = rows[:, :, None] * camera.width_px + columns[:, None, :]
        places.append(number[inside])
        lights.append(light[inside])
    return torch.cat(places), torch.cat(lights)


def _with_wide(
    rgb: Float[Tensor, "height width 3"],
    pixels: Float[Tensor, "seen 2"],
    power: Float[Tensor, "seen 3"],
    camera: Camera,
) -> Float[Tensor, "height width 3"]:
    """A copy of the image with wide glare, in the rows that it reaches."""
    rows = torch.arange(0, camera.height_px + COARSE, COARSE, device=pixels.device)
    columns = torch.arange(0, camera.width_px + COARSE, COARSE, device=pixels.device)
    light = power.new_zeros(len(rows), len(columns), 3)
    for sigma_rad, share in WIDE_RAD:
        sigma_px = sigma_rad * camera.fx_px
        down = torch.exp(-0.5 * ((rows + 0.5 - pixels[:, 1:]) / sigma_px) ** 2)
        across = torch.exp(-0.5 * ((columns + 0.5 - pixels[:, :1]) / sigma_px) ** 2)
        height = share / (2 * torch.pi * sigma_rad**2)
        light += torch.einsum("lr,lk,lc->rkc", down, across, height * power)
    out = rgb.clone()
    reached = (light.amax(dim=(1, 2)) > LEAST_LIGHT).nonzero()[:, 0].tolist()
    if len(reached) < 2:
        return out
    first, last = reached[0], reached[-1]
    planes = to_display(light[first : last + 1]).permute(2, 0, 1)[None]
    size = ((last - first) * COARSE + 1, (len(columns) - 1) * COARSE + 1)
    fine = torch.nn.functional.interpolate(planes, size=size, mode="bilinear", align_corners=True)
    band = out[first * COARSE : last * COARSE + 1]
    glow = fine[0, :, : len(band), : camera.width_px].permute(1, 2, 0)
    band.addcmul_(1 - band.clamp(max=1), glow)
    return out
