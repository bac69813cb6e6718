"""The Waymo Open Dataset as Parquet: one folder per component, one file per segment in each.

Components are joined by the columns `key.frame_timestamp_micros`, `key.camera_name`,
`key.laser_name` and `key.laser_object_id`. Needed are `vehicle_pose`, `camera_calibration`,
`camera_image`, `lidar_calibration`, `lidar` and `lidar_pose`; `lidar_box` and
`lidar_camera_synced_box` hold the labels (a folder that is not there, as in the testing split,
means no labels; a file that is not in its folder is refused). Images and range images are
streamed: their files are in the order of time, row groups are never whole in memory.
"""

from collections import defaultdict
from pathlib import Path

import numpy as np

from lidarpainter_models.errors import DataError
from lidarpainter_models.readers.waymo.calibration import (
    CAMERA_NAMES,
    LIDAR_NAMES,
    CameraCalibration,
    LidarCalibration,
    camera_calibration,
    lidar_calibration,
    sensor_name,
)
from lidarpainter_models.readers.waymo.log import (
    MAX_LABELS,
    POSE_CHANNELS,
    RANGE_CHANNELS,
    UprightBox,
    WaymoFrame,
    WaymoImage,
    WaymoLabel,
    WaymoSweep,
    actor_name,
    category_name,
    checked_box,
    checked_frame,
    checked_image,
    checked_speed,
    echoes_present,
)
from lidarpainter_models.readers.waymo.parquet_rows import FrameStream, ParquetRow, ParquetRows
from lidarpainter_models.readers.waymo.range_images import shaped_matrix

SEGMENT, TIME = "key.segment_context_name", "key.frame_timestamp_micros"
CAMERA, LIDAR, OBJECT = "key.camera_name", "key.laser_name", "key.laser_object_id"
_POSE = "[VehiclePoseComponent].world_from_vehicle.transform"
_LENS = tuple(
    f"[CameraCalibrationComponent].intrinsic.{name}"
    for name in ("f_u", "f_v", "c_u", "c_v", "k1", "k2", "p1", "p2", "k3")
)
_CAMERA_MOUNT = "[CameraCalibrationComponent].extrinsic.transform"
_CAMERA_SIZE = ("[CameraCalibrationComponent].width", "[CameraCalibrationComponent].height")
_READOUT = "[CameraCalibrationComponent].rolling_shutter_direction"
_LIDAR_MOUNT = "[LiDARCalibrationComponent].extrinsic.transform"
_BEAM_LIMITS = tuple(
    f"[LiDARCalibrationComponent].beam_inclination.{end}" for end in ("min", "max")
)
_BEAMS = "[LiDARCalibrationComponent].beam_inclination.values"
_JPEG = "[CameraImageComponent].image"
_IMAGE_POSE = "[CameraImageComponent].pose.transform"
_VELOCITY = tuple(
    f"[CameraImageComponent].velocity.{kind}_velocity.{axis}"
    for kind in ("linear", "angular")
    for axis in "xyz"
)
_TIMES = (
    "[CameraImageComponent].pose_timestamp",
    *(
        f"[CameraImageComponent].rolling_shutter_params.{name}"
        for name in ("shutter", "camera_trigger_time", "camera_readout_done_time")
    ),
)
_ECHOES = tuple(f"[LiDARComponent].range_image_return{number}" for number in (1, 2))
_PIXEL_POSES = "[LiDARPoseComponent].range_image_return1"
_BOX_NUMBERS = ("center.x", "center.y", "center.z", "size.x", "size.y", "size.z", "heading")
_BOX = tuple(f"[LiDARBoxComponent].box.{name}" for name in _BOX_NUMBERS)
_TYPE = "[LiDARBoxComponent].type"
_SPEED = ("[LiDARBoxComponent].speed.x", "[LiDARBoxComponent].speed.y")
_SYNCED_CAMERA = "[LiDARCameraSyncedBoxComponent].most_visible_camera_name"
_SYNCED_BOX = tuple(
    f"[LiDARCameraSyncedBoxComponent].camera_synced_box.{name}" for name in _BOX_NUMBERS
)


class WaymoParquetSegment:
    """One segment of version 2."""

    def __init__(self, folder: Path, segment: str) -> None:
        self.place = str(folder)
        self._folder, self._segment = folder, segment
        self._files: dict[str, ParquetRows] = {}
        self.cameras = self._read_cameras()
        self.lidars = self._read_lidars()
        self._poses = self._read_poses()
        self._times_us = sorted(self._poses)
        self._labels = self._read_labels()
        self._images = self._stream(
            "camera_image", (CAMERA, _JPEG, _IMAGE_POSE, *_VELOCITY, *_TIMES)
        )
        echoes = tuple(f"{echo}.{part}" for echo in _ECHOES for part in ("values", "shape"))
        self._sweeps = self._stream("lidar", (LIDAR, *echoes))
        self._pixel_poses = self._stream(
            "lidar_pose", (LIDAR, f"{_PIXEL_POSES}.values", f"{_PIXEL_POSES}.shape")
        )

    @property
    def num_frames(self) -> int:
        """How many frames there are."""
        return len(self._times_us)

    def provenance(self) -> dict[str, object]:
        """What was read, with a digest of each streamed component."""
        return {
            "release": "v2",
            "components": {name: rows.provenance() for name, rows in self._files.items()},
        }

    def read_frame(self, index: int) -> WaymoFrame:
        """Time, pose and labels of one frame.

        Raises:
            DataError: the time or the pose makes no sense.
        """
        time_us = self._times_us[index]
        row = self._poses[time_us]
        labels = tuple(self._labels.get(time_us, ()))
        if len(labels) > MAX_LABELS:
            raise DataError(f"{row.place}: {len(labels)} labels, expected {MAX_LABELS} at most")
        return checked_frame(time_us, row.numbers(_POSE).tolist(), labels, row.place)

    def read_sensors(self, index: int) -> tuple[list[WaymoImage], list[WaymoSweep]]:
        """Images and range images of one frame; frames are asked for in ascending order.

        Raises:
            DataError: something of it is damaged, senseless, or no known sensor's.
        """
        time_us = self._times_us[index]
        poses = {
            _lidar_name(row): self._matrix("lidar_pose", row, _PIXEL_POSES, POSE_CHANNELS)
            for row in self._pixel_poses.rows_at(time_us)
        }
        images = [self._image(row) for row in self._images.rows_at(time_us)]
        sweeps = (self._sweep(row, poses) for row in self._sweeps.rows_at(time_us))
        return images, [sweep for sweep in sweeps if sweep.returns]

    def _open(
        self, component: str, columns: tuple[str, ...], optional: tuple[str, ...] = ()
    ) -> ParquetRows:
        path = self._folder / component / f"{self._segment}.parquet"
        self._files[component] = ParquetRows(path, (SEGMENT, *columns), optional)
        return self._files[component]

    def _table(
        self, component: str, columns: tuple[str, ...], optional: tuple[str, ...] = ()
    ) -> list[ParquetRow]:
        rows = self._open(component, columns, optional).small_table()
        for row in rows:
            self._require_segment(row)
        return rows

    def _stream(self, component: str, columns: tuple[str, ...]) -> FrameStream:
        return FrameStream(self._open(component, (TIME, *columns)), TIME)

    def _require_segment(self, row: ParquetRow) -> None:
        name = row.text(SEGMENT)
        if name != self._segment:
            raise DataError(f"{row.place}, {SEGMENT}: {name!r}, expected {self._segment!r}")

    def _read_cameras(self) -> dict[str, CameraCalibration]:
        columns = (CAMERA, *_LENS, _CAMERA_MOUNT, *_CAMERA_SIZE, _READOUT)
        cameras = {}
        for row in self._table("camera_calibration", columns):
            name = _camera_name(row)
            width_px, height_px = (row.whole_number(column) for column in _CAMERA_SIZE)
            cameras[name] = camera_calibration(
                name,
                [row.number(column) for column in _LENS],
                row.numbers(_CAMERA_MOUNT).tolist(),
                (width_px, height_px),
                row.whole_number(_READOUT),
                f"{row.place} ({name})",
            )
        return cameras

    def _read_lidars(self) -> dict[str, LidarCalibration]:
        lidars = {}
        for row in self._table("lidar_calibration", (LIDAR, _LIDAR_MOUNT, *_BEAM_LIMITS, _BEAMS)):
            name = _lidar_name(row)
            low_rad, high_rad = (row.number(column) for column in _BEAM_LIMITS)
            lidars[name] = lidar_calibration(
                name,
                row.numbers(_LIDAR_MOUNT).tolist(),
                row.numbers(_BEAMS).tolist(),
                (low_rad, high_rad),
                f"{row.place} ({name})",
            )
        return lidars

    def _read_poses(self) -> dict[int, ParquetRow]:
        poses: dict[int, ParquetRow] = {}
        for row in self._table("vehicle_pose", (TIME, _POSE)):
            time_us = row.whole_number(TIME)
            if time_us in poses:
                raise DataError(f"{row.place}, {TIME}: {time_us} stands twice, expected once")
            poses[time_us] = row
        return poses

    def _read_labels(self) -> dict[int, list[WaymoLabel]]:
        """The labels of each frame; those without a camera-synced box have their LiDAR box."""
        if not (self._folder / "lidar_box").is_dir():
            return {}
        synced = self._read_synced_boxes()
        labels = defaultdict(list)
        for row in self._table("lidar_box", (TIME, OBJECT, *_BOX, _TYPE), _SPEED):
            key = row.whole_number(TIME), row.text(OBJECT)
            where = f"{row.place} ({key[1]!r})"
            labels[key[0]].append(
                WaymoLabel(
                    actor_id=actor_name(key[1], where),
                    category=category_name(row.whole_number(_TYPE), where),
                    box=checked_box([row.number(column) for column in _BOX], where),
                    speed_mps=_speed(row),
                    synced=synced.get(key),
                )
            )
        return labels

    def _read_synced_boxes(self) -> dict[tuple[int, str], tuple[str, UprightBox]]:
        """By frame and actor."""
        if not (self._folder / "lidar_camera_synced_box").is_dir():
            return {}
        rows = self._table("lidar_camera_synced_box", (TIME, OBJECT, _SYNCED_CAMERA, *_SYNCED_BOX))
        return {
            (row.whole_number(TIME), row.text(OBJECT)): (
                _camera_name(row, _SYNCED_CAMERA),
                checked_box([row.number(column) for column in _SYNCED_BOX], row.place),
            )
            for row in rows
        }

    def _image(self, row: ParquetRow) -> WaymoImage:
        self._require_segment(row)
        name = _camera_name(row)
        jpeg = row.content(_JPEG)
        self._files["camera_image"].take_digest(jpeg)
        return checked_image(
            name,
            jpeg,
            row.numbers(_IMAGE_POSE).tolist(),
            [row.number(column) for column in _VELOCITY],
            [row.number(column) for column in _TIMES],
            f"{row.place} ({name})",
        )

    def _sweep(self, row: ParquetRow, poses: dict[str, np.ndarray]) -> WaymoSweep:
        self._require_segment(row)
        name = _lidar_name(row)
        place = f"{row.place} ({name})"
        images = (self._matrix("lidar", row, echo, RANGE_CHANNELS) for echo in _ECHOES)
        returns = [image if image.size else None for image in images]
        return WaymoSweep(
            lidar_name=name,
            returns=echoes_present(returns, place),
            pixel_poses=poses.get(name),
            place=place,
        )

    def _matrix(self, component: str, row: ParquetRow, column: str, channels: int) -> np.ndarray:
        """The range image of a row; empty where there is none."""
        values = np.ascontiguousarray(row.numbers(f"{column}.values"), dtype=np.float32)
        if values.size == 0:
            return np.empty((0, 0, channels), dtype=np.float32)
        self._files[component].take_digest(values.data)
        where = f"{row.place}, {column}"
        return shaped_matrix(values, row.numbers(f"{column}.shape").tolist(), channels, where)


def _camera_name(row: ParquetRow, column: str = CAMERA) -> str:
    """Of a camera that is given by its number, or its name where the file spells it out."""
    return sensor_name(_sensor(row, column), CAMERA_NAMES, row.place)


def _lidar_name(row: ParquetRow) -> str:
    return sensor_name(_sensor(row, LIDAR), LIDAR_NAMES, row.place)


def _sensor(row: ParquetRow, column: str) -> int | str:
    value = row.values[column]
    return row.text(column) if isinstance(value, str) else row.whole_number(column)


def _speed(row: ParquetRow) -> float:
    """Level speed of a label, 0 where it is not stated."""
    if any(row.values[column] is None for column in _SPEED):
        return 0.0
    x_mps, y_mps = (row.number(column) for column in _SPEED)
    return checked_speed(x_mps, y_mps, row.place)
