"""What images show of points, in NumPy."""

import numpy as np
from jaxtyping import Float, Float32
from numpy import ndarray

from lidarpainter_models.kernels import point_contrasts as rules
from lidarpainter_models.kernels.point_contrasts import AssumedCamera, SeenContrasts


def depths_before(
    points: Float[ndarray, "points 3"], camera: AssumedCamera
) -> Float[ndarray, " points"]:
    """See `point_contrasts.depths_before`."""
    return _projected(points, camera)[1]


def seen_contrasts(
    points: Float[ndarray, "points 3"],
    camera: AssumedCamera,
    levels: Float32[ndarray, "levels height width 3"],
    nearest_m: Float32[ndarray, "height width"],
    level: int,
    hub_depth_m: Float[ndarray, " points"],
) -> SeenContrasts:
    """See `point_contrasts.seen_contrasts`."""
    pixels_uv, depth_m, change = _projected(points, camera)
    size = camera.lens[4:]
    nearer = np.maximum(hub_depth_m, rules.LEAST_DEPTH_M) / np.maximum(depth_m, rules.LEAST_DEPTH_M)
    octaves = np.log2(nearer)
    is_seen = (depth_m > rules.NEAR_M) & (np.abs(octaves) < 1)
    is_seen &= ((pixels_uv > rules.BORDER_PX) & (pixels_uv < size - rules.BORDER_PX)).all(1)
    column, row = np.clip(pixels_uv, 0, size - 1).astype(int).T
    is_seen &= depth_m <= nearest_m[row, column].astype(float) * rules.HIDDEN + rules.HIDDEN_M
    found = _sampled(levels, pixels_uv, level + rules.LEVELS_PER_OCTAVE * octaves)
    scale = np.maximum(depth_m, rules.LEAST_SCALE_M)[:, None]  # a gradient per metre of the surface
    return SeenContrasts(
        contrast=found[:, 0],
        is_seen=is_seen,
        slope=np.einsum("pa,pab->pb", found[:, 1:], change),
        gradient=found[:, 1:] / scale * is_seen[:, None],
        motion=change * scale[..., None],
    )


def _projected(
    points: Float[ndarray, "points 3"], camera: AssumedCamera
) -> tuple[ndarray, ndarray, ndarray]:
    """Pixels (points, 2), depth, and derivatives of the pixels (points, 2, 5)."""
    pose, turned = camera.camera_from_world, camera.turned_from_camera
    focal, centre, size = camera.lens[:2], camera.lens[2:4], camera.lens[4:]
    start = points @ pose[:3, :3].T + pose[:3, 3]
    flow = -(np.cross(camera.twist_per_s[:3], start) + camera.twist_per_s[3:])
    after_s = np.zeros(len(points))
    for _ in range(rules.GUESSES):
        moved = start + (camera.late_s + after_s)[:, None] * flow
        x, y, depth_m = (moved @ turned.T).T
        ahead = np.maximum(depth_m, rules.LEAST_AHEAD_M)
        pixels_uv = focal * np.stack([x, y], 1) / ahead[:, None] + centre
        share = np.clip(pixels_uv / size - 0.5, -0.5, 0.5)
        after_s = share @ camera.across_s
    change = np.zeros((len(points), 3, 5))
    change[:, 0, 1], change[:, 0, 2] = -depth_m, y
    change[:, 1, 0], change[:, 1, 2] = depth_m, -x
    change[:, 2, 0], change[:, 2, 1] = -y, x
    change[:, :, rules.LATE] = flow @ turned.T
    change[:, :, rules.READOUT] = change[:, :, rules.LATE] * share[:, 1:]
    slant = (pixels_uv - centre)[..., None] / ahead[:, None, None]
    across = focal[:, None] * change[:, :2] / ahead[:, None, None]
    return pixels_uv, depth_m, across - slant * change[:, 2:]


def _sampled(
    levels: Float32[ndarray, "levels height width 3"],
    pixels_uv: Float[ndarray, "points 2"],
    level: Float[ndarray, " points"],
) -> Float[ndarray, "points 3"]:
    """Contrast and slopes at continuous pixels and levels, linear between."""
    count, height, width, _ = levels.shape
    places = (level, pixels_uv[:, 1] - 0.5, pixels_uv[:, 0] - 0.5)
    ends = (count, height, width)
    inside = [np.clip(x, 0, end - 1.001) for x, end in zip(places, ends, strict=True)]
    first = [place.astype(np.int64) for place in inside]
    later = [place - low for place, low in zip(inside, first, strict=True)]
    flat, found = levels.reshape(-1, 3), np.zeros((len(level), 3))
    for corner in np.ndindex(2, 2, 2):
        weight = np.ones(len(level))
        for step, share in zip(corner, later, strict=True):
            weight = weight * (share if step else 1 - share)
        level_at, row, column = (low + step for low, step in zip(first, corner, strict=True))
        found += weight[:, None] * flat[(level_at * height + row) * width + column]
    return found
