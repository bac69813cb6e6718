"""Which places the sun does not reach, if shadows of one given actor are left out."""

import numba
import numpy as np

from lidarpainter_models.synthetic.raytracing.scene_arrays import (
    ACTOR,
    SUN_DIRECTION,
    InstanceArrays,
    SceneArrays,
)
from lidarpainter_models.synthetic.raytracing.trace import RAY, WORK_ROWS, trace_scene

SHADE_REACH_M = 120.0
SHADE_START_M = 0.03
MOST_OWN_HITS = 6
"""A ray to the sun leaves the actor's own surfaces after no more of them."""


@numba.njit(**{**RAY, "_nrt": True})
def is_shaded(
    scene: SceneArrays, instances: InstanceArrays, points: np.ndarray, actor: int
) -> np.ndarray:
    """Bool (points): whether anything but one actor stands between world points and the sun."""
    sun = (
        scene.light[SUN_DIRECTION],
        scene.light[SUN_DIRECTION + 1],
        scene.light[SUN_DIRECTION + 2],
    )
    stack = np.full((WORK_ROWS, 2), -1.0)
    found = np.zeros(points.shape[0], np.bool_)
    for index in range(points.shape[0]):
        gone = SHADE_START_M
        for _ in range(MOST_OWN_HITS):
            origin = (
                points[index, 0] + gone * sun[0],
                points[index, 1] + gone * sun[1],
                points[index, 2] + gone * sun[2],
            )
            hit = trace_scene(scene, instances, 0, origin, sun, (SHADE_REACH_M, 0.004, 0.0), stack)
            if hit[1] < 0:
                break
            if scene.prim_index[hit[1], ACTOR] != actor:
                found[index] = True
                break
            gone += hit[0] + SHADE_START_M
    return found
