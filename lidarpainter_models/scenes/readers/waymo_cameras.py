"""Where a camera of the Waymo Open Dataset stood when its picture was taken, and when that was.

The rows or columns of a picture are read one after the other. The first is exposed in the middle
of its shutter time after the trigger, the last as long before the end of the readout, so the
middle of the exposure is half-way between trigger and end, and the readout takes what is left when
one shutter time is subtracted. A picture comes with a pose of the vehicle from the nearest tick of
a 100 Hz clock, up to 5 ms away, and with the vehicle's velocity: the pose is carried to the middle
of the exposure. The velocity is in the global frame; the turn is in the vehicle's own, as the
dataset's camera model takes it (its message description says global; as the car is nearly level
the two agree to 0.001 degrees over 5 ms).
"""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.geometry.transforms import (
    invert_rigid,
    rigid_from_rotation,
    rotation_from_vector,
    transform_points,
)
from lidarpainter_models.scenes.readers.pandaset_calibration import nanoseconds
from lidarpainter_models.scenes.readers.waymo_calibration import CameraCalibration
from lidarpainter_models.scenes.readers.waymo_log import WaymoImage
from lidarpainter_models.scenes.records import ImageRecord, RollingShutter

_NEAR_PLANE_M = 0.1
_CAPTURE_STEPS = 4
"""Each step shrinks the error by the picture's motion per readout: 0.1 us are left."""


def exposure_s(image: WaymoImage) -> float:
    """The middle of the exposure."""
    return (image.trigger_s + image.readout_done_s) / 2


def readout_s(image: WaymoImage) -> float:
    """From the middle of the first row's or column's exposure to that of the last."""
    return max(image.readout_done_s - image.trigger_s - image.shutter_s, 0.0)


def global_from_vehicle_at(image: WaymoImage, time_s: float) -> Float[Tensor, "4 4"]:
    """The vehicle's pose a little before or after that of a picture, moving as it then did."""
    since_s = time_s - image.pose_time_s
    turn = rotation_from_vector(torch.from_numpy(image.turn_radps * since_s))
    pose = image.global_from_vehicle
    moved_m = torch.from_numpy(image.velocity_mps * since_s)
    return rigid_from_rotation(pose[:3, :3] @ turn, pose[:3, 3] + moved_m)


def image_record(
    image: WaymoImage, calibration: CameraCalibration, world_from_global: Float[Tensor, "4 4"]
) -> ImageRecord:
    """What the store keeps of a picture beside its bytes."""
    time_s = exposure_s(image)
    world_from_vehicle = world_from_global @ global_from_vehicle_at(image, time_s)
    lens = calibration.lens
    shutter = (
        RollingShutter(duration_s=readout_s(image), direction=calibration.readout)
        if calibration.readout
        else None
    )
    return ImageRecord(
        camera_name=image.camera_name,
        timestamp_ns=nanoseconds(time_s),
        camera=replace(lens, world_from_camera=world_from_vehicle @ lens.world_from_camera),
        distortion=calibration.distortion,
        rolling_shutter=shutter,
    )


def capture_s(
    image: WaymoImage, calibration: CameraCalibration, point_global_m: np.ndarray
) -> float | None:
    """When a camera read the row or column that shows a point; None if it is behind the camera.

    The distortion of the lens moves a column by some pixels, which are some 0.1 ms: left out.
    """
    time_s = exposure_s(image)
    point = torch.from_numpy(point_global_m)[None]
    for _ in range(_CAPTURE_STEPS):
        global_from_camera = (
            global_from_vehicle_at(image, time_s) @ calibration.lens.world_from_camera
        )
        x_m, y_m, z_m = transform_points(invert_rigid(global_from_camera), point)[0].tolist()
        if z_m < _NEAR_PLANE_M:
            return None
        time_s = exposure_s(image) + readout_s(image) * (
            _read_share(calibration, x_m / z_m, y_m / z_m) - 0.5
        )
    return time_s


def _read_share(calibration: CameraCalibration, across: float, down: float) -> float:
    """How much of the picture has been read when a direction (x/z, y/z) comes, 0 to 1."""
    lens = calibration.lens
    column = min(max((across * lens.fx_px + lens.cx_px) / lens.width_px, 0.0), 1.0)
    row = min(max((down * lens.fy_px + lens.cy_px) / lens.height_px, 0.0), 1.0)
    shares = {"right": column, "left": 1 - column, "down": row, "up": 1 - row}
    return shares.get(calibration.readout or "", 0.5)
