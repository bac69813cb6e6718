"""LiDAR sweeps as other programs read them: PCD, the five columns of nuScenes, NPZ and Parquet.

Points stand in the frame of their sensor at the time of the sweep, motion already taken out.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import torch

from lidarpainter_models.export.formats import SWEEP_FORMATS
from lidarpainter_models.geometry.transforms import invert_rigid, transform_points
from lidarpainter_models.scenes.records import Sweep, SweepPoints
from lidarpainter_models.storage.whole_files import write_whole

_PCD_ROW = np.dtype(
    [
        *(("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4")),
        *(("ring", "<i4"), ("time_offset_ns", "<i4")),
    ]
)


@dataclass(frozen=True, eq=False, kw_only=True)
class WrittenSweep:
    """A sweep as it is written."""

    sweep: Sweep
    points: SweepPoints
    actor_ids: Sequence[str] | None = None
    """Whom each point has met, empty where it met the street; None where nobody says."""


def write_sweep(path: Path, written: WrittenSweep, file_format: str) -> None:
    """Write a sweep in one of `SWEEP_FORMATS`, folders included.

    PCD is binary, of version 0.7; `pcd.bin` is float32 x, y, z, intensity, ring and nothing else,
    as nuScenes has it; NPZ and Parquet hold `sweep_columns`.

    Raises:
        WriteError: the disk refuses.
    """
    write_whole(path, _CONTENTS[file_format](written))


def _pcd(written: WrittenSweep) -> bytes:
    points = written.points
    table = np.zeros(points.num_points, dtype=_PCD_ROW)
    for axis, column in zip("xyz", points_lidar(written.sweep, points).unbind(1), strict=True):
        table[axis] = column.numpy()
    table["intensity"] = points.intensity.numpy()
    table["ring"] = points.ring.numpy()
    table["time_offset_ns"] = points.time_offset_ns.numpy()
    kinds = [_PCD_ROW[name].kind.upper() for name in _PCD_ROW.names or ()]
    header = (
        "# .PCD v0.7 - Point Cloud Data file format",
        "VERSION 0.7",
        f"FIELDS {' '.join(_PCD_ROW.names or ())}",
        f"SIZE {' '.join('4' for _ in kinds)}",
        f"TYPE {' '.join(kinds)}",
        f"COUNT {' '.join('1' for _ in kinds)}",
        f"WIDTH {len(table)}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {len(table)}",
        "DATA binary",
    )
    return ("\n".join(header) + "\n").encode("ascii") + table.tobytes()


def _pcd_bin(written: WrittenSweep) -> bytes:
    points = written.points
    columns = [points.intensity[:, None], points.ring.float()[:, None]]
    table = torch.cat([points_lidar(written.sweep, points), *columns], dim=1)
    return table.numpy().astype("<f4").tobytes()


def _npz(written: WrittenSweep) -> bytes:
    content = BytesIO()
    columns: dict[str, Any] = dict(sweep_columns(written))
    np.savez_compressed(content, **columns)
    return content.getvalue()


def _parquet(written: WrittenSweep) -> bytes:
    import pyarrow as pa
    from pyarrow import parquet

    content = BytesIO()
    parquet.write_table(pa.table(sweep_columns(written)), content)
    return content.getvalue()


_CONTENTS: dict[str, Callable[[WrittenSweep], bytes]] = dict(
    zip(SWEEP_FORMATS, (_pcd, _pcd_bin, _npz, _parquet), strict=True)
)


def sweep_columns(written: WrittenSweep) -> dict[str, np.ndarray]:
    """Everything that is known of a sweep's points, column by column.

    Returns:
        `x`, `y`, `z` (float32, metres, in the frame of the sensor at the time of the sweep),
        `intensity`, `ring`, `return`, `timestamp_ns`, and `actor` where it is known.
    """
    sweep, points = written.sweep, written.points
    places = points_lidar(sweep, points)
    columns = {name: place.numpy() for name, place in zip("xyz", places.unbind(1), strict=True)}
    columns["intensity"] = points.intensity.numpy().astype(np.float32)
    columns["ring"] = points.ring.numpy().astype(np.int16)
    columns["return"] = points.return_index.numpy().astype(np.int8)
    columns["timestamp_ns"] = sweep.timestamp_ns + points.time_offset_ns.numpy().astype(np.int64)
    if written.actor_ids is not None:
        columns["actor"] = np.array(written.actor_ids, dtype=str)
    return columns


def points_lidar(sweep: Sweep, points: SweepPoints) -> torch.Tensor:
    """The points in the frame of their sensor, float32."""
    lidar_from_world = invert_rigid(sweep.world_from_lidar.double())
    return transform_points(lidar_from_world, points.xyz_m.double()).float()
