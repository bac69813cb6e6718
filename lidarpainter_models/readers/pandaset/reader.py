"""Read PandaSet (Hesai and Scale AI, CC BY 4.0) in its native layout.

`<root>/<sequence>/` holds `lidar/NN.pkl.gz` (points already in the dataset's world, with their
times), `lidar/poses.json`, `camera/<name>/NN.jpg` with poses at exposure, intrinsics and times,
`annotations/cuboids/NN.pkl.gz` and, for most sequences, `annotations/semseg/NN.pkl.gz`.

Frames. The pose in `lidar/poses.json` is that of a frame on the vehicle 0.3 m above the road with
x right, y forward, z up, at the stated time (the end of the sweep: the front camera, taken 50 ms
earlier, trails it by just that at every speed). Ego is the same frame with x forward and y left.
The scene's world has its origin at the first ego pose read and its x along that heading; its z is
the dataset's up and not the vehicle's, which leans 2 degrees: the road is level in the former.
"""

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.errors import DataError
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.geometry.transforms import invert_rigid, transform_points
from lidarpainter_models.readers.pandaset.boxes import merge_boxes, read_boxes
from lidarpainter_models.readers.pandaset.calibration import (
    CAMERA_NAMES,
    read_camera,
    read_poses,
    read_timestamps,
)
from lidarpainter_models.readers.pandaset.dataframe_pickle import read_table
from lidarpainter_models.readers.source_logs.drive_poses import (
    NS_PER_S,
    level_frame,
    nanoseconds,
    pose_at,
)
from lidarpainter_models.readers.source_logs.folder import SourceFolder
from lidarpainter_models.readers.source_logs.log import chosen_cameras, chosen_frames
from lidarpainter_models.readers.source_logs.swept_boxes import SweepTimes, moving_actors
from lidarpainter_models.scenes.frame_content import FrameContent, SourceImage, SourceSweep
from lidarpainter_models.scenes.records import BoxRecord, ImageRecord, RollingShutter, SweepPoints
from lidarpainter_models.scenes.validation import jpeg_header_size, require_classes
from lidarpainter_models.scenes.writer import SceneHeader

LIDAR_NAMES = ("pandar64", "pandar_gt")
"""Positions are the values of a point's `d`: the spinning and the forward LiDAR."""

_POINT_COLUMNS = ("x", "y", "z", "i", "t", "d")
_MAX_SWEEP_S = 1.0
"""A point farther from the middle of its sweep was not measured in it."""
_LATEST_S = 2**62 / NS_PER_S
_FARTHEST_M = 1e8
"""The Earth's radius is 6.4e6 m."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PandasetPoints:
    """All points of one frame, row by row as in their file."""

    xyz_m: np.ndarray
    """(points, 3) in the dataset's frame, float64."""
    intensity: np.ndarray
    time_s: np.ndarray
    sensor: np.ndarray
    where: str
    """The file, for errors."""

    def sweep(
        self, rows: np.ndarray, xyz_world_m: Float[Tensor, "points 3"], middle_ns: int
    ) -> SweepPoints:
        """The points of one LiDAR, whose rows and middle time are given."""
        offset_ns = np.rint((self.time_s[rows] - middle_ns / NS_PER_S) * NS_PER_S)
        return SweepPoints.of(
            xyz_world_m[torch.from_numpy(rows)],
            intensity=torch.from_numpy(self.intensity[rows].astype(np.float32)),
            time_offset_ns=torch.from_numpy(offset_ns.astype(np.int32)),
        )


def read_points(source: SourceFolder, frame_index: int) -> PandasetPoints:
    """The points of a frame.

    Raises:
        DataError: the table is damaged, or its numbers are no measurement.
    """
    name = f"lidar/{frame_index:02d}.pkl.gz"
    table = read_table(source, name, _POINT_COLUMNS)
    where = str(source.root / name)
    xyz_m = np.stack([table[axis].astype(np.float64, copy=False) for axis in "xyz"], axis=1)
    time_s = table["t"].astype(np.float64, copy=False)
    if not np.isin(table["d"], range(len(LIDAR_NAMES))).any():
        raise DataError(f"{where}: zero points of a known LiDAR, expected at least one")
    if not (np.isfinite(xyz_m).all() and np.isfinite(time_s).all()):
        raise DataError(f"{where}: points or their times are not finite")
    if np.abs(xyz_m).max() > _FARTHEST_M or np.abs(time_s).max() > _LATEST_S:
        raise DataError(f"{where}: a point is farther than the Earth is wide, or at no date")
    if np.abs(time_s - np.median(time_s)).max() > _MAX_SWEEP_S:
        raise DataError(f"{where}: points are more than {_MAX_SWEEP_S} s from their sweep")
    intensity = table["i"]
    if not (np.abs(intensity) <= np.finfo(np.float32).max).all():
        raise DataError(f"{where}: an intensity is not finite")
    return PandasetPoints(
        xyz_m=xyz_m, intensity=intensity, time_s=time_s, sensor=table["d"], where=where
    )


def read_classes(source: SourceFolder, frame_index: int, num_points: int) -> np.ndarray:
    """The class of each point of a frame, uint8.

    Raises:
        DataError: the table is damaged or does not fit the points.
    """
    name = f"annotations/semseg/{frame_index:02d}.pkl.gz"
    classes = read_table(source, name, ("class",))["class"]
    if len(classes) != num_points:
        raise DataError(f"{source.root / name}: {len(classes)} classes for {num_points} points")
    if not ((classes >= 0) & (classes <= np.iinfo(np.uint8).max)).all():
        raise DataError(f"{source.root / name}: a class number is not within 0 to 255")
    return classes.astype(np.uint8)


DATASET = "pandaset"
LICENCE = "CC BY 4.0, PandaSet by Hesai and Scale AI"

# x forward, y left, z up seen from x right, y forward, z up
_VEHICLE_FROM_EGO = torch.tensor(
    [[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], dtype=torch.float64
)
_EGO_FROM_LIDAR_M = ((0.81, 0.0, 1.85), (1.42, 0.0, 1.55))
"""Where the two LiDARs sit on the vehicle.

From the published calibration relative to the front camera; the elevations of the 64 beams fit the
sensor's data sheet best around (0.79, 0.00, 1.865), and the forward LiDAR's rays cross near (1.4,
0.0, 1.6).
"""

_SHUTTER = RollingShutter(duration_s=0.04, direction="down", first_row_s=-0.03)
"""Every camera reads its rows from 30 ms before the time and pose of its image to 10 ms after.

The data set does not say so; neurad-studio's reader of it has these times (Tonderski et al.,
NeuRAD, 2024).
"""


def list_pandaset_sequences(root: Path) -> tuple[str, ...]:
    """Names of the sequences below a root, sorted."""
    return tuple(sorted(file.parent.parent.name for file in Path(root).glob("*/lidar/poses.json")))


class PandasetLog:
    """One sequence; what is needed before its first frame can be written is read at once."""

    dataset = DATASET
    is_drive = True

    def __init__(
        self, root: Path, sequence: str, frames: slice | None, cameras: tuple[str, ...] | None
    ) -> None:
        """Open a sequence, see `open_log`."""
        folder = root / sequence
        self.place, self.sequence = str(folder), sequence
        if not folder.is_dir():
            raise DataError(f"{folder}: no such sequence folder")
        self.source = SourceFolder(folder)
        self.timestamps_ns = read_timestamps(self.source, "lidar")
        num_frames = len(self.timestamps_ns)
        if any(later <= earlier for earlier, later in pairwise(self.timestamps_ns)):
            raise DataError(f"{folder / 'lidar/timestamps.json'}: the times do not ascend")
        self.frame_indices = chosen_frames(num_frames, frames, folder)
        self.global_from_ego = read_poses(self.source, "lidar", num_frames) @ _VEHICLE_FROM_EGO
        self.global_from_world = level_frame(self.global_from_ego[self.frame_indices[0]])
        self.world_from_global = invert_rigid(self.global_from_world)
        self.cameras = {
            name: read_camera(self.source, name, num_frames)
            for name in chosen_cameras(cameras, CAMERA_NAMES, folder)
        }
        self.semantic_classes = _semantic_classes(self.source)
        self.header = SceneHeader(
            licence=LICENCE,
            global_from_world=self.global_from_world,
            semantic_classes=self.semantic_classes,
        )
        boxes = {index: read_boxes(self.source, index) for index in self.frame_indices}
        self.boxes = merge_boxes(boxes)
        self.moving = moving_actors(
            self.boxes, {index: self.timestamps_ns[index] / NS_PER_S for index in boxes}
        )

    def provenance(self) -> dict[str, object]:
        """Where the log lies and what was read of it."""
        return {"root": self.source.root.parent.name, **self.source.provenance()}

    def read_frame(self, frame_index: int) -> FrameContent:
        """Everything of one frame, as the writer takes it."""
        points = read_points(self.source, frame_index)
        classes = (
            read_classes(self.source, frame_index, len(points.xyz_m))
            if self.semantic_classes
            else None
        )
        return FrameContent(
            frame_index=frame_index,
            place=f"{self.place}, frame {frame_index}",
            timestamp_ns=self.timestamps_ns[frame_index],
            world_from_ego=self.world_from_global @ self.global_from_ego[frame_index],
            images=[self._read_image(frame_index, name) for name in self.cameras],
            sweeps=self._sweeps(points, classes),
            boxes=self._boxes(frame_index, points),
        )

    def _read_image(self, frame_index: int, name: str) -> SourceImage:
        file = f"camera/{name}/{frame_index:02d}.jpg"
        jpeg = self.source.read_bytes(file)
        where = str(self.source.root / file)
        width_px, height_px = jpeg_header_size(jpeg, where)
        recorded = self.cameras[name]
        camera = Camera(
            world_from_camera=self.world_from_global @ recorded.global_from_camera[frame_index],
            **recorded.intrinsics,
            shutter=None,
            width_px=width_px,
            height_px=height_px,
        )
        record = ImageRecord(
            camera_name=name,
            timestamp_ns=recorded.timestamps_ns[frame_index],
            camera=camera,
            rolling_shutter=_SHUTTER,
        )
        return SourceImage(record=record, jpeg=jpeg, source=where)

    def _sweeps(self, points: PandasetPoints, classes: np.ndarray | None) -> list[SourceSweep]:
        xyz_world_m = transform_points(self.world_from_global, torch.from_numpy(points.xyz_m))
        xyz_world_m = xyz_world_m.to(torch.float32)
        sweeps = []
        for sensor, lidar_name in enumerate(LIDAR_NAMES):
            rows = np.flatnonzero(points.sensor == sensor)
            if len(rows) == 0:
                continue
            middle_ns = nanoseconds(float(np.median(points.time_s[rows])))
            sweeps.append(
                SourceSweep(
                    lidar_name=lidar_name,
                    points=points.sweep(rows, xyz_world_m, middle_ns),
                    timestamp_ns=middle_ns,
                    world_from_lidar=self.world_from_global
                    @ self._global_from_lidar(middle_ns, sensor),
                    semantics=None if classes is None else torch.from_numpy(classes[rows]),
                    source=points.where,
                )
            )
        return sweeps

    def _boxes(self, frame_index: int, points: PandasetPoints) -> list[BoxRecord]:
        lidar_m = self._global_from_lidar(self.timestamps_ns[frame_index], 0)[:3, 3].numpy()
        times = SweepTimes(points.xyz_m, points.time_s, points.sensor, lidar_m)
        records = []
        for box in self.boxes[frame_index]:
            rows, is_moving = times.inside(box), box.actor_id in self.moving
            stated = self.world_from_global, times.time_of(box, rows), len(rows)
            records.append(box.record(*stated, is_moving=is_moving))
        return records

    def _global_from_lidar(self, timestamp_ns: int, sensor: int) -> Float[Tensor, "4 4"]:
        """Pose of a LiDAR between the ego poses; before the first the motion is continued."""
        global_from_ego = pose_at(self.global_from_ego, self.timestamps_ns, timestamp_ns)
        ego_from_lidar = torch.eye(4, dtype=torch.float64)
        ego_from_lidar[:3, 3] = torch.tensor(_EGO_FROM_LIDAR_M[sensor], dtype=torch.float64)
        return global_from_ego @ ego_from_lidar


def _semantic_classes(source: SourceFolder) -> dict[int, str]:
    """Names of the point classes by number; empty where the log has none."""
    if not (source.root / "annotations/semseg").is_dir():
        return {}
    file = "annotations/semseg/classes.json"
    classes = source.read_json(file, dict)
    if not classes:
        raise DataError(f"{source.root / file}: expected names by class number")
    return require_classes(classes, str(source.root / file))
