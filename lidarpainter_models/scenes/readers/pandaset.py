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

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.errors import DataError
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.geometry.transforms import (
    interpolate_rigid,
    invert_rigid,
    rigid_from_rotation,
    rotation_from_quaternion,
    transform_points,
)
from lidarpainter_models.scenes.readers.dataframe_pickle import Table
from lidarpainter_models.scenes.readers.pandaset_boxes import (
    BOX_COLUMNS,
    SourceBox,
    SweepTimes,
    merge_boxes,
    moving_actors,
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

_NS_PER_S = 1_000_000_000
_POINT_COLUMNS = ("x", "y", "z", "i", "t", "d")
# x forward, y left, z up seen from x right, y forward, z up
_VEHICLE_FROM_EGO = torch.tensor(
    [[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], dtype=torch.float64
)
_EGO_FROM_LIDAR_M = ((0.81, 0.0, 1.85), (1.42, 0.0, 1.55))
"""Where the two LiDARs sit on the vehicle."""


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
    """The parts of a sequence that are needed before its first frame can be written."""

    def __init__(self, folder: Path, frames: slice | None, cameras: tuple[str, ...] | None) -> None:
        if not folder.is_dir():
            raise DataError(f"{folder}: no such sequence folder")
        self.source = SourceFolder(folder)
        self.timestamps_ns = self._timestamps("lidar")
        self.frame_indices = _selected(len(self.timestamps_ns), frames, folder)
        global_from_vehicle = self._poses("lidar")
        self.global_from_ego = global_from_vehicle @ _VEHICLE_FROM_EGO
        self.global_from_world = level_frame(self.global_from_ego[self.frame_indices[0]])
        self.world_from_global = invert_rigid(self.global_from_world)
        self.camera_names = self._camera_names(cameras)
        self.cameras = {name: self._camera(name) for name in self.camera_names}
        self.semantic_classes = self._semantic_classes()
        tables = {
            index: self.source.read_table(f"annotations/cuboids/{index:02d}.pkl.gz", BOX_COLUMNS)
            for index in self.frame_indices
        }
        self.boxes = merge_boxes(tables)
        self.moving = moving_actors(
            self.boxes, {index: self.timestamps_ns[index] / _NS_PER_S for index in tables}
        )

    def write_frame(self, writer: SceneWriter, frame_index: int) -> None:
        """Everything of one frame."""
        writer.add_frame(
            frame_index,
            timestamp_ns=self.timestamps_ns[frame_index],
            world_from_ego=self.world_from_global @ self.global_from_ego[frame_index],
        )
        for name in self.camera_names:
            self._write_image(writer, frame_index, name)
        table, xyz_m = self._read_points(frame_index)
        self._write_sweeps(writer, frame_index, table, xyz_m)
        self._write_boxes(writer, frame_index, table, xyz_m)

    def _write_image(self, writer: SceneWriter, frame_index: int, name: str) -> None:
        file = f"camera/{name}/{frame_index:02d}.jpg"
        jpeg = self.source.read_bytes(file)
        where = str(self.source.root / file)
        width_px, height_px = jpeg_header_size(jpeg, where)
        poses, timestamps_ns, intrinsics = self.cameras[name]
        camera = Camera(
            world_from_camera=self.world_from_global @ poses[frame_index],
            **intrinsics,
            width_px=width_px,
            height_px=height_px,
        )
        record = ImageRecord(
            camera_name=name, timestamp_ns=timestamps_ns[frame_index], camera=camera
        )
        writer.add_image(record, jpeg, source=where)

    def _read_points(self, frame_index: int) -> tuple[Table, np.ndarray]:
        """The table of points of a frame and their positions in the dataset's frame, float64."""
        name = f"lidar/{frame_index:02d}.pkl.gz"
        table = self.source.read_table(name, _POINT_COLUMNS)
        xyz_m = np.stack([table[axis].astype(np.float64) for axis in "xyz"], axis=1)
        if len(xyz_m) == 0:
            raise DataError(f"{self.source.root / name}: zero points, expected at least one")
        if not (np.isfinite(xyz_m).all() and np.isfinite(table["t"]).all()):
            raise DataError(f"{self.source.root / name}: points or their times are not finite")
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
            middle_ns = _nanoseconds(float(np.median(time_s)))
            offset_ns = np.rint((time_s - middle_ns / _NS_PER_S) * _NS_PER_S).astype(np.int32)
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
        file = self.source.root / f"annotations/cuboids/{frame_index:02d}.pkl.gz"
        for box in self.boxes[frame_index]:
            where = f"{file}, {box.category} {box.actor_id}"
            require_size(box.size_m, where)
            global_from_box = _box_pose(box)
            require_pose(global_from_box, where)
            rows = times.inside(box)
            writer.add_box(
                BoxRecord(
                    actor_id=box.actor_id,
                    category=box.category,
                    timestamp_ns=_nanoseconds(times.time_of(box, rows)),
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
        return classes.astype(np.uint8)

    def _global_from_lidar(self, timestamp_ns: int, sensor: int) -> Float[Tensor, "4 4"]:
        """Pose of a LiDAR between the ego poses; before the first the motion is continued."""
        global_from_ego = _pose_at(self.global_from_ego, self.timestamps_ns, timestamp_ns)
        ego_from_lidar = torch.eye(4, dtype=torch.float64)
        ego_from_lidar[:3, 3] = torch.tensor(_EGO_FROM_LIDAR_M[sensor], dtype=torch.float64)
        return global_from_ego @ ego_from_lidar

    def _camera_names(self, wanted: tuple[str, ...] | None) -> tuple[str, ...]:
        folder = self.source.root / "camera"
        if not folder.is_dir():
            raise DataError(f"{folder}: the camera folder is missing")
        known = tuple(sorted(path.name for path in folder.iterdir() if path.is_dir()))
        if not known:
            raise DataError(f"{folder}: no camera in it")
        for name in wanted or ():
            if name not in known:
                raise DataError(f"{folder}: no camera {name!r}; it has {', '.join(known)}")
        return known if wanted is None else tuple(dict.fromkeys(wanted))

    def _camera(self, name: str) -> tuple[Tensor, list[int], dict[str, float]]:
        file = f"camera/{name}/intrinsics.json"
        values = self.source.read_json(file, dict)
        where = str(self.source.root / file)
        intrinsics = {f"{key}_px": _number(values, key, where) for key in ("fx", "fy", "cx", "cy")}
        if min(intrinsics["fx_px"], intrinsics["fy_px"]) <= 0:
            raise DataError(f"{where}: focal lengths must be positive")
        return self._poses(f"camera/{name}"), self._timestamps(f"camera/{name}"), intrinsics

    def _timestamps(self, folder: str) -> list[int]:
        file = f"{folder}/timestamps.json"
        where = str(self.source.root / file)
        values = self.source.read_json(file, list)
        if not values or not all(_is_number(value) for value in values):
            raise DataError(f"{where}: expected a list of times in seconds")
        return self._one_per_frame([_nanoseconds(value) for value in values], where)

    def _poses(self, folder: str) -> Float[Tensor, "frames 4 4"]:
        file = f"{folder}/poses.json"
        where = str(self.source.root / file)
        entries = self._one_per_frame(self.source.read_json(file, list), where)
        return torch.stack(
            [_pose(entry, f"{where}, frame {index}") for index, entry in enumerate(entries)]
        )

    def _one_per_frame(self, values: list, where: str) -> list:
        expected = len(getattr(self, "timestamps_ns", values))
        if len(values) != expected:
            raise DataError(f"{where}: {len(values)} entries, expected {expected}, one per frame")
        return values

    def _semantic_classes(self) -> dict[int, str]:
        if not (self.source.root / "annotations/semseg").is_dir():
            return {}
        classes = self.source.read_json("annotations/semseg/classes.json", dict)
        return {int(number): str(name) for number, name in classes.items()}


def level_frame(global_from_ego: Float[Tensor, "4 4"]) -> Float[Tensor, "4 4"]:
    """A frame at the ego's place whose x is its heading in the level plane and z is up."""
    heading_rad = torch.atan2(global_from_ego[1, 0], global_from_ego[0, 0])
    return rigid_from_rotation(_about_up(float(heading_rad)), global_from_ego[:3, 3])


def _about_up(angle_rad: float) -> Float[Tensor, "3 3"]:
    cosine, sine = math.cos(angle_rad), math.sin(angle_rad)
    return torch.tensor([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]], dtype=torch.float64)


def _box_pose(box: SourceBox) -> Float[Tensor, "4 4"]:
    return rigid_from_rotation(_about_up(box.yaw_rad), torch.from_numpy(box.centre_m))


def _pose(entry: Any, where: str) -> Float[Tensor, "4 4"]:  # noqa: ANN401
    if not isinstance(entry, dict):
        raise DataError(f"{where}: expected a position and a heading")
    position, heading = entry.get("position"), entry.get("heading")
    if not (isinstance(position, dict) and isinstance(heading, dict)):
        raise DataError(f"{where}: expected a position and a heading")
    translation = torch.tensor([_number(position, axis, where) for axis in "xyz"]).double()
    rotation_wxyz = torch.tensor([_number(heading, axis, where) for axis in "wxyz"]).double()
    if not 0.99 < float(rotation_wxyz.norm()) < 1.01:
        raise DataError(f"{where}: the heading is not a unit quaternion")
    return rigid_from_rotation(rotation_from_quaternion(rotation_wxyz), translation)


def _pose_at(
    global_from_ego: Float[Tensor, "frames 4 4"], timestamps_ns: list[int], timestamp_ns: int
) -> Float[Tensor, "4 4"]:
    if len(timestamps_ns) == 1:
        return global_from_ego[0]
    after = int(np.clip(np.searchsorted(timestamps_ns, timestamp_ns), 1, len(timestamps_ns) - 1))
    start_ns, end_ns = timestamps_ns[after - 1], timestamps_ns[after]
    fraction = (timestamp_ns - start_ns) / (end_ns - start_ns)
    return interpolate_rigid(
        global_from_ego[after - 1],
        global_from_ego[after],
        torch.tensor(fraction, dtype=torch.float64),
    )


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _number(values: dict[str, Any], key: str, where: str) -> float:
    value = values.get(key)
    if not _is_number(value):
        raise DataError(f"{where}: {key} is {value!r}, expected a finite number")
    return float(value)


def _nanoseconds(time_s: float) -> int:
    return round(time_s * _NS_PER_S)


def _selected(num_frames: int, frames: slice | None, folder: Path) -> list[int]:
    chosen = list(range(num_frames))[frames or slice(None)]
    if not chosen:
        raise DataError(f"{folder}: the frames asked for select none of its {num_frames} frames")
    return chosen
