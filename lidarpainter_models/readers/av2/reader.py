"""Read sensor logs of Argoverse 2 (Wilson et al., NeurIPS 2021, CC BY-NC-SA 4.0) as downloaded.

`<root>/<log>/`, or `<root>/<split>/<log>/` for a root that holds train, val and test, has
`sensors/cameras/<camera>/<time>.jpg`, `sensors/lidar/<time>.feather` (sweeps.py),
`city_SE3_egovehicle.feather`, `calibration/` and, but for test logs, `annotations.feather`. Times
are nanoseconds in the names of the files, which are their only list.

Every sweep (10 Hz) is a frame. The seven ring cameras and the two stereo cameras take 20 images a
second; a frame has the one nearest to the middle of its turn, the other half is not read.
The shutters are global, so no readout is told. Images are undistorted as published: the devkit, and
with it NCore and neurad-studio, project by fx, fy, cx, cy alone; k1, k2, k3 of the calibration tell
what the lenses were.

Frames. Ego is on the rear axle, x forward, y left, z up; a pose of it is recorded for every image
and sweep and in between. A box is in the ego frame at its sweep's timestamp, around the points as
they lie there: it holds when a LiDAR saw the actor, the median time of the points inside it.
"""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor

from lidarpainter_models.errors import DataError
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.geometry.timed_poses import poses_at
from lidarpainter_models.geometry.transforms import invert_rigid, transform_points
from lidarpainter_models.readers.av2.sweeps import (
    LASERS,
    LIDAR_NAMES,
    Av2Sweep,
    is_upper_first,
    read_sweep,
)
from lidarpainter_models.readers.source_logs.drive_poses import NS_PER_S, level_frame
from lidarpainter_models.readers.source_logs.feather_tables import (
    Kind,
    read_feather,
    stated_poses,
)
from lidarpainter_models.readers.source_logs.folder import SourceFolder
from lidarpainter_models.readers.source_logs.log import chosen_cameras, chosen_frames
from lidarpainter_models.readers.source_logs.sweep_frames import nearest_images
from lidarpainter_models.readers.source_logs.swept_boxes import seen_records, with_motion
from lidarpainter_models.scenes.frame_content import FrameContent, SourceImage, SourceSweep
from lidarpainter_models.scenes.records import BoxRecord, ImageRecord, SweepPoints
from lidarpainter_models.scenes.schema import GLOBAL_FRAME
from lidarpainter_models.scenes.validation import require_name, require_size
from lidarpainter_models.scenes.writer import SceneHeader

DATASET = "av2"
LICENCE = "CC BY-NC-SA 4.0 (non-commercial), Argoverse 2 by Argo AI"
CAMERA_NAMES = (
    *("ring_front_center", "ring_front_left", "ring_front_right", "ring_side_left"),
    *("ring_side_right", "ring_rear_left", "ring_rear_right"),
    *("stereo_front_left", "stereo_front_right"),
)
HALF_TURN_NS = 50_000_000
MAX_BEYOND_NS = 100_000_000
"""A sweep that begins so long before the first pose or after the last has none."""
_POSE: dict[str, Kind] = dict.fromkeys(("qw", "qx", "qy", "qz"), "number")
_POSE |= {f"t{axis}_m": "number" for axis in "xyz"}
_LENS = ("fx_px", "fy_px", "cx_px", "cy_px")
_SIZE = ("length_m", "width_m", "height_m")
_TIME = re.compile(r"[1-9][0-9]{0,17}|[1-3][0-9]{18}")
"""Nanoseconds that 62 bits hold."""
_POSES, _ANNOTATIONS = "city_SE3_egovehicle.feather", "annotations.feather"


def list_av2_logs(root: Path) -> tuple[str, ...]:
    """Names of the logs at a root or one folder below it, sorted."""
    found = (file for pattern in ("*", "*/*") for file in Path(root).glob(f"{pattern}/{_POSES}"))
    return tuple(sorted({file.parent.name for file in found}))


@dataclass(frozen=True, kw_only=True, eq=False)
class Av2Camera:
    """Where a camera sits, through what it looks, and when."""

    ego_from_camera: Float[Tensor, "4 4"]
    intrinsics: dict[str, float]
    width_px: int
    height_px: int
    images_ns: Int64[np.ndarray, " images"]


class Av2Log:
    """One log; tables are read at once, sweeps and images frame by frame."""

    dataset = DATASET
    is_drive = True

    def __init__(
        self, root: Path, sequence: str, frames: slice | None, cameras: tuple[str, ...] | None
    ) -> None:
        """Open a log, see `open_log`."""
        folder = _log_folder(root, sequence)
        self.place, self.sequence, self.source = str(folder), sequence, SourceFolder(folder)
        self._poses_ns, self._city_from_ego = self._read_poses()
        self._sweeps_ns = _times(folder / "sensors/lidar", ".feather")
        if not len(self._sweeps_ns):
            raise DataError(f"{folder / 'sensors/lidar'}: no sweep, expected TIME.feather")
        self._require_poses()
        self.frame_indices = chosen_frames(len(self._sweeps_ns), frames, folder)
        self._ego_from_sensor = self._read_sensors()
        self._cameras = self._read_cameras(cameras)
        city_from_ego = self._pose_at(int(self._sweeps_ns[self.frame_indices[0]]))
        self.global_from_world = level_frame(city_from_ego)
        self._world_from_city = invert_rigid(self.global_from_world)
        self.header = SceneHeader(
            licence=LICENCE, global_from_world=self.global_from_world, more=_global_frame(folder)
        )
        self._boxes = with_motion(self._read_boxes())
        self._images = {
            name: nearest_images(
                self._sweeps_ns + HALF_TURN_NS, camera.images_ns, reach_ns=HALF_TURN_NS
            )
            for name, camera in self._cameras.items()
        }
        self._is_upper_first: bool | None = None

    def read_frame(self, frame_index: int) -> FrameContent:
        """Everything of one frame, as the writer takes it."""
        time_ns = int(self._sweeps_ns[frame_index])
        sweep = read_sweep(self.source, f"sensors/lidar/{time_ns}.feather")
        world_from_ego = self._world_from_city @ self._pose_at(time_ns)
        xyz_m = transform_points(world_from_ego, torch.from_numpy(sweep.xyz_m)).to(torch.float32)
        lidar_m = (world_from_ego @ self._ego_from_sensor[LIDAR_NAMES[0]])[:3, 3].numpy()
        return FrameContent(
            frame_index=frame_index,
            place=f"{self.place}, frame {frame_index}",
            timestamp_ns=time_ns,
            world_from_ego=world_from_ego,
            images=[
                self._read_image(name, int(camera.images_ns[self._images[name][frame_index]]))
                for name, camera in self._cameras.items()
                if self._images[name][frame_index] >= 0
            ],
            sweeps=self._split(sweep, xyz_m, time_ns),
            boxes=seen_records(
                self._boxes.get(time_ns, []), xyz_m, sweep.offset_ns, time_ns, lidar_m
            ),
        )

    def provenance(self) -> dict[str, object]:
        """The log's folder and what was read of it."""
        return {"root": self.source.root.parent.name, **self.source.provenance()}

    def _pose_at(self, time_ns: int) -> Float[Tensor, "4 4"]:
        return poses_at(self._city_from_ego, self._poses_ns, np.array([time_ns]))[0]

    def _read_poses(self) -> tuple[np.ndarray, Float[Tensor, "poses 4 4"]]:
        """Times and poses of the car, ascending, each time once."""
        table = read_feather(self.source, _POSES, {"timestamp_ns": "whole", **_POSE})
        times_ns, rows = np.unique(table["timestamp_ns"], return_index=True)
        if not len(times_ns):
            raise DataError(f"{self.source.root / _POSES}: no pose, expected at least one")
        poses = stated_poses(table, str(self.source.root / _POSES))
        return times_ns, poses[torch.from_numpy(rows)]

    def _require_poses(self) -> None:
        first_ns, last_ns = self._poses_ns[0] - MAX_BEYOND_NS, self._poses_ns[-1] + MAX_BEYOND_NS
        for time_ns in self._sweeps_ns[[0, -1]].tolist():
            if not first_ns <= time_ns <= last_ns:
                raise DataError(
                    f"{self.place}/sensors/lidar/{time_ns}.feather: no pose in {_POSES} within "
                    f"{MAX_BEYOND_NS / NS_PER_S} s, expected one for every sweep"
                )

    def _read_sensors(self) -> dict[str, Float[Tensor, "4 4"]]:
        name = "calibration/egovehicle_SE3_sensor.feather"
        table = read_feather(self.source, name, {"sensor_name": "text", **_POSE})
        poses = stated_poses(table, str(self.source.root / name))
        found = dict(zip(table["sensor_name"].tolist(), poses, strict=True))
        for lidar in LIDAR_NAMES:
            if lidar not in found:
                raise DataError(f"{self.source.root / name}: no row of {lidar}")
        return found

    def _read_cameras(self, wanted: tuple[str, ...] | None) -> dict[str, Av2Camera]:
        name = "calibration/intrinsics.feather"
        columns: dict[str, Kind] = {"sensor_name": "text", "width_px": "whole"}
        columns |= {"height_px": "whole", **dict.fromkeys(_LENS, "number")}
        table = read_feather(self.source, name, columns)
        rows = {sensor: row for row, sensor in enumerate(table["sensor_name"].tolist())}
        folder = self.source.root / "sensors/cameras"
        known = [camera for camera in CAMERA_NAMES if (folder / camera).is_dir()]
        cameras = {}
        for camera in chosen_cameras(wanted, known, folder):
            if camera not in rows or camera not in self._ego_from_sensor:
                raise DataError(f"{self.source.root / name}: {camera} is in no calibration")
            row = rows[camera]
            cameras[camera] = Av2Camera(
                ego_from_camera=self._ego_from_sensor[camera],
                intrinsics={column: float(table[column][row]) for column in _LENS},
                width_px=int(table["width_px"][row]),
                height_px=int(table["height_px"][row]),
                images_ns=_times(folder / camera, ".jpg"),
            )
        return cameras

    def _read_boxes(self) -> dict[int, list[BoxRecord]]:
        """The boxes by the timestamp of their sweep; none where the log is not annotated."""
        if not (self.source.root / _ANNOTATIONS).is_file():
            return {}
        columns: dict[str, Kind] = {"timestamp_ns": "whole", "track_uuid": "text"}
        columns |= {"category": "text", **dict.fromkeys(_SIZE, "number"), **_POSE}
        table = read_feather(self.source, _ANNOTATIONS, columns)
        where = str(self.source.root / _ANNOTATIONS)
        times_ns = table["timestamp_ns"]
        chosen = np.flatnonzero(np.isin(times_ns, self._sweeps_ns[self.frame_indices]))
        city_from_ego = poses_at(self._city_from_ego, self._poses_ns, times_ns[chosen])
        ego_from_box = stated_poses(table, where)[torch.from_numpy(chosen)]
        poses = self._world_from_city @ city_from_ego @ ego_from_box
        found: dict[int, list[BoxRecord]] = {}
        for row, pose in zip(chosen.tolist(), poses, strict=True):
            length_m, width_m, height_m = (float(table[column][row]) for column in _SIZE)
            size_m = (length_m, width_m, height_m)
            require_size(size_m, f"{where}, row {row}")
            box = BoxRecord(
                actor_id=require_name(table["track_uuid"][row], f"{where}, row {row}: actor"),
                category=table["category"][row],
                timestamp_ns=int(times_ns[row]),
                world_from_box=pose,
                size_m=size_m,
                is_moving=False,
                num_points=0,
            )
            found.setdefault(box.timestamp_ns, []).append(box)
        return found

    def _read_image(self, name: str, time_ns: int) -> SourceImage:
        file, recorded = f"sensors/cameras/{name}/{time_ns}.jpg", self._cameras[name]
        world_from_ego = self._world_from_city @ self._pose_at(time_ns)
        camera = Camera(
            world_from_camera=world_from_ego @ recorded.ego_from_camera,
            **recorded.intrinsics,
            shutter=None,
            width_px=recorded.width_px,
            height_px=recorded.height_px,
        )
        record = ImageRecord(camera_name=name, timestamp_ns=time_ns, camera=camera)
        jpeg = self.source.read_bytes(file)
        return SourceImage(record=record, jpeg=jpeg, source=str(self.source.root / file))

    def _split(
        self, sweep: Av2Sweep, xyz_m: Float[Tensor, "points 3"], time_ns: int
    ) -> list[SourceSweep]:
        """The sweep of each LiDAR, dated to the middle of the turn of both."""
        if self._is_upper_first is None:
            self._is_upper_first = is_upper_first(sweep, self._ego_from_sensor)
        middle_ns = time_ns + sweep.middle_ns
        world_from_ego = self._world_from_city @ self._pose_at(middle_ns)
        parts = []
        for name in LIDAR_NAMES:
            is_first = (name == LIDAR_NAMES[0]) == self._is_upper_first
            rows = np.flatnonzero((sweep.laser < LASERS) == is_first)
            if not len(rows):
                continue
            offset_ns = (sweep.offset_ns[rows] - sweep.middle_ns).astype(np.int32)
            points = SweepPoints.of(
                xyz_m[torch.from_numpy(rows)],
                intensity=torch.from_numpy(sweep.intensity[rows].astype(np.float32)),
                time_offset_ns=torch.from_numpy(offset_ns),
                ring=torch.from_numpy((sweep.laser[rows] % LASERS).astype(np.int16)),
            )
            parts.append(
                SourceSweep(
                    lidar_name=name,
                    points=points,
                    timestamp_ns=middle_ns,
                    world_from_lidar=world_from_ego @ self._ego_from_sensor[name],
                    source=sweep.where,
                )
            )
        return parts


def _log_folder(root: Path, sequence: str) -> Path:
    folders = [path.parent for path in Path(root).glob(f"*/{sequence}/{_POSES}")]
    folders += [root / sequence] if (root / sequence / _POSES).is_file() else []
    if len(folders) != 1:
        how = "in several splits" if folders else "in no folder of its own"
        raise DataError(f"{root}: log {sequence} lies {how}, expected {sequence}/{_POSES} once")
    return folders[0]


def _times(folder: Path, suffix: str) -> Int64[np.ndarray, " files"]:
    """The times in the names of a folder's files, ascending; other files are none of the log."""
    found = (path.stem for path in folder.glob(f"*{suffix}") if _TIME.fullmatch(path.stem))
    return np.array(sorted(map(int, found)), dtype=np.int64)


def _global_frame(folder: Path) -> dict[str, str]:
    """The name of the city that poses are in, which the file of the map has in its own."""
    for file in sorted(folder.glob("map/log_map_archive_*.json")):
        city = file.stem.split("____")[-1].split("_")[0]
        if re.fullmatch(r"[A-Z]{3}", city):
            return {GLOBAL_FRAME: f"av2-{city}"}
    return {}
