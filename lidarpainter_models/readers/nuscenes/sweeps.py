"""Sweeps of LIDAR_TOP, a Velodyne HDL-32E that turns 20 times a second.

A file holds x, y, z, intensity and ring of every point as float32, in the frame of the sensor: x
right, y forward, z up. The sweep's time is the end of the turn, which starts at the left and goes
clockwise (forum.nuscenes.org/t/245).

**The points are motion-compensated already**: they stand where they would have been seen from the
sensor's pose at the sweep's time. The forum says so; the key frame that the tests read shows it,
taken at 9.3 m/s:

- The laser firings that met nothing are stored at the sensor's origin. Their stored places run
  along a straight line from 0.45 m behind the sensor (first firing) to 0.1 mm (last): the way the
  car drove in the turn. Uncompensated, all would be at zero.
- Laser beams have fixed elevations. As stored, a ring's elevations spread by 0.15 degrees; with
  the motion of 9.3 m/s put back in, by 0.023 degrees, the least of all speeds.

So one rigid transform takes a sweep to the world. The time of a point follows from its azimuth; on
that key frame it agrees with the order of firing to 1 ms. Where a file has its points in that
order, the order decides on which side of the seam a point belongs.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Float, Int64

from lidarpainter_models.errors import DataError
from lidarpainter_models.readers.source_logs.folder import SourceFolder

TURN_NS = 50_000_000
"""Of a sensor that turns at 20 Hz."""
MIN_RANGE_M = 1.0
"""Nearer "points" are firings that met nothing, or the car's own roof; the sensor's least range."""
MAX_RANGE_M = 1000.0
"""Ten times as far as the sensor can see: a damaged number."""
_COLUMNS = 5
_MAX_FILE_BYTES = 64 * 1024 * 1024
"""A larger file is no turn of one LiDAR; the real ones have 0.7 MB."""
_MAX_RING = 1023
_MAX_ORDER_ERROR = 0.05
"""Share of a turn: points are in the order of firing if their median is not farther from it."""


class LidarPoints:
    """The points of one sweep that met something."""

    def __init__(self, rows: Float[np.ndarray, "points 5"], time_offset_ns: np.ndarray) -> None:
        self.xyz_m = rows[:, :3].astype(np.float64)
        """In the frame of the sensor at the sweep's time."""
        self.intensity = rows[:, 3]
        """0 to 255."""
        self.ring = rows[:, 4].astype(np.int16)
        self.time_offset_ns = time_offset_ns
        """After the sweep's time: up to one turn before it."""


def read_lidar_points(source: SourceFolder, name: str) -> LidarPoints:
    """The points of one `.pcd.bin` file.

    Raises:
        DataError: the file is missing, cut off, or holds something other than points.
    """
    path = source.root / name
    rows = _read_rows(source, name, path)
    offset_ns = _time_offsets(rows)
    range_m = np.linalg.norm(rows[:, :3].astype(np.float64), axis=1)
    met = range_m >= MIN_RANGE_M
    if range_m.max(initial=0.0) > MAX_RANGE_M:
        number = int(range_m.argmax())
        raise DataError(f"{path}, point {number}: {range_m[number]:.3g} m from the sensor")
    if not met.any():
        raise DataError(f"{path}: zero points beyond {MIN_RANGE_M} m, expected at least one")
    return LidarPoints(rows[met], offset_ns[met])


def turn_offset_ns(
    x_m: Float[np.ndarray, " points"], y_m: Float[np.ndarray, " points"]
) -> Int64[np.ndarray, " points"]:
    """When, relative to the end of the turn, the LiDAR looks along directions in its own frame."""
    return np.rint((_turn_share(x_m, y_m) - 1.0) * TURN_NS).astype(np.int64)


def _turn_share(x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
    """The part of a turn, from the left clockwise, until the LiDAR looks along directions."""
    clockwise_rad = np.pi - np.arctan2(y_m.astype(np.float64), x_m.astype(np.float64))
    return clockwise_rad / (2 * np.pi) % 1.0


def _read_rows(source: SourceFolder, name: str, path: Path) -> Float[np.ndarray, "points 5"]:
    rows = source.read_points(name, _COLUMNS)
    if rows.nbytes > _MAX_FILE_BYTES:
        raise DataError(f"{path}: more than {_MAX_FILE_BYTES} bytes, expected one turn of a LiDAR")
    ring = rows[:, 4]
    senseless = np.flatnonzero((ring < 0) | (ring > _MAX_RING) | (ring != np.rint(ring)))
    if len(senseless):
        raise DataError(f"{path}, point {senseless[0]}: ring {ring[senseless[0]]} is no laser")
    return rows


def _time_offsets(rows: Float[np.ndarray, "points 5"]) -> np.ndarray:
    share = _turn_share(rows[:, 0], rows[:, 1])
    in_order = (np.arange(len(rows)) + 0.5) / max(len(rows), 1)
    away = share - in_order
    around = np.rint(away)  # a point seen at the seam may seem to be a whole turn away
    if len(rows) and np.median(np.abs(away - around)) <= _MAX_ORDER_ERROR:
        share = share - around
    return np.rint((share - 1.0) * TURN_NS).astype(np.int32)
