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

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.errors import DataError
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.geometry.transforms import invert_rigid, transform_points
from lidarpainter_models.scenes.readers.dataframe_pickle import Table
from lidarpainter_models.scenes.readers.pandaset_boxes import (
    BOX_NUMBERS,
    BOX_TEXTS,
    SweepTimes,
    merge_boxes,
    moving_actors,
)
from lidarpainter_models.scenes.readers.pandaset_calibration import (
    CAMERA_NAMES,
    NS_PER_S,
    level_frame,
    nanoseconds,
    pose_at,
    read_camera,
    read_poses,
    read_timestamps,
    turned_about_up,
)
from lidarpainter_models.scenes.readers.source_folder import SourceFolder
from lidarpainter_models.scenes.records import BoxRecord, ImageRecord, SweepPoints
from lidarpainter_models.scenes.validation import (
    jpeg_header_size,
    require_name,
    require_pose,
    require_size,
)
from lidarpainter_models.scenes.writer import SceneHeader, SceneWriter

DATASET = "pandaset"
LICENCE = "CC BY 4.0, PandaSet by Hesai and Scale AI"
LIDAR_NAMES = ("pandar64", "pandar_gt")
"""Positions are the values of a point's `d`: the spinning and the forward LiDAR."""
Progress = Callable[[int, int], None]
"""Told frames done and frames in all."""

_POINT_COLUMNS = ("x", "y", "z", "i", "t", "d")
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
_MAX_SWEEP_S = 1.0
"""A point farther from the middle of its sweep was not measured in it."""


def list_pandaset_sequences(root: Path) -> tuple[str, ...]:
    """Names of the sequences below a root, sorted."""
    return tuple(sorted(file.parent.parent.name for file in Path(root).glob("*/lidar/poses.json")))


def read_pandaset(
    root: Path,
    sequence: str,
    store: Path,
    *,
    frames: slice | None = None,
    cameras: tuple[str, ...] | None = None,
    progress: Progress | None = None,
) -> Path:
    """Write one sequence into the store as a canonical scene; gives the scene's path.

    Args:
        root: the folder that holds the sequences.
        sequence: a folder name below the root.
        store: where scenes live.
        frames: which frames to take, by position; all of them if None.
        cameras: which cameras to take, by name; all of them if None.
        progress: told after every frame.

    Raises:
        DataError: something in the log is missing, damaged or makes no sense.
        StorageError: the store cannot be written.
    """
    require_name(sequence, "sequence")
    log = _PandasetLog(Path(root) / sequence, frames, cameras)
    header = SceneHeader(
        licence=LICENCE,
        global_from_world=log.global_from_world,
        semantic_classes=log.semantic_classes,
    )
    with SceneWriter(store, DATASET, sequence, header) as writer:
        for done, frame_index in enumerate(log.frame_indices, start=1):
            log.write_frame(writer, frame_index)
            if progress is not None:
                progress(done, len(log.frame_indices))
        writer.set_provenance({"root": str(root), **log.source.provenance()})
    return writer.path


class _PandasetLog:
    """One sequence; what is needed before its first frame can be written is read at once."""

    def __init__(self, folder: Path, frames: slice | None, cameras: tuple[str, ...] | None) -> None:
        if not folder.is_dir():
            raise DataError(f"{folder}: no such sequence folder")
        self.source = SourceFolder(folder)
        self.timestamps_ns = read_timestamps(self.source, "lidar")
        num_frames = len(self.timestamps_ns)
        self.frame_indices = _selected(num_frames, frames, folder)
        self.global_from_ego = read_poses(self.source, "lidar", num_frames) @ _VEHICLE_FROM_EGO
        self.global_from_world = level_frame(self.global_from_ego[self.frame_indices[0]])
        self.world_from_global = invert_rigid(self.global_from_world)
        self.cameras = {
            name: read_camera(self.source, name, num_frames) for name in _cameras(cameras, folder)
        }
        self.semantic_classes = self._semantic_classes()
        boxes = {
            index: self.source.read_table(_boxes_file(index), BOX_NUMBERS, texts=BOX_TEXTS)
            for index in self.frame_indices
        }
        self.boxes = merge_boxes(boxes)
        self.moving = moving_actors(
            self.boxes, {index: self.timestamps_ns[index] / NS_PER_S for index in boxes}
        )

    def write_frame(self, writer: SceneWriter, frame_index: int) -> None:
        """Everything of one frame."""
        writer.add_frame(
            frame_index,
            timestamp_ns=self.timestamps_ns[frame_index],
            world_from_ego=self.world_from_global @ self.global_from_ego[frame_index],
        )
        for name in self.cameras:
            self._write_image(writer, frame_index, name)
        table, xyz_m = self._read_points(frame_index)
        self._write_sweeps(writer, frame_index, table, xyz_m)
        self._write_boxes(writer, frame_index, table, xyz_m)

    def _write_image(self, writer: SceneWriter, frame_index: int, name: str) -> None:
        file = f"camera/{name}/{frame_index:02d}.jpg"
        jpeg = self.source.read_bytes(file)
        where = str(self.source.root / file)
        width_px, height_px = jpeg_header_size(jpeg, where)
        recorded = self.cameras[name]
        camera = Camera(
            world_from_camera=self.world_from_global @ recorded.global_from_camera[frame_index],
            **recorded.intrinsics,
            width_px=width_px,
            height_px=height_px,
        )
        record = ImageRecord(
            camera_name=name, timestamp_ns=recorded.timestamps_ns[frame_index], camera=camera
        )
        writer.add_image(record, jpeg, source=where)

    def _read_points(self, frame_index: int) -> tuple[Table, np.ndarray]:
        """The table of points of a frame and their positions in the dataset's frame, float64."""
        name = f"lidar/{frame_index:02d}.pkl.gz"
        table = self.source.read_table(name, _POINT_COLUMNS)
        where = self.source.root / name
        xyz_m = np.stack([table[axis] for axis in "xyz"], axis=1)
        if not np.isin(table["d"], range(len(LIDAR_NAMES))).any():
            raise DataError(f"{where}: zero points of a known LiDAR, expected at least one")
        if not (np.isfinite(xyz_m).all() and np.isfinite(table["t"]).all()):
            raise DataError(f"{where}: points or their times are not finite")
        if np.abs(table["t"] - np.median(table["t"])).max() > _MAX_SWEEP_S:
            raise DataError(f"{where}: points are more than {_MAX_SWEEP_S} s from their sweep")
        return table, xyz_m

    def _write_sweeps(
        self, writer: SceneWriter, frame_index: int, table: Table, xyz_m: np.ndarray
    ) -> None:
        classes = self._read_classes(frame_index, len(xyz_m))
        xyz_world_m = transform_points(self.world_from_global, torch.from_numpy(xyz_m))
        for sensor, lidar_name in enumerate(LIDAR_NAMES):
            rows = np.flatnonzero(table["d"] == sensor)
            if len(rows) == 0:
                continue
            time_s = table["t"][rows]
            middle_ns = nanoseconds(float(np.median(time_s)))
            offset_ns = np.rint((time_s - middle_ns / NS_PER_S) * NS_PER_S).astype(np.int32)
            count = len(rows)
            points = SweepPoints(
                xyz_m=xyz_world_m[rows].to(torch.float32),
                intensity=torch.from_numpy(table["i"][rows].astype(np.float32)),
                time_offset_ns=torch.from_numpy(offset_ns),
                ring=torch.full((count,), -1, dtype=torch.int16),
                return_index=torch.zeros(count, dtype=torch.int8),
                lidar=torch.full((count,), sensor, dtype=torch.uint8),
            )
            writer.add_sweep(
                lidar_name,
                points,
                timestamp_ns=middle_ns,
                world_from_lidar=self.world_from_global
                @ self._global_from_lidar(middle_ns, sensor),
                semantics=None if classes is None else torch.from_numpy(classes[rows]),
            )

    def _write_boxes(
        self, writer: SceneWriter, frame_index: int, table: Table, xyz_m: np.ndarray
    ) -> None:
        lidar_m = self._global_from_lidar(self.timestamps_ns[frame_index], 0)[:3, 3].numpy()
        times = SweepTimes(xyz_m, table["t"], table["d"], lidar_m)
        file = self.source.root / _boxes_file(frame_index)
        for box in self.boxes[frame_index]:
            where = f"{file}, {box.category} {box.actor_id}"
            require_size(box.size_m, where)
            global_from_box = turned_about_up(box.yaw_rad, torch.from_numpy(box.centre_m))
            require_pose(global_from_box, where)
            rows = times.inside(box)
            writer.add_box(
                BoxRecord(
                    actor_id=box.actor_id,
                    category=box.category,
                    timestamp_ns=nanoseconds(times.time_of(box, rows)),
                    world_from_box=self.world_from_global @ global_from_box,
                    size_m=box.size_m,
                    is_moving=box.actor_id in self.moving,
                    num_points=len(rows),
                )
            )

    def _read_classes(self, frame_index: int, num_points: int) -> np.ndarray | None:
        if not self.semantic_classes:
            return None
        name = f"annotations/semseg/{frame_index:02d}.pkl.gz"
        classes = self.source.read_table(name, ("class",))["class"]
        if len(classes) != num_points:
            raise DataError(
                f"{self.source.root / name}: {len(classes)} classes for {num_points} points"
            )
        if classes.min() < 0 or classes.max() > np.iinfo(np.uint8).max:
            raise DataError(f"{self.source.root / name}: a class number is not within 0 to 255")
        return classes.astype(np.uint8)

    def _global_from_lidar(self, timestamp_ns: int, sensor: int) -> Float[Tensor, "4 4"]:
        """Pose of a LiDAR between the ego poses; before the first the motion is continued."""
        global_from_ego = pose_at(self.global_from_ego, self.timestamps_ns, timestamp_ns)
        ego_from_lidar = torch.eye(4, dtype=torch.float64)
        ego_from_lidar[:3, 3] = torch.tensor(_EGO_FROM_LIDAR_M[sensor], dtype=torch.float64)
        return global_from_ego @ ego_from_lidar

    def _semantic_classes(self) -> dict[int, str]:
        if not (self.source.root / "annotations/semseg").is_dir():
            return {}
        file = "annotations/semseg/classes.json"
        classes = self.source.read_json(file, dict)
        if not classes or not all(number.isdigit() for number in classes):
            raise DataError(f"{self.source.root / file}: expected names by class number")
        return {int(number): str(name) for number, name in classes.items()}


def _selected(num_frames: int, frames: slice | None, folder: Path) -> list[int]:
    chosen = list(range(num_frames))[frames or slice(None)]
    if not chosen:
        raise DataError(f"{folder}: the frames asked for select none of its {num_frames} frames")
    return chosen


def _cameras(wanted: tuple[str, ...] | None, folder: Path) -> tuple[str, ...]:
    for name in wanted or ():
        if name not in CAMERA_NAMES:
            raise DataError(
                f"{folder}: no camera {name!r}, expected some of {', '.join(CAMERA_NAMES)}"
            )
    return CAMERA_NAMES if wanted is None else tuple(dict.fromkeys(wanted))


def _boxes_file(frame_index: int) -> str:
    return f"annotations/cuboids/{frame_index:02d}.pkl.gz"
