"""Read a bag as a scene: MCAP with ROS 2 or Foxglove messages, as a rig.toml says or as proposed.

A bag is read twice: once for all that is small (survey.py), once for images and points, which go to
the writer as they come. The first LiDAR is the clock: each of its sweeps is a frame, with the image
of each camera and the sweep of each other LiDAR that are nearest to its middle. Frames for whose
time the bag has no pose are left out. Boxes stand when the LiDAR saw what is inside them, where
points have times, and else when they are stamped.
"""

import hashlib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor

from lidarpainter_models.errors import DataError
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.geometry.timed_poses import compensated
from lidarpainter_models.geometry.transforms import invert_rigid, transform_points
from lidarpainter_models.readers.bags.chunks import BagMessage, bag_files, bag_messages
from lidarpainter_models.readers.bags.clouds import BagPoints, points_of
from lidarpainter_models.readers.bags.frame_plan import FramePlan
from lidarpainter_models.readers.bags.messages import BagLens, lens_of, place_of
from lidarpainter_models.readers.bags.pictures import BagVideo, jpeg_of_message
from lidarpainter_models.readers.bags.proposal import proposed_rig
from lidarpainter_models.readers.bags.rig import RigCamera, RigLidar, RigSensor, read_rig
from lidarpainter_models.readers.bags.survey import survey_bag
from lidarpainter_models.readers.source_logs.drive_poses import level_frame
from lidarpainter_models.readers.source_logs.swept_boxes import seen_records, with_counts
from lidarpainter_models.scenes.frame_content import FrameContent, SourceImage, SourceSweep
from lidarpainter_models.scenes.records import BoxRecord, ImageRecord, SweepPoints
from lidarpainter_models.scenes.schema import NO_POSES, POSES
from lidarpainter_models.scenes.validation import jpeg_header_size
from lidarpainter_models.scenes.writer import SceneHeader

DATASET = "mcap"
MAX_HELD_BYTES = 256 << 20
"""Of images and points that wait for the rest of their frames."""
Part = tuple[str, bytes | BagPoints]
"""Where something came from, and the JPEG or the points."""


class BagLog:
    """One bag."""

    dataset = DATASET

    def __init__(
        self,
        root: Path,
        sequence: str,
        frames: slice | None,
        cameras: tuple[str, ...] | None,
        rig: Path | None = None,
    ) -> None:
        """Open a bag, see `open_log`; without a rig it is read as `lidarpainter rig` proposes."""
        self._files = bag_files(Path(root), sequence)
        self.sequence, self.place = sequence, str(self._files[0])
        stated = read_rig(rig) if rig is not None else None
        self._survey = survey_bag(self._files, clock=stated.clock if stated else "header")
        chosen = stated or proposed_rig(self._survey).complete(self.place)
        self._plan = FramePlan(self._survey, chosen, self.place, frames, cameras)
        self._rig = self._plan.rig
        self.is_drive = self._rig.world != self._rig.ego
        self.frame_indices = self._plan.frame_indices
        first_ns = self._plan.frames_ns[self.frame_indices[:1]]
        self.global_from_world = level_frame(self._pose(self._rig.ego, int(first_ns[0])))
        self._world_from_global = invert_rigid(self.global_from_world)
        self.header = SceneHeader(
            licence=self._rig.licence,
            global_from_world=self.global_from_world,
            more={} if self.is_drive else {POSES: NO_POSES},
        )
        self._lenses: dict[str, BagLens] = {c.name: self._lens(c) for c in self._rig.cameras}
        self._digest, self._num_messages = hashlib.sha256(), 0
        self._parts: dict[int, dict[str, Part]] = {}
        self._done: dict[str, int] = {}
        self._arrivals = self._arrived()
        self._held_bytes = 0

    def read_frame(self, frame_index: int) -> FrameContent:
        """Everything of one frame, as the writer takes it."""
        while not self._is_whole(frame_index):
            if next(self._arrivals, None) is None:
                break
        parts = self._parts.pop(frame_index, {})
        self._held_bytes -= sum(_num_bytes(part) for _, part in parts.values())
        images = {k: (where, v) for k, (where, v) in parts.items() if isinstance(v, bytes)}
        points = {k: (where, v) for k, (where, v) in parts.items() if isinstance(v, BagPoints)}
        time_ns = int(self._plan.frames_ns[frame_index])
        sweeps = [
            self._sweep(lidar, frame_index, *points[lidar.topic])
            for lidar in self._rig.lidars
            if lidar.topic in points
        ]
        sweeps = [sweep for sweep in sweeps if sweep.points.num_points]
        return FrameContent(
            frame_index=frame_index,
            place=f"{self.place}, frame {frame_index}",
            timestamp_ns=time_ns,
            world_from_ego=self._world_from_global @ self._pose(self._rig.ego, time_ns),
            images=[
                self._image(camera, frame_index, *images[camera.topic])
                for camera in self._rig.cameras
                if camera.topic in images
            ],
            sweeps=sweeps,
            boxes=self._boxes(frame_index, sweeps),
        )

    def provenance(self) -> dict[str, object]:
        """The files, and a digest over the messages that were used."""
        return {
            "root": self._files[0].name,
            "num_files": len(self._files),
            "num_messages": self._num_messages,
            "sha256": self._digest.hexdigest(),
        }

    def _pose(self, frame: str, time_ns: int) -> Float[Tensor, "4 4"]:
        """Where a frame stands in the bag's world."""
        return self._plan.tree.poses(self._rig.world, frame, np.array([time_ns]))[0]

    def _lens(self, camera: RigCamera) -> BagLens:
        message = self._survey.topics[camera.lens].first
        assert message is not None, "the plan has looked"  # noqa: S101
        decoded, where = self._survey.decoders.decoded(message), place_of(message)
        return lens_of(decoded, where, is_rectified=camera.is_rectified)

    def _is_whole(self, frame_index: int) -> bool:
        """Whether all that a frame has is there, or can come no more."""
        return all(
            topic in self._parts.get(frame_index, {}) or self._done.get(topic, -1) >= number
            for topic, number in self._plan.parts_of(frame_index)
        )

    def _arrived(self) -> Iterator[bool]:
        """Read the bag on, a message at a time, and keep what frames want."""
        sensors = {sensor.topic: sensor for sensor in self._rig.sensors}
        counts = dict.fromkeys(sensors, -1)
        videos: dict[str, BagVideo] = {}
        for message in bag_messages(self._files):
            if message.topic not in sensors:
                continue
            counts[message.topic] += 1
            number, wanted = counts[message.topic], self._plan.wanted[message.topic]
            if self._survey.topics[message.topic].kind == "video":
                self._take_pictures(videos, message, number)
            else:
                if number in wanted:
                    self._keep(message.topic, number, self._part(sensors[message.topic], message))
                self._done[message.topic] = number
            if number in wanted:
                self._num_messages += 1
                self._digest.update(message.data)
            yield True
        for topic, video in videos.items():
            self._take(topic, video.pictures(None, 0, set(self._plan.wanted[topic]), topic), topic)
            self._done[topic] = counts[topic]

    def _part(self, sensor: RigSensor, message: BagMessage) -> Part:
        decoded, where = self._survey.decoders.decoded(message), place_of(message)
        if isinstance(sensor, RigLidar):
            time_ns = self._plan.stamp_ns(message)
            return where, points_of(decoded, time_ns, where, time_field=sensor.point_time)
        return where, jpeg_of_message(decoded, where)

    def _take_pictures(self, videos: dict[str, BagVideo], message: BagMessage, number: int) -> None:
        """Decode a message of a video; earlier ones that could not be shown are given up."""
        decoded, where = self._survey.decoders.decoded(message), place_of(message)
        if message.topic not in videos:
            videos[message.topic] = BagVideo(str(decoded.format), where)
        wanted = set(self._plan.wanted[message.topic])
        pictures = videos[message.topic].pictures(bytes(decoded.data), number, wanted, where)
        self._take(message.topic, pictures, where)

    def _take(self, topic: str, pictures: Iterator[tuple[int, bytes | None]], where: str) -> None:
        for shown, jpeg in pictures:
            if jpeg is not None:
                self._keep(topic, shown, (where, jpeg))
            self._done[topic] = shown

    def _keep(self, topic: str, number: int, part: Part) -> None:
        frame_index = self._plan.wanted[topic][number]
        self._parts.setdefault(frame_index, {})[topic] = part
        self._held_bytes += _num_bytes(part[1])
        if self._held_bytes > MAX_HELD_BYTES:
            raise DataError(
                f"{part[0]}: images and points of one time lie more than {MAX_HELD_BYTES >> 20} MB "
                "apart in the bag, expected them in the order of time: `mcap sort` puts them in it"
            )

    def _image(self, camera: RigCamera, frame_index: int, where: str, jpeg: bytes) -> SourceImage:
        time_ns, lens = self._plan.time_of(camera.topic, frame_index), self._lenses[camera.name]
        width_px, height_px = jpeg_header_size(jpeg, where)
        if (width_px, height_px) != (lens.width_px, lens.height_px):
            raise DataError(
                f"{where}: the image is {width_px} x {height_px} px, expected "
                f"{lens.width_px} x {lens.height_px} as {camera.lens} says"
            )
        world_from_camera = self._world_from_global @ self._pose(
            self._plan.frame_of(camera), time_ns
        )
        record = ImageRecord(
            camera_name=camera.name,
            timestamp_ns=time_ns,
            camera=Camera(
                world_from_camera=world_from_camera,
                **lens.intrinsics,
                shutter=None,
                width_px=width_px,
                height_px=height_px,
            ),
            distortion=lens.distortion,
        )
        return SourceImage(record=record, jpeg=jpeg, source=where)

    def _sweep(
        self, lidar: RigLidar, frame_index: int, where: str, points: BagPoints
    ) -> SourceSweep:
        time_ns, frame = self._plan.time_of(lidar.topic, frame_index), self._plan.frame_of(lidar)
        offset_ns = points.offset_ns
        middle_ns = int(offset_ns.min(initial=0) + offset_ns.max(initial=0)) // 2
        held_ns = offset_ns  # the time at which a point is where it is said to be
        if lidar.is_compensated and not self.is_drive:
            held_ns = np.zeros_like(offset_ns)
        stored = SweepPoints.of(
            self._placed(lidar, frame, points, time_ns),
            intensity=torch.from_numpy(points.intensity),
            time_offset_ns=torch.from_numpy((held_ns - middle_ns).astype(np.int32)),
            ring=torch.from_numpy(points.ring),
        )
        return SourceSweep(
            lidar_name=lidar.name,
            points=stored,
            timestamp_ns=time_ns + middle_ns,
            world_from_lidar=self._world_from_global @ self._pose(frame, time_ns + middle_ns),
            source=where,
        )

    def _placed(
        self, lidar: RigLidar, frame: str, points: BagPoints, time_ns: int
    ) -> Float[Tensor, "points 3"]:
        """The points in the scene's world, each by the pose of its time."""
        if lidar.point_time is None or lidar.is_compensated:
            pose = self._world_from_global @ self._pose(frame, time_ns)
            return transform_points(pose, torch.from_numpy(points.xyz_m)).to(torch.float32)
        times_ns = time_ns + points.offset_ns
        known_ns = _around(self._plan.tree.times_ns(self._rig.world, frame), times_ns)
        poses = self._plan.tree.poses(self._rig.world, frame, known_ns)
        return compensated(points.xyz_m, times_ns, self._world_from_global @ poses, known_ns)

    def _boxes(self, frame_index: int, sweeps: list[SourceSweep]) -> list[BoxRecord]:
        boxes = [
            replace(box, world_from_box=self._world_from_global @ box.world_from_box)
            for box in self._plan.boxes.get(frame_index, [])
        ]
        if not (boxes and sweeps):
            return boxes
        xyz_m = torch.cat([sweep.points.xyz_m for sweep in sweeps])
        origin_ns = sweeps[0].timestamp_ns
        if self._rig.lidars[0].point_time is not None:
            offset_ns = np.concatenate(
                [
                    sweep.points.time_offset_ns.numpy().astype(np.int64)
                    + (sweep.timestamp_ns - origin_ns)
                    for sweep in sweeps
                ]
            )
            lidar_m = sweeps[0].world_from_lidar[:3, 3].numpy()
            return seen_records(boxes, xyz_m, offset_ns, origin_ns, lidar_m)
        return with_counts(boxes, xyz_m)


def _around(
    known_ns: Int64[np.ndarray, " poses"], times_ns: Int64[np.ndarray, " points"]
) -> Int64[np.ndarray, " kept"]:
    """The times of poses between which points were measured, two at least where there are."""
    if not len(times_ns):
        return known_ns[:1]
    first, last = np.searchsorted(known_ns, [times_ns.min(), times_ns.max()])
    return known_ns[max(min(int(first) - 1, len(known_ns) - 2), 0) : int(last) + 2]


def _num_bytes(part: bytes | BagPoints) -> int:
    return len(part) if isinstance(part, bytes) else 2 * part.xyz_m.nbytes
