"""Sensors of the Waymo Open Dataset: names, lenses, beams and where they sit on the vehicle.

Frames. Vehicle: x forward, y left, z up, origin on the road below the middle of the rear axle.
Waymo's camera frame has the same axes as the vehicle (x through the lens, y left, z up); here a
camera is x right, y down, z forward. Principal points count from the left and upper edges of the
image, as ours do (the dataset's camera projections say so), so they are kept as they are. The
lens terms k1 k2 p1 p2 k3 are OpenCV's.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.errors import DataError, LidarPainterError
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.scenes.records import Distortion
from lidarpainter_models.scenes.undistortion import pinhole_of
from lidarpainter_models.scenes.validation import require_pose

Direction = Literal["down", "up", "left", "right"]

CAMERA_NAMES = {1: "FRONT", 2: "FRONT_LEFT", 3: "FRONT_RIGHT", 4: "SIDE_LEFT", 5: "SIDE_RIGHT"}
LIDAR_NAMES = {1: "TOP", 2: "FRONT", 3: "SIDE_LEFT", 4: "SIDE_RIGHT", 5: "REAR"}
TOP = "TOP"
"""The spinning LiDAR on the roof; the other four see what is near."""
READOUT_DIRECTIONS: dict[int, Direction] = {1: "down", 2: "right", 3: "up", 4: "left"}
"""By `RollingShutterReadOutDirection`; the others are an unknown and a global shutter."""
NUM_INTRINSICS = 9
MAX_SIDE_PX = 8192
MAX_MOUNT_M = 20.0
"""No sensor sits farther from the vehicle's origin."""
MAX_ROWS = 256
"""Beams of a LiDAR."""
_MAX_LENS_TERM = 10.0
_FOCAL_PER_SIDE = (0.05, 50.0)
_SENSOR_FROM_CAMERA = torch.tensor(
    [[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]], dtype=torch.float64
)


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraCalibration:
    """One camera of a segment."""

    name: str
    lens: Camera
    """In the vehicle frame instead of the world: `world_from_camera` is vehicle_from_camera."""
    distortion: Distortion
    readout: Direction | None
    """In which direction the image is read; None for a global or unknown shutter."""


@dataclass(frozen=True, kw_only=True, eq=False)
class LidarCalibration:
    """One LiDAR of a segment."""

    name: str
    vehicle_from_lidar: Float[Tensor, "4 4"]
    beams_rad: np.ndarray
    """Inclinations as stored, lowest first; empty where they are uniform."""
    limits_rad: tuple[float, float]
    """Lower and upper edge of the uniform inclinations."""

    def row_inclinations_rad(self, num_rows: int, where: str) -> np.ndarray:
        """Inclination of each row of a range image; the first row is the highest.

        Uniform beams point at the centres of equal parts of the range between the limits.

        Raises:
            DataError: the range image has another number of rows than there are beams.
        """
        if len(self.beams_rad) == 0:
            lowest_rad, highest_rad = self.limits_rad
            share = (np.arange(num_rows) + 0.5) / num_rows
            return (lowest_rad + share * (highest_rad - lowest_rad))[::-1]
        if len(self.beams_rad) != num_rows:
            raise DataError(
                f"{where}: {num_rows} rows, expected {len(self.beams_rad)}, one per beam"
            )
        return self.beams_rad[::-1]


def sensor_name(value: object, names: dict[int, str], where: str) -> str:
    """The name of a camera or LiDAR that is given as its number or its name.

    Raises:
        DataError: there is no such sensor.
    """
    if isinstance(value, str) and value in names.values():
        return value
    if isinstance(value, int) and value in names:
        return names[value]
    raise DataError(f"{where}: sensor {value!r} is not known, expected {', '.join(names.values())}")


def finite_numbers(values: Sequence[float], count: int, where: str) -> np.ndarray:
    """So many finite float64 numbers."""
    numbers = np.asarray(values, dtype=np.float64)
    if numbers.shape != (count,):
        raise DataError(f"{where}: has {numbers.size} numbers, expected {count}")
    if not np.isfinite(numbers).all():
        raise DataError(f"{where}: holds a number that is not finite")
    return numbers


def rigid_pose(values: Sequence[float], where: str) -> Float[Tensor, "4 4"]:
    """A `target_from_source` of 16 row-major numbers."""
    return require_pose(torch.from_numpy(finite_numbers(values, 16, where)).reshape(4, 4), where)


def camera_calibration(
    name: str,
    intrinsics: Sequence[float],
    vehicle_from_sensor: Sequence[float],
    size_px: tuple[int, int],
    readout: int,
    where: str,
) -> CameraCalibration:
    """Check the calibration of a camera and bring it into our axes.

    Intrinsics are f_u f_v c_u c_v k1 k2 p1 p2 k3, `vehicle_from_sensor` is 16 numbers in Waymo's
    axes, `readout` a number of `READOUT_DIRECTIONS`, or another one.

    Raises:
        DataError: a number is missing or no lens could have it.
    """
    fx_px, fy_px, cx_px, cy_px, *terms = finite_numbers(
        intrinsics, NUM_INTRINSICS, f"{where}, intrinsic"
    ).tolist()
    width_px, height_px = size_px
    if not (0 < width_px <= MAX_SIDE_PX and 0 < height_px <= MAX_SIDE_PX):
        raise DataError(
            f"{where}: the image is {width_px} x {height_px} px, expected 1 to {MAX_SIDE_PX}"
        )
    lens_values = {"fx_px": fx_px, "fy_px": fy_px, "cx_px": cx_px, "cy_px": cy_px}
    _require_lens(lens_values, size_px, where)
    if max(abs(term) for term in terms) > _MAX_LENS_TERM:
        raise DataError(f"{where}: a lens term exceeds {_MAX_LENS_TERM:.0f}")
    lens = Camera(
        world_from_camera=_mount(vehicle_from_sensor, where) @ _SENSOR_FROM_CAMERA,
        **lens_values,
        width_px=width_px,
        height_px=height_px,
    )
    # a lens whose terms are all zero is a pinhole; undoing nothing would only blur its images
    distortion = Distortion("brown", tuple(terms)) if any(terms) else Distortion()
    _require_undistortable(lens, distortion, where)
    return CameraCalibration(
        name=name, lens=lens, distortion=distortion, readout=READOUT_DIRECTIONS.get(readout)
    )


def lidar_calibration(
    name: str,
    vehicle_from_lidar: Sequence[float],
    beams_rad: Sequence[float],
    limits_rad: tuple[float, float],
    where: str,
) -> LidarCalibration:
    """Check the calibration of a LiDAR.

    Raises:
        DataError: a number is missing or no LiDAR could have it.
    """
    if len(beams_rad) > MAX_ROWS:
        raise DataError(f"{where}: {len(beams_rad)} beams, expected {MAX_ROWS} at most")
    beams = finite_numbers(beams_rad, len(beams_rad), f"{where}, beam inclinations")
    limits = finite_numbers(limits_rad, 2, f"{where}, limits of the beam inclinations")
    if np.abs([*beams, *limits]).max() > np.pi / 2 + 1e-6:
        raise DataError(f"{where}: a beam inclination exceeds 90 degrees")
    if (np.diff(beams) <= 0).any() or (len(beams) == 0 and limits[0] >= limits[1]):
        raise DataError(f"{where}: the beam inclinations do not ascend")
    return LidarCalibration(
        name=name,
        vehicle_from_lidar=_mount(vehicle_from_lidar, where),
        beams_rad=beams,
        limits_rad=(float(limits[0]), float(limits[1])),
    )


def _mount(vehicle_from_sensor: Sequence[float], where: str) -> Float[Tensor, "4 4"]:
    pose = rigid_pose(vehicle_from_sensor, f"{where}, extrinsic")
    away_m = float(pose[:3, 3].norm())
    if away_m > MAX_MOUNT_M:
        raise DataError(
            f"{where}, extrinsic: {away_m:.0f} m from the vehicle, expected {MAX_MOUNT_M:.0f} m "
            "at most"
        )
    return pose


def _require_lens(values: dict[str, float], size_px: tuple[int, int], where: str) -> None:
    low, high = (factor * max(size_px) for factor in _FOCAL_PER_SIDE)
    if not all(low <= values[key] <= high for key in ("fx_px", "fy_px")):
        raise DataError(
            f"{where}: focal lengths {values['fx_px']:g} and {values['fy_px']:g} px, expected "
            f"{low:g} to {high:g} px"
        )
    if not all(abs(values[key]) <= 2 * max(size_px) for key in ("cx_px", "cy_px")):
        raise DataError(f"{where}: the principal point is far outside of the image")


def _require_undistortable(lens: Camera, distortion: Distortion, where: str) -> None:
    """Refuse a lens that OpenCV cannot undo, before anything is stored that needs it."""
    try:
        pinhole = pinhole_of(lens, distortion)
        values = {key: getattr(pinhole, key) for key in ("fx_px", "fy_px", "cx_px", "cy_px")}
        if not np.isfinite(list(values.values())).all():
            raise DataError("the pinhole is not finite")
        _require_lens(values, (lens.width_px, lens.height_px), where)
    except (LidarPainterError, cv2.error):
        raise DataError(f"{where}: the distortion of the lens cannot be undone") from None
