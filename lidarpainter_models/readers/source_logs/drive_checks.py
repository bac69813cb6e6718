"""Refuse what no car with cameras and LiDARs records, while its log is written.

A single wrong number (a time, a pose, a lens) would spoil a reconstruction without any other sign.
The limits of motion and time are those by which the doctor fails a scene. Where the doctor judges
by statistics (sweeps a little apart, boxes beside their points, cameras a degree off), the log is
taken and the doctor tells: real drives come close to such limits, none comes close to these.
"""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.checks.actors import NEAR_M
from lidarpainter_models.checks.doctor import MAX_CAMERA_LAG_S, MAX_SPEED_MPS, MAX_TURN_RADPS
from lidarpainter_models.checks.sweep_agreement import nearest_gap_m, points_near
from lidarpainter_models.checks.sweeps import LidarReach, could_any_hit
from lidarpainter_models.checks.verdicts import sampled_positions
from lidarpainter_models.errors import DataError
from lidarpainter_models.geometry.transforms import turn_rad
from lidarpainter_models.readers.source_logs.drive_poses import NS_PER_S
from lidarpainter_models.scenes.frame_content import FrameContent, SourceImage, SourceSweep

MAX_MOUNT_M = 20.0
"""A sensor is on the car, which drives 9 m at most between the poses of both."""
MAX_REACH_M = 1000.0
"""Of a LiDAR; those of PandaSet reach 310 m."""
MAX_GAP_M = 1.0
"""Between consecutive sweeps near the car; PandaSet's lie 0.04 m apart, points of chance metres."""
MIN_BOXES = 5
"""Of moving actors near the car, before none of them holding a point tells anything."""
_POINT_STRIDE = 3


class DriveChecks:
    """What has been seen of one log; told every frame in order."""

    def __init__(self, num_frames: int) -> None:
        self._compared = {position + 1 for position in sampled_positions(num_frames - 1)}
        self._position = 0
        self._last: FrameContent | None = None
        self._last_exposure_ns: dict[str, int] = {}
        self._unseeing: dict[str, str] = {}
        self._seeing: set[str] = set()
        self._num_boxes = self._num_held = 0

    def require_frame(self, content: FrameContent) -> None:
        """Refuse a frame that does not follow from the one before or hold together.

        Raises:
            DataError: with the file of the image or sweep, or the frame.
        """
        if self._last is not None:
            require_motion(
                (self._last.timestamp_ns, self._last.world_from_ego),
                (content.timestamp_ns, content.world_from_ego),
                content.place,
            )
        for sweep in content.sweeps:
            _require_reach(sweep, content.world_from_ego)
        for image in content.images:
            self._require_image(image, content)
        if self._last is not None and self._position in self._compared:
            _require_agreement(self._last, content)
        self._count_boxes(content)
        self._last, self._position = content, self._position + 1

    def require_all_cameras(self) -> None:
        """Refuse a log with a camera in whose images no LiDAR point ever falls.

        Raises:
            DataError: with the file of its first image.
        """
        for name, source in self._unseeing.items():
            raise DataError(
                f"{source}: no LiDAR point falls into any image of {name}, expected its pose "
                "and lens to show what the LiDARs see"
            )

    def require_points_in_boxes(self) -> None:
        """Refuse a log whose moving actors are never where the LiDARs see anything.

        Raises:
            DataError: without a place; one wrong pose or mount spoils them all.
        """
        if self._num_boxes >= MIN_BOXES and self._num_held == 0:
            raise DataError(
                f"none of {self._num_boxes} boxes of moving actors within {NEAR_M:.0f} m that a "
                "LiDAR could hit holds a point, expected the poses of LiDARs and boxes to agree"
            )

    def _count_boxes(self, content: FrameContent) -> None:
        """Count boxes that a LiDAR could hit, until one that holds a point settles the matter."""
        if self._num_held:
            return
        near = [
            box
            for box in content.boxes
            if box.is_moving
            and float((box.world_from_box - content.world_from_ego)[:3, 3].norm()) < NEAR_M
        ]
        self._num_held = sum(box.num_points > 0 for box in near)
        if near and not self._num_held:
            reaches = [
                LidarReach.of(sweep.points.xyz_m, sweep.world_from_lidar)
                for sweep in content.sweeps
                if sweep.points.num_points
            ]
            self._num_boxes += sum(
                could_any_hit(reaches, box.world_from_box, torch.tensor(box.size_m)) for box in near
            )

    def _require_image(self, image: SourceImage, content: FrameContent) -> None:
        name, exposure_ns = image.record.camera_name, image.record.timestamp_ns
        _require_mount(image.record.camera.world_from_camera, content.world_from_ego, image.source)
        if exposure_ns <= self._last_exposure_ns.get(name, exposure_ns - 1):
            raise DataError(
                f"{image.source}: taken at {exposure_ns / NS_PER_S:.6f} s, expected after the "
                "camera's last one"
            )
        self._last_exposure_ns[name] = exposure_ns
        if content.sweeps:
            require_timely(exposure_ns, content.sweeps[0].timestamp_ns, image.source)
        if name not in self._seeing:
            if any(_is_seen(sweep, image) for sweep in content.sweeps):
                self._seeing.add(name)
                self._unseeing.pop(name, None)
            else:
                self._unseeing.setdefault(name, image.source)


def apart(first: Float[Tensor, "4 4"], second: Float[Tensor, "4 4"]) -> tuple[float, float]:
    """Distance of the origins in metres, and the angle between the axes in radians."""
    return float((first[:3, 3] - second[:3, 3]).norm()), float(turn_rad(first, second))


def require_motion(
    before: tuple[int, Float[Tensor, "4 4"]], after: tuple[int, Float[Tensor, "4 4"]], where: str
) -> None:
    """Refuse two poses of the car, each with its time in ns, between which none could drive."""
    step_s = (after[0] - before[0]) / NS_PER_S
    apart_m, apart_rad = apart(before[1], after[1])
    if step_s > 0 and (apart_m > MAX_SPEED_MPS * step_s or apart_rad > MAX_TURN_RADPS * step_s):
        raise DataError(
            f"{where}, pose: the vehicle has moved {apart_m:.1f} m and turned "
            f"{apart_rad:.2f} rad in {step_s:.3f} s, expected {MAX_SPEED_MPS:.0f} m/s and "
            f"{MAX_TURN_RADPS:.0f} rad/s at most"
        )


def require_timely(exposure_ns: int, sweep_ns: int, where: str) -> None:
    """Refuse an image that was not taken while its frame's LiDAR turned."""
    lag_s = (exposure_ns - sweep_ns) / NS_PER_S
    if abs(lag_s) > MAX_CAMERA_LAG_S:
        raise DataError(
            f"{where}: taken {lag_s:+.3f} s after the middle of the sweep, expected "
            f"{MAX_CAMERA_LAG_S} s at most"
        )


def _require_mount(
    world_from_sensor: Float[Tensor, "4 4"], world_from_ego: Float[Tensor, "4 4"], where: str
) -> None:
    apart_m = float((world_from_sensor[:3, 3] - world_from_ego[:3, 3]).norm())
    if apart_m > MAX_MOUNT_M:
        raise DataError(
            f"{where}: the sensor is {apart_m:.1f} m from the car, expected {MAX_MOUNT_M:.0f} m "
            "at most"
        )


def _require_reach(sweep: SourceSweep, world_from_ego: Float[Tensor, "4 4"]) -> None:
    _require_mount(sweep.world_from_lidar, world_from_ego, sweep.source)
    away_m = sweep.points.xyz_m.numpy() - sweep.world_from_lidar[:3, 3].numpy().astype(np.float32)
    reach_m = float(np.sqrt(np.einsum("ij,ij->i", away_m, away_m).max(initial=0.0)))
    if reach_m > MAX_REACH_M:
        raise DataError(
            f"{sweep.source}: a point is {reach_m:.0f} m from its LiDAR, expected "
            f"{MAX_REACH_M:.0f} m at most"
        )


def _require_agreement(before: FrameContent, after: FrameContent) -> None:
    """Consecutive sweeps lie on each other near the car."""
    if not (before.sweeps and after.sweeps):
        return
    gap_m = nearest_gap_m(_near(before), _near(after))
    if gap_m is not None and gap_m > MAX_GAP_M:
        raise DataError(
            f"{after.sweeps[0].source}: the points lie {gap_m:.1f} m (median) from those of the "
            f"frame before, expected {MAX_GAP_M:g} m at most"
        )


def _near(content: FrameContent) -> np.ndarray:
    xyz_m = torch.cat([sweep.points.xyz_m for sweep in content.sweeps])
    return points_near(xyz_m, content.world_from_ego[:3, 3])


def _is_seen(sweep: SourceSweep, image: SourceImage) -> bool:
    camera = image.record.camera
    pixels_uv, depth_m = camera.project(sweep.points.xyz_m[::_POINT_STRIDE])
    return bool(camera.contains(pixels_uv, depth_m).any())
