"""Read nuScenes (Motional, CC BY-NC-SA 4.0): the tables of v1.0 and the files they name.

Every sweep of LIDAR_TOP is a frame, key frames and those in between; `recordings.py` says
which pictures it gets, `sweeps.py` what the points are and when they were measured,
`boxes.py` where the boxes stand between key frames, `dataset.py` how versions
and tables are found. The sequence is named as the scene (`scene-0061`).

Frames. Ego (`ego_pose`) is on the ground below the rear axle, x forward, y left, z up; every
picture and every sweep has an ego pose of its own time. The time of a frame is that of its sweep,
the end of the turn; a canonical sweep has its time in the middle, where the LiDAR's pose lies
between those recorded. The scene's world has its origin at the first ego pose read, x along that
heading in the level plane, z up. Pictures are undistorted in the dataset; sensors are calibrated
once a scene.
"""

from collections.abc import Callable
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.geometry.transforms import invert_rigid, transform_points
from lidarpainter_models.scenes.readers.drive_poses import level_frame, pose_at
from lidarpainter_models.scenes.readers.nuscenes.boxes import Annotations, PointsByPlace
from lidarpainter_models.scenes.readers.nuscenes.dataset import (
    find_scene,
    open_versions,
    read_samples,
)
from lidarpainter_models.scenes.readers.nuscenes.recordings import (
    CAMERA_NAMES,
    LIDAR_NAME,
    RecordedFrame,
    Recording,
    form_frames,
    read_recordings,
)
from lidarpainter_models.scenes.readers.nuscenes.sweeps import (
    TURN_NS,
    LidarPoints,
    read_lidar_points,
)
from lidarpainter_models.scenes.readers.selection import chosen_cameras, chosen_frames
from lidarpainter_models.scenes.readers.source_folder import SourceFolder
from lidarpainter_models.scenes.records import BoxRecord, ImageRecord, SweepPoints
from lidarpainter_models.scenes.validation import require_name
from lidarpainter_models.scenes.writer import SceneHeader, SceneWriter

DATASET = "nuscenes"
LICENCE = "CC BY-NC-SA 4.0 (non-commercial), nuScenes by Motional"
Progress = Callable[[int, int], None]
"""Told frames done and frames in all."""


def list_nuscenes_scenes(root: Path) -> tuple[str, ...]:
    """Names of the scenes of all versions below a root, sorted."""
    return tuple(
        sorted(
            {row.text("name") for tables in open_versions(root) for row in tables["scene"].rows()}
        )
    )


def read_nuscenes(
    root: Path,
    sequence: str,
    store: Path,
    *,
    frames: slice | None = None,
    cameras: tuple[str, ...] | None = None,
    progress: Progress | None = None,
) -> Path:
    """Write one scene into the store as a canonical scene; gives its path.

    Args:
        root: the folder that holds `v1.0-*`, `samples` and `sweeps`.
        sequence: the name of a scene.
        store: where scenes live.
        frames: which sweeps to take, by position; all of them if None.
        cameras: which cameras to take, by channel; all of them if None.
        progress: told after every frame.

    Raises:
        DataError: something in the log is missing, damaged or makes no sense.
        StorageError: the store cannot be written.
    """
    require_name(sequence, "sequence")
    log = _NuscenesLog(Path(root), sequence, frames, cameras)
    header = SceneHeader(licence=LICENCE, global_from_world=log.global_from_world)
    with SceneWriter(store, DATASET, sequence, header) as writer:
        for done, frame_index in enumerate(log.frame_indices, start=1):
            log.write_frame(writer, frame_index)
            if progress is not None:
                progress(done, len(log.frame_indices))
        writer.set_provenance({"root": str(root), **log.provenance()})
    return writer.path


class _NuscenesLog:
    """One scene; all its rows are read at once, files frame by frame."""

    def __init__(
        self, root: Path, sequence: str, frames: slice | None, cameras: tuple[str, ...] | None
    ) -> None:
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
        self._world_from_global = invert_rigid(self.global_from_world)
        self._sweep_ns = [sweep.timestamp_ns for sweep in self._sweeps]
        self._global_from_lidar = torch.stack([sweep.global_from_sensor for sweep in self._sweeps])

    def write_frame(self, writer: SceneWriter, frame_index: int) -> None:
        """Everything of one frame."""
        frame = self._frames[frame_index]
        writer.add_frame(
            frame_index,
            timestamp_ns=frame.sweep.timestamp_ns,
            world_from_ego=self._world_from_global @ frame.sweep.global_from_ego,
        )
        for picture in frame.pictures.values():
            self._write_image(writer, picture)
        points = read_lidar_points(self.source, frame.sweep.file)
        world_from_lidar = self._world_from_global @ frame.sweep.global_from_sensor
        xyz_m = transform_points(world_from_lidar, torch.from_numpy(points.xyz_m))
        self._write_sweep(writer, frame.sweep, points, xyz_m)
        self._write_boxes(writer, frame, xyz_m)

    def provenance(self) -> dict[str, object]:
        """The version, and digests of its tables and of the files that were read."""
        return {
            "version": self._tables.folder.name,
            "tables_sha256": self._tables.digests(),
            **self.source.provenance(),
        }

    def _write_image(self, writer: SceneWriter, picture: Recording) -> None:
        width_px, height_px = picture.size_px
        camera = Camera(
            world_from_camera=self._world_from_global @ picture.global_from_sensor,
            **picture.calibration.intrinsics,
            width_px=width_px,
            height_px=height_px,
        )
        record = ImageRecord(
            camera_name=picture.calibration.channel,
            timestamp_ns=picture.timestamp_ns,
            camera=camera,
        )
        jpeg = self.source.read_bytes(picture.file)
        writer.add_image(record, jpeg, source=str(self.source.root / picture.file))

    def _write_sweep(
        self,
        writer: SceneWriter,
        sweep: Recording,
        points: LidarPoints,
        xyz_m: Float[Tensor, "points 3"],
    ) -> None:
        count = len(xyz_m)
        middle_ns = sweep.timestamp_ns - TURN_NS // 2
        global_from_lidar = pose_at(self._global_from_lidar, self._sweep_ns, middle_ns)
        writer.add_sweep(
            LIDAR_NAME,
            SweepPoints(
                xyz_m=xyz_m.to(torch.float32),
                intensity=torch.from_numpy(points.intensity),
                time_offset_ns=torch.from_numpy(points.time_offset_ns + TURN_NS // 2),
                ring=torch.from_numpy(points.ring),
                return_index=torch.zeros(count, dtype=torch.int8),
                lidar=torch.zeros(count, dtype=torch.uint8),
            ),
            timestamp_ns=middle_ns,
            world_from_lidar=self._world_from_global @ global_from_lidar,
        )

    def _write_boxes(
        self, writer: SceneWriter, frame: RecordedFrame, xyz_m: Float[Tensor, "points 3"]
    ) -> None:
        points = PointsByPlace(xyz_m)
        for box in self.annotations.boxes_at(frame.sweep):
            world_from_box = self._world_from_global @ box.global_from_box
            writer.add_box(
                BoxRecord(
                    actor_id=box.actor_id,
                    category=box.category,
                    timestamp_ns=box.timestamp_ns,
                    world_from_box=world_from_box,
                    size_m=box.size_m,
                    is_moving=box.actor_id in self.annotations.moving,
                    num_points=points.count_inside(world_from_box, box.size_m),
                )
            )
