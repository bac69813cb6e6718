"""Read nuScenes (Motional, CC BY-NC-SA 4.0): the tables of v1.0 and the files they name.

Every sweep of LIDAR_TOP is a frame, key frames and those in between; `recordings.py` says
which images it gets, `sweeps.py` what the points are and when they were measured,
`boxes.py` where the boxes stand between key frames, `dataset.py` how versions
and tables are found. The sequence is named as the scene (`scene-0061`).

Frames. Ego (`ego_pose`) is on the ground below the rear axle, x forward, y left, z up; every
image and every sweep has an ego pose of its own time. The time of a frame is that of its sweep,
the end of the turn; a canonical sweep has its time in the middle, where the LiDAR's pose lies
between those recorded. The scene's world has its origin at the first ego pose read, x along that
heading in the level plane, z up. Poses of all scenes of a location are in the frame of its map: a
car that is parked there stands at one place in all of them. Images are undistorted in the dataset;
sensors are calibrated once a scene.
"""

from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.geometry.boxes import count_points_in_boxes
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.geometry.transforms import invert_rigid, transform_points
from lidarpainter_models.readers.nuscenes.boxes import Annotations
from lidarpainter_models.readers.nuscenes.dataset import (
    find_scene,
    open_versions,
    read_global_frame,
    read_samples,
)
from lidarpainter_models.readers.nuscenes.recordings import (
    CAMERA_NAMES,
    LIDAR_NAME,
    RecordedFrame,
    Recording,
    form_frames,
    read_recordings,
)
from lidarpainter_models.readers.nuscenes.sweeps import TURN_NS, LidarPoints, read_lidar_points
from lidarpainter_models.readers.source_logs.drive_poses import level_frame, pose_at
from lidarpainter_models.readers.source_logs.folder import SourceFolder
from lidarpainter_models.readers.source_logs.log import chosen_cameras, chosen_frames
from lidarpainter_models.scenes.frame_content import FrameContent, SourceImage, SourceSweep
from lidarpainter_models.scenes.records import BoxRecord, ImageRecord, SweepPoints
from lidarpainter_models.scenes.schema import GLOBAL_FRAME
from lidarpainter_models.scenes.writer import SceneHeader

DATASET = "nuscenes"
LICENCE = "CC BY-NC-SA 4.0 (non-commercial), nuScenes by Motional"


def list_nuscenes_scenes(root: Path) -> tuple[str, ...]:
    """Names of the scenes of all versions below a root, sorted."""
    return tuple(
        sorted(
            {row.text("name") for tables in open_versions(root) for row in tables["scene"].rows()}
        )
    )


class NuscenesLog:
    """One scene; all its rows are read at once, files frame by frame."""

    dataset = DATASET
    is_drive = True

    def __init__(
        self, root: Path, sequence: str, frames: slice | None, cameras: tuple[str, ...] | None
    ) -> None:
        """Open a scene, see `open_log`; the root holds `v1.0-*`, `samples` and `sweeps`."""
        self.place, self.sequence = str(root), sequence
        self.source = SourceFolder(root)
        self._tables, scene = find_scene(root, sequence)
        samples = read_samples(self._tables, scene)
        channels = chosen_cameras(cameras, CAMERA_NAMES, scene.where)
        recordings = read_recordings(self._tables, samples, (LIDAR_NAME, *channels))
        self._sweeps = recordings.pop(LIDAR_NAME)
        self.annotations = Annotations(self._tables, samples, self._sweeps)
        self._frames = form_frames(self._sweeps, recordings)
        self.frame_indices = chosen_frames(len(self._frames), frames, scene.where)
        first = self._frames[self.frame_indices[0]]
        self.global_from_world = level_frame(first.sweep.global_from_ego)
        self.header = SceneHeader(
            licence=LICENCE,
            global_from_world=self.global_from_world,
            more={GLOBAL_FRAME: read_global_frame(self._tables, scene)},
        )
        self._world_from_global = invert_rigid(self.global_from_world)
        self._sweep_ns = [sweep.timestamp_ns for sweep in self._sweeps]
        self._global_from_lidar = torch.stack([sweep.global_from_sensor for sweep in self._sweeps])

    def read_frame(self, frame_index: int) -> FrameContent:
        """Everything of one frame, as the writer takes it."""
        frame = self._frames[frame_index]
        points = read_lidar_points(self.source, frame.sweep.file)
        world_from_lidar = self._world_from_global @ frame.sweep.global_from_sensor
        xyz_m = transform_points(world_from_lidar, torch.from_numpy(points.xyz_m))
        return FrameContent(
            frame_index=frame_index,
            place=frame.sweep.where,
            timestamp_ns=frame.sweep.timestamp_ns,
            world_from_ego=self._world_from_global @ frame.sweep.global_from_ego,
            images=[self._read_image(image) for image in frame.images.values()],
            sweeps=[self._sweep(frame.sweep, points, xyz_m)],
            boxes=self._boxes(frame, xyz_m),
        )

    def provenance(self) -> dict[str, object]:
        """The version, and digests of its tables and of the files that were read."""
        return {
            "root": self.source.root.name,
            "version": self._tables.folder.name,
            "tables_sha256": self._tables.digests(),
            **self.source.provenance(),
        }

    def _read_image(self, image: Recording) -> SourceImage:
        width_px, height_px = image.size_px
        camera = Camera(
            world_from_camera=self._world_from_global @ image.global_from_sensor,
            **image.calibration.intrinsics,
            shutter=None,
            width_px=width_px,
            height_px=height_px,
        )
        record = ImageRecord(
            camera_name=image.calibration.channel, timestamp_ns=image.timestamp_ns, camera=camera
        )
        jpeg = self.source.read_bytes(image.file)
        return SourceImage(record=record, jpeg=jpeg, source=str(self.source.root / image.file))

    def _sweep(
        self, sweep: Recording, points: LidarPoints, xyz_m: Float[Tensor, "points 3"]
    ) -> SourceSweep:
        middle_ns = sweep.timestamp_ns - TURN_NS // 2
        global_from_lidar = pose_at(self._global_from_lidar, self._sweep_ns, middle_ns)
        return SourceSweep(
            lidar_name=LIDAR_NAME,
            points=SweepPoints.of(
                xyz_m.to(torch.float32),
                intensity=torch.from_numpy(points.intensity),
                time_offset_ns=torch.from_numpy(points.time_offset_ns + TURN_NS // 2),
                ring=torch.from_numpy(points.ring),
            ),
            timestamp_ns=middle_ns,
            world_from_lidar=self._world_from_global @ global_from_lidar,
            source=str(self.source.root / sweep.file),
        )

    def _boxes(self, frame: RecordedFrame, xyz_m: Float[Tensor, "points 3"]) -> list[BoxRecord]:
        boxes = self.annotations.boxes_at(frame.sweep)
        if not boxes:
            return []
        poses = self._world_from_global @ torch.stack([box.global_from_box for box in boxes])
        counts = count_points_in_boxes(xyz_m, poses, torch.tensor([box.size_m for box in boxes]))
        return [
            BoxRecord(
                actor_id=box.actor_id,
                category=box.category,
                timestamp_ns=box.timestamp_ns,
                world_from_box=pose,
                size_m=box.size_m,
                is_moving=box.actor_id in self.annotations.moving,
                num_points=num_points,
            )
            for box, pose, num_points in zip(boxes, poses, counts.tolist(), strict=True)
        ]
