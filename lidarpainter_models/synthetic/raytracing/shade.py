"""Colour of a ray: filtered textures, sun with shadow, sky light, gloss and haze.

Texture footprints come from exact ray differentials (Igehy, "Tracing ray differentials", 1999);
long ones are averaged from several taps along their longer axis.
"""

import numba
import numpy as np

from lidarpainter_models.synthetic.raytracing.scene_arrays import (
    ACTOR,
    DETAIL_PER_M,
    DETAIL_STRENGTH,
    DETAIL_TEXTURE,
    EMISSION,
    GLOSS,
    GROUND_RGB,
    HAZE_PER_M,
    HORIZON_RGB,
    KIND,
    KIND_CUT_OUT,
    KIND_GLOSS,
    KIND_ROAD,
    LAMP,
    SEMANTICS,
    SUN_DIRECTION,
    SUN_RGB,
    SURFACE,
    TEXTURE,
    TINT,
    TRANSLUCENCY,
    UV_FIRST,
    UV_SECOND,
    ZENITH_RGB,
    InstanceArrays,
    SceneArrays,
)
from lidarpainter_models.synthetic.raytracing.sky import mirrored_radiance
from lidarpainter_models.synthetic.raytracing.texture import filtered_texture, sample_texture
from lidarpainter_models.synthetic.raytracing.trace import INLINED, RAY, to_box, trace_scene, uv_at

SHADOW_START_M = 0.004
SHADOW_REACH_M = 120.0


@numba.njit(**INLINED)
def _contact_shade(instances: InstanceArrays, time_index: int, x: float, y: float) -> float:
    """How much sky light reaches the ground at a place near vehicles."""
    shade = 1.0
    for index in range(instances.contact.shape[1]):
        east = x - instances.contact[time_index, index, 0]
        north = y - instances.contact[time_index, index, 1]
        if abs(east) > 4.5 or abs(north) > 4.5:
            continue
        row = instances.contact[time_index, index]
        along = abs(row[2] * east + row[3] * north) - row[4]
        aside = abs(row[2] * north - row[3] * east) - row[5]
        outside = np.sqrt(max(along, 0.0) ** 2 + max(aside, 0.0) ** 2)
        inside = max(-max(along, aside), 0.0)
        shade *= 1.0 - 0.62 * np.exp(-3.2 * outside) * min(0.55 + 1.4 * inside, 1.0)
    return shade


@numba.njit(**INLINED)
def _steps_in_uv(
    scene: SceneArrays, prim: int, direction: tuple, differentials: tuple, t: float
) -> tuple[tuple, tuple]:
    """Texture steps of the two ray differentials on the plane of a primitive."""
    row, shading = scene.prim_geometry[prim], scene.prim_shading[prim]
    nx = row[4] * row[8] - row[5] * row[7]
    ny = row[5] * row[6] - row[3] * row[8]
    nz = row[3] * row[7] - row[4] * row[6]
    square = nx * nx + ny * ny + nz * nz
    facing = nx * direction[0] + ny * direction[1] + nz * direction[2]
    result = ((0.0, 0.0), (0.0, 0.0))
    for axis in range(2):
        step = differentials[axis]
        back = (nx * step[0] + ny * step[1] + nz * step[2]) / facing
        dx = t * (step[0] - back * direction[0])
        dy = t * (step[1] - back * direction[1])
        dz = t * (step[2] - back * direction[2])
        du = (dy * row[8] - dz * row[7]) * nx + (dz * row[6] - dx * row[8]) * ny
        du = (du + (dx * row[7] - dy * row[6]) * nz) / square
        dv = (row[4] * dz - row[5] * dy) * nx + (row[5] * dx - row[3] * dz) * ny
        dv = (dv + (row[3] * dy - row[4] * dx) * nz) / square
        in_uv = (
            shading[UV_FIRST] * du + shading[UV_SECOND] * dv,
            shading[UV_FIRST + 1] * du + shading[UV_SECOND + 1] * dv,
        )
        result = (in_uv, result[1]) if axis == 0 else (result[0], in_uv)
    return result


@numba.njit(**INLINED)
def hit_normal(
    scene: SceneArrays, instances: InstanceArrays, time_index: int, direction: tuple, hit: tuple
) -> tuple[float, float, float]:
    """Smooth unit normal in the world, on the side the ray comes from."""
    shading = scene.prim_shading[hit[1]]
    x = shading[0] + hit[2] * shading[3] + hit[3] * shading[6]
    y = shading[1] + hit[2] * shading[4] + hit[3] * shading[7]
    z = shading[2] + hit[2] * shading[5] + hit[3] * shading[8]
    if hit[4] >= 0:
        pose = instances.world_from_box[time_index, hit[4]]
        x, y, z = (
            pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z,
            pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z,
            pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z,
        )
    scale = 1.0 / np.sqrt(x * x + y * y + z * z)
    if x * direction[0] + y * direction[1] + z * direction[2] > 0:
        scale = -scale
    return x * scale, y * scale, z * scale


@numba.njit(**INLINED)
def _sunlight(
    scene: SceneArrays,
    instances: InstanceArrays,
    time_index: int,
    point: tuple,
    normal: tuple,
    surface: int,
    stack: np.ndarray,
) -> float:
    """Cosine-weighted share of the sun that arrives, traced through cut-outs."""
    sun = (
        scene.light[SUN_DIRECTION],
        scene.light[SUN_DIRECTION + 1],
        scene.light[SUN_DIRECTION + 2],
    )
    facing = normal[0] * sun[0] + normal[1] * sun[1] + normal[2] * sun[2]
    through = scene.surface_value[surface, TRANSLUCENCY]
    received = max(facing, 0.0) * (1.0 - 0.5 * through) + through * 0.5 * abs(facing)
    if received <= 1e-3:
        return 0.0
    start = 0.02 if through > 0 else SHADOW_START_M
    origin = (
        point[0] + start * (normal[0] + sun[0]),
        point[1] + start * (normal[1] + sun[1]),
        point[2] + start * (normal[2] + sun[2]),
    )
    limits = (SHADOW_REACH_M, 0.004, 1.0)
    hit = trace_scene(scene, instances, time_index, origin, sun, limits, stack)
    return 0.0 if hit[1] >= 0 else received


@numba.njit(**INLINED)
def _albedo(
    scene: SceneArrays, hit: tuple, point: tuple, direction: tuple, differentials: tuple
) -> tuple[float, float, float, float]:
    """Filtered colour of a surface and its fourth channel."""
    prim = hit[1]
    shading = scene.prim_shading[prim]
    surface = scene.prim_index[prim, SURFACE]
    value = scene.surface_value[surface]
    place = uv_at(shading, hit[2], hit[3])
    steps = _steps_in_uv(scene, prim, direction, differentials, hit[0])
    index = scene.surface_index[surface]
    colour = filtered_texture(scene, index[TEXTURE], place, steps[0], steps[1])
    factor = 1.0
    if index[DETAIL_TEXTURE] >= 0:
        ax, ay, az = abs(shading[0]), abs(shading[1]), abs(shading[2])
        s, t = point[0], point[1]
        if az < max(ax, ay):
            s, t = (point[1], point[2]) if ax > ay else (point[0], point[2])
        at = (s * value[DETAIL_PER_M], t * value[DETAIL_PER_M])
        size = scene.texture_index[index[DETAIL_TEXTURE], 0] * value[DETAIL_PER_M]
        step = differentials[0]
        width = hit[0] * np.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2) * size
        level = int(np.floor(np.log2(max(width, 1e-3)) + 1.0))
        detail = sample_texture(scene, index[DETAIL_TEXTURE], at, level)
        factor = 1.0 + value[DETAIL_STRENGTH] * (detail[3] - 0.5)
    return (
        colour[0] * value[TINT] * factor,
        colour[1] * value[TINT + 1] * factor,
        colour[2] * value[TINT + 2] * factor,
        colour[3],
    )


@numba.njit(**INLINED)
def _add_gloss(
    scene: SceneArrays, diffuse: tuple, gloss: float, direction: tuple, normal: tuple, sun: float
) -> tuple[float, float, float]:
    """Mix in the mirrored sky by Schlick's Fresnel term (1994), and a highlight of the sun."""
    scale = 1.0 / np.sqrt(direction[0] ** 2 + direction[1] ** 2 + direction[2] ** 2)
    dx, dy, dz = direction[0] * scale, direction[1] * scale, direction[2] * scale
    facing = -(dx * normal[0] + dy * normal[1] + dz * normal[2])
    fresnel = gloss * (0.05 + 0.95 * (1.0 - min(max(facing, 0.0), 1.0)) ** 5)
    rx, ry, rz = (
        dx + 2.0 * facing * normal[0],
        dy + 2.0 * facing * normal[1],
        dz + 2.0 * facing * normal[2],
    )
    seen = mirrored_radiance(scene, rx, ry, rz)
    light = scene.light
    towards = rx * light[SUN_DIRECTION] + ry * light[SUN_DIRECTION + 1]
    towards += rz * light[SUN_DIRECTION + 2]
    flash = 3.0 * gloss * max(towards, 0.0) ** 500 if sun > 0 else 0.0
    return (
        diffuse[0] + fresnel * (seen[0] - diffuse[0]) + flash * light[SUN_RGB],
        diffuse[1] + fresnel * (seen[1] - diffuse[1]) + flash * light[SUN_RGB + 1],
        diffuse[2] + fresnel * (seen[2] - diffuse[2]) + flash * light[SUN_RGB + 2],
    )


@numba.njit(**INLINED)
def _ambient(light: np.ndarray, up: float, channel: int) -> float:
    return up * light[ZENITH_RGB + channel] * 0.9 + (1.0 - up) * light[GROUND_RGB + channel]


@numba.njit(**INLINED)
def classify(scene: SceneArrays, prim: int, fourth: float) -> int:
    """Class of a hit; a road's paint follows the road's own class."""
    index = scene.surface_index[scene.prim_index[prim, SURFACE]]
    is_paint = index[KIND] == KIND_ROAD and fourth > 0.5
    return index[SEMANTICS] + (1 if is_paint else 0)


@numba.njit(**RAY)
def paint_at(scene: SceneArrays, hit: tuple) -> float:
    """Share of road paint at a hit, unfiltered; 0 away from roads."""
    index = scene.surface_index[scene.prim_index[hit[1], SURFACE]]
    if index[KIND] != KIND_ROAD:
        return 0.0
    place = uv_at(scene.prim_shading[hit[1]], hit[2], hit[3])
    return sample_texture(scene, index[TEXTURE], place, 0)[3]


@numba.njit(**INLINED)
def shade(
    scene: SceneArrays,
    instances: InstanceArrays,
    time_index: int,
    ray: tuple,
    hit: tuple,
    stack: np.ndarray,
) -> tuple[float, float, float, int]:
    """Light along a ray (origin, direction, two differentials) from its hit.

    Returns:
        Linear red, green, blue (before exposure) and the class.
    """
    origin, direction, differentials = ray
    t, prim = hit[0], hit[1]
    point = (
        origin[0] + t * direction[0],
        origin[1] + t * direction[1],
        origin[2] + t * direction[2],
    )
    local, local_steps = direction, differentials
    if hit[4] >= 0:
        pose = instances.world_from_box[time_index, hit[4]]
        local = to_box(pose, direction[0], direction[1], direction[2])
        a, b = differentials
        local_steps = (to_box(pose, a[0], a[1], a[2]), to_box(pose, b[0], b[1], b[2]))
    red, green, blue, fourth = _albedo(scene, hit, point, local, local_steps)
    normal = hit_normal(scene, instances, time_index, direction, hit)
    surface = scene.prim_index[prim, SURFACE]
    value, light = scene.surface_value[surface], scene.light
    sun = _sunlight(scene, instances, time_index, point, normal, surface, stack)
    up = 0.5 + 0.5 * normal[2]
    open_sky = 1.0
    kind = scene.surface_index[surface, KIND]
    if normal[2] > 0.8 and kind != KIND_CUT_OUT and scene.prim_index[prim, ACTOR] < 0:
        open_sky = _contact_shade(instances, time_index, point[0], point[1])
    emission, lamp = value[EMISSION], scene.surface_index[surface, LAMP]
    if lamp >= 0:
        emission *= instances.is_lit[time_index, lamp]
    diffuse = (
        red * (sun * light[SUN_RGB] + open_sky * _ambient(light, up, 0) + emission),
        green * (sun * light[SUN_RGB + 1] + open_sky * _ambient(light, up, 1) + emission),
        blue * (sun * light[SUN_RGB + 2] + open_sky * _ambient(light, up, 2) + emission),
    )
    gloss = value[GLOSS] * (1.0 if kind != KIND_GLOSS else fourth)
    if gloss > 0.02:
        diffuse = _add_gloss(scene, diffuse, gloss, direction, normal, sun)
    length = np.sqrt(direction[0] ** 2 + direction[1] ** 2 + direction[2] ** 2)
    haze = 1.0 - np.exp(-light[HAZE_PER_M] * t * length)
    return (
        diffuse[0] + haze * (light[HORIZON_RGB] - diffuse[0]),
        diffuse[1] + haze * (light[HORIZON_RGB + 1] - diffuse[1]),
        diffuse[2] + haze * (light[HORIZON_RGB + 2] - diffuse[2]),
        classify(scene, prim, fourth),
    )
