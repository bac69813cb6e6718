"""Range images of the Waymo Open Dataset, and the points that they stand for.

A row is a beam (the highest first), a column a direction: the columns go clockwise around the
vehicle from straight behind, the first one half a column from it. With u the position of a column
(0 to 1), the azimuth in the LiDAR's own frame is pi (1 - 2u) less the LiDAR's own heading on the
vehicle, so that all LiDARs' columns point the same way.

The image of the TOP LiDAR is raw: each pixel has the pose of the vehicle when it was measured. The
other images are virtual: their points have already been moved to the vehicle at the frame's pose.
"""

import zlib
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.errors import DataError
from lidarpainter_models.readers.waymo.calibration import MAX_ROWS, LidarCalibration
from lidarpainter_models.readers.waymo.log import MAX_REACH_M, WaymoSweep
from lidarpainter_models.readers.waymo.messages import parse_message

MAX_COLUMNS = 8192
MAX_PIXELS = 1 << 19
"""The largest image has 64 x 2650."""
_FLOAT_BYTES = 4
_MESSAGE_BYTES = 64
"""What a matrix message takes beside its numbers."""
_MAX_MOTION_M = 20.0
"""The vehicle does not get farther from the frame's pose while the LiDAR turns once."""
_MAX_ALONE_SHARE = 0.1
"""Of later echoes without an earlier one: no more than stray pixels."""


@dataclass(frozen=True, eq=False)
class RangePoints:
    """Points of one LiDAR, first echoes first."""

    xyz_vehicle_m: np.ndarray
    """float64 (points, 3) in the vehicle frame at the frame's pose."""
    intensity: np.ndarray
    row: np.ndarray
    column: np.ndarray
    return_index: np.ndarray
    num_columns: int


def unpack_matrix(compressed: bytes, channels: int, where: str) -> np.ndarray:
    """A zlib-compressed `MatrixFloat` as float32 (rows, columns, channels).

    Raises:
        DataError: it does not unpack, is larger than any range image, or states another shape.
    """
    limit = MAX_PIXELS * channels * _FLOAT_BYTES + _MESSAGE_BYTES
    unpacker = zlib.decompressobj()
    try:
        content = unpacker.decompress(compressed, limit)
    except zlib.error as error:
        raise DataError(f"{where}: cannot be unpacked ({error})") from None
    if unpacker.unconsumed_tail:
        raise DataError(f"{where}: unpacks to more than {limit} bytes")
    if not unpacker.eof:
        raise DataError(f"{where}: the compressed matrix is cut off")
    message = parse_message("MatrixFloat", content, where)
    return shaped_matrix(np.frombuffer(message.data, np.uint8), message.shape.dims, channels, where)


def shaped_matrix(values: np.ndarray, shape: object, channels: int, where: str) -> np.ndarray:
    """Give the bytes or float32 numbers of a matrix its shape, which is checked first.

    Raises:
        DataError: the shape is none of a range image, or the numbers are more or fewer.
    """
    sizes = list(shape)[:4]  # type: ignore[call-overload]
    if (
        len(sizes) != 3
        or sizes[2] != channels
        or not (0 < sizes[0] <= MAX_ROWS and 0 < sizes[1] <= MAX_COLUMNS)
        or sizes[0] * sizes[1] > MAX_PIXELS
    ):
        raise DataError(
            f"{where}: shape {sizes}, expected at most {MAX_ROWS} rows, {MAX_COLUMNS} columns, "
            f"{MAX_PIXELS} pixels and exactly {channels} channels"
        )
    dims = [int(size) for size in sizes]
    num_bytes = dims[0] * dims[1] * channels * _FLOAT_BYTES
    if values.nbytes != num_bytes:
        raise DataError(f"{where}: {values.nbytes} bytes, expected {num_bytes} for shape {dims}")
    return values.view("<f4").reshape(dims)


def range_points(
    sweep: WaymoSweep, calibration: LidarCalibration, global_from_vehicle: Float[Tensor, "4 4"]
) -> RangePoints:
    """The points of a LiDAR's range images; a pixel without an echo has a range of 0 or less.

    Raises:
        DataError: the echoes differ in shape or come without an earlier one, or a range or pose
            makes no sense.
    """
    num_rows, num_columns = sweep.returns[0].shape[:2]
    if any(image.shape[:2] != (num_rows, num_columns) for image in sweep.returns):
        raise DataError(f"{sweep.place}: the echoes differ in shape")
    _require_first_echoes(sweep)
    inclination = calibration.row_inclinations_rad(num_rows, sweep.place)
    turned = calibration.vehicle_from_lidar[:2, 0].numpy()
    # of each column about the vehicle's z, counter-clockwise from ahead
    azimuth = np.pi * (1 - 2 * (np.arange(num_columns) + 0.5) / num_columns)
    azimuth -= np.arctan2(turned[1], turned[0])
    pixels = [_measured(image, sweep.place) for image in sweep.returns]
    row, column = (np.concatenate([found[axis] for found in pixels]) for axis in (0, 1))
    values = np.concatenate(
        [image[found] for image, found in zip(sweep.returns, pixels, strict=True)]
    )
    level_m = values[:, 0] * np.cos(inclination)[row]
    xyz_lidar_m = np.stack(
        [
            level_m * np.cos(azimuth)[column],
            level_m * np.sin(azimuth)[column],
            values[:, 0] * np.sin(inclination)[row],
        ],
        axis=1,
    )
    vehicle_from_lidar = calibration.vehicle_from_lidar.numpy()
    xyz_m = xyz_lidar_m @ vehicle_from_lidar[:3, :3].T + vehicle_from_lidar[:3, 3]
    if sweep.pixel_poses is not None:
        if sweep.pixel_poses.shape[:2] != (num_rows, num_columns):
            raise DataError(f"{sweep.place}: the pixel poses are not one per pixel")
        poses = sweep.pixel_poses[row, column]
        if not np.isfinite(poses).all():  # before it is cast, of which a signalling NaN complains
            raise DataError(f"{sweep.place}: a pixel pose is not finite")
        xyz_m = _compensated(xyz_m, poses.astype(np.float64), global_from_vehicle, sweep.place)
    return RangePoints(
        xyz_vehicle_m=xyz_m,
        intensity=values[:, 1],
        row=row,
        column=column,
        return_index=np.repeat(np.arange(len(pixels)), [len(found[0]) for found in pixels]),
        num_columns=num_columns,
    )


def _require_first_echoes(sweep: WaymoSweep) -> None:
    """A beam has a second echo because something behind the first one sent it back."""
    for first, second in pairwise(image[..., 0] > 0 for image in sweep.returns):
        num_alone, num_second = int((second & ~first).sum()), int(second.sum())
        if num_alone > _MAX_ALONE_SHARE * num_second:
            raise DataError(
                f"{sweep.place}: {num_alone} of {num_second} later echoes have no earlier one"
            )


def _measured(image: np.ndarray, where: str) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of the pixels that hold an echo."""
    ranges_m = image[..., 0]
    if not np.isfinite(image[..., :2]).all():
        raise DataError(f"{where}: a range or intensity is not finite")
    if ranges_m.max() > MAX_REACH_M:
        raise DataError(
            f"{where}: a range of {ranges_m.max():g} m, expected {MAX_REACH_M:.0f} m at most"
        )
    row, column = np.nonzero(ranges_m > 0)
    return row, column


def _compensated(
    xyz_m: np.ndarray, poses: np.ndarray, global_from_vehicle: Float[Tensor, "4 4"], where: str
) -> np.ndarray:
    """Move points from the vehicle at each one's own pose to the vehicle at the frame's pose."""
    frame = global_from_vehicle.to(torch.float64).numpy()
    moved_m = poses[:, 3:] - frame[:3, 3]
    if len(moved_m) and np.abs(moved_m).max() > _MAX_MOTION_M:
        raise DataError(
            f"{where}: a pixel was measured {np.abs(moved_m).max():.1f} m from the frame's pose, "
            f"expected {_MAX_MOTION_M:.0f} m at most"
        )
    x, y, z = xyz_m.T
    (cos_roll, cos_pitch, cos_yaw), (sin_roll, sin_pitch, sin_yaw) = (
        np.cos(poses[:, :3]).T,
        np.sin(poses[:, :3]).T,
    )
    y, z = cos_roll * y - sin_roll * z, sin_roll * y + cos_roll * z
    x, z = cos_pitch * x + sin_pitch * z, cos_pitch * z - sin_pitch * x
    x, y = cos_yaw * x - sin_yaw * y, sin_yaw * x + cos_yaw * y
    return (np.stack([x, y, z], axis=1) + moved_m) @ frame[:3, :3]
