"""How well the images of hubs agree under a turn, a lateness and a readout of their camera.

A hub is an image with the points that it shows and the images beside it that show them too. The
parameters under which all agree best are found by Gauss-Newton with a robust weight (Geman and
McClure, 1987), after a search over the lateness. Parameters are a turn about the camera's axes
(rad), a lateness and a readout (s).
"""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float

from lidarpainter_models.kernels.point_contrasts import (
    LATE,
    READOUT,
    TURN,
    AssumedCamera,
    depths_before,
    seen_contrasts,
)
from lidarpainter_models.lidar.hub_images import Hub, HubImage

_SEARCHED_S = np.linspace(-0.06, 0.06, 7)
_SEARCH_LEVEL, _SEARCH_ROUNDS, _SEARCH_STRIDE = 3, 3, 3
_SCHEDULE = ((3, 5), (2, 14))  # level and rounds of Gauss-Newton
_STEP = 1.5  # derivatives of images that do not fit yet are too small
_OUTLIER = 5.0  # medians from which on a difference counts little
_EXPECTED = np.array([0.01, 0.01, 0.01, 0.05, 0.03])
_SAMPLES_OF_PRIOR = 500.0  # neighbouring points look alike


class Found(NamedTuple):
    """A camera's turn (rad), lateness and readout (s), and their standard errors."""

    values: Float[np.ndarray, "5"]
    errors: Float[np.ndarray, "5"]


def found_in(hubs: Sequence[Hub], free: np.ndarray) -> Found:
    """The parameters under which the images of some hubs agree."""
    return _refined(hubs, _searched(hubs, free), free)


def gains_of(hubs: Sequence[Hub], values: Float[np.ndarray, "5"]) -> Float[np.ndarray, " hubs"]:
    """By which share the images of each hub differ less under some parameters than as stored."""
    gains = []
    for hub in hubs:
        as_stored = _equations([hub], np.zeros(5), _SCHEDULE[-1][0], None)
        changed = _equations([hub], values, _SCHEDULE[-1][0], as_stored.outlier)
        gains.append(1 - changed.difference / max(as_stored.difference, 1e-9))
    return np.array(gains)


def _assumed(image: HubImage, values: Float[np.ndarray, "5"]) -> AssumedCamera:
    """An image's camera under some parameters; a told readout is kept."""
    camera, across_s = image.camera, (0.0, float(values[READOUT]))
    if camera.shutter is not None and camera.shutter.is_rolling:
        across_s = camera.shutter.across_s
    focal, centre = (camera.fx_px, camera.fy_px), (camera.cx_px, camera.cy_px)
    return AssumedCamera(
        camera_from_world=camera.camera_from_world.numpy(),
        twist_per_s=image.twist_per_s,
        turned_from_camera=cv2.Rodrigues(-values[TURN])[0],
        lens=np.array([*focal, *centre, camera.width_px, camera.height_px], np.float64),
        late_s=float(values[LATE]),
        across_s=np.array(across_s),
    )


class _Compared(NamedTuple):
    """What the images of a hub show of its points."""

    contrast: Float[np.ndarray, "images points"]
    is_seen: Bool[np.ndarray, "images points"]
    slope: Float[np.ndarray, "images points 5"]
    """Derivative of the contrast by the parameters."""
    shared_slope: Float[np.ndarray, "images points 5"]
    """The same with the mean gradient of a point, which has less noise."""


def _compared(hub: Hub, values: Float[np.ndarray, "5"], level: int, stride: int) -> _Compared:
    points = hub.points[::stride]
    cameras = [_assumed(image, values) for image in hub.images]
    hub_depth_m = depths_before(points, cameras[hub.own])
    seen = [
        seen_contrasts(points, camera, image.contrasts, image.nearest_m, level, hub_depth_m)
        for image, camera in zip(hub.images, cameras, strict=True)
    ]
    is_seen = np.array([one.is_seen for one in seen])
    gradient = np.sum([one.gradient for one in seen], 0)
    mean = gradient / np.maximum(is_seen.sum(0), 1)[:, None]
    return _Compared(
        contrast=np.array([one.contrast for one in seen]),
        is_seen=is_seen,
        slope=np.array([one.slope for one in seen]),
        shared_slope=np.array([np.einsum("pa,pab->pb", mean, one.motion) for one in seen]),
    )


class _Equations(NamedTuple):
    """A step's normal equations, one right side for each hub."""

    matrix: Float[np.ndarray, "5 5"]
    sides: Float[np.ndarray, "hubs 5"]
    difference: float
    """Variance of what images show of a point, over the strength of what they show."""
    noise: float
    outlier: float


def _equations(
    hubs: Sequence[Hub],
    values: Float[np.ndarray, "5"],
    level: int,
    outlier: float | None,
    stride: int = 1,
) -> _Equations:
    compared = [_compared(hub, values, level, stride) for hub in hubs]
    if outlier is None:
        away = [np.abs(c.contrast - _mean(c.is_seen, c.contrast))[c.is_seen] for c in compared]
        outlier = _OUTLIER * float(np.median(np.concatenate(away)))
    matrix, sides, slopes, sums = np.zeros((5, 5)), [], [], np.zeros(3)
    for c in compared:
        weight = c.is_seen.astype(float)
        for _ in range(3):
            away = c.contrast - _mean(weight, c.contrast)
            weight = c.is_seen / (1 + (away / outlier) ** 2) ** 2
        weight *= c.is_seen.sum(0) > 1
        away = c.contrast - _mean(weight, c.contrast)
        slope = c.slope - _mean(weight, c.slope)
        shared = c.shared_slope - _mean(weight, c.shared_slope)
        matrix += np.einsum("ipa,ip,ipb->ab", shared, weight, shared)
        matrix += 0.1 * np.einsum("ipa,ip,ipb->ab", slope, weight, slope)
        sides.append(np.einsum("ipa,ip->a", slope, weight * away))
        slopes.append(np.einsum("ipa,ip->a", c.slope, weight * c.contrast))
        sums += (weight * away**2).sum(), (weight * c.contrast**2).sum(), weight.sum()
    difference = sums[0] / max(sums[1], 1e-9)
    # of the quotient: what only makes the images weaker is no progress
    right = np.array(sides) - difference * np.array(slopes)
    return _Equations(matrix, right, difference, sums[0] / max(sums[2], 1e-9), outlier)


def _mean(weight: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Over the images, point by point."""
    weight = weight.reshape(*weight.shape, *[1] * (values.ndim - 2))
    return (weight * values).sum(0) / np.maximum(weight.sum(0), 1e-9)


def _stepped(
    found: _Equations, values: np.ndarray, free: np.ndarray, samples: float
) -> tuple[np.ndarray, np.ndarray]:
    """The values after a step, and the inverse of the matrix of the free ones."""
    prior = samples * found.noise / _EXPECTED**2
    inverse = np.linalg.inv((found.matrix + np.diag(prior))[np.ix_(free, free)])
    stepped = values.copy()
    stepped[free] -= _STEP * inverse @ (found.sides.sum(0) + prior * values)[free]
    return stepped, inverse


def _searched(hubs: Sequence[Hub], free: np.ndarray) -> Float[np.ndarray, "5"]:
    """Of several latenesses the best one, each with its own turn."""
    tried: list[tuple[float, int, np.ndarray]] = []
    outlier = None
    for late_s in _SEARCHED_S:
        values = np.zeros(5)
        values[LATE] = late_s
        for _ in range(_SEARCH_ROUNDS):
            found = _equations(hubs, values, _SEARCH_LEVEL, outlier, _SEARCH_STRIDE)
            outlier, before = found.outlier, values
            values, _ = _stepped(found, values, free[TURN], _SAMPLES_OF_PRIOR / _SEARCH_STRIDE)
        tried.append((found.difference, len(tried), before))
    return min(tried)[2]


def _refined(hubs: Sequence[Hub], values: Float[np.ndarray, "5"], free: np.ndarray) -> Found:
    """All free parameters, and how much they scatter between hubs."""
    for level, rounds in _SCHEDULE:
        outlier = None
        for _ in range(rounds):
            found = _equations(hubs, values, level, outlier)
            outlier = found.outlier
            values, inverse = _stepped(found, values, free, _SAMPLES_OF_PRIOR)
    scatter = found.sides[:, free].T @ found.sides[:, free]
    covariance = inverse @ scatter @ inverse * len(hubs) / max(len(hubs) - 1, 1)
    errors = np.zeros(5)
    errors[free] = np.sqrt(np.diag(covariance))
    return Found(values, errors)
