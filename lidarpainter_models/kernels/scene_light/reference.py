"""Light of Gaussians in plain torch: every lamp on every surface."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.kernels.frustum_culling import Frustum
from lidarpainter_models.kernels.scene_light import (
    FAINT,
    MOST_GAIN,
    SH_CONSTANT,
    SKYLINE_SOFTNESS,
    STRAY_REACH_M,
    WIDEST_BEAM,
    Appearance,
    Lamps,
    Surfaces,
    Surroundings,
    lamps_that_reach,
)
from lidarpainter_models.weather.darkness import (
    BEAM_CUT_RAD,
    BEAM_EDGE_RAD,
    NEAREST_M2,
    STRAY_LIGHT,
    dipped_beam,
)
from lidarpainter_models.weather.light import to_display
from lidarpainter_models.weather.water import fresnel


def irradiance(
    surfaces: Surfaces, world_from_body: Float[Tensor, "bodies 4 4"], lamps: Lamps
) -> Float[Tensor, "gaussians 3"]:
    """See `scene_light.irradiance`."""
    points, normals = _in_world(surfaces, world_from_body)
    every = torch.ones(len(lamps.reach_m), len(points), dtype=torch.bool, device=points.device)
    return _lamp_light(surfaces, points, normals, lamps, every)


def seen_harmonics(
    surfaces: Surfaces,
    appearance: Appearance,
    surroundings: Surroundings,
    lamps: Lamps,
    frustum: Frustum | None,
    world_from_body: Float[Tensor, "bodies 4 4"],
    camera_from_body: Float[Tensor, "bodies 4 4"],
) -> Float[Tensor, "gaussians coefficients 3"]:
    """See `scene_light.seen_harmonics`."""
    points, normals = _in_world(surfaces, world_from_body)
    body = surfaces.body_index.long()
    from_camera = _placed(surfaces.means, camera_from_body, body)
    distance_m = from_camera.norm(dim=-1)
    counts = lamps_that_reach(surfaces, world_from_body, lamps)[body].T
    thrown = _lamp_light(surfaces, points, normals, lamps, counts)
    light = appearance.light + appearance.reflectance * thrown
    camera_world = _camera_centre(world_from_body, camera_from_body).to(points)
    wet = _mirrored(light, points - camera_world, appearance, surroundings)
    through = torch.exp(-surroundings.extinction_per_m * distance_m)[:, None]
    shown = wet * through + surroundings.airlight * (1 - through)
    rgb = to_display(shown)
    share = (through * light / shown.clamp_min(1e-6)).clamp(max=1.0)
    gain = (share * rgb * appearance.per_base).clamp(max=MOST_GAIN)
    constant = ((rgb - 0.5) / SH_CONSTANT)[:, None]
    harmonics = torch.cat([constant, gain[:, None] * appearance.harmonics], dim=1)
    if frustum is None:
        return harmonics
    in_view = _in_view(from_camera, surfaces.reach_m, frustum)
    return torch.where(in_view[:, None, None], harmonics, torch.zeros_like(harmonics))


def _placed(points: Tensor, bodies: Tensor, body: Tensor) -> Float[Tensor, "gaussians 3"]:
    of_each = bodies.to(points)[body]
    return torch.einsum("nij,nj->ni", of_each[:, :3, :3], points) + of_each[:, :3, 3]


def _in_world(
    surfaces: Surfaces, world_from_body: Float[Tensor, "bodies 4 4"]
) -> tuple[Float[Tensor, "gaussians 3"], Float[Tensor, "gaussians 3"]]:
    body = surfaces.body_index.long()
    rotation = world_from_body.to(surfaces.normals)[body, :3, :3]
    normals = torch.einsum("nij,nj->ni", rotation, surfaces.normals)
    return _placed(surfaces.means, world_from_body, body), normals


def _camera_centre(
    world_from_body: Float[Tensor, "bodies 4 4"], camera_from_body: Float[Tensor, "bodies 4 4"]
) -> Float[Tensor, "3"]:
    street = camera_from_body[0].double()
    centre_body = -street[:3, :3].T @ street[:3, 3]
    world = world_from_body[0].to(centre_body)
    return world[:3, :3] @ centre_body + world[:3, 3]


def _lamp_light(
    surfaces: Surfaces, points: Tensor, normals: Tensor, lamps: Lamps, counts: Tensor
) -> Float[Tensor, "gaussians 3"]:
    """Irradiance by the lamps that count for each surface."""
    found = torch.zeros_like(points)
    is_beam = (lamps.heading_world != 0).any(dim=1).tolist()
    for lamp in counts.any(dim=1).nonzero()[:, 0].tolist():
        to_point = points - lamps.position_world[lamp].to(points)
        squared = to_point.square().sum(dim=-1)
        away_m = squared.sqrt().clamp_min(1e-3)
        fade = (1 - squared / lamps.reach_m[lamp] ** 2).clamp_min(0) ** 2
        flat = normals.norm(dim=-1)
        cosine = (normals * to_point).sum(dim=-1).abs() / away_m + 0.5 * (1 - flat)
        span = surfaces.facing - surfaces.least_facing
        back = surfaces.least_facing + span * cosine.clamp(0, 1)
        strength = fade * back / (squared + NEAREST_M2) * counts[lamp]
        if is_beam[lamp]:
            strength = strength * _beam(to_point, lamps.heading_world[lamp].to(points))
        found = found + strength[:, None] * lamps.power_rgb[lamp].to(points)
    return found


def _beam(
    to_point: Float[Tensor, "gaussians 3"], heading: Float[Tensor, "3"]
) -> Float[Tensor, " gaussians"]:
    """Share of a dipped beam in the direction of each point; tangents stand for angles."""
    ahead = to_point[:, 0] * heading[0] + to_point[:, 1] * heading[1]
    across = to_point[:, 1] * heading[0] - to_point[:, 0] * heading[1]
    level = ahead.clamp_min(0.1)
    up = to_point[:, 2] / level
    is_above = (up - BEAM_CUT_RAD) > FAINT * BEAM_EDGE_RAD
    fade = (1 - to_point.square().sum(dim=-1) / STRAY_REACH_M**2).clamp_min(0)
    is_before = (ahead > 0) & (across.abs() <= WIDEST_BEAM * level)
    beam = dipped_beam(across / level, up, stray=STRAY_LIGHT * fade)
    return torch.where(is_above & (fade == 0), 0.0, beam) * is_before


def _mirrored(
    light: Tensor, view: Tensor, appearance: Appearance, surroundings: Surroundings
) -> Float[Tensor, "gaussians 3"]:
    """Light with that which wet ground mirrors towards the camera."""
    level_m = view[:, :2].norm(dim=-1).clamp_min(1e-3)
    slope = (-view[:, 2]).clamp_min(0) / level_m  # tangent of the mirrored ray
    cosine = slope / (1 + slope**2).sqrt()
    shine = appearance.shine * fresnel(cosine)
    sky = surroundings.sky_light.expand_as(light)
    seen = sky
    sectors = surroundings.skylines.shape[1]
    if len(surroundings.skylines):
        turn = torch.remainder(torch.atan2(view[:, 1], view[:, 0]) / (2 * math.pi), 1) * sectors
        first = turn.floor()
        weight = (turn - first)[:, None]
        place = appearance.skyline.long().clamp_min(0)
        before = surroundings.skylines[place, first.long() % sectors]
        after = surroundings.skylines[place, (first.long() + 1) % sectors]
        around = before + weight * (after - before)
        is_over = ((slope - around[:, 3]) / SKYLINE_SOFTNESS + 0.5).clamp(0, 1)[:, None]
        seen = torch.where(
            appearance.skyline[:, None] >= 0, around[:, :3] + is_over * (sky - around[:, :3]), sky
        )
    return light + shine[:, None] * (seen - light)


def _in_view(from_camera: Tensor, reach_m: Tensor, frustum: Frustum) -> Tensor:
    z = from_camera[:, 2]
    inside = z >= frustum.near_m
    for axis in range(2):
        most = reach_m * frustum.stretch[axis]
        inside = inside & (from_camera[:, axis] - frustum.highest[axis] * z <= most)
        inside = inside & (frustum.lowest[axis] * z - from_camera[:, axis] <= most)
    return inside
