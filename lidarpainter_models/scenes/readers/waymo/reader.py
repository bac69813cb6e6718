"""Read the Waymo Open Dataset (perception), version 1 and 2, without TensorFlow.

Version 1 is a TFRecord file per segment (`segment-<name>_with_camera_labels.tfrecord`), version 2 a
Parquet file per segment and component (`camera_image/<name>.parquet`, ...). Which one it is shows
by what lies at the root or up to two folders below it; a segment is called by its name in either.

Frames. A frame of the dataset is a frame of the scene: one turn of the TOP LiDAR (0.1 s), the
pictures taken meanwhile, the labels. Ego is the dataset's vehicle frame: x forward, y left, z up,
on the road below the rear axle. The frame's pose is the vehicle's in the middle of the turn; as
it is that of the FRONT picture, the time of that pose is the frame's time (elsewhere the middle of
the turn). The world has its origin at the first pose and its x along that heading, z is up.

A sweep has the time and the pose of its frame. The points of TOP have been measured each at its
own pose and time: columns go clockwise from straight behind, evenly over the turn, which begins at
the frame's timestamp. The points of the other LiDARs have been moved to the frame's pose by the
dataset, which does not say when they were measured: their time offsets are 0. The ring is the row
of the range image, the highest beam is 0. Points in no-label zones are kept.

A frame without a point or without a picture, and a TOP image without its pixel poses (some
derived files have none of these), is refused.
"""

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import torch

from lidarpainter_models.errors import ConfigError, DataError
from lidarpainter_models.geometry.transforms import invert_rigid, transform_points
from lidarpainter_models.scenes.readers.drive_poses import level_frame, nanoseconds
from lidarpainter_models.scenes.readers.selection import chosen_cameras, chosen_frames
from lidarpainter_models.scenes.readers.waymo.boxes import FramePoints, box_records, moving_ids
from lidarpainter_models.scenes.readers.waymo.calibration import CAMERA_NAMES, TOP
from lidarpainter_models.scenes.readers.waymo.cameras import exposure_s, image_record
from lidarpainter_models.scenes.readers.waymo.checks import (
    require_agreement,
    require_drive,
    require_timely,
)
from lidarpainter_models.scenes.readers.waymo.log import (
    MAX_LAG_S,
    WaymoFrame,
    WaymoImage,
    WaymoSegment,
    WaymoSweep,
)
from lidarpainter_models.scenes.readers.waymo.range_images import range_points
from lidarpainter_models.scenes.readers.waymo.v1 import WaymoRecordSegment
from lidarpainter_models.scenes.readers.waymo.v2 import WaymoParquetSegment
from lidarpainter_models.scenes.records import SweepPoints
from lidarpainter_models.scenes.validation import jpeg_header_size, require_name
from lidarpainter_models.scenes.writer import SceneHeader, SceneWriter

DATASET = "waymo"
LICENCE = "Waymo Open Dataset License Agreement for Non-Commercial Use (waymo.com/open/terms)"
Progress = Callable[[int, int], None]
"""Told frames done and frames in all."""

_RECORD_NAME = re.compile(r"(?:(?:[a-z]+_)?segment-)?(.+?)(?:_with_camera_labels)?")
_DEPTHS = ("", "*/", "*/*/")
_TURN_S = 0.1
_TURN_LIMITS_S = (0.05, 0.2)
_US_PER_S = 1_000_000
_NS_PER_S = 1_000_000_000
_SAME_POSE_M = 0.01


def list_waymo_segments(root: Path) -> tuple[str, ...]:
    """Names of the segments of either release at or below a root, sorted."""
    return tuple(sorted({name for name, _path in _segments(Path(root))}))


def read_waymo(
    root: Path,
    sequence: str,
    store: Path,
    *,
    frames: slice | None = None,
    cameras: tuple[str, ...] | None = None,
    progress: Progress | None = None,
) -> Path:
    """Write one segment into the store as a canonical scene; gives the scene's path.

    Args:
        root: the folder that holds the segments.
        sequence: a segment's name.
        store: where scenes live.
        frames: which frames to take, by position; all of them if None.
        cameras: which cameras to take, by name; all of them if None.
        progress: told after every frame.

    Raises:
        DataError: something in the segment is missing, damaged or makes no sense.
        StorageError: the store cannot be written.
    """
    require_name(sequence, "sequence")
    segment = _open_segment(Path(root), sequence)
    with _naming(segment.place):
        log = _WaymoLog(segment, frames, cameras)
        header = SceneHeader(licence=LICENCE, global_from_world=log.global_from_world)
        with SceneWriter(store, DATASET, sequence, header) as writer:
            for done, index in enumerate(log.frames, start=1):
                log.write_frame(writer, index)
                if progress is not None:
                    progress(done, len(log.frames))
            writer.set_provenance({"root": str(root), **segment.provenance()})
    return writer.path


class _WaymoLog:
    """One segment; poses and labels of all frames are in memory, sensors of one at a time."""

    def __init__(
        self, segment: WaymoSegment, frames: slice | None, cameras: tuple[str, ...] | None
    ) -> None:
        self.segment = segment
        chosen = chosen_frames(segment.num_frames, frames, segment.place)
        self.frames = {index: segment.read_frame(index) for index in chosen}
        self.cameras = chosen_cameras(cameras, CAMERA_NAMES.values(), segment.place)
        require_drive(list(self.frames.values()))
        self.turn_s = _turn_s(self.frames)
        self.global_from_world = level_frame(self.frames[chosen[0]].global_from_vehicle)
        self.world_from_global = invert_rigid(self.global_from_world)
        self.moving = moving_ids(list(self.frames.values()))
        self._last_exposure_s: dict[str, float] = {}

    def write_frame(self, writer: SceneWriter, index: int) -> None:
        """Everything of one frame."""
        frame = self.frames[index]
        with _naming(frame.place):
            sensors = self.segment.read_sensors(index)
            if not sensors.images:
                raise DataError("zero pictures, expected at least one")
            images = {image.camera_name: image for image in sensors.images}
            time_s = self._time_s(frame, images)
            writer.add_frame(
                index,
                timestamp_ns=nanoseconds(time_s),
                world_from_ego=self.world_from_global @ frame.global_from_vehicle,
            )
            for image in sensors.images:
                self._write_image(writer, frame, image, time_s)
            points = self._write_sweeps(writer, frame, sensors.sweeps, time_s)
            world_from_vehicle = self.world_from_global @ frame.global_from_vehicle
            for record in box_records(
                frame, points, images, self.segment.cameras, world_from_vehicle, self.moving
            ):
                writer.add_box(record)

    def _time_s(self, frame: WaymoFrame, images: dict[str, WaymoImage]) -> float:
        """When the frame's pose holds: with the FRONT picture, or in the middle of the turn."""
        middle_s = frame.start_us / _US_PER_S + self.turn_s / 2
        front = images.get(CAMERA_NAMES[1])
        if front is None or abs(front.pose_time_s - middle_s) > MAX_LAG_S:
            return middle_s
        apart_m = (front.global_from_vehicle - frame.global_from_vehicle)[:3, 3].norm()
        return front.pose_time_s if float(apart_m) <= _SAME_POSE_M else middle_s

    def _write_image(
        self, writer: SceneWriter, frame: WaymoFrame, image: WaymoImage, time_s: float
    ) -> None:
        if image.camera_name not in self.cameras:
            return
        calibration = self.segment.cameras.get(image.camera_name)
        if calibration is None:
            raise DataError(f"{image.place}: the camera has no calibration")
        require_timely(image, time_s, self._last_exposure_s.get(image.camera_name))
        self._last_exposure_s[image.camera_name] = exposure_s(image)
        require_agreement(image, frame, time_s)
        lens = calibration.lens
        stated_px = jpeg_header_size(image.jpeg, image.place)
        if stated_px != (lens.width_px, lens.height_px):
            raise DataError(
                f"{image.place}: the picture is {stated_px[0]} x {stated_px[1]} px, expected "
                f"{lens.width_px} x {lens.height_px} px as calibrated"
            )
        record = image_record(image, calibration, self.world_from_global)
        writer.add_image(record, image.jpeg, source=image.place)

    def _write_sweeps(
        self,
        writer: SceneWriter,
        frame: WaymoFrame,
        sweeps: tuple[WaymoSweep, ...],
        time_s: float,
    ) -> FramePoints:
        points = FramePoints(time_s, self._top_position_m())
        world_from_vehicle = self.world_from_global @ frame.global_from_vehicle
        num_points = 0
        for number, sweep in enumerate(sweeps):
            calibration = self.segment.lidars.get(sweep.lidar_name)
            if calibration is None:
                raise DataError(f"{sweep.place}: the LiDAR has no calibration")
            is_top = sweep.lidar_name == TOP
            if is_top and sweep.pixel_poses is None:
                raise DataError(f"{sweep.place}: the pixel poses are missing")
            found = range_points(sweep, calibration, frame.global_from_vehicle)
            if len(found.row) == 0:
                continue
            num_points += len(found.row)
            offset_s = np.zeros(len(found.row))
            if is_top:
                begins_s = frame.start_us / _US_PER_S - time_s
                offset_s = begins_s + (found.column + 0.5) / found.num_columns * self.turn_s
            points.add(found.xyz_vehicle_m, offset_s, is_top=is_top)
            xyz_world_m = transform_points(
                world_from_vehicle, torch.from_numpy(found.xyz_vehicle_m)
            )
            writer.add_sweep(
                sweep.lidar_name,
                SweepPoints(
                    xyz_m=xyz_world_m.to(torch.float32),
                    intensity=torch.from_numpy(found.intensity),
                    time_offset_ns=torch.from_numpy(np.rint(offset_s * _NS_PER_S).astype(np.int32)),
                    ring=torch.from_numpy(found.row.astype(np.int16)),
                    return_index=torch.from_numpy(found.return_index.astype(np.int8)),
                    lidar=torch.full((len(found.row),), number, dtype=torch.uint8),
                ),
                timestamp_ns=nanoseconds(time_s),
                world_from_lidar=world_from_vehicle @ calibration.vehicle_from_lidar,
            )
        if num_points == 0:
            raise DataError("no LiDAR has a point, expected range images")
        return points

    def _top_position_m(self) -> np.ndarray:
        top = self.segment.lidars.get(TOP)
        return np.zeros(3) if top is None else top.vehicle_from_lidar[:3, 3].numpy()


def _segments(root: Path) -> Iterator[tuple[str, Path]]:
    """Names of segments with their TFRecord file or their Parquet file of poses."""
    for depth in _DEPTHS:
        for path in root.glob(f"{depth}*.tfrecord"):
            match = _RECORD_NAME.fullmatch(path.stem)
            yield (match[1] if match else path.stem), path
        for path in root.glob(f"{depth}vehicle_pose/*.parquet"):
            yield path.stem, path


def _open_segment(root: Path, sequence: str) -> WaymoSegment:
    found = sorted(path for name, path in _segments(root) if name == sequence)
    if not found:
        raise DataError(f"{root}: no segment {sequence}, expected a TFRecord or Parquet file of it")
    if len(found) > 1:
        raise DataError(f"{found[0]}: segment {sequence} lies at {found[1]}, too; expected it once")
    if found[0].suffix == ".tfrecord":
        return WaymoRecordSegment(found[0])
    return WaymoParquetSegment(found[0].parent.parent, sequence)


def _turn_s(frames: dict[int, WaymoFrame]) -> float:
    """Time of a turn of the TOP LiDAR: the usual step from one frame to the next."""
    steps_s = [
        (frames[index + 1].start_us - frame.start_us) / _US_PER_S
        for index, frame in frames.items()
        if index + 1 in frames
    ]
    usual_s = float(np.median(steps_s)) if steps_s else _TURN_S
    low_s, high_s = _TURN_LIMITS_S
    return usual_s if low_s <= usual_s <= high_s else _TURN_S


@contextmanager
def _naming(place: str) -> Iterator[None]:
    """Errors of the writer know the scene but not the file: put its place in front."""
    try:
        yield
    except (DataError, ConfigError) as error:
        if place in str(error):
            raise
        raise DataError(f"{place}: {error}") from None
