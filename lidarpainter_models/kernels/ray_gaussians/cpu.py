"""What rays meet of Gaussians with numba: tile by tile, each ray through its tile's list.

Lists are in the order of the least distance at which a Gaussian can answer. Answers wait, sorted,
until no Gaussian of the rest of the list can come before them; so a ray is blended in the true
order and ends where it is stopped.
"""

import math
from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor

from lidarpainter_models.kernels import ray_gaussians as rules
from lidarpainter_models.kernels.ray_gaussians import Ellipsoids, RayHits, RayReturns, Rays
from lidarpainter_models.kernels.ray_gaussians.tiles import (
    TURN_RAD,
    beside_rays,
    bounded,
    tile_lists,
)

TILE_RAD = math.radians(1.6)
TILE_RAYS = 8
"""Rays of a column of azimuth that share a row of tiles, at least."""
MOST_ROWS = 64
PART = 64
"""Bounds of a list that are compared with a ray at once."""
WAITING = 64
"""Answers that wait to be blended; of more the nearest goes first."""
_FAINTEST, _MOST, _LEFT = (
    np.float32(value) for value in (rules.FAINTEST, rules.MOST_OPAQUE, rules.LEFT_OVER)
)
_NEAREST, _HALF = np.float32(rules.NEAREST_M), np.float32(0.5)


def trace_rays(rays: Rays, gaussians: Ellipsoids, most_hits: int) -> RayReturns:
    """See `ray_gaussians.trace_rays`."""
    count, num_channels = len(rays.origin_m), gaussians.channels.shape[1]
    floats = np.zeros((count, 4 + num_channels), np.float32)
    floats[:, 1] = np.inf
    nearest = np.full(count, rules.NOTHING, np.int64)
    listed = np.full((count, most_hits), rules.NOTHING, np.int64)
    about = np.zeros((count, most_hits, 4), np.float32)
    if count and len(gaussians.means):
        _trace(rays, gaussians, (floats, nearest, listed, about))
    columns_of = torch.from_numpy(floats)
    hits = torch.from_numpy(about)
    return RayReturns(
        range_m=columns_of[:, 0] / columns_of[:, 2].clamp(min=1e-9),
        median_m=columns_of[:, 1],
        alpha=columns_of[:, 2],
        cosine=columns_of[:, 3],
        channels=columns_of[:, 4:],
        nearest=torch.from_numpy(nearest),
        hits=RayHits(torch.from_numpy(listed), *hits.unbind(2)),
    )


def _trace(rays: Rays, gaussians: Ellipsoids, out: tuple[np.ndarray, ...]) -> None:
    """Fill in what the rays met; those are rows of the Gaussians that were given."""
    origin, direction, after_s = (_array(column) for column in rays)
    means, axes, scale_m, opacity, velocity, channels = (
        _array(column) for column in vars(gaussians).values()
    )
    azimuth = np.arctan2(direction[:, 1], direction[:, 0])
    elevation = np.arcsin(np.clip(direction[:, 2], -1, 1))
    columns, edges = _tiling(azimuth, elevation)
    middle = math.atan2(np.sin(azimuth).mean(), np.cos(azimuth).mean())
    aside = np.abs(np.remainder(azimuth - middle + math.pi, TURN_RAD) - math.pi).max()
    started_m, longest_s = np.linalg.norm(origin, axis=1).max(), np.abs(after_s).max()
    rows, grown_m = beside_rays(
        (means, scale_m, opacity, velocity), (middle, aside, started_m, longest_s), rules.FAINTEST
    )
    means, axes, scale_m, opacity = means[rows], axes[rows], scale_m[rows], opacity[rows]
    bounds, near_m = bounded(means, axes, scale_m, opacity, grown_m, rules.FAINTEST)
    is_reached = (bounds[:, 3] >= edges[0]) & (bounds[:, 2] <= edges[-1])
    order = np.flatnonzero(is_reached)
    order = order[np.argsort(near_m[order], kind="stable")]
    starts, lists = tile_lists(order, bounds, columns, edges)
    tile = _tile_of(azimuth, elevation, columns, edges)
    thin, whitening = scale_m.argmin(axis=1), axes / scale_m[:, :, None]
    _follow(
        (np.argsort(tile, kind="stable"), tile, starts, lists, len(edges) - 1, columns),
        (origin, direction, after_s, azimuth, elevation),
        (means, velocity[rows], (whitening, opacity, channels[rows], thin, scale_m.min(axis=1))),
        (bounds, near_m),
        out,
    )
    for found in out[1:3]:
        is_met = found >= 0
        found[is_met] = rows[found[is_met]]


def _array(tensor: Tensor) -> np.ndarray:
    return np.ascontiguousarray(tensor.detach().numpy())


def _tiling(azimuth: np.ndarray, elevation: np.ndarray) -> tuple[int, np.ndarray]:
    """How many columns of tiles fill the turn, and elevations between their rows."""
    columns = math.ceil(TURN_RAD / TILE_RAD)
    taken = len(np.unique(np.floor(azimuth / TURN_RAD * columns)))
    rows = int(np.clip(len(elevation) / taken / TILE_RAYS**2, 1, MOST_ROWS))
    edges = np.quantile(elevation, np.linspace(0, 1, rows + 1)).astype(np.float64)
    edges[0], edges[-1] = edges[0] - 1e-6, edges[-1] + 1e-6
    return columns, np.unique(edges)


def _tile_of(
    azimuth: np.ndarray, elevation: np.ndarray, columns: int, edges: np.ndarray
) -> np.ndarray:
    rows = len(edges) - 1
    column = np.floor(azimuth / (TURN_RAD / columns)).astype(np.int64) % columns
    row = np.clip(np.searchsorted(edges, elevation, side="right") - 1, 0, rows - 1)
    return column * rows + row


_INNER: dict[str, Any] = {"fastmath": {"contract"}, "error_model": "numpy", "forceinline": True}
_INNER |= {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}


@numba.njit(**_INNER)
def _answer(
    ray: tuple, mean: np.ndarray, whitening: np.ndarray, velocity: np.ndarray
) -> tuple[np.float32, np.float32]:
    """Where along a ray a Gaussian answers, and the square of how many deviations out."""
    ox, oy, oz, dx, dy, dz, after = ray
    mx = mean[0] + after * velocity[0] - ox
    my = mean[1] + after * velocity[1] - oy
    mz = mean[2] + after * velocity[2] - oz
    along = mx * dx + my * dy + mz * dz
    px, py, pz = along * dx - mx, along * dy - my, along * dz - mz
    w = whitening
    sx = w[0, 0] * px + w[0, 1] * py + w[0, 2] * pz
    sy = w[1, 0] * px + w[1, 1] * py + w[1, 2] * pz
    sz = w[2, 0] * px + w[2, 1] * py + w[2, 2] * pz
    wx = w[0, 0] * dx + w[0, 1] * dy + w[0, 2] * dz
    wy = w[1, 0] * dx + w[1, 1] * dy + w[1, 2] * dz
    wz = w[2, 0] * dx + w[2, 1] * dy + w[2, 2] * dz
    on = -(sx * wx + sy * wy + sz * wz) / (wx * wx + wy * wy + wz * wz)
    sx, sy, sz = sx + on * wx, sy + on * wy, sz + on * wz
    return along + on, sx * sx + sy * sy + sz * sz


@numba.njit(**_INNER)
def _thin_answer(ray: tuple, whitening: np.ndarray, thin: int, least_m: np.float32) -> tuple:
    """Slope of the answer's distance along the thinnest axis, and the cosine of incidence."""
    _, _, _, dx, dy, dz, _ = ray
    squared, along = np.float32(0), np.float32(0)
    for axis in range(3):
        w = whitening[axis, 0] * dx + whitening[axis, 1] * dy + whitening[axis, 2] * dz
        squared += w * w
        if axis == thin:
            along = w
    return along / (least_m * squared), abs(along) * least_m


@numba.njit(**_INNER)
def _reaching(
    azimuth: np.float32, elevation: np.float32, bounds: np.ndarray, part: tuple, found: np.ndarray
) -> int:
    """List which bounds of a part of a tile's list hold a ray; returns how many do."""
    first, last = part
    count = 0
    for place in range(first, last):
        found[count] = place
        beside = abs(azimuth - bounds[0, place]) <= bounds[1, place]
        count += beside & (elevation >= bounds[2, place]) & (elevation <= bounds[3, place])
    return count


@numba.njit(**_INNER)
def _wait(numbers: np.ndarray, rows: np.ndarray, ends: tuple, hit: tuple) -> tuple[int, int]:
    """Put an answer among those that wait, in order; of equally far ones the lower row first."""
    first, last = ends
    range_m, alpha, g = hit
    if last == WAITING:  # what was blended has left room before the first
        for at in range(last - first):
            numbers[at, 0], numbers[at, 1] = numbers[at + first, 0], numbers[at + first, 1]
            rows[at] = rows[at + first]
        first, last = 0, last - first
    at = last
    while at > first and (
        numbers[at - 1, 0] > range_m or (numbers[at - 1, 0] == range_m and rows[at - 1] > g)
    ):
        numbers[at, 0], numbers[at, 1] = numbers[at - 1, 0], numbers[at - 1, 1]
        rows[at] = rows[at - 1]
        at -= 1
    numbers[at, 0], numbers[at, 1], rows[at] = range_m, alpha, g
    return first, last + 1


@numba.njit(**_INNER)
def _stop(ray: tuple, through: np.float32, hit: tuple, solids: tuple, out: tuple) -> np.float32:
    """Let an answer stop its part of a ray; returns how much of the ray goes on."""
    range_m, alpha, g = hit
    whitening, opacity, channels, thin, least_m = solids
    floats, nearest, listed, about, num_hits = out
    slope, cosine = _thin_answer(ray, whitening[g], thin[g], least_m[g])
    if num_hits < len(listed):
        listed[num_hits] = g
        about[num_hits, 0], about[num_hits, 1] = alpha / opacity[g], range_m
        about[num_hits, 2], about[num_hits, 3] = slope, cosine
    weight = through * min(alpha, _MOST)
    floats[0] += weight * range_m
    floats[2] += weight
    floats[3] += weight * cosine
    for channel in range(channels.shape[1]):
        floats[4 + channel] += weight * channels[g, channel]
    if through >= _HALF and through - weight < _HALF:
        floats[1], nearest[0] = range_m, g
    return through - weight


@numba.njit(**_INNER)
def _listed(lists: np.ndarray, bounds: np.ndarray, near_m: np.ndarray, middle: float) -> tuple:
    """Bounds (4, list), azimuths from a tile's middle, and least distances of a tile's list."""
    count = len(lists)
    own, near = np.empty((4, count), np.float32), np.empty(count, np.float32)
    for place in range(count):
        g = lists[place]
        aside = bounds[g, 0] - middle
        own[0, place] = aside - TURN_RAD * math.floor(aside / TURN_RAD + 0.5)
        own[1, place] = bounds[g, 1] if bounds[g, 1] < math.pi else 2 * TURN_RAD
        own[2, place], own[3, place], near[place] = bounds[g, 2], bounds[g, 3], near_m[g]
    return own, near


@numba.njit(**_INNER)
def _follow_one(
    ray: tuple, angles: tuple, tile: tuple, everything: tuple, scratch: tuple, out: tuple
) -> None:
    """One ray through its tile's list."""
    lists, bounds, near_m = tile
    means, velocity, solids = everything
    numbers, rows, found = scratch
    floats, nearest, listed, about = out
    opacity, through, ends, num_hits = solids[1], np.float32(1), (0, 0), 0
    for start in range(0, len(lists), PART):
        part = (start, min(start + PART, len(lists)))
        count = _reaching(angles[0], angles[1], bounds, part, found)
        for number in range(count + 1):
            is_end = number == count
            place = min(part[1], len(lists) - 1) if is_end else found[number]
            until_m = near_m[place]
            if is_end and part[1] == len(lists):
                until_m = np.float32(np.inf)
            while ends[0] < ends[1] and (
                numbers[ends[0], 0] <= until_m or ends[1] - ends[0] == WAITING
            ):
                hit = (numbers[ends[0], 0], numbers[ends[0], 1], rows[ends[0]])
                own = (floats, nearest, listed, about, num_hits)
                through = _stop(ray, through, hit, solids, own)
                ends, num_hits = (ends[0] + 1, ends[1]), num_hits + 1
                if through < _LEFT:
                    return
            if not is_end:
                g = lists[place]
                range_m, apart = _answer(ray, means[g], solids[0][g], velocity[g])
                alpha = np.float32(opacity[g] * math.exp(-_HALF * apart))
                if alpha >= _FAINTEST and range_m > _NEAREST:
                    ends = _wait(numbers, rows, ends, (range_m, alpha, g))


@numba.njit(cache=True, nogil=True, fastmath={"contract"}, error_model="numpy")
def _follow(tiles: tuple, rays: tuple, everything: tuple, limits: tuple, out: tuple) -> None:
    """All rays, tile by tile."""
    by_tile, tile_of, starts, lists, rows_of_tiles, columns = tiles
    origin, direction, after_s, azimuth, elevation = rays
    floats, nearest, listed, about = out
    scratch = np.empty((WAITING, 2), np.float32), np.empty(WAITING, np.int32)
    found = np.empty(PART + 1, np.int64)
    tile = -1
    own = (lists[:0], np.empty((4, 0), np.float32), np.empty(0, np.float32))
    middle = 0.0
    for r in by_tile:
        if tile_of[r] != tile:
            tile = tile_of[r]
            part = lists[starts[tile] : starts[tile + 1]]
            middle = (tile // rows_of_tiles + 0.5) * TURN_RAD / columns
            bounds, near_m = _listed(part, limits[0], limits[1], middle)
            own = (part, bounds, near_m)
        o, d = origin[r], direction[r]
        ray = (o[0], o[1], o[2], d[0], d[1], d[2], after_s[r])
        aside = azimuth[r] - middle
        aside = np.float32(aside - TURN_RAD * math.floor(aside / TURN_RAD + 0.5))
        results = (floats[r], nearest[r : r + 1], listed[r], about[r])
        _follow_one(
            ray, (aside, elevation[r]), own, everything, (scratch[0], scratch[1], found), results
        )
