"""Which Gaussians the rays of each tile of azimuth and elevation may meet, with numba.

Rows of tiles hold equally many rays, whatever the sensor's beams are; columns are equally wide. A
Gaussian's ellipsoid, as far out as it answers, is bounded by the vertical planes and by the cones
about the vertical that touch it: the angles of the planes are exact, so that a Gaussian over the
seam or over the pole needs no case of its own. It is first grown by the way that sensor and
Gaussian make between the rays.
"""

import math

import numba
import numpy as np

TURN_RAD, RIGHT_RAD = 2 * math.pi, math.pi / 2
SLACK_RAD = 2e-5
"""What float32 leaves of angles."""


@numba.njit(cache=True, nogil=True)
def touching_angles(xx: float, xy: float, yy: float) -> tuple[float, float]:
    """Angles of the lines through the origin that touch an ellipse: their middle and half-width.

    Args:
        xx: of the matrix m m^T - S, where the ellipse is m + S^(1/2) u for all |u| <= 1.
        xy: of the same.
        yy: of the same.

    Returns:
        The middle up to half a turn, and pi where the ellipse holds the origin; rad.
    """
    mean, cosine, sine = (xx + yy) / 2, (yy - xx) / 2, -xy
    reach = math.hypot(cosine, sine)
    if mean <= -reach:
        return 0.0, math.pi
    if mean >= reach:  # a point: the line through it
        return 0.5 * (math.atan2(sine, cosine) + math.pi), 0.0
    return 0.5 * (math.atan2(sine, cosine) + math.pi), 0.5 * math.acos(mean / reach)


@numba.njit(cache=True, nogil=True)
def _wrapped(angle_rad: float) -> float:
    """The same angle from -pi to pi."""
    return angle_rad - TURN_RAD * math.floor(angle_rad / TURN_RAD + 0.5)


@numba.njit(cache=True, nogil=True)
def bounds_of(
    mean: np.ndarray, covariance: np.ndarray, reach: float, grown_m: float
) -> tuple[float, float, float, float]:
    """Middle azimuth, half its width, lowest and highest elevation of an ellipsoid, rad.

    Args:
        mean: its centre, metres from where rays start.
        covariance: of the Gaussian, square metres.
        reach: how many standard deviations out it answers.
        grown_m: by so much it is grown to all sides.
    """
    x, y, z = mean
    largest_m = reach * math.sqrt(max(covariance[0, 0] + covariance[1, 1] + covariance[2, 2], 0.0))
    share = grown_m / max(largest_m, 1e-6)
    more, wide = reach * reach * (1 + share), grown_m * grown_m
    wide += grown_m * largest_m
    sxx, sxy, syy = more * covariance[0, 0] + wide, more * covariance[0, 1], 0.0
    syy, szz = more * covariance[1, 1] + wide, more * covariance[2, 2] + wide
    sxz, syz = more * covariance[0, 2], more * covariance[1, 2]
    everywhere = (0.0, math.pi, -RIGHT_RAD, RIGHT_RAD)
    middle, half = touching_angles(x * x - sxx, x * y - sxy, y * y - syy)
    if half >= RIGHT_RAD:
        return everywhere
    if x * math.cos(middle) + y * math.sin(middle) < 0:
        middle += math.pi
    ahead, flat = math.atan2(y, x), math.hypot(x, y)
    aside = abs(_wrapped(ahead - middle)) + half
    c, s = math.cos(ahead), math.sin(ahead)
    srr, srz = c * c * sxx + 2 * c * s * sxy + s * s * syy, c * sxz + s * syz
    lifted, tall = touching_angles(flat * flat - srr, flat * z - srz, z * z - szz)
    if tall >= RIGHT_RAD or aside >= RIGHT_RAD:
        return middle, half, -RIGHT_RAD, RIGHT_RAD
    if flat * math.cos(lifted) + z * math.sin(lifted) < 0:
        lifted += math.pi
    lifted = _wrapped(lifted)
    low, high = lifted - tall, lifted + tall
    if low <= -RIGHT_RAD or high >= RIGHT_RAD:
        return everywhere
    shrunk = math.cos(aside)  # what lies beside the middle is farther, and so less high
    if low > 0:
        low = math.atan(math.tan(low) * shrunk)
    if high < 0:
        high = math.atan(math.tan(high) * shrunk)
    return middle, half, low, high


@numba.njit(cache=True, nogil=True)
def beside_rays(solids: tuple, sector: tuple, faintest: float) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the Gaussians that a sphere around each lets some rays meet, and their own growth.

    Args:
        solids: means, scales, opacities and velocities.
        sector: middle azimuth and half width of where the rays go (rad), how far from the origin
            they begin at most (m), and how long before or after (s).
        faintest: answers weaker than that are none.

    Returns:
        Rows (int64), and by how much each is to be grown for the ways made meanwhile, metres.
    """
    means, scale_m, opacity, velocity = solids
    middle, aside, started_m, longest_s = sector
    is_narrow = aside < RIGHT_RAD
    left = (-math.sin(middle + aside), math.cos(middle + aside))
    right = (math.sin(middle - aside), -math.cos(middle - aside))
    rows, grown_m, count = np.empty(len(means), np.int64), np.empty(len(means)), 0
    for g in range(len(means)):
        if not opacity[g] > faintest:
            continue
        x, y = means[g, 0], means[g, 1]
        speed = math.sqrt(velocity[g, 0] ** 2 + velocity[g, 1] ** 2 + velocity[g, 2] ** 2)
        grown = started_m + longest_s * speed
        largest = max(scale_m[g, 0], scale_m[g, 1], scale_m[g, 2])
        radius = largest * math.sqrt(2 * math.log(opacity[g] / faintest)) + grown
        outside = max(left[0] * x + left[1] * y, right[0] * x + right[1] * y)
        if is_narrow and outside > radius:
            continue
        rows[count], grown_m[count] = g, grown
        count += 1
    return rows[:count], grown_m[:count]


@numba.njit(cache=True, nogil=True)
def bounded(
    means: np.ndarray,
    axes: np.ndarray,
    scale_m: np.ndarray,
    opacity: np.ndarray,
    grown_m: np.ndarray,
    faintest: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Angular bounds (gaussians, 4) as of `bounds_of`, and the least distance of each, float32.

    All are more opaque than the faintest answer.
    """
    count = len(means)
    bounds, near_m = np.empty((count, 4), np.float32), np.empty(count, np.float32)
    covariance = np.empty((3, 3))
    for g in range(count):
        reach = math.sqrt(2 * math.log(opacity[g] / faintest))
        for row in range(3):
            for column in range(row, 3):
                total = 0.0
                for axis in range(3):
                    along = axes[g, axis, row] * axes[g, axis, column]
                    total += along * scale_m[g, axis] * scale_m[g, axis]
                covariance[row, column] = covariance[column, row] = total
        largest = max(scale_m[g, 0], scale_m[g, 1], scale_m[g, 2])
        away = math.sqrt(means[g, 0] ** 2 + means[g, 1] ** 2 + means[g, 2] ** 2)
        near_m[g] = max(away - reach * largest - grown_m[g], 0.0)
        middle, half, low, high = bounds_of(means[g], covariance, reach, grown_m[g])
        bounds[g, 0], bounds[g, 1] = middle, half + SLACK_RAD
        bounds[g, 2], bounds[g, 3] = low - SLACK_RAD, high + SLACK_RAD
    return bounds, near_m


@numba.njit(cache=True, nogil=True)
def tile_lists(
    order: np.ndarray, bounds: np.ndarray, columns: int, edges_rad: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Where the list of each tile starts (tiles + 1), and the Gaussians in the order given.

    Args:
        order: Gaussians, nearest first.
        bounds: their angular bounds.
        columns: how many there are; they fill the turn from azimuth 0 on.
        edges_rad: elevations (rows + 1) between rows of tiles, ascending.
    """
    rows, width = len(edges_rad) - 1, TURN_RAD / columns
    starts = np.zeros(rows * columns + 1, np.int64)
    lists = np.empty(0, np.int32)
    for is_filling in range(2):
        for g in order:
            low_row = max(np.searchsorted(edges_rad, bounds[g, 2], side="right") - 1, 0)
            high_row = min(np.searchsorted(edges_rad, bounds[g, 3], side="left"), rows)
            left = math.floor((bounds[g, 0] - bounds[g, 1]) / width)
            right = math.floor((bounds[g, 0] + bounds[g, 1]) / width)
            for column in range(left, min(right, left + columns - 1) + 1):
                for row in range(low_row, high_row):
                    tile = column % columns * rows + row
                    if is_filling:
                        lists[starts[tile]] = g
                    starts[tile + 1 - is_filling] += 1
        if not is_filling:
            starts = np.cumsum(starts)
            lists = np.empty(starts[-1], np.int32)
    starts[1:] = starts[:-1].copy()  # filling has moved each start to the next one
    starts[0] = 0
    return starts, lists
