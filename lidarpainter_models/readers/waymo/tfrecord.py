"""The Waymo Open Dataset as first released: one TFRecord file of `Frame` messages per segment.

A segment is read twice: once for times, poses and labels (an actor counts as moving by all of its
boxes), once frame by frame for the sensors. What every frame repeats about the segment, its name
and calibrations, is taken from the first frame chosen, and the others must name the same segment.
"""

import hashlib
import stat
import struct
from pathlib import Path
from typing import Any

import google_crc32c

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
from lidarpainter_models.readers.waymo.messages import parse_message
from lidarpainter_models.readers.waymo.range_images import unpack_matrix

MAX_RECORD_BYTES = 64 << 20
"""A frame of five cameras and five LiDARs takes 4 to 10 MB."""
MAX_RECORDS = 10_000
"""A segment of 20 s has 200."""
_LENGTH = struct.Struct("<Q")
_CHECKSUM = struct.Struct("<I")
_HEADER_BYTES = _LENGTH.size + _CHECKSUM.size
_MASK_DELTA = 0xA282EAD8
_WORD = 0xFFFFFFFF


class TfrecordFile:
    """The records of one file, read one at a time."""

    def __init__(self, path: Path) -> None:
        """Walk over the lengths of the records; their contents are not read yet.

        Raises:
            DataError: the file is missing, empty, cut off, or a length is not what was written.
        """
        self.path = Path(path)
        self._digest = hashlib.sha256()
        try:
            self._records = self._index()
        except OSError as error:
            raise DataError(f"{self.path}: cannot be read ({error.strerror})") from None
        if not self._records:
            raise DataError(f"{self.path}: zero records, expected at least one")

    @property
    def num_records(self) -> int:
        """How many records there are."""
        return len(self._records)

    def place(self, index: int) -> str:
        """The place to name in errors: file, record and byte."""
        return f"{self.path}, record {index} at byte {self._records[index][0] - _HEADER_BYTES}"

    def read(self, index: int) -> bytes:
        """The content of one record.

        Raises:
            DataError: the content is not what was written.
        """
        offset, num_bytes = self._records[index]
        try:
            with self.path.open("rb") as file:
                file.seek(offset)
                content = file.read(num_bytes)
                checksum = file.read(_CHECKSUM.size)
        except OSError as error:
            raise DataError(f"{self.path}: cannot be read ({error.strerror})") from None
        if len(content) != num_bytes or not _matches(content, checksum):
            raise DataError(
                f"{self.place(index)}: the checksum of its {num_bytes} bytes differs, "
                "expected what was written"
            )
        self._digest.update(content)
        return content

    def provenance(self) -> dict[str, object]:
        """The file, and one digest over the records in the order they were read."""
        return {
            "file": self.path.name,
            "num_records": self.num_records,
            "sha256": self._digest.hexdigest(),
        }

    def _index(self) -> list[tuple[int, int]]:
        """Where the content of each record lies, and its length."""
        records: list[tuple[int, int]] = []
        status = self.path.stat()
        if not stat.S_ISREG(status.st_mode):
            raise DataError(f"{self.path}: not a file")
        size = status.st_size
        position = 0
        with self.path.open("rb") as file:
            while position < size:
                where = f"{self.path}, record {len(records)} at byte {position}"
                if len(records) == MAX_RECORDS:
                    raise DataError(f"{where}: one record too many, expected {MAX_RECORDS} at most")
                file.seek(position)
                num_bytes = _length(file.read(_HEADER_BYTES), where)
                offset = position + _HEADER_BYTES
                position = offset + num_bytes + _CHECKSUM.size
                if position > size:
                    raise DataError(
                        f"{where}: states {num_bytes} bytes, the file ends after "
                        f"{max(size - offset, 0)}"
                    )
                records.append((offset, num_bytes))
        return records


def masked_checksum(content: bytes) -> int:
    """The CRC-32C of some bytes as TFRecord stores it: turned by 15 bits, plus a constant."""
    checksum = google_crc32c.value(content)
    return (((checksum >> 15) | (checksum << 17)) + _MASK_DELTA) & _WORD


def _matches(content: bytes, checksum: bytes) -> bool:
    return checksum == _CHECKSUM.pack(masked_checksum(content))


def _length(header: bytes, where: str) -> int:
    if len(header) < _HEADER_BYTES:
        raise DataError(f"{where}: the file ends inside the length of a record")
    length, checksum = header[: _LENGTH.size], header[_LENGTH.size :]
    if not _matches(length, checksum):
        raise DataError(f"{where}: the checksum of the length differs, expected a TFRecord file")
    (num_bytes,) = _LENGTH.unpack(length)
    if num_bytes > MAX_RECORD_BYTES:
        raise DataError(f"{where}: states {num_bytes} bytes, expected {MAX_RECORD_BYTES} at most")
    return num_bytes


_ECHOES = ("ri_return1", "ri_return2")
_VELOCITY = ("v_x", "v_y", "v_z", "w_x", "w_y", "w_z")
_TIMES = ("pose_timestamp", "shutter", "camera_trigger_time", "camera_readout_done_time")
_BOX = ("center_x", "center_y", "center_z", "length", "width", "height", "heading")


class WaymoRecordSegment:
    """One segment of version 1."""

    def __init__(self, path: Path) -> None:
        self._file = TfrecordFile(path)
        self.place = str(path)
        self._context: bytes | None = None
        self._name = b""
        self.cameras: dict[str, CameraCalibration] = {}
        self.lidars: dict[str, LidarCalibration] = {}

    @property
    def num_frames(self) -> int:
        """How many frames there are."""
        return self._file.num_records

    def provenance(self) -> dict[str, object]:
        """What was read, with a digest."""
        return {"release": "v1", **self._file.provenance()}

    def read_frame(self, index: int) -> WaymoFrame:
        """Time, pose and labels of one frame.

        Raises:
            DataError: the frame is damaged, senseless, or of another segment.
        """
        place = self._file.place(index)
        frame = parse_message("Frame", self._file.read(index), place)
        self._require_same_segment(frame.context, place)
        if len(frame.laser_labels) > MAX_LABELS:
            raise DataError(f"{place}: {len(frame.laser_labels)} labels, expected {MAX_LABELS}")
        labels = tuple(
            _label(content, f"{place}, laser_labels[{position}]")
            for position, content in enumerate(frame.laser_labels)
        )
        return checked_frame(frame.timestamp_micros, frame.pose.transform, labels, place)

    def read_sensors(self, index: int) -> tuple[list[WaymoImage], list[WaymoSweep]]:
        """Images and range images of one frame.

        Raises:
            DataError: something of it is damaged, senseless, or no known sensor's.
        """
        place = self._file.place(index)
        frame = parse_message("Frame", self._file.read(index), place)
        _require_few(frame.images, CAMERA_NAMES, f"{place}, images")
        _require_few(frame.lasers, LIDAR_NAMES, f"{place}, lasers")
        images = [
            _image(content, f"{place}, images[{position}]")
            for position, content in enumerate(frame.images)
        ]
        sweeps = (
            _sweep(content, f"{place}, lasers[{position}]")
            for position, content in enumerate(frame.lasers)
            if content  # derived files keep the place of a LiDAR that they have emptied
        )
        return images, [sweep for sweep in sweeps if sweep.returns]

    def _require_same_segment(self, content: bytes, place: str) -> None:
        """Take the calibrations from the first frame; later ones repeat them byte for byte."""
        if content == self._context:
            return
        place = f"{place}, context"
        context = parse_message("Context", content, place)
        if self._context is not None:
            if context.name != self._name:
                raise DataError(
                    f"{place}: segment {context.name!r}, expected {self._name!r} as in the frames "
                    "before"
                )
            return
        _require_few(context.camera_calibrations, CAMERA_NAMES, f"{place}, camera_calibrations")
        _require_few(context.laser_calibrations, LIDAR_NAMES, f"{place}, laser_calibrations")
        for position, part in enumerate(context.camera_calibrations):
            camera = _camera(part, f"{place}, camera_calibrations[{position}]")
            self.cameras[camera.name] = camera
        for position, part in enumerate(context.laser_calibrations):
            lidar = _lidar(part, f"{place}, laser_calibrations[{position}]")
            self.lidars[lidar.name] = lidar
        self._context, self._name = content, context.name


def _require_few(parts: Any, names: dict[int, str], where: str) -> None:  # noqa: ANN401
    if len(parts) > len(names):
        raise DataError(f"{where}: {len(parts)} entries, expected {len(names)} at most")


def _camera(content: bytes, where: str) -> CameraCalibration:
    message = parse_message("CameraCalibration", content, where)
    name = sensor_name(message.name, CAMERA_NAMES, where)
    return camera_calibration(
        name,
        message.intrinsic,
        message.extrinsic.transform,
        (message.width, message.height),
        message.rolling_shutter_direction,
        f"{where} ({name})",
    )


def _lidar(content: bytes, where: str) -> LidarCalibration:
    message = parse_message("LaserCalibration", content, where)
    name = sensor_name(message.name, LIDAR_NAMES, where)
    return lidar_calibration(
        name,
        message.extrinsic.transform,
        message.beam_inclinations,
        (message.beam_inclination_min, message.beam_inclination_max),
        f"{where} ({name})",
    )


def _image(content: bytes, where: str) -> WaymoImage:
    message = parse_message("CameraImage", content, where)
    name = sensor_name(message.name, CAMERA_NAMES, where)
    return checked_image(
        name,
        message.image,
        message.pose.transform,
        [getattr(message.velocity, field) for field in _VELOCITY],
        [getattr(message, field) for field in _TIMES],
        f"{where} ({name})",
    )


def _sweep(content: bytes, where: str) -> WaymoSweep:
    """The range images of a LiDAR; echoes that are not there are left out."""
    message = parse_message("Laser", content, where)
    name = sensor_name(message.name, LIDAR_NAMES, where)
    where = f"{where} ({name})"
    packed = {name: getattr(message, name).range_image_compressed for name in _ECHOES}
    returns = [
        unpack_matrix(content, RANGE_CHANNELS, f"{where}, {name}") if content else None
        for name, content in packed.items()
    ]
    poses = message.ri_return1.range_image_pose_compressed
    return WaymoSweep(
        lidar_name=name,
        returns=echoes_present(returns, where),
        pixel_poses=unpack_matrix(poses, POSE_CHANNELS, f"{where}, pixel poses") if poses else None,
        place=where,
    )


def _label(content: bytes, where: str) -> WaymoLabel:
    message = parse_message("Label", content, where)
    object_id = message.id.decode("utf-8", "replace")
    where = f"{where} ({object_id!r})"
    return WaymoLabel(
        actor_id=actor_name(object_id, where),
        category=category_name(message.type, where),
        box=checked_box([getattr(message.box, field) for field in _BOX], f"{where}, box"),
        speed_mps=checked_speed(
            message.metadata.speed_x, message.metadata.speed_y, f"{where}, metadata"
        ),
        synced=_synced_box(message, where),
    )


def _synced_box(message: Any, where: str) -> tuple[str, UprightBox] | None:  # noqa: ANN401
    """The camera-synced box, which counts only together with its camera."""
    if not (message.HasField("camera_synced_box") and message.most_visible_camera_name):
        return None
    where = f"{where}, camera_synced_box"
    name = message.most_visible_camera_name.decode("utf-8", "replace")
    numbers = [getattr(message.camera_synced_box, field) for field in _BOX]
    return sensor_name(name, CAMERA_NAMES, where), checked_box(numbers, where)
