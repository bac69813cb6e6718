"""What the sensors of nuScenes recorded in one scene, and how it becomes frames.

The clock is the LiDAR: every sweep of LIDAR_TOP (20 Hz, key frames and those in between) is a
frame. The cameras take 12 images a second, each when the LiDAR looks where the camera looks. An
image of a key frame belongs to its key sweep, as the tables say; any other to the sweep that
looked along the camera's axis nearest to the exposure, if within half a turn. A sweep keeps at
most one image of each camera, that of the key frame or else the nearest; many sweeps have none.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.errors import DataError
from lidarpainter_models.geometry.transforms import invert_rigid
from lidarpainter_models.readers.nuscenes.dataset import NuscenesTables
from lidarpainter_models.readers.nuscenes.rows import TableRow
from lidarpainter_models.readers.nuscenes.sweeps import TURN_NS, turn_offset_ns

LIDAR_NAME = "LIDAR_TOP"
CAMERA_NAMES = (
    *("CAM_FRONT", "CAM_FRONT_LEFT", "CAM_FRONT_RIGHT"),
    *("CAM_BACK", "CAM_BACK_LEFT", "CAM_BACK_RIGHT"),
)


@dataclass(frozen=True, kw_only=True, eq=False)
class Calibration:
    """Where a sensor sits on the car, and through what lens it looks."""

    channel: str
    ego_from_sensor: Float[Tensor, "4 4"]
    intrinsics: dict[str, float]
    """fx_px, fy_px, cx_px, cy_px of a camera; empty for the LiDAR."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Recording:
    """One image or sweep: a row of `sample_data` with what it refers to."""

    where: str
    file: str
    timestamp_ns: int
    """Of an image its exposure, of a sweep its end."""
    sample_token: str
    is_key_frame: bool
    global_from_ego: Float[Tensor, "4 4"]
    """At the timestamp."""
    calibration: Calibration
    size_px: tuple[int, int]
    """Width and height of an image; zeros for a sweep."""

    @property
    def global_from_sensor(self) -> Float[Tensor, "4 4"]:
        """At the timestamp."""
        return self.global_from_ego @ self.calibration.ego_from_sensor


@dataclass(frozen=True, kw_only=True, eq=False)
class RecordedFrame:
    """One sweep and the images that belong to it, by camera."""

    sweep: Recording
    images: dict[str, Recording]


def read_recordings(
    tables: NuscenesTables, samples: list[str], channels: tuple[str, ...]
) -> dict[str, list[Recording]]:
    """Everything that some sensors recorded in a scene, by channel and time.

    Raises:
        DataError: a row lacks something, makes no sense, or refers to a row that is not there.
    """
    found: dict[str, list[Recording]] = {channel: [] for channel in channels}
    calibrations: dict[str, Calibration] = {}
    for sample in samples:
        for row in tables["sample_data"].rows_with(sample):
            token = row.text("calibrated_sensor_token")
            if token not in calibrations:
                calibrations[token] = _read_calibration(tables, token, row.where)
            if calibrations[token].channel in found:
                recording = _recording(tables, row, calibrations[token])
                found[recording.calibration.channel].append(recording)
    for channel, recordings in found.items():
        recordings.sort(key=lambda recording: recording.timestamp_ns)
        for first, second in pairwise(recordings):
            if first.timestamp_ns == second.timestamp_ns:
                raise DataError(f"{second.where}: {channel} has another row of the same time")
    return found


def form_frames(sweeps: list[Recording], images: dict[str, list[Recording]]) -> list[RecordedFrame]:
    """A frame for every sweep; the module says which images each gets."""
    key_sweeps: dict[str, int] = {}
    for index, sweep in enumerate(sweeps):
        if sweep.is_key_frame and key_sweeps.setdefault(sweep.sample_token, index) != index:
            raise DataError(f"{sweep.where}: the sample has another key frame of {LIDAR_NAME}")
    frames = [RecordedFrame(sweep=sweep, images={}) for sweep in sweeps]
    for channel, recorded in images.items():
        for index, image in _assigned(sweeps, key_sweeps, recorded).items():
            frames[index].images[channel] = image
    return frames


def _assigned(
    sweeps: list[Recording], key_sweeps: dict[str, int], images: list[Recording]
) -> dict[int, Recording]:
    """The image of one camera for each sweep that has one."""
    sweep_ns = np.array([sweep.timestamp_ns for sweep in sweeps])
    chosen: dict[int, tuple[bool, int, Recording]] = {}
    for image in images:
        looks_ns = sweep_ns + _looks_along_after_ns(sweeps[0].calibration, image.calibration)
        lag_ns = np.abs(looks_ns - image.timestamp_ns)
        is_key = image.is_key_frame and image.sample_token in key_sweeps
        index = key_sweeps[image.sample_token] if is_key else int(lag_ns.argmin())
        if is_key or lag_ns[index] <= TURN_NS // 2:
            rank = (not is_key, int(lag_ns[index]), image)
            if index not in chosen or rank[:2] < chosen[index][:2]:
                chosen[index] = rank
    return {index: image for index, (_, _, image) in chosen.items()}


def _looks_along_after_ns(lidar: Calibration, camera: Calibration) -> int:
    """When, relative to a sweep's time, the LiDAR looks where a camera looks."""
    lidar_from_camera = invert_rigid(lidar.ego_from_sensor) @ camera.ego_from_sensor
    axis = lidar_from_camera[:2, 2].numpy()
    return int(turn_offset_ns(axis[:1], axis[1:])[0])


def _read_calibration(tables: NuscenesTables, token: str, asked_by: str) -> Calibration:
    row = tables["calibrated_sensor"].row(token, asked_by)
    sensor = tables["sensor"].row(row.text("sensor_token"), row.where)
    channel = sensor.text("channel")
    return Calibration(
        channel=channel,
        ego_from_sensor=row.pose(),
        intrinsics=row.intrinsics() if channel in CAMERA_NAMES else {},
    )


def _recording(tables: NuscenesTables, row: TableRow, calibration: Calibration) -> Recording:
    is_image = bool(calibration.intrinsics)
    return Recording(
        where=row.where,
        file=row.file(),
        timestamp_ns=row.timestamp_ns(),
        sample_token=row.text("sample_token"),
        is_key_frame=row.flag("is_key_frame"),
        global_from_ego=tables["ego_pose"].row(row.text("ego_pose_token"), row.where).pose(),
        calibration=calibration,
        size_px=(row.count("width"), row.count("height")) if is_image else (0, 0),
    )
