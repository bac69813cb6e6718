"""Sweeps of the two LiDARs of Argoverse 2, Velodyne VLP-32C that stand on each other.

A file holds the points of both in the ego frame, motion-compensated to its timestamp, which is the
start of the turn; `offset_ns` says when after it a point was measured (`structures/sweep.py` of the
devkit av2, Wilson et al., 2021). The two spin at 10 Hz, half a turn apart, so together they look
anywhere twice a turn. Coordinates are float16: 3 cm apart at 50 m.

Lasers 0 to 31 are of one LiDAR, 32 to 63 of the other. Which of them is which no document says, and
readers disagree; the points do: a laser of a spinning LiDAR keeps one elevation in its own frame,
and in the frame of the other, which hangs upside down and leans, it does not.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from lidarpainter_models.errors import DataError
from lidarpainter_models.geometry.transforms import invert_rigid, transform_points
from lidarpainter_models.readers.source_logs.feather_tables import Kind, read_feather
from lidarpainter_models.readers.source_logs.folder import SourceFolder

LIDAR_NAMES = ("up_lidar", "down_lidar")
LASERS = 32
"""Of each LiDAR."""
MAX_OFFSET_NS = 500_000_000
"""After the start of a turn, which takes 100 ms."""
_COLUMNS: dict[str, Kind] = {
    **dict.fromkeys("xyz", "number"),
    "intensity": "number",
    "laser_number": "whole",
    "offset_ns": "whole",
}
_SHOWN = 4000
"""Points of each half by which the halves are told apart."""


@dataclass(frozen=True, eq=False)
class Av2Sweep:
    """The points of one file."""

    where: str
    xyz_m: Float64[np.ndarray, "points 3"]
    """In the ego frame at the sweep's timestamp."""
    intensity: np.ndarray
    """0 to 255."""
    laser: np.ndarray
    """0 to 63."""
    offset_ns: np.ndarray
    """After the sweep's timestamp."""

    @property
    def middle_ns(self) -> int:
        """The middle of the turn, after the sweep's timestamp."""
        return int(self.offset_ns.min() + self.offset_ns.max()) // 2


def read_sweep(source: SourceFolder, name: str) -> Av2Sweep:
    """The points of one file.

    Raises:
        DataError: the file is missing or damaged, or holds no points of two LiDARs.
    """
    where, table = str(source.root / name), read_feather(source, name, _COLUMNS)
    laser, offset_ns = table["laser_number"], table["offset_ns"]
    if not len(laser):
        raise DataError(f"{where}: zero points, expected at least one")
    if laser.min() < 0 or laser.max() >= 2 * LASERS:
        raise DataError(f"{where}: a laser {laser.max()}, expected 0 to {2 * LASERS - 1}")
    if np.abs(offset_ns).max() > MAX_OFFSET_NS:
        raise DataError(
            f"{where}: a point is {np.abs(offset_ns).max() / 1e9:.3g} s from its sweep, expected "
            f"{MAX_OFFSET_NS / 1e9} s at most"
        )
    xyz_m = np.stack([table[axis] for axis in "xyz"], axis=1)
    return Av2Sweep(where, xyz_m, table["intensity"], laser, offset_ns)


def is_upper_first(sweep: Av2Sweep, ego_from_lidar: dict[str, Float[Tensor, "4 4"]]) -> bool:
    """Whether lasers 0 to 31 are those of the upper LiDAR; so it is held where points do not tell.

    Args:
        sweep: any sweep of the log.
        ego_from_lidar: where each LiDAR sits.
    """
    first, second = sweep.laser < LASERS, sweep.laser >= LASERS
    up, down = (ego_from_lidar[name] for name in LIDAR_NAMES)
    as_named = _spread(sweep, first, up) + _spread(sweep, second, down)
    return as_named <= _spread(sweep, first, down) + _spread(sweep, second, up)


def _spread(sweep: Av2Sweep, rows: np.ndarray, ego_from_lidar: Float[Tensor, "4 4"]) -> float:
    """How much the elevations of a laser differ in a LiDAR's frame, in radians: the mean."""
    kept = np.flatnonzero(rows)
    if not len(kept):
        return 0.0
    kept = kept[:: max(len(kept) // _SHOWN, 1)]
    xyz_m = transform_points(invert_rigid(ego_from_lidar), torch.from_numpy(sweep.xyz_m[kept]))
    x_m, y_m, z_m = xyz_m.numpy().T
    elevation_rad = np.arctan2(z_m, np.hypot(x_m, y_m))
    laser = sweep.laser[kept] % LASERS
    count = np.bincount(laser, minlength=LASERS).clip(1)
    mean_rad = np.bincount(laser, elevation_rad, LASERS) / count
    return float(np.abs(elevation_rad - mean_rad[laser]).mean())
