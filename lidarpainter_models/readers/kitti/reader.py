"""Read KITTI (Geiger et al., CC BY-NC-SA 3.0): synchronised raw drives and the tracking benchmark.

A raw drive is `<date>/<date>_drive_<n>_sync` with `image_02`, `image_03`, `velodyne_points`, `oxts`
and, where it is labelled, `tracklet_labels.xml`; the date's folder holds `calib_*.txt`. The
tracking benchmark has `training/{image_02,velodyne,calib,label_02,oxts}`; its sequences are numbers
(`0000`).

Frames are those of the files. The LiDAR turns at 10 Hz, clockwise, beginning and ending behind the
car, and triggers the cameras when it looks ahead: its `timestamps.txt` has that moment, the middle
of the turn. The tracking benchmark has no times: 10 frames a second are taken. Points are not
compensated as published: each is placed by the pose at its own time, which follows from its
azimuth. A frame whose sweep is missing (the raw drive 0009 lacks four) or empty has its images
alone. PNG images are stored as JPEG of quality 98. Images are rectified, and taken at once.

Ego is the frame of the LiDAR, 1.7 m above the road, x forward, y left, z up.
"""

from collections.abc import Iterable
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.errors import DataError
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.geometry.timed_poses import compensated, poses_at
from lidarpainter_models.geometry.transforms import invert_rigid
from lidarpainter_models.readers.kitti.drives import open_drive
from lidarpainter_models.readers.kitti.texts import KittiBox
from lidarpainter_models.readers.source_logs.drive_poses import level_frame
from lidarpainter_models.readers.source_logs.folder import SourceFolder
from lidarpainter_models.readers.source_logs.log import chosen_frames
from lidarpainter_models.readers.source_logs.swept_boxes import with_counts, with_motion
from lidarpainter_models.scenes.frame_content import FrameContent, SourceImage, SourceSweep
from lidarpainter_models.scenes.image_bytes import as_jpeg
from lidarpainter_models.scenes.records import BoxRecord, ImageRecord, SweepPoints
from lidarpainter_models.scenes.validation import jpeg_header_size
from lidarpainter_models.scenes.writer import SceneHeader

DATASET = "kitti"
LICENCE = "CC BY-NC-SA 3.0 (non-commercial), KITTI by Geiger, Lenz, Stiller and Urtasun"
LIDAR_NAME = "velodyne"
_HALF_PIXEL = 0.5
"""KITTI counts pixels from the centre of the first one."""


class KittiLog:
    """One drive; its texts are read at once, sweeps and images frame by frame."""

    dataset = DATASET
    is_drive = True

    def __init__(
        self, root: Path, sequence: str, frames: slice | None, cameras: tuple[str, ...] | None
    ) -> None:
        """Open a drive, see `open_log`."""
        self.sequence, self.source = sequence, SourceFolder(root)
        self._drive = drive = open_drive(self.source, sequence, cameras)
        self.place = drive.place
        if not all(before < after for before, after in pairwise(drive.sweeps_ns.tolist())):
            raise DataError(f"{self.place}: the times of the sweeps do not ascend")
        self._oxts_ns, rows = np.unique(np.array(drive.oxts_ns), return_index=True)
        self.frame_indices = chosen_frames(len(drive.sweeps_ns), frames, self.place)
        known = drive.global_from_lidar[torch.from_numpy(rows)]
        first_ns = drive.sweeps_ns[self.frame_indices[:1]]
        self.global_from_world = level_frame(poses_at(known, self._oxts_ns, first_ns)[0])
        self._world_from_lidar = invert_rigid(self.global_from_world) @ known
        self._period_ns = drive.period_ns
        self._boxes = with_motion(self._placed_boxes(drive.boxes))
        self.header = SceneHeader(licence=LICENCE, global_from_world=self.global_from_world)

    def read_frame(self, frame_index: int) -> FrameContent:
        """Everything of one frame, as the writer takes it."""
        time_ns = int(self._drive.sweeps_ns[frame_index])
        sweeps, boxes = self._sweep(frame_index, time_ns), self._boxes.get(frame_index, [])
        if sweeps:
            boxes = with_counts(boxes, sweeps[0].points.xyz_m)
        return FrameContent(
            frame_index=frame_index,
            place=f"{self.place}, frame {frame_index}",
            timestamp_ns=time_ns,
            world_from_ego=self._pose_at(time_ns),
            images=[self._read_image(frame_index, name) for name in self._drive.projections],
            sweeps=sweeps,
            boxes=boxes,
        )

    def provenance(self) -> dict[str, object]:
        """The root's name and what was read below it."""
        return {"root": self.source.root.name, **self.source.provenance()}

    def _pose_at(self, time_ns: int) -> Float[Tensor, "4 4"]:
        return poses_at(self._world_from_lidar, self._oxts_ns, np.array([time_ns]))[0]

    def _seen_ns(self, time_ns: int, xy_m: Float[np.ndarray, "places 2"]) -> np.ndarray:
        """When, in the turn around a time, the LiDAR looks at places in its frame."""
        share = 0.5 - np.arctan2(xy_m[:, 1], xy_m[:, 0]) / (2 * np.pi)
        return time_ns + np.rint((share - 0.5) * self._period_ns).astype(np.int64)

    def _sweep(self, frame_index: int, time_ns: int) -> list[SourceSweep]:
        name = self._drive.sweeps.format(frame_index)
        path = self.source.root / name
        if not path.exists():
            return []
        scan = self.source.read_points(name, 4)
        if not len(scan):
            return []
        seen_ns = self._seen_ns(time_ns, scan[:, :2].astype(np.float64))
        xyz_m = compensated(
            scan[:, :3].astype(np.float64), seen_ns, self._world_from_lidar, self._oxts_ns
        )
        points = SweepPoints.of(
            xyz_m,
            intensity=torch.from_numpy(scan[:, 3].copy()),
            time_offset_ns=torch.from_numpy((seen_ns - time_ns).astype(np.int32)),
        )
        pose = self._pose_at(time_ns)
        return [
            SourceSweep(
                lidar_name=LIDAR_NAME,
                points=points,
                timestamp_ns=time_ns,
                world_from_lidar=pose,
                source=str(path),
            )
        ]

    def _read_image(self, frame_index: int, name: str) -> SourceImage:
        file = self._drive.images.format(name, frame_index)
        where = str(self.source.root / file)
        jpeg = as_jpeg(self.source.read_bytes(file), where)
        width_px, height_px = jpeg_header_size(jpeg, where)
        time_ns = int(self._drive.images_ns[name][frame_index])
        projection = self._drive.projections[name]
        # a projection is K [I | t]: the camera stands beside the first one
        beside = torch.eye(4, dtype=torch.float64)
        beside[:3, 3] = torch.from_numpy(np.linalg.solve(projection[:, :3], projection[:, 3]))
        camera = Camera(
            world_from_camera=self._pose_at(time_ns)
            @ invert_rigid(beside @ self._drive.camera_from_lidar),
            fx_px=float(projection[0, 0]),
            fy_px=float(projection[1, 1]),
            cx_px=float(projection[0, 2]) + _HALF_PIXEL,
            cy_px=float(projection[1, 2]) + _HALF_PIXEL,
            width_px=width_px,
            height_px=height_px,
        )
        record = ImageRecord(camera_name=name, timestamp_ns=time_ns, camera=camera)
        return SourceImage(record=record, jpeg=jpeg, source=where)

    def _placed_boxes(self, boxes: Iterable[tuple[int, KittiBox]]) -> dict[int, list[BoxRecord]]:
        """The boxes in the world by frame, each when the LiDAR looked at it."""
        chosen = set(self.frame_indices)
        kept = [(frame, box) for frame, box in boxes if frame in chosen]
        if not kept:
            return {}
        lidar_from_box = torch.stack([box.lidar_from_box for _, box in kept])
        frames_ns = self._drive.sweeps_ns[[frame for frame, _ in kept]]
        places_m = lidar_from_box[:, :2, 3].numpy()
        seen_ns = self._seen_ns(0, places_m) + frames_ns
        poses = poses_at(self._world_from_lidar, self._oxts_ns, seen_ns) @ lidar_from_box
        found: dict[int, list[BoxRecord]] = {}
        for (frame, box), time_ns, pose in zip(kept, seen_ns.tolist(), poses, strict=True):
            record = BoxRecord(
                actor_id=box.actor_id,
                category=box.category,
                timestamp_ns=time_ns,
                world_from_box=pose,
                size_m=box.size_m,
                is_moving=False,
                num_points=0,
            )
            found.setdefault(frame, []).append(record)
        return found
