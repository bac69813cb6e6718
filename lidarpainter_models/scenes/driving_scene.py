"""A driving scene in its canonical form, whatever dataset it came from.

World: x forward, y left, z up, origin at the first ego pose. A `DrivingScene` is a lazy handle: the
tables are in memory, images and points are read when asked for.
"""

import copy
from collections.abc import Collection, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow as pa
import torch
from jaxtyping import Float, Int, Shaped, UInt8
from torch import Tensor

from lidarpainter_models.errors import SceneError
from lidarpainter_models.geometry.cameras import Camera, Shutter
from lidarpainter_models.geometry.driven_paths import DrivenPath
from lidarpainter_models.geometry.transforms import rigid_from_tangent, transform_points
from lidarpainter_models.scenes.ego_corrections import EgoCorrections
from lidarpainter_models.scenes.image_bytes import decode_image
from lidarpainter_models.scenes.own_boxes import own_places, without_own_boxes
from lidarpainter_models.scenes.records import (
    Distortion,
    ImageRecord,
    RecordedView,
    RollingShutter,
    Sweep,
    SweepPoints,
)
from lidarpainter_models.scenes.schema import NO_POSES, POSES
from lidarpainter_models.scenes.shutters import recorded_shutters
from lidarpainter_models.scenes.stored import Fetch, StoredScene
from lidarpainter_models.scenes.tracks import ActorTrack, tracks_from_boxes
from lidarpainter_models.scenes.undistortion import pinhole_of, undistort

__all__ = ["ActorTrack", "DrivingScene", "RecordedView", "Sweep", "SweepPoints"]

_POINT_COLUMNS = {
    "xyz_m": "point_xyz_m",
    "intensity": "point_intensity",
    "time_offset_ns": "point_time_offset_ns",
    "ring": "point_ring",
    "return_index": "point_return",
    "lidar": "point_lidar",
}


class DrivingScene:
    """One stored sequence: poses, images, sweeps and actor tracks."""

    def __init__(self, stored: StoredScene) -> None:
        """Take the tables into memory; `DrivingScene.open` is the usual way in."""
        self._stored = stored
        self.path = stored.path
        self.manifest: dict[str, Any] = stored.manifest
        self.dataset: str = self.manifest["dataset"]
        self.sequence: str = self.manifest["sequence"]
        self.content_digest: str = self.manifest["content_digest"]
        """Same digest, same content: what derived work is keyed by."""
        self.camera_names: tuple[str, ...] = tuple(self.manifest["camera_names"])
        self.lidar_names: tuple[str, ...] = tuple(self.manifest["lidar_names"])
        self.semantic_classes: dict[int, str] = {
            int(number): name for number, name in self.manifest["semantic_classes"].items()
        }
        """Names of the point classes; empty where the dataset has none."""
        frames = stored.table("frames")
        self.frame_indices: tuple[int, ...] = tuple(frames["frame_index"].to_pylist())
        self.frame_timestamps_ns = torch.tensor(frames["timestamp_ns"].to_pylist())
        self.world_from_ego: Float[Tensor, "frames 4 4"] = _poses(frames, "world_from_ego")
        self.corrections = EgoCorrections.none()
        """What `corrected` has moved; nothing of a scene as it was opened."""
        self._read_tables()

    @classmethod
    def open(cls, path: Path, fetch: Fetch | None = None) -> "DrivingScene":
        """Open the scene at a path.

        `fetch` brings files there before they are read; None if all are there.

        Raises:
            SceneError: there is no scene, or it is incomplete or damaged.
        """
        return cls(StoredScene(Path(path), fetch))

    @property
    def global_from_world(self) -> Float[Tensor, "4 4"]:
        """The dataset's own frame from the world, float64."""
        return torch.tensor(self.manifest["global_from_world"], dtype=torch.float64).reshape(4, 4)

    @property
    def has_poses(self) -> bool:
        """Whether it is known where the car drove; else all is in the car's frame of its time."""
        return self.manifest.get(POSES) != NO_POSES

    def frame_position(self, frame_index: int) -> int:
        """Position of a frame in `frame_indices` and its tensors."""
        try:
            return self.frame_indices.index(frame_index)
        except ValueError:
            raise SceneError(
                f"{self.path}: no frame {frame_index}; frames go from {self.frame_indices[0]} "
                f"to {self.frame_indices[-1]}"
            ) from None

    def views_of(self, camera_name: str) -> tuple[RecordedView, ...]:
        """The images of one camera, frame by frame.

        Raises:
            SceneError: the scene has no such camera.
        """
        if camera_name not in self.camera_names:
            raise SceneError(
                f"{self.path}: no camera {camera_name!r}; it has {', '.join(self.camera_names)}"
            )
        return tuple(view for view in self.views if view.camera_name == camera_name)

    def view(self, frame_index: int, camera_name: str) -> RecordedView:
        """One image by frame and camera."""
        for view in self.views_of(camera_name):
            if view.frame_index == frame_index:
                return view
        raise SceneError(f"{self.path}: camera {camera_name!r} has no frame {frame_index}")

    def read_image(self, view: RecordedView) -> UInt8[Tensor, "height width 3"]:
        """The recorded image as RGB bytes; a distorted lens is undone."""
        image = decode_image(self.read_jpeg(view))
        if image is None:
            raise SceneError(f"{self.path}: the image {view.key} cannot be decoded")
        image = cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
        record = self._images[view.index]
        shown = undistort(image, record.camera, record.distortion, view.camera)
        return torch.from_numpy(shown)

    def read_jpeg(self, view: RecordedView) -> bytes:
        """The recorded image as the camera's own JPEG bytes."""
        offset, num_bytes = self._image_ranges[view.index]
        return self._stored.read_rows("image_bytes", offset, num_bytes).tobytes()

    def image_record(self, view: RecordedView) -> ImageRecord:
        """What is stored of the image itself: through which lens it was taken, undone or not."""
        return self._images[view.index]

    def is_stored_undistorted(self, view: RecordedView) -> bool:
        """Whether the camera's own bytes show what `read_image` gives."""
        return self._images[view.index].distortion.model == "none"

    def read_sweep(self, sweep: Sweep) -> SweepPoints:
        """The points of one sweep, in the world."""
        return SweepPoints(**{name: self.read_column(sweep, name) for name in _POINT_COLUMNS})

    def read_column(self, sweep: Sweep, name: str) -> Shaped[Tensor, "points *_"]:
        """One field of `read_sweep`, for whoever needs no other."""
        array = _POINT_COLUMNS[name]
        values = torch.from_numpy(self._stored.read_rows(array, sweep.offset, sweep.num_points))
        if name == "xyz_m" and len(self.corrections):
            return transform_points(self.corrections.at(sweep.timestamp_ns).to(values), values)
        return values

    def measured_ns(self, sweep: Sweep) -> Int[Tensor, " points"]:
        """When each point of a sweep was measured."""
        return sweep.timestamp_ns + self.read_column(sweep, "time_offset_ns").to(torch.int64)

    def has_lidar(self, frame_indices: Collection[int]) -> bool:
        """Whether a LiDAR swept in any of these frames."""
        return any(sweep.frame_index in frame_indices for sweep in self.sweeps)

    @property
    def swept_frames(self) -> list[int]:
        """Frames that have a LiDAR sweep, ascending."""
        return sorted({sweep.frame_index for sweep in self.sweeps})

    def sweeps_of(self, frame_index: int) -> tuple[Sweep, ...]:
        """The sweeps of all LiDARs in one frame."""
        return tuple(sweep for sweep in self.sweeps if sweep.frame_index == frame_index)

    def read_points(self, frame_index: int) -> SweepPoints:
        """The points of all LiDARs of one frame; time offsets are those of each own sweep."""
        sweeps = self._sweeps_required(frame_index)
        return SweepPoints.concatenate([self.read_sweep(sweep) for sweep in sweeps])

    def read_positions(self, frame_index: int) -> Float[Tensor, "points 3"]:
        """Where the points of `read_points` are, for whoever needs no more."""
        sweeps = self._sweeps_required(frame_index)
        return torch.cat([self.read_column(sweep, "xyz_m") for sweep in sweeps])

    def read_semantics(self, frame_index: int) -> UInt8[Tensor, " points"] | None:
        """Class of each point of `read_points`, or None where the dataset has no classes."""
        if not self._stored.has_array("point_semantics"):
            return None
        parts = [
            self._stored.read_rows("point_semantics", sweep.offset, sweep.num_points)
            for sweep in self._sweeps_required(frame_index)
        ]
        return torch.from_numpy(np.concatenate(parts))

    def corrected(self, corrections: EgoCorrections) -> "DrivingScene":
        """The same log with everything moved to where it was, for a scene as it was opened.

        Cameras, sweeps, their points, boxes and the car itself are; images are the same.
        """
        if not len(corrections):
            return self
        moved = copy.copy(self)
        moved.corrections = corrections
        moved.world_from_ego = corrections.at_times(self.frame_timestamps_ns) @ self.world_from_ego
        moved.views = corrections.of_views(self.views)
        moved.sweeps = tuple(
            replace(
                sweep, world_from_lidar=corrections.at(sweep.timestamp_ns) @ sweep.world_from_lidar
            )
            for sweep in self.sweeps
        )
        moved.tracks = tuple(map(corrections.of_track, self.tracks))
        return moved

    def verify_content(self) -> None:
        """Read the whole scene and compare it with its digests (SceneError where it differs)."""
        self._stored.verify_content()

    def _sweeps_required(self, frame_index: int) -> tuple[Sweep, ...]:
        sweeps = self.sweeps_of(frame_index)
        if not sweeps:
            raise SceneError(f"{self.path}: frame {frame_index} has no LiDAR sweep")
        return sweeps

    def _read_tables(self) -> None:
        cameras = self._stored.table("cameras")
        rows = cameras.drop_columns(["world_from_camera"]).to_pylist()
        poses = _poses(cameras, "world_from_camera")
        shutters = recorded_shutters(rows, poses)
        self._image_ranges = [(row["offset"], row["num_bytes"]) for row in rows]
        self._images = [
            image_of_row(row, pose, shutter)
            for row, pose, shutter in zip(rows, poses, shutters, strict=True)
        ]
        self.views: tuple[RecordedView, ...] = tuple(
            _recorded_view(row["frame_index"], record, index)
            for index, (row, record) in enumerate(zip(rows, self._images, strict=True))
        )
        sweeps = self._stored.table("sweeps")
        poses = _poses(sweeps, "world_from_lidar")
        self.sweeps: tuple[Sweep, ...] = tuple(
            Sweep(
                frame_index=row["frame_index"],
                lidar_name=row["lidar"],
                timestamp_ns=row["timestamp_ns"],
                world_from_lidar=pose,
                offset=row["offset"],
                num_points=row["num_points"],
            )
            for row, pose in zip(sweeps.to_pylist(), poses, strict=True)
        )
        boxes = self._stored.table("boxes")
        columns = boxes.drop_columns(["world_from_box"]).to_pydict()
        ego = driven_road(self)
        self.tracks: tuple[ActorTrack, ...]
        self.tracks, self.own_boxes = without_own_boxes(
            tracks_from_boxes(columns, _poses(boxes, "world_from_box")),
            own_places(self.views, self.sweeps, ego),
            ego,
        )


def _poses(table: pa.Table, column: str) -> Float[Tensor, "rows 4 4"]:
    flat = table[column].combine_chunks().flatten().to_numpy(zero_copy_only=False)
    return torch.from_numpy(np.array(flat, dtype=np.float64)).reshape(-1, 4, 4)


def image_of_row(
    row: Mapping[str, Any], world_from_camera: Float[Tensor, "4 4"], shutter: Shutter | None = None
) -> ImageRecord:
    """What a row of the table of images says of one; `shutter` is how its camera moved."""
    read = ("duration_s", "direction", "first_row_s")
    columns = ("rolling_shutter_s", "rolling_shutter_direction", "rolling_shutter_first_row_s")
    told = {name: row[column] for name, column in zip(read, columns, strict=True)}
    lens = ("fx_px", "fy_px", "cx_px", "cy_px", "width_px", "height_px")
    return ImageRecord(
        camera_name=row["camera"],
        timestamp_ns=row["timestamp_ns"],
        camera=Camera(
            world_from_camera=world_from_camera,
            shutter=shutter,
            **{name: row[name] for name in lens},
        ),
        distortion=Distortion(row["distortion_model"], tuple(row["distortion_terms"])),
        rolling_shutter=None if told["duration_s"] is None else RollingShutter(**told),
    )


def _recorded_view(frame_index: int, record: ImageRecord, index: int) -> RecordedView:
    """The view when and where the middle row of its image was read."""
    camera = record.camera
    middle_s = record.rolling_shutter.middle_s if record.rolling_shutter else 0.0
    if middle_s and camera.shutter:
        moved = rigid_from_tangent(middle_s * camera.shutter.twist_per_s)
        camera = replace(camera, world_from_camera=camera.world_from_camera @ moved)
    return RecordedView(
        frame_index=frame_index,
        camera_name=record.camera_name,
        timestamp_ns=record.timestamp_ns + round(1e9 * middle_s),
        camera=pinhole_of(camera, record.distortion),
        index=index,
    )


def driven_road(scene: DrivingScene) -> DrivenPath:
    """The way the car drove."""
    return DrivenPath(timestamps_ns=scene.frame_timestamps_ns, world_from_body=scene.world_from_ego)
