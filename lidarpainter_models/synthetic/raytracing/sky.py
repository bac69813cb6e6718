"""Light from the sky, straight or mirrored."""

import numba

from lidarpainter_models.synthetic.raytracing.scene_arrays import (
    CLOUD_OFFSET,
    CLOUD_TEXTURE,
    GROUND_RGB,
    HORIZON_RGB,
    SUN_DIRECTION,
    SUN_RGB,
    ZENITH_RGB,
    SceneArrays,
)
from lidarpainter_models.synthetic.raytracing.texture import sample_texture
from lidarpainter_models.synthetic.raytracing.trace import INLINED, RAY


@numba.njit(**RAY)
def sky_radiance(scene: SceneArrays, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Sky in a unit direction: gradient, clouds on a plane above, glow and disc of the sun."""
    light = scene.light
    height = max(z, 0.0)
    fade = (1.0 - height) ** 4
    sun = x * light[SUN_DIRECTION] + y * light[SUN_DIRECTION + 1] + z * light[SUN_DIRECTION + 2]
    glow = 0.25 * max(sun, 0.0) ** 12 + (30.0 if sun > 0.99985 else 0.0)
    cover, bright = 0.0, 0.0
    if height > 0.02:
        scale = 0.09 / (height + 0.12)
        at = (x * scale + light[CLOUD_OFFSET], y * scale + light[CLOUD_OFFSET + 1])
        level = 1 if height > 0.25 else 2
        cloud = sample_texture(scene, int(light[CLOUD_TEXTURE]), at, level)
        cover = cloud[3] * min((height - 0.02) * 9.0, 1.0)
        bright = cloud[0]
    red, green, blue = 0.0, 0.0, 0.0
    for channel in range(3):
        clear = light[ZENITH_RGB + channel] * (1.0 - fade) + light[HORIZON_RGB + channel] * fade
        clear += glow * light[SUN_RGB + channel] * 0.12
        white = 1.25 * bright - 0.30 + 0.15 * clear + 0.25 * glow
        value = clear * (1.0 - cover) + white * cover
        if channel == 0:
            red = value
        elif channel == 1:
            green = value
        else:
            blue = value
    return red, green, blue


@numba.njit(**INLINED)
def mirrored_radiance(
    scene: SceneArrays, x: float, y: float, z: float
) -> tuple[float, float, float]:
    """What a glossy surface shows: sky, with a dark band of street below it."""
    above = min(max((z - 0.12) * 4.0, 0.0), 1.0)
    light = scene.light
    low = (
        0.5 * light[GROUND_RGB] + 0.05,
        0.5 * light[GROUND_RGB + 1] + 0.05,
        0.5 * light[GROUND_RGB + 2] + 0.05,
    )
    if above <= 0.0:
        return low
    sky = sky_radiance(scene, x, y, z)
    return (
        low[0] + above * (min(sky[0], 4.0) - low[0]),
        low[1] + above * (min(sky[1], 4.0) - low[1]),
        low[2] + above * (min(sky[2], 4.0) - low[2]),
    )
