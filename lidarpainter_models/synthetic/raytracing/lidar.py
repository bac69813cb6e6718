"""Cast the rays of a spinning LiDAR, each from where the car and the actors are at its time."""

import numba
import numpy as np

from lidarpainter_models.synthetic.raytracing.scene_arrays import (
    ACTOR,
    GLOSS,
    KIND,
    KIND_GLOSS,
    SURFACE,
    TEXTURE,
    TINT,
    InstanceArrays,
    SceneArrays,
)
from lidarpainter_models.synthetic.raytracing.shade import classify, hit_normal, paint_at
from lidarpainter_models.synthetic.raytracing.texture import sample_texture
from lidarpainter_models.synthetic.raytracing.trace import (
    INLINED,
    RAY,
    WORK_ROWS,
    trace_scene,
    uv_at,
)

BEAM_WIDTH_RAD = 0.002


@numba.njit(**INLINED)
def _reflection(scene: SceneArrays, hit: tuple) -> tuple[float, float]:
    """Brightness and gloss of the texture at a hit."""
    surface = scene.prim_index[hit[1], SURFACE]
    place = uv_at(scene.prim_shading[hit[1]], hit[2], hit[3])
    colour = sample_texture(scene, scene.surface_index[surface, TEXTURE], place, 1)
    value = scene.surface_value[surface]
    bright = (
        0.4 * colour[0] * value[TINT]
        + 0.4 * colour[1] * value[TINT + 1]
        + 0.2 * colour[2] * value[TINT + 2]
    )
    gloss = value[GLOSS]
    if scene.surface_index[surface, KIND] == KIND_GLOSS:
        gloss *= colour[3]
    return bright, gloss


@numba.njit(**{**RAY, "_nrt": True, "parallel": True})
def cast_sweep(
    scene: SceneArrays,
    instances: InstanceArrays,
    world_from_lidar: np.ndarray,
    azimuth_rad: np.ndarray,
    inclination_rad: np.ndarray,
    max_range_m: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """First hit of every ray.

    Instances and `world_from_lidar`, float64 (columns, 3, 4), are those at the time of each column.
    Azimuths go counter-clockwise from ahead, inclinations up.

    Returns:
        range float64 (columns, beams), inf where nothing was hit; brightness, gloss and cosine of
        incidence float32 (columns, beams, 3); class and actor int32 (columns, beams, 2).
    """
    columns, beams = azimuth_rad.size, inclination_rad.size
    range_m = np.full((columns, beams), np.inf)
    surface = np.zeros((columns, beams, 3), np.float32)
    label = np.full((columns, beams, 2), -1, np.int32)
    for column in numba.prange(columns):
        stack = np.full((WORK_ROWS, 2), -1.0)
        pose = world_from_lidar[column]
        origin = (pose[0, 3], pose[1, 3], pose[2, 3])
        for beam in range(beams):
            flat, z = np.cos(inclination_rad[beam]), np.sin(inclination_rad[beam])
            x, y = flat * np.cos(azimuth_rad[column]), flat * np.sin(azimuth_rad[column])
            direction = (
                pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z,
                pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z,
                pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z,
            )
            limits = (max_range_m, BEAM_WIDTH_RAD, 0.0)
            hit = trace_scene(scene, instances, column, origin, direction, limits, stack)
            if hit[1] < 0:
                continue
            range_m[column, beam] = hit[0]
            bright, gloss = _reflection(scene, hit)
            normal = hit_normal(scene, instances, column, direction, hit)
            surface[column, beam, 0] = bright
            surface[column, beam, 1] = gloss
            surface[column, beam, 2] = -(
                normal[0] * direction[0] + normal[1] * direction[1] + normal[2] * direction[2]
            )
            label[column, beam, 0] = classify(scene, hit[1], paint_at(scene, hit))
            label[column, beam, 1] = scene.prim_index[hit[1], ACTOR]
    return range_m, surface, label
