"""Read the Waymo Open Dataset (perception), version 1 and 2, without TensorFlow.

Version 1 is a TFRecord file per segment (`segment-<name>_with_camera_labels.tfrecord`), version 2 a
Parquet file per segment and component (`camera_image/<name>.parquet`, ...). Which one it is shows
by what lies at the root or up to two folders below it; a segment is called by its name in either.

Frames. A frame of the dataset is a frame of the scene: one turn of the TOP LiDAR (0.1 s), the
images taken meanwhile, the labels. Ego is the dataset's vehicle frame: x forward, y left, z up,
on the road below the rear axle. The frame's pose is the vehicle's in the middle of the turn; as
it is that of the FRONT image, the time of that pose is the frame's time (elsewhere the middle of
the turn). The world has its origin at the first pose and its x along that heading, z is up.

A sweep has the time and the pose of its frame. The points of TOP have been measured each at its
own pose and time: columns go clockwise from straight behind, evenly over the turn, which begins at
the frame's timestamp. The points of the other LiDARs have been moved to the frame's pose by the
dataset, which does not say when they were measured: their time offsets are 0. The ring is the row
of the range image, the highest beam is 0. Points in no-label zones are kept.

A frame without a point or without an image of each camera that is read, and a TOP image without
its pixel poses (some derived files have none of these), is refused.
"""

import re
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch

from lidarpainter_models.errors import DataError
from lidarpainter_models.geometry.transforms import invert_rigid, transform_points
from lidarpainter_models.readers.source_logs.drive_checks import (
    apart,
    require_motion,
    require_timely,
)
from lidarpainter_models.readers.source_logs.drive_poses import NS_PER_S, level_frame, nanoseconds
from lidarpainter_models.readers.source_logs.log import chosen_cameras, chosen_frames, naming
from lidarpainter_models.readers.waymo.boxes import FramePoints, box_records, moving_ids
from lidarpainter_models.readers.waymo.calibration import CAMERA_NAMES, TOP
from lidarpainter_models.readers.waymo.cameras import (
    exposure_s,
    global_from_vehicle_at,
    image_record,
)
from lidarpainter_models.readers.waymo.log import MAX_LAG_S, WaymoFrame, WaymoImage, WaymoSweep
from lidarpainter_models.readers.waymo.parquet import WaymoParquetSegment
from lidarpainter_models.readers.waymo.range_images import range_points
from lidarpainter_models.readers.waymo.tfrecord import WaymoRecordSegment
from lidarpainter_models.scenes.frame_content import FrameContent, SourceImage, SourceSweep
from lidarpainter_models.scenes.records import SweepPoints
from lidarpainter_models.scenes.validation import jpeg_header_size
from lidarpainter_models.scenes.writer import SceneHeader

DATASET = "waymo"
LICENCE = "Waymo Open Dataset License Agreement for Non-Commercial Use (waymo.com/open/terms)"
_RECORD_NAME = re.compile(r"(?:(?:[a-z]+_)?segment-)?(.+?)(?:_with_camera_labels)?")
_DEPTHS = ("", "*/", "*/*/")
_TURN_S = 0.1
_TURN_LIMITS_S = (0.05, 0.2)
_US_PER_S = 1_000_000
_SAME_POSE_M = 0.01
MAX_POSE_GAP_M = 1.0
MAX_POSE_GAP_RAD = 0.05
"""An image's pose, carried to the frame's time, agrees with the frame's to some centimetres."""
NS_PER_US = 1000


def list_waymo_segments(root: Path) -> tuple[str, ...]:
    """Names of the segments of either release at or below a root, sorted."""
    return tuple(sorted({name for name, _path in _segments(Path(root))}))


class WaymoLog:
    """One segment; poses and labels of all frames are in memory, sensors of one or two."""

    dataset = DATASET
    is_drive = True

    def __init__(
        self, root: Path, sequence: str, frames: slice | None, cameras: tuple[str, ...] | None
    ) -> None:
        """Open a segment, see `open_log`."""
        self._segment = _open_segment(root, sequence)
        self.place, self.sequence, self._root = self._segment.place, sequence, root
        with naming(self.place):
            self.frame_indices = chosen_frames(self._segment.num_frames, frames, self.place)
            self._frames = {index: self._segment.read_frame(index) for index in self.frame_indices}
            self._cameras = chosen_cameras(cameras, CAMERA_NAMES.values(), self.place)
            self._expected = [
                name
                for name in self._cameras
                if cameras is not None or name in self._segment.cameras
            ]
            require_drive(list(self._frames.values()))
            self._turn_s = _turn_s(self._frames)
            first = self._frames[self.frame_indices[0]]
            self._global_from_world = level_frame(first.global_from_vehicle)
            self._world_from_global = invert_rigid(self._global_from_world)
            self._moving = moving_ids(list(self._frames.values()))
        self.header = SceneHeader(licence=LICENCE, global_from_world=self._global_from_world)

    def provenance(self) -> dict[str, object]:
        """The release, and digests of what was read."""
        return {"root": self._root.name, **self._segment.provenance()}

    def read_frame(self, frame_index: int) -> FrameContent:
        """Everything of one frame, as the writer takes it."""
        frame = self._frames[frame_index]
        with naming(frame.place):
            recorded, swept = self._segment.read_sensors(frame_index)
            if not recorded:
                raise DataError("zero images, expected at least one")
            images = {image.camera_name: image for image in recorded}
            self._require_images(images)
            time_s = self._time_s(frame, images)
            world_from_vehicle = self._world_from_global @ frame.global_from_vehicle
            points = FramePoints(time_s, self._top_position_m())
            sweeps = self._sweeps(frame, swept, points)
            boxes = box_records(
                frame, points, images, self._segment.cameras, world_from_vehicle, self._moving
            )
            return FrameContent(
                frame_index=frame_index,
                place=frame.place,
                timestamp_ns=nanoseconds(time_s),
                world_from_ego=world_from_vehicle,
                images=[
                    self._image(frame, image, time_s)
                    for image in recorded
                    if image.camera_name in self._cameras
                ],
                sweeps=sweeps,
                boxes=boxes,
            )

    def _require_images(self, images: dict[str, WaymoImage]) -> None:
        """Every camera takes an image a frame: a file that lacks one has lost it."""
        missing = [name for name in self._expected if name not in images]
        if missing:
            others = ",".join(name for name in self._expected if name in images)
            hint = f"; to read the others alone: --cameras {others}" if others else ""
            raise DataError(f"no image of {', '.join(missing)}, expected one of each camera{hint}")

    def _time_s(self, frame: WaymoFrame, images: dict[str, WaymoImage]) -> float:
        """When the frame's pose holds: with the FRONT image, or in the middle of the turn."""
        middle_s = frame.start_us / _US_PER_S + self._turn_s / 2
        front = images.get(CAMERA_NAMES[1])
        if front is None or abs(front.pose_time_s - middle_s) > MAX_LAG_S:
            return middle_s
        apart_m = (front.global_from_vehicle - frame.global_from_vehicle)[:3, 3].norm()
        return front.pose_time_s if float(apart_m) <= _SAME_POSE_M else middle_s

    def _image(self, frame: WaymoFrame, image: WaymoImage, time_s: float) -> SourceImage:
        calibration = self._segment.cameras.get(image.camera_name)
        if calibration is None:
            raise DataError(f"{image.place}: the camera has no calibration")
        require_timely(nanoseconds(exposure_s(image)), nanoseconds(time_s), image.place)
        require_agreement(image, frame, time_s)
        lens = calibration.lens
        stated_px = jpeg_header_size(image.jpeg, image.place)
        if stated_px != (lens.width_px, lens.height_px):
            raise DataError(
                f"{image.place}: the image is {stated_px[0]} x {stated_px[1]} px, expected "
                f"{lens.width_px} x {lens.height_px} px as calibrated"
            )
        record = image_record(image, calibration, self._world_from_global)
        return SourceImage(record=record, jpeg=image.jpeg, source=image.place)

    def _sweeps(
        self, frame: WaymoFrame, sweeps: list[WaymoSweep], points: FramePoints
    ) -> list[SourceSweep]:
        """The sweeps that have points, which are added to those of the frame."""
        read = (self._sweep(frame, sweep, points) for sweep in sweeps)
        found = [sweep for sweep in read if sweep is not None]
        if not found:
            raise DataError("no LiDAR has a point, expected range images")
        if TOP in self._segment.lidars and TOP not in [sweep.lidar_name for sweep in found]:
            raise DataError(f"the {TOP} LiDAR has no point, expected its range images")
        return found

    def _sweep(
        self, frame: WaymoFrame, sweep: WaymoSweep, points: FramePoints
    ) -> SourceSweep | None:
        calibration = self._segment.lidars.get(sweep.lidar_name)
        if calibration is None:
            raise DataError(f"{sweep.place}: the LiDAR has no calibration")
        is_top = sweep.lidar_name == TOP
        if is_top and sweep.pixel_poses is None:
            raise DataError(f"{sweep.place}: the pixel poses are missing")
        found = range_points(sweep, calibration, frame.global_from_vehicle)
        count = len(found.row)
        if count == 0:
            return None
        offset_s = np.zeros(count)
        if is_top:
            begins_s = frame.start_us / _US_PER_S - points.time_s
            offset_s = begins_s + (found.column + 0.5) / found.num_columns * self._turn_s
        points.add(found.xyz_vehicle_m, offset_s, is_top=is_top)
        world_from_vehicle = self._world_from_global @ frame.global_from_vehicle
        xyz_world_m = transform_points(world_from_vehicle, torch.from_numpy(found.xyz_vehicle_m))
        return SourceSweep(
            lidar_name=sweep.lidar_name,
            points=SweepPoints.of(
                xyz_world_m.to(torch.float32),
                intensity=torch.from_numpy(found.intensity),
                time_offset_ns=torch.from_numpy(np.rint(offset_s * NS_PER_S).astype(np.int32)),
                ring=torch.from_numpy(found.row.astype(np.int16)),
                return_index=torch.from_numpy(found.return_index.astype(np.int8)),
            ),
            timestamp_ns=nanoseconds(points.time_s),
            world_from_lidar=world_from_vehicle @ calibration.vehicle_from_lidar,
            source=sweep.place,
        )

    def _top_position_m(self) -> np.ndarray:
        top = self._segment.lidars.get(TOP)
        return np.zeros(3) if top is None else top.vehicle_from_lidar[:3, 3].numpy()


def _segments(root: Path) -> Iterator[tuple[str, Path]]:
    """Names of segments with their TFRecord file or their Parquet file of poses."""
    for depth in _DEPTHS:
        for path in root.glob(f"{depth}*.tfrecord"):
            match = _RECORD_NAME.fullmatch(path.stem)
            yield (match[1] if match else path.stem), path
        for path in root.glob(f"{depth}vehicle_pose/*.parquet"):
            yield path.stem, path


def _open_segment(root: Path, sequence: str) -> WaymoRecordSegment | WaymoParquetSegment:
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


def require_drive(frames: list[WaymoFrame]) -> None:
    """Refuse frames whose times do not ascend, or between which no car could have driven."""
    for before, after in pairwise(frames):
        if after.start_us <= before.start_us:
            raise DataError(
                f"{after.place}, timestamp: {after.start_us} us, expected more than the frame "
                f"before, {before.start_us} us"
            )
        require_motion(
            (before.start_us * NS_PER_US, before.global_from_vehicle),
            (after.start_us * NS_PER_US, after.global_from_vehicle),
            after.place,
        )


def require_agreement(image: WaymoImage, frame: WaymoFrame, time_s: float) -> None:
    """Refuse an image that states another place of the vehicle than its frame does."""
    apart_m, apart_rad = apart(global_from_vehicle_at(image, time_s), frame.global_from_vehicle)
    if apart_m > MAX_POSE_GAP_M or apart_rad > MAX_POSE_GAP_RAD:
        raise DataError(
            f"{image.place}, pose: {apart_m:.2f} m and {apart_rad:.3f} rad from the frame's, "
            f"expected {MAX_POSE_GAP_M:g} m and {MAX_POSE_GAP_RAD:g} rad at most"
        )
