"""LiDAR points of PandaSet and their classes, checked.

The points of both LiDARs of a frame lie in one table, in the dataset's own frame: x, y, z, the
intensity `i`, the time `t` in seconds since the epoch, and `d`, which LiDAR measured them. A table
of the same rows holds the classes. The files say nothing of beams or echoes.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.errors import DataError
from lidarpainter_models.readers.pandaset.dataframe_pickle import read_table
from lidarpainter_models.readers.source_logs.drive_poses import NS_PER_S
from lidarpainter_models.readers.source_logs.folder import SourceFolder
from lidarpainter_models.scenes.records import SweepPoints

LIDAR_NAMES = ("pandar64", "pandar_gt")
"""Positions are the values of a point's `d`: the spinning and the forward LiDAR."""

_POINT_COLUMNS = ("x", "y", "z", "i", "t", "d")
_MAX_SWEEP_S = 1.0
"""A point farther from the middle of its sweep was not measured in it."""
_LATEST_S = 2**62 / NS_PER_S
_FARTHEST_M = 1e8
"""The Earth's radius is 6.4e6 m."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PandasetPoints:
    """All points of one frame, row by row as in their file."""

    xyz_m: np.ndarray
    """(points, 3) in the dataset's frame, float64."""
    intensity: np.ndarray
    time_s: np.ndarray
    sensor: np.ndarray
    where: str
    """The file, for errors."""

    def sweep(
        self, rows: np.ndarray, xyz_world_m: Float[Tensor, "points 3"], middle_ns: int
    ) -> SweepPoints:
        """The points of one LiDAR, whose rows and middle time are given."""
        offset_ns = np.rint((self.time_s[rows] - middle_ns / NS_PER_S) * NS_PER_S)
        return SweepPoints.of(
            xyz_world_m[torch.from_numpy(rows)],
            intensity=torch.from_numpy(self.intensity[rows].astype(np.float32)),
            time_offset_ns=torch.from_numpy(offset_ns.astype(np.int32)),
        )


def read_points(source: SourceFolder, frame_index: int) -> PandasetPoints:
    """The points of a frame.

    Raises:
        DataError: the table is damaged, or its numbers are no measurement.
    """
    name = f"lidar/{frame_index:02d}.pkl.gz"
    table = read_table(source, name, _POINT_COLUMNS)
    where = str(source.root / name)
    xyz_m = np.stack([table[axis].astype(np.float64, copy=False) for axis in "xyz"], axis=1)
    time_s = table["t"].astype(np.float64, copy=False)
    if not np.isin(table["d"], range(len(LIDAR_NAMES))).any():
        raise DataError(f"{where}: zero points of a known LiDAR, expected at least one")
    if not (np.isfinite(xyz_m).all() and np.isfinite(time_s).all()):
        raise DataError(f"{where}: points or their times are not finite")
    if np.abs(xyz_m).max() > _FARTHEST_M or np.abs(time_s).max() > _LATEST_S:
        raise DataError(f"{where}: a point is farther than the Earth is wide, or at no date")
    if np.abs(time_s - np.median(time_s)).max() > _MAX_SWEEP_S:
        raise DataError(f"{where}: points are more than {_MAX_SWEEP_S} s from their sweep")
    intensity = table["i"]
    if not (np.abs(intensity) <= np.finfo(np.float32).max).all():
        raise DataError(f"{where}: an intensity is not finite")
    return PandasetPoints(
        xyz_m=xyz_m, intensity=intensity, time_s=time_s, sensor=table["d"], where=where
    )


def read_classes(source: SourceFolder, frame_index: int, num_points: int) -> np.ndarray:
    """The class of each point of a frame, uint8.

    Raises:
        DataError: the table is damaged or does not fit the points.
    """
    name = f"annotations/semseg/{frame_index:02d}.pkl.gz"
    classes = read_table(source, name, ("class",))["class"]
    if len(classes) != num_points:
        raise DataError(f"{source.root / name}: {len(classes)} classes for {num_points} points")
    if not ((classes >= 0) & (classes <= np.iinfo(np.uint8).max)).all():
        raise DataError(f"{source.root / name}: a class number is not within 0 to 255")
    return classes.astype(np.uint8)
