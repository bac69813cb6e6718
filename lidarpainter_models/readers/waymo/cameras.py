"""Where a camera of the Waymo Open Dataset stood when its image was taken, and when that was.

The rows or columns of an image are read one after the other. The first is exposed in the middle
of its shutter time after the trigger, the last as long before the end of the readout, so the
middle of the exposure is half-way between trigger and end, and the readout takes what is left when
one shutter time is subtracted. An image comes with a pose of the vehicle from the nearest tick of
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
)
from lidarpainter_models.readers.source_logs.drive_poses import nanoseconds
from lidarpainter_models.readers.waymo.calibration import CameraCalibration
from lidarpainter_models.readers.waymo.log import WaymoImage
from lidarpainter_models.scenes.records import ImageRecord, RollingShutter

_NEAR_PLANE_M = 0.1
_SHARES = np.array([0.0, 0.5, 1.0])


def exposure_s(image: WaymoImage) -> float:
    """The middle of the exposure."""
    return (image.trigger_s + image.readout_done_s) / 2


def readout_s(image: WaymoImage) -> float:
    """From the middle of the first row's or column's exposure to that of the last."""
    return max(image.readout_done_s - image.trigger_s - image.shutter_s, 0.0)


def global_from_vehicle_at(image: WaymoImage, time_s: float) -> Float[Tensor, "4 4"]:
    """The vehicle's pose a little before or after that of an image, moving as it then did."""
    since_s = time_s - image.pose_time_s
    turn = rotation_from_vector(torch.from_numpy(image.turn_radps * since_s))
    pose = image.global_from_vehicle
    moved_m = torch.from_numpy(image.velocity_mps * since_s)
    return rigid_from_rotation(pose[:3, :3] @ turn, pose[:3, 3] + moved_m)


def image_record(
    image: WaymoImage, calibration: CameraCalibration, world_from_global: Float[Tensor, "4 4"]
) -> ImageRecord:
    """What the store keeps of an image beside its bytes."""
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


class ImageClock:
    """Tells when a camera read the row or column that shows a point.

    Where the point is in the image depends on when it is looked at, as the vehicle moves
    meanwhile: its place is taken at the beginning, middle and end of the readout and put between.
    The distortion of the lens moves a column by some pixels, which are some 0.1 ms: left out.
    """

    def __init__(self, image: WaymoImage, calibration: CameraCalibration) -> None:
        self._lens, self._readout = calibration.lens, calibration.readout
        self._begin_s = exposure_s(image) - readout_s(image) / 2
        self._duration_s = readout_s(image)
        self._camera_from_global = np.stack(
            [
                invert_rigid(
                    global_from_vehicle_at(image, self._begin_s + share * self._duration_s)
                    @ calibration.lens.world_from_camera
                ).numpy()
                for share in _SHARES
            ]
        )

    def time_of(self, point_global_m: np.ndarray) -> float | None:
        """When the point was read; beside the image its edge's time, None behind the camera."""
        rotation = self._camera_from_global[:, :3, :3]
        x_m, y_m, z_m = (rotation @ point_global_m + self._camera_from_global[:, :3, 3]).T
        if z_m.min() < _NEAR_PLANE_M:
            return None
        share = self._share_read(x_m / z_m, y_m / z_m)
        # where the share of the image that has been read is the one that shows the point
        found = float(np.interp(0.0, _SHARES - share, _SHARES))
        return self._begin_s + found * self._duration_s

    def _share_read(self, across: np.ndarray, down: np.ndarray) -> np.ndarray:
        """How much of the image has been read when a direction (x/z, y/z) comes, 0 to 1."""
        lens = self._lens
        column = np.clip((across * lens.fx_px + lens.cx_px) / lens.width_px, 0.0, 1.0)
        row = np.clip((down * lens.fy_px + lens.cy_px) / lens.height_px, 0.0, 1.0)
        shares = {"right": column, "left": 1 - column, "down": row, "up": 1 - row}
        return shares.get(self._readout or "", np.full_like(column, 0.5))
