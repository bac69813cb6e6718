"""Nearest hit of a ray in a tree of triangles and parallelograms, some with cut-out textures.

Intersection after Moeller and Trumbore (1997), with the second barycentric bound dropped for
parallelograms. Rays need no unit length: a hit at t is at origin + t * direction.
"""

from typing import Any

import numba
import numpy as np

from lidarpainter_models.synthetic.raytracing.scene_arrays import (
    IS_CUT_OUT,
    IS_PARALLELOGRAM,
    LEVEL_OFFSET,
    SURFACE,
    TEXTURE,
    UV_CORNER,
    UV_FIRST,
    UV_SECOND,
    InstanceArrays,
    SceneArrays,
)

STACK_SIZE = 96
NO_NODE = 1 << 30
WORK_ROWS = STACK_SIZE + 2
"""Rows of a working space: the stack, then the last hit of nearest-hit and of any-hit rays."""
RAY: dict[str, Any] = {
    "cache": True,
    "error_model": "numpy",
    "fastmath": {"nsz", "arcp", "contract", "afn", "reassoc"},  # infinities keep their meaning
    "_nrt": False,  # nothing is allocated per ray, so no array needs its references counted
}
INLINED = {**RAY, "forceinline": True}  # else each call would copy the whole tuple of arrays
CUT_OUT_LEVELS = 4
CUT_OUT_THRESHOLD = 105
NOTHING, BEYOND = np.float32(0.0), np.float32(np.inf)
ROUNDED_UP = np.float32(1.0000004)
EDGE = 1e-6  # neighbours overlap by this much, so no ray slips between them


@numba.njit(**INLINED)
def _inverse(step: float) -> np.float32:
    """1 / step without infinities, which would meet zeros in `_enter`."""
    return np.float32(1.0 / step if abs(step) > 1e-12 else 1e12)


@numba.njit(**INLINED)
def _enter(
    bounds: np.ndarray, side: int, origin: tuple, inverse: tuple, limit: np.float32
) -> np.float32:
    """Where the ray enters a child's box, or `BEYOND`."""
    x1 = (bounds[side] - origin[0]) * inverse[0]
    x2 = (bounds[side + 3] - origin[0]) * inverse[0]
    y1 = (bounds[side + 1] - origin[1]) * inverse[1]
    y2 = (bounds[side + 4] - origin[1]) * inverse[1]
    z1 = (bounds[side + 2] - origin[2]) * inverse[2]
    z2 = (bounds[side + 5] - origin[2]) * inverse[2]
    start = max(max(min(x1, x2), min(y1, y2)), max(min(z1, z2), NOTHING))
    end = min(min(max(x1, x2), max(y1, y2)), min(max(z1, z2), limit))
    return start if start <= end * ROUNDED_UP else BEYOND


@numba.njit(**INLINED)
def _hit_prim(row: np.ndarray, origin: tuple, direction: tuple) -> tuple[float, float, float]:
    """Distance (negative: missed) and the two edge coordinates."""
    px = direction[1] * row[8] - direction[2] * row[7]
    py = direction[2] * row[6] - direction[0] * row[8]
    pz = direction[0] * row[7] - direction[1] * row[6]
    scale = 1.0 / (row[3] * px + row[4] * py + row[5] * pz)
    tx, ty, tz = origin[0] - row[0], origin[1] - row[1], origin[2] - row[2]
    u = (tx * px + ty * py + tz * pz) * scale
    qx = ty * row[5] - tz * row[4]
    qy = tz * row[3] - tx * row[5]
    qz = tx * row[4] - ty * row[3]
    v = (direction[0] * qx + direction[1] * qy + direction[2] * qz) * scale
    most = max(u, v) if row[IS_PARALLELOGRAM] > 0 else u + v
    if not (u >= -EDGE and v >= -EDGE and most <= 1.0 + EDGE):
        return -1.0, 0.0, 0.0
    return (row[6] * qx + row[7] * qy + row[8] * qz) * scale, u, v


@numba.njit(**INLINED)
def uv_at(shading: np.ndarray, u: float, v: float) -> tuple[float, float]:
    """Texture place at the edge coordinates of a hit."""
    return (
        shading[UV_CORNER] + u * shading[UV_FIRST] + v * shading[UV_SECOND],
        shading[UV_CORNER + 1] + u * shading[UV_FIRST + 1] + v * shading[UV_SECOND + 1],
    )


@numba.njit(**RAY)
def is_cut_away(scene: SceneArrays, prim: int, u: float, v: float, width_m: float) -> bool:
    """Whether a cut-out texture is open where a ray of this width meets it."""
    shading = scene.prim_shading[prim]
    texture = scene.texture_index[scene.surface_index[scene.prim_index[prim, SURFACE], TEXTURE]]
    s, t = uv_at(shading, u, v)
    geometry = scene.prim_geometry[prim]
    edge_m = np.sqrt(geometry[3] ** 2 + geometry[4] ** 2 + geometry[5] ** 2)
    per_uv = np.sqrt(shading[UV_FIRST] ** 2 + shading[UV_FIRST + 1] ** 2)
    texels = width_m * texture[0] * per_uv / edge_m
    level, step = 0, 1
    while step * 2 < texels and level < min(CUT_OUT_LEVELS, texture[3] - 1):
        level, step = level + 1, step * 2
    width, height = max(texture[0] // step, 1), max(texture[1] // step, 1)
    column = int(np.floor(s * width)) % width
    line = int(np.floor(t * height)) % height
    texel = texture[LEVEL_OFFSET + level] + line * width + column
    return scene.texels[texel, 3] < CUT_OUT_THRESHOLD


@numba.njit(**INLINED)
def _hit_leaf(
    scene: SceneArrays, leaf: int, origin: tuple, direction: tuple, limits: tuple, best: tuple
) -> tuple[float, int, float, float]:
    """The better of the best hit so far and those in a leaf."""
    t_best, prim_best, u_best, v_best = best
    first, count = (-leaf - 1) >> 3, (-leaf - 1) & 7
    for prim in range(first, first + count):
        row = scene.prim_geometry[prim]
        t, u, v = _hit_prim(row, origin, direction)
        if not (0.0 < t < t_best):
            continue
        if row[IS_CUT_OUT] > 0 and is_cut_away(scene, prim, u, v, t * limits[1]):
            continue
        t_best, prim_best, u_best, v_best = t, prim, u, v
    return t_best, prim_best, u_best, v_best


@numba.njit(**INLINED)
def _try_hint(
    scene: SceneArrays, hint: int, origin: tuple, direction: tuple, limit: float
) -> tuple[float, int, float, float]:
    """The hit to start from: that of one primitive, or none."""
    best = (float(limit), -1, 0.0, 0.0)
    if hint >= 0 and scene.prim_geometry[hint, IS_CUT_OUT] == 0:
        t, u, v = _hit_prim(scene.prim_geometry[hint], origin, direction)
        if 0.0 < t < limit:
            best = (t, hint, u, v)
    return best


@numba.njit(**INLINED)
def _descend(
    scene: SceneArrays,
    node: int,
    start: tuple,
    inverse: tuple,
    limit: float,
    stack: np.ndarray,
    top: int,
) -> tuple[int, int]:
    """The nearer child that the ray enters (NO_NODE: none) and the stack with the farther one."""
    bounds = scene.node_bounds[node]
    left = _enter(bounds, 0, start, inverse, limit)
    right = _enter(bounds, 6, start, inverse, limit)
    far = 1 if left <= right else 0
    if max(left, right) < BEYOND:
        stack[top, 0] = scene.node_children[node, far]
        stack[top, 1] = max(left, right)
        top += 1
    if min(left, right) < BEYOND:
        return int(scene.node_children[node, 1 - far]), top
    return NO_NODE, top


@numba.njit(**INLINED)
def _pop(stack: np.ndarray, top: int, limit: float) -> tuple[int, int]:
    """The next waiting node that begins before `limit` (NO_NODE: none) and the rest."""
    while top > 0:
        top -= 1
        if stack[top, 1] <= limit:
            return int(stack[top, 0]), top
    return NO_NODE, 0


@numba.njit(**RAY)
def trace(
    scene: SceneArrays,
    root: int,
    origin: tuple,
    direction: tuple,
    limits: tuple,
    hint: int,
    stack: np.ndarray,
) -> tuple[float, int, float, float]:
    """Nearest hit below `limits[0]` in the tree of one root.

    Args:
        scene: the arrays.
        root: node to start from.
        origin: of the ray, in the frame of the tree.
        direction: of the ray.
        limits: greatest t, width of the ray per t in metres, 1.0 where any hit will do.
        hint: primitive that the ray probably hits (-1: none); tried first, it saves steps and
            never changes the result.
        stack: float64 (WORK_ROWS, 2), working space.

    Returns:
        t, primitive (-1: none) and the edge coordinates u, v of the hit.
    """
    best = _try_hint(scene, hint, origin, direction, limits[0])
    takes_any = limits[2] > 0
    start = (np.float32(origin[0]), np.float32(origin[1]), np.float32(origin[2]))
    inverse = (_inverse(direction[0]), _inverse(direction[1]), _inverse(direction[2]))
    node, top = root, 0
    while not (takes_any and best[1] >= 0):
        if node >= 0:
            node, top = _descend(scene, node, start, inverse, np.float32(best[0]), stack, top)
        else:
            best = _hit_leaf(scene, node, origin, direction, limits, best)
            node = NO_NODE
        if node == NO_NODE:
            node, top = _pop(stack, top, best[0])
            if node == NO_NODE:
                break
    return best


@numba.njit(**INLINED)
def to_box(pose: np.ndarray, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Turn a world direction into the frame of a pose."""
    return (
        pose[0, 0] * x + pose[1, 0] * y + pose[2, 0] * z,
        pose[0, 1] * x + pose[1, 1] * y + pose[2, 1] * z,
        pose[0, 2] * x + pose[1, 2] * y + pose[2, 2] * z,
    )


@numba.njit(**INLINED)
def trace_scene(
    scene: SceneArrays,
    instances: InstanceArrays,
    time_index: int,
    origin: tuple,
    direction: tuple,
    limits: tuple,
    stack: np.ndarray,
) -> tuple[float, int, float, float, int]:
    """Nearest hit among the street and the moving objects; see `trace`.

    Returns:
        t, primitive (-1: none), u, v and the instance that was hit (-1: the street).
    """
    kind = int(limits[2])
    hint = int(stack[STACK_SIZE + kind, 0])
    t, prim, u, v = trace(scene, 0, origin, direction, limits, hint, stack)
    instance = -1
    stack[STACK_SIZE + kind, 0] = prim
    if limits[2] > 0 and prim >= 0:
        return t, prim, u, v, instance
    squared = direction[0] ** 2 + direction[1] ** 2 + direction[2] ** 2
    for index in range(instances.roots.shape[1]):
        pose = instances.world_from_box[time_index, index]
        x, y, z = origin[0] - pose[0, 3], origin[1] - pose[1, 3], origin[2] - pose[2, 3]
        along = x * direction[0] + y * direction[1] + z * direction[2]
        outside = x * x + y * y + z * z - instances.radius_m[index] ** 2
        if along * along < outside * squared or (outside > 0 and along > 0):
            continue
        local_origin = to_box(pose, x, y, z)
        local_direction = to_box(pose, direction[0], direction[1], direction[2])
        root = instances.roots[time_index, index]
        new_limits = (t, limits[1], limits[2])
        new_t, new_prim, new_u, new_v = trace(
            scene, root, local_origin, local_direction, new_limits, -1, stack
        )
        if new_prim >= 0:
            t, prim, u, v, instance = new_t, new_prim, new_u, new_v, index
    return t, prim, u, v, instance
