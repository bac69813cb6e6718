"""What a fit sees of a scene: training images at fit size, sparse depth, sky masks, LiDAR map.

Prepared once and stored, so that a fit reads no dataset. Only training views and the sweeps of
training frames enter. Frames: world (z up) and camera (x right, y down, z forward); metres.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields
from typing import Any

import cv2
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from lidarpainter_models.errors import ConfigError, SceneError
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.lidar.lidar_map import LidarMap, MapPoints, build_lidar_map
from lidarpainter_models.lidar.sky_masks import sky_mask
from lidarpainter_models.lidar.sparse_depth import (
    SparseDepthConfig,
    move_actor_points,
    sparse_lidar_depth,
)
from lidarpainter_models.observations.stored_tracks import COLUMNS as TRACK_COLUMNS
from lidarpainter_models.observations.stored_tracks import tracks_from_arrays, tracks_to_arrays
from lidarpainter_models.scenes.driving_scene import ActorTrack, DrivingScene, RecordedView
from lidarpainter_models.scenes.records import ViewKey
from lidarpainter_models.scenes.splits import ViewSplit

SCHEMA = 1
_LENS = ("fx_px", "fy_px", "cx_px", "cy_px", "width_px", "height_px")


@dataclass(frozen=True, slots=True, kw_only=True)
class ObservationConfig:
    """How recordings are prepared for a fit."""

    width_px: int = 480
    """Fit width; the height keeps each camera's aspect ratio."""
    depth: SparseDepthConfig = field(default_factory=SparseDepthConfig)

    def __post_init__(self) -> None:
        """Refuse images too small for the SSIM window."""
        if self.width_px < 32:
            raise ConfigError(f"width_px must be at least 32, got {self.width_px}")


@dataclass(frozen=True, kw_only=True, eq=False)
class TrainingView:
    """One recorded image that a fit may use."""

    key: ViewKey
    camera: Camera
    """As recorded, at fit size."""
    timestamp_ns: int
    rgb_u8: UInt8[Tensor, "height width 3"]
    sky_mask: Bool[Tensor, "height width"]
    lidar_depth_m: Float[Tensor, "height width"]
    """The own frame's sweeps, 0 where no point falls."""

    @property
    def rgb(self) -> Float[Tensor, "height width 3"]:
        """The image as floats."""
        return self.rgb_u8.float() / 255


@dataclass(frozen=True, kw_only=True, eq=False)
class GuidanceView:
    """One painted image of a view nobody recorded."""

    camera: Camera
    """Where the image was painted; it is never corrected."""
    timestamp_ns: int
    rgb: Float[Tensor, "height width 3"]
    weight: Float[Tensor, "height width"]
    """Confidence per pixel, 0 to 1."""
    lidar_depth_m: Float[Tensor, "height width"]
    """Sparse LiDAR depth in this view, 0 where there is none."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SceneObservations:
    """All that a fit sees."""

    views: tuple[TrainingView, ...]
    lidar_map: LidarMap
    tracks: tuple[ActorTrack, ...]
    """Moving actors only."""

    @property
    def camera_names(self) -> tuple[str, ...]:
        """Cameras that have training views, sorted."""
        return tuple(sorted({view.key[1] for view in self.views}))

    def to_arrays(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Arrays and JSON-able metadata; `from_arrays` is the inverse, bit for bit."""
        track_arrays, track_records = tracks_to_arrays(self.tracks)
        arrays = {f"tracks.{name}": value for name, value in track_arrays.items()}
        actor_ids = sorted(self.lidar_map.actors)
        parts = [self.lidar_map.street, *(self.lidar_map.actors[name] for name in actor_ids)]
        for index, part in enumerate(parts):
            for column in fields(MapPoints):
                arrays[f"map.{index}.{column.name}"] = getattr(part, column.name).contiguous()
        records = []
        for index, view in enumerate(self.views):
            for name in ("rgb_u8", "sky_mask", "lidar_depth_m"):
                arrays[f"view.{index}.{name}"] = getattr(view, name).contiguous()
            arrays[f"view.{index}.world_from_camera"] = view.camera.world_from_camera.contiguous()
            lens = {name: getattr(view.camera, name) for name in _LENS}
            records.append({"key": list(view.key), "timestamp_ns": view.timestamp_ns, "lens": lens})
        metadata = {
            "schema": SCHEMA,
            "views": records,
            "tracks": track_records,
            "map_actors": actor_ids,
        }
        return arrays, metadata

    @classmethod
    def from_arrays(
        cls, arrays: dict[str, Tensor], metadata: dict[str, Any]
    ) -> "SceneObservations":
        """Rebuild stored observations.

        Raises:
            SceneError: they were written by another version.
        """
        if metadata.get("schema") != SCHEMA:
            raise SceneError(
                f"stored observations have schema {metadata.get('schema')}, this version reads "
                f"{SCHEMA}: prepare them again"
            )
        tracks = tracks_from_arrays(
            {name: arrays[f"tracks.{name}"] for name in TRACK_COLUMNS}, metadata["tracks"]
        )
        parts = [
            MapPoints(
                **{
                    column.name: arrays[f"map.{index}.{column.name}"]
                    for column in fields(MapPoints)
                }
            )
            for index in range(len(metadata["map_actors"]) + 1)
        ]
        actors = dict(zip(metadata["map_actors"], parts[1:], strict=True))
        views = [_stored_view(arrays, index, row) for index, row in enumerate(metadata["views"])]
        return cls(
            views=tuple(views), lidar_map=LidarMap(street=parts[0], actors=actors), tracks=tracks
        )


def _stored_view(arrays: dict[str, Tensor], index: int, record: dict[str, Any]) -> TrainingView:
    """One view of stored observations."""
    frame_index, camera_name = record["key"]
    return TrainingView(
        key=(int(frame_index), str(camera_name)),
        camera=Camera(
            world_from_camera=arrays[f"view.{index}.world_from_camera"], **record["lens"]
        ),
        timestamp_ns=record["timestamp_ns"],
        rgb_u8=arrays[f"view.{index}.rgb_u8"],
        sky_mask=arrays[f"view.{index}.sky_mask"],
        lidar_depth_m=arrays[f"view.{index}.lidar_depth_m"],
    )


def shrink_image(
    rgb_u8: UInt8[Tensor, "height width 3"], *, width_px: int, height_px: int
) -> UInt8[Tensor, "rows columns 3"]:
    """Area-averaged copy of an image."""
    if rgb_u8.shape[:2] == (height_px, width_px):
        return rgb_u8
    small = cv2.resize(rgb_u8.numpy(), (width_px, height_px), interpolation=cv2.INTER_AREA)
    return torch.from_numpy(small)


def fit_camera(view: RecordedView, config: ObservationConfig) -> Camera:
    """The view's camera at fit size; images are never enlarged."""
    width_px = min(config.width_px, view.camera.width_px)
    height_px = max(round(view.camera.height_px * width_px / view.camera.width_px), 1)
    return view.camera.resized(width_px=width_px, height_px=height_px)


def view_lidar_depth(
    scene: DrivingScene,
    view: RecordedView,
    camera: Camera,
    tracks: Sequence[ActorTrack],
    config: SparseDepthConfig,
) -> Float[Tensor, "height width"]:
    """Sparse depth in `camera` from the sweeps of the view's frame, actors at its exposure."""
    clouds = [
        move_actor_points(
            scene.read_sweep(sweep).xyz_m,
            tracks,
            from_ns=sweep.timestamp_ns,
            to_ns=view.timestamp_ns,
        )
        for sweep in scene.sweeps
        if sweep.frame_index == view.frame_index
    ]
    points = torch.cat(clouds) if clouds else torch.zeros(0, 3)
    return sparse_lidar_depth(points, camera, config=config)


def prepare_observations(
    scene: DrivingScene,
    split: ViewSplit,
    config: ObservationConfig,
    *,
    progress: Callable[[int, int], None] | None = None,
) -> SceneObservations:
    """Read everything that a fit on the split's training views needs.

    Args:
        scene: where it is read from.
        split: its training views give images, its training frames give sweeps.
        config: see there.
        progress: told after each view how many of how many are done.

    Raises:
        SceneError: the split has no training views.
    """
    if not split.train:
        raise SceneError(f"the split of {scene.dataset}/{scene.sequence} has no training views")
    moving = tuple(track for track in scene.tracks if track.is_moving)
    views = []
    for done, recorded in enumerate(split.train, start=1):
        camera = fit_camera(recorded, config)
        size = {"width_px": camera.width_px, "height_px": camera.height_px}
        views.append(
            TrainingView(
                key=recorded.key,
                camera=camera,
                timestamp_ns=recorded.timestamp_ns,
                rgb_u8=shrink_image(scene.read_image(recorded), **size),
                sky_mask=sky_mask(scene, recorded, camera),
                lidar_depth_m=view_lidar_depth(scene, recorded, camera, moving, config.depth),
            )
        )
        if progress is not None:
            progress(done, len(split.train))
    lidar_map = build_lidar_map(scene, split_frames=split.train_frames, colour_views=split.train)
    return SceneObservations(views=tuple(views), lidar_map=lidar_map, tracks=moving)
