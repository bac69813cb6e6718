"""Trace an image: colour, depth, class and actor of every pixel, one row per task.

Samples are turned into image values before they are averaged, so an image made at half the size
with twice the samples equals the larger one averaged over 2x2 pixels.
"""

import numba
import numpy as np

from lidarpainter_models.synthetic.raytracing.scene_arrays import (
    ACTOR,
    DISPLAY_LIMIT,
    EXPOSURE,
    InstanceArrays,
    SceneArrays,
    ViewArrays,
)
from lidarpainter_models.synthetic.raytracing.shade import classify, paint_at, shade
from lidarpainter_models.synthetic.raytracing.sky import sky_radiance
from lidarpainter_models.synthetic.raytracing.trace import INLINED, RAY, WORK_ROWS, trace_scene

FAR_M = 5000.0
SKY_CLASS = 0


@numba.njit(**INLINED)
def _displayed(scene: SceneArrays, light: float) -> float:
    """Image value 0..1 of linear light: exposure, then the tone curve."""
    place = light * scene.light[EXPOSURE] * ((scene.to_display.size - 1) / DISPLAY_LIMIT)
    place = min(max(place, 0.0), scene.to_display.size - 1.001)
    step = int(place)
    first, second = scene.to_display[step], scene.to_display[step + 1]
    return first + (place - step) * (second - first)


@numba.njit(**INLINED)
def _direction(view: ViewArrays, time_index: int, x: float, y: float) -> tuple[float, float, float]:
    """World direction with camera z = 1 through a pixel position."""
    pose = view.world_from_camera[time_index]
    u = (x - view.intrinsics[2]) / view.intrinsics[0]
    v = (y - view.intrinsics[3]) / view.intrinsics[1]
    return (
        pose[0, 0] * u + pose[0, 1] * v + pose[0, 2],
        pose[1, 0] * u + pose[1, 1] * v + pose[1, 2],
        pose[2, 0] * u + pose[2, 1] * v + pose[2, 2],
    )


@numba.njit(**INLINED)
def _sample(
    scene: SceneArrays,
    instances: InstanceArrays,
    view: ViewArrays,
    time_index: int,
    place: tuple,
    stack: np.ndarray,
) -> tuple[float, float, float, float, int, int]:
    """Image values, inverse depth (0: sky), class and primitive (-1: sky) of one sample."""
    pose, footprint = view.world_from_camera[time_index], view.footprint_px
    origin = (pose[0, 3], pose[1, 3], pose[2, 3])
    direction = _direction(view, time_index, place[0], place[1])
    width, down = footprint / view.intrinsics[0], footprint / view.intrinsics[1]
    limits = (FAR_M, width, 0.0)
    hit = trace_scene(scene, instances, time_index, origin, direction, limits, stack)
    if hit[1] < 0:
        scale = 1.0 / np.sqrt(direction[0] ** 2 + direction[1] ** 2 + direction[2] ** 2)
        sky = sky_radiance(scene, direction[0] * scale, direction[1] * scale, direction[2] * scale)
        red, green, blue = sky
        kind, inverse = SKY_CLASS, 0.0
    else:
        differentials = (
            (pose[0, 0] * width, pose[1, 0] * width, pose[2, 0] * width),
            (pose[0, 1] * down, pose[1, 1] * down, pose[2, 1] * down),
        )
        ray = (origin, direction, differentials)
        red, green, blue, kind = shade(scene, instances, time_index, ray, hit, stack)
        inverse = 1.0 / hit[0]
    return (
        _displayed(scene, red),
        _displayed(scene, green),
        _displayed(scene, blue),
        inverse,
        kind,
        hit[1],
    )


@numba.njit(**INLINED)
def _centre(
    scene: SceneArrays,
    instances: InstanceArrays,
    view: ViewArrays,
    time_index: int,
    place: tuple,
    stack: np.ndarray,
) -> tuple[float, int, int]:
    """Depth, class and primitive on the ray through the pixel centre."""
    pose = view.world_from_camera[time_index]
    origin = (pose[0, 3], pose[1, 3], pose[2, 3])
    direction = _direction(view, time_index, place[0], place[1])
    limits = (FAR_M, view.footprint_px / view.intrinsics[0], 0.0)
    hit = trace_scene(scene, instances, time_index, origin, direction, limits, stack)
    if hit[1] < 0:
        return 0.0, SKY_CLASS, -1
    return hit[0], classify(scene, hit[1], paint_at(scene, hit)), hit[1]


@numba.njit(**INLINED)
def _render_pixel(
    scene: SceneArrays,
    instances: InstanceArrays,
    view: ViewArrays,
    time_index: int,
    place: tuple,
    stack: np.ndarray,
) -> tuple[tuple[float, float, float], float, int, int]:
    """Image values, depth, class and actor of the pixel whose top-left corner is `place`."""
    red, green, blue, inverse = 0.0, 0.0, 0.0, 0.0
    num_samples = view.offsets.shape[0]
    first_prim, first_kind, num_same, num_kind = -2, 0, 0, 0
    for index in range(num_samples):
        at = (place[0] + view.offsets[index, 0], place[1] + view.offsets[index, 1])
        sample = _sample(scene, instances, view, time_index, at, stack)
        if index == 0:
            first_kind, first_prim = sample[4], sample[5]
        red += sample[0]
        green += sample[1]
        blue += sample[2]
        inverse += sample[3]
        num_same += sample[5] == first_prim
        num_kind += sample[4] == first_kind
    weight = 1.0 / num_samples
    if num_same == num_samples and num_kind == num_samples:
        # 1 / z is affine on a plane, so its mean over symmetric samples is that of the centre
        depth_m = num_samples / inverse if first_prim >= 0 else 0.0
        kind, prim = first_kind, first_prim
    else:
        centre = (place[0] + 0.5, place[1] + 0.5)
        depth_m, kind, prim = _centre(scene, instances, view, time_index, centre, stack)
    actor = scene.prim_index[prim, ACTOR] if prim >= 0 else -1
    return (red * weight, green * weight, blue * weight), depth_m, kind, actor


@numba.njit(**{**RAY, "_nrt": True, "parallel": True})
def render_image(
    scene: SceneArrays, instances: InstanceArrays, view: ViewArrays, height_px: int, width_px: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Trace every pixel, all at one time or each row at its own.

    Returns:
        rgb float32 (height, width, 3) in 0..1, depth float32 (camera z, metres; 0: sky), class
        and actor int32 (-1: none).
    """
    rgb = np.empty((height_px, width_px, 3), np.float32)
    depth_m = np.empty((height_px, width_px), np.float32)
    semantics = np.empty((height_px, width_px), np.int32)
    actor_index = np.empty((height_px, width_px), np.int32)
    for line in numba.prange(height_px):
        stack = np.full((WORK_ROWS, 2), -1.0)
        time_index = np.int64(line) if view.world_from_camera.shape[0] > 1 else 0
        for column in range(width_px):
            place = (float(column), float(line))
            pixel = _render_pixel(scene, instances, view, time_index, place, stack)
            for channel in range(3):
                rgb[line, column, channel] = pixel[0][channel]
            depth_m[line, column] = pixel[1]
            semantics[line, column] = pixel[2]
            actor_index[line, column] = pixel[3]
    return rgb, depth_m, semantics, actor_index
