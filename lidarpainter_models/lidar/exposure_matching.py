"""Bring the images of several cameras to one exposure, from points that two of them saw.

A view's gain (one factor per channel) is that of its camera times its own departure from it. Both
are medians of log ratios between samples of the same points, so a few wrong samples do not count;
the cameras are joined by weighted least squares over all pairs that share points.
"""

import numpy as np
from scipy.sparse.csgraph import connected_components

from lidarpainter_models.kernels.colour_sampling import BestSamples

DARKEST, BRIGHTEST = 16, 240
"""Samples outside are clipped or noisy and say nothing about exposure."""
LEAST_SHARED = 100
"""A pair of cameras with fewer points in common is not compared."""
SMALLEST_DEPARTURE = 0.03
"""A view that departs less (in log gain) from its camera's other views keeps its camera's gain."""
_ROUNDS = 8
_MOST_POINTS, _MOST_POINTS_PER_VIEW = 40_000, 100
"""Points that are compared: so many, or more where so many for each view are more."""


def match_exposure(samples: BestSamples, view_camera: np.ndarray) -> np.ndarray:
    """Gains (views, 3) float32 that bring every view to the exposure of camera 0.

    A camera that shares too few points with those joined to camera 0 keeps gain 1. `view_camera`
    (views,) is the camera of each view.
    """
    several = np.flatnonzero(samples.weight[:, 1] > 0)
    most = max(_MOST_POINTS, _MOST_POINTS_PER_VIEW * len(view_camera))
    several = several[:: max(1, len(several) // most)]
    rgb, view = samples.rgb[several], samples.view[several]
    usable = (samples.weight[several] > 0) & (rgb >= DARKEST).all(-1) & (rgb <= BRIGHTEST).all(-1)
    log_rgb = np.log(np.maximum(rgb, 1).astype(np.float32))
    departures = _departures(log_rgb, usable, view, view_camera)
    log_rgb += departures[view]
    camera_gains = _camera_gains(log_rgb, usable, view_camera[view], int(view_camera.max()) + 1)
    return np.exp(departures + camera_gains[view_camera]).astype(np.float32)


def _departures(
    log_rgb: np.ndarray, usable: np.ndarray, view: np.ndarray, view_camera: np.ndarray
) -> np.ndarray:
    """Log gains (views, 3) that bring each view to the median view of its camera."""
    gains = np.zeros((len(view_camera), 3), np.float32)
    pairs = [
        (view[rows, 0], view[rows, slot], log_rgb[rows, slot] - log_rgb[rows, 0])
        for slot in range(1, view.shape[1])
        for same in [view_camera[view[:, 0]] == view_camera[view[:, slot]]]
        for rows in [np.flatnonzero(usable[:, 0] & usable[:, slot] & same)]
    ]
    whose = np.concatenate([number for first, second, _ in pairs for number in (first, second)])
    order = np.argsort(whose, kind="stable")
    ends = np.searchsorted(whose[order], np.arange(len(view_camera) + 1))
    for _ in range(_ROUNDS):
        ratios = []
        for first, second, ratio in pairs:
            ratio_now = ratio + gains[second] - gains[first]
            ratios += [ratio_now, -ratio_now]
        found = np.concatenate(ratios)[order]
        for number in np.flatnonzero(np.diff(ends) >= LEAST_SHARED):
            gains[number] += 0.5 * np.median(found[ends[number] : ends[number + 1]], axis=0)
    for camera in np.unique(view_camera):
        own = view_camera == camera
        gains[own] -= np.median(gains[own], axis=0)
    gains[np.abs(gains).max(axis=1) < SMALLEST_DEPARTURE] = 0
    return gains


def _camera_gains(
    log_rgb: np.ndarray, usable: np.ndarray, camera: np.ndarray, num_cameras: int
) -> np.ndarray:
    """Log gains (cameras, 3) that bring each camera to camera 0."""
    rows, values, weights = [], [], []
    for first in range(num_cameras):
        for second in range(first + 1, num_cameras):
            ratios = _ratios(log_rgb, usable, camera, first, second)
            if len(ratios) >= LEAST_SHARED:
                row = np.zeros(num_cameras)
                row[first], row[second] = 1, -1
                rows.append(row)
                values.append(np.median(ratios, axis=0))
                weights.append(np.sqrt(len(ratios)))
    gains = np.zeros((num_cameras, 3))
    # only cameras that pairs link to the first one have a gain beside its
    are_compared = np.array(rows).reshape(-1, num_cameras) != 0
    _, group = connected_components(are_compared.T.astype(int) @ are_compared)
    free = np.flatnonzero(group[1:] == group[0]) + 1
    if len(free):
        scale = np.array(weights)[:, None]
        system, right = np.array(rows)[:, free] * scale, np.array(values) * scale
        gains[free] = np.linalg.lstsq(system, right, rcond=None)[0]
    return gains


def _ratios(
    log_rgb: np.ndarray, usable: np.ndarray, camera: np.ndarray, first: int, second: int
) -> np.ndarray:
    """log(second / first), one per point that both cameras saw, from its best samples of each."""
    in_first, in_second = usable & (camera == first), usable & (camera == second)
    both = np.flatnonzero(in_first.any(1) & in_second.any(1))
    best_first, best_second = in_first[both].argmax(1), in_second[both].argmax(1)
    return log_rgb[both, best_second] - log_rgb[both, best_first]
