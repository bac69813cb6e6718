"""Points of PointCloud2 and of Foxglove's PointCloud: fields in any order, of any type.

No standard says what a field with the time of a point is called or counts. Drivers write `t` or
`offset_time` (nanoseconds after the header's time, whole), `time` (seconds after it, float32) or
`timestamp` (seconds since the epoch, float64; or nanoseconds, whole): the numbers tell which.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64

from lidarpainter_models.errors import DataError
from lidarpainter_models.readers.bags.messages import pose_of
from lidarpainter_models.readers.source_logs.drive_poses import NS_PER_S

_ROS_TYPES = dict(enumerate(("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8"), start=1))
_FOXGLOVE_TYPES = dict(enumerate(("u1", "i1", "u2", "i2", "u4", "i4", "f4", "f8"), start=1))
TIME_FIELDS = ("t", "time", "timestamp", "time_stamp", "offset_time", "t_offset", "time_offset_ns")
_INTENSITY_FIELDS = ("intensity", "i", "reflectivity", "reflectance")
_RING_FIELDS = ("ring", "laser_number", "channel", "line", "laser_id", "beam")
MAX_POINTS = 10_000_000
MAX_FIELDS = 64
MAX_TURN_S = 2.0
"""Of the times of points of one message."""
_UNITS_S = (1.0, 1e-3, 1e-6, 1e-9)
_LEAST_TURN_S = 2e-3
"""A unit is the right one if the points of a message are taken within this and `MAX_TURN_S`."""


@dataclass(frozen=True, eq=False)
class BagPoints:
    """The points of one message that met something."""

    xyz_m: Float64[np.ndarray, "points 3"]
    intensity: np.ndarray
    ring: np.ndarray
    """-1 where the message has none."""
    offset_ns: Int64[np.ndarray, " points"]
    """After the time in the message's header."""


def points_of(
    decoded: Any,  # noqa: ANN401
    time_ns: int,
    where: str,
    *,
    time_field: str | None,
) -> BagPoints:
    """The points of a message; those of no return (not finite, or at the origin) are left out.

    Args:
        decoded: the message.
        time_ns: that of its header.
        where: its place, to name in errors.
        time_field: the field with the times of points; all are taken at once if None.

    Raises:
        DataError: it lacks x, y, z or the field of times, or states more than it holds.
    """
    rows = _rows(decoded, where)
    known = rows.dtype.names or ()
    missing = [name for name in ("x", "y", "z", time_field) if name and name not in known]
    if missing:
        have = ", ".join(known)
        raise DataError(f"{where}: no field {', '.join(missing)}, expected it among {have}")
    xyz_m = np.stack([rows[axis].astype(np.float64) for axis in "xyz"], axis=1)
    met = np.isfinite(xyz_m).all(axis=1) & (xyz_m != 0.0).any(axis=1)
    rows, xyz_m = rows[met], xyz_m[met]
    if decoded.HasField("pose") if hasattr(decoded, "HasField") else hasattr(decoded, "pose"):
        pose = pose_of(decoded.pose.orientation, decoded.pose.position, where).numpy()
        xyz_m = xyz_m @ pose[:3, :3].T + pose[:3, 3]  # Foxglove's clouds may lie beside their frame
    if time_field is None or not len(rows):
        offset_ns = np.zeros(len(rows), dtype=np.int64)
    else:
        offset_ns = _offsets(rows[time_field], time_ns, f"{where}, {time_field}")
    return BagPoints(
        xyz_m=xyz_m,
        intensity=np.nan_to_num(_column(rows, _INTENSITY_FIELDS, 0.0).astype(np.float32)),
        ring=_rings(_column(rows, _RING_FIELDS, -1)),
        offset_ns=offset_ns,
    )


def time_field_of(decoded: Any, where: str) -> str | None:  # noqa: ANN401
    """The name of the field with the times of points, by the names that drivers give it."""
    names = _rows(decoded, where).dtype.names or ()
    return next((name for name in names if name.lower() in TIME_FIELDS), None)


def _rows(decoded: Any, where: str) -> np.ndarray:  # noqa: ANN401
    """The points as records with the fields of the message."""
    is_ros = hasattr(decoded, "point_step")
    types = _ROS_TYPES if is_ros else _FOXGLOVE_TYPES
    step = int(decoded.point_step if is_ros else decoded.point_stride)
    order = ">" if getattr(decoded, "is_bigendian", False) else "<"
    formats, names, offsets = [], [], []
    for field in decoded.fields[:MAX_FIELDS]:
        number = field.datatype if is_ros else field.type
        if number not in types:
            raise DataError(
                f"{where}: field {field.name!r:.40} is of type {number}, expected 1 to 8"
            )
        if field.name not in names:
            names.append(field.name)
            formats.append(order + types[number])
            offsets.append(int(field.offset))
    reach = max(
        (at + np.dtype(form).itemsize for at, form in zip(offsets, formats, strict=True)), default=0
    )
    if not names or not 0 < reach <= step or step > 4096:
        raise DataError(f"{where}: points of {step} bytes with fields up to {reach}")
    data = bytes(decoded.data)
    count = int(decoded.width) * int(decoded.height) if is_ros else len(data) // step
    if not 0 <= count <= MAX_POINTS or len(data) < count * step:
        raise DataError(f"{where}: states {count} points of {step} bytes, holds {len(data)} bytes")
    kind = np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": step})
    row_step = int(getattr(decoded, "row_step", 0))
    if is_ros and decoded.height > 1 and row_step > decoded.width * step:
        return _padded(data, kind, decoded, where)
    return np.frombuffer(data, kind, count)


def _padded(data: bytes, kind: np.dtype, decoded: Any, where: str) -> np.ndarray:  # noqa: ANN401
    """The points of an organised cloud whose rows are longer than their points."""
    height, width, row_step = decoded.height, decoded.width, decoded.row_step
    if len(data) < height * row_step:
        raise DataError(f"{where}: {height} rows of {row_step} bytes, holds {len(data)} bytes")
    rows = np.frombuffer(data, np.uint8, height * row_step).reshape(height, row_step)
    return np.ascontiguousarray(rows[:, : width * kind.itemsize]).reshape(-1).view(kind)


def _offsets(times: np.ndarray, time_ns: int, where: str) -> np.ndarray:
    """Times of points in nanoseconds after the header's, whatever they count from and in."""
    if not np.isfinite(times.astype(np.float64)).all():
        raise DataError(f"{where}: a time is not finite")
    is_whole = times.dtype.kind in "iu"
    first = times.min()
    spread = float(times.max() - first) if is_whole else float(times.max()) - float(first)
    turn_s = [unit_s for unit_s in _UNITS_S if _LEAST_TURN_S <= spread * unit_s <= MAX_TURN_S]
    if not turn_s:
        if spread == 0:
            return np.zeros(len(times), dtype=np.int64)
        raise DataError(f"{where}: times from {first} to {times.max()} are no turn of a LiDAR")
    unit_s = turn_s[-1] if is_whole else turn_s[0]
    start_ns = (
        int(first) * round(unit_s * NS_PER_S) if is_whole else round(float(first) * 1e9 * unit_s)
    )
    if abs(start_ns - time_ns) > abs(start_ns):  # counted from the header
        start_ns += time_ns
    since = (times - first).astype(np.float64) * unit_s * NS_PER_S
    offset_ns = np.rint(since).astype(np.int64) + (start_ns - time_ns)
    if np.abs(offset_ns).max() > MAX_TURN_S * NS_PER_S:
        raise DataError(
            f"{where}: a point is {np.abs(offset_ns).max() / NS_PER_S:.3g} s from its message, "
            f"expected {MAX_TURN_S:g} s at most"
        )
    return offset_ns


def _column(rows: np.ndarray, names: tuple[str, ...], absent: float) -> np.ndarray:
    found = next((name for name in rows.dtype.names or () if name.lower() in names), None)
    return np.full(len(rows), absent) if found is None else rows[found]


def _rings(ring: np.ndarray) -> np.ndarray:
    """Whole numbers that 16 bits hold; -1 for others."""
    limit = np.iinfo(np.int16).max
    return np.where((ring >= 0) & (ring <= limit), ring, -1).astype(np.int16)
