"""Write a scene in its canonical form, frame by frame, whole or not at all.

Every reader and the synthetic street write through `SceneWriter`. It checks all it is given, keeps
no more than a chunk of each array in memory, and puts the scene in place only when it is complete:
`<store>/scenes/<dataset>/<sequence>/` (schema.py names what lies there).
"""

import json
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Integer
from torch import Tensor

from lidarpainter_models.errors import DataError, SceneError
from lidarpainter_models.geometry.transforms import is_rigid
from lidarpainter_models.scenes import schema
from lidarpainter_models.scenes.array_writer import create_arrays
from lidarpainter_models.scenes.records import BoxRecord, ImageRecord, SweepPoints
from lidarpainter_models.scenes.stored import content_digest, stored_digest, write_table
from lidarpainter_models.scenes.validation import (
    require_jpeg,
    require_label,
    require_lens,
    require_name,
    require_points,
    require_pose,
    require_shutter,
    require_size,
    require_start,
    require_time,
)
from lidarpainter_models.storage.whole_files import storage_errors
from lidarpainter_models.storage.whole_folders import AsideFolder


@dataclass(frozen=True, kw_only=True, eq=False)
class SceneHeader:
    """What is true of a whole scene."""

    licence: str
    """Of the data, with the attribution it asks for."""
    global_from_world: Float[Tensor, "4 4"]
    """The dataset's own frame from the scene's world, float64."""
    semantic_classes: Mapping[int, str] = field(default_factory=dict)
    """Names of the point classes; empty where the dataset has none."""
    more: Mapping[str, Any] = field(default_factory=dict)
    """Further JSON-able entries of the manifest that belong to the content (`generator`)."""


class SceneWriter:
    """Context manager: leaving it normally publishes the scene, an exception leaves nothing.

    Frames come in ascending order; images, sweeps and boxes belong to the frame added last.
    """

    def __init__(self, store: Path, dataset: str, sequence: str, header: SceneHeader) -> None:
        require_name(dataset, "dataset")
        require_name(sequence, "sequence")
        require_pose(header.global_from_world, f"{dataset}/{sequence}: global_from_world")
        self.path = Path(store) / "scenes" / dataset / sequence
        self._name = f"{dataset}/{sequence}"
        self._identity = {"dataset": dataset, "sequence": sequence}
        self._header = header
        self._rows: dict[str, list[dict[str, Any]]] = {name: [] for name in schema.TABLES}
        self._camera_names: list[str] = []
        self._lidar_names: list[str] = []
        self._seen: set[tuple[str, int, str]] = set()
        self._box_frames: dict[tuple[str, int], int] = {}  # by actor and time
        self._provenance: Mapping[str, Any] = {}

    def __enter__(self) -> "SceneWriter":
        self._aside = AsideFolder(self.path)
        layouts = [
            layout
            for layout in schema.ARRAYS.values()
            if not layout.is_optional or self._header.semantic_classes
        ]
        self._writing = ThreadPoolExecutor(1, thread_name_prefix="writing")
        try:
            with storage_errors(self.path):
                self._arrays = create_arrays(
                    self._aside.path / schema.ARRAYS_NAME, layouts, self._writing
                )
        except BaseException:
            self._discard()
            raise
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if kind is not None:
            self._discard()
            return
        try:
            self._require_complete()
            with storage_errors(self.path):
                digest = self._write_manifest()
                self._writing.shutdown()
                if digest == stored_digest(self.path):
                    self._aside.discard()  # whoever reads the equal scene there reads on
                else:
                    self._aside.publish()
        except BaseException:
            self._discard()
            raise

    def _discard(self) -> None:
        self._writing.shutdown(cancel_futures=True)  # it must not write into what is removed
        self._aside.discard()

    def add_frame(
        self, frame_index: int, *, timestamp_ns: int, world_from_ego: Float[Tensor, "4 4"]
    ) -> None:
        """Begin a frame: everything added next belongs to it."""
        where = f"{self._name}, frame {frame_index}"
        require_pose(world_from_ego, f"{where}, ego")
        require_time(timestamp_ns, where)
        frames = self._rows["frames"]
        if not frames:
            require_start(world_from_ego, f"{where}, ego")
        if frames and (
            frame_index <= frames[-1]["frame_index"] or timestamp_ns <= frames[-1]["timestamp_ns"]
        ):
            raise DataError(
                f"{where}: at {timestamp_ns} ns, expected a later frame and time than frame "
                f"{frames[-1]['frame_index']} at {frames[-1]['timestamp_ns']} ns"
            )
        frames.append(
            {
                "frame_index": frame_index,
                "timestamp_ns": timestamp_ns,
                "world_from_ego": _flat(world_from_ego),
            }
        )

    def add_image(self, record: ImageRecord, jpeg: bytes, *, source: str | None = None) -> None:
        """Store one image of the current frame as its original JPEG bytes.

        Errors in the bytes name `source`, the file they came from, if it is given.
        """
        frame_index, where = self._place(record.camera_name, "camera")
        camera = record.camera
        size_px = {"width_px": camera.width_px, "height_px": camera.height_px}
        require_jpeg(jpeg, **size_px, where=source or where)
        require_pose(camera.world_from_camera, where)
        require_time(record.timestamp_ns, where)
        require_lens(camera, record.distortion, where)
        require_shutter(record.rolling_shutter, where)
        with storage_errors(self.path):
            offset = self._arrays["image_bytes"].append(np.frombuffer(jpeg, np.uint8))
        if record.camera_name not in self._camera_names:
            self._camera_names.append(record.camera_name)
        shutter = record.rolling_shutter
        self._rows["cameras"].append(
            {
                "frame_index": frame_index,
                "camera": record.camera_name,
                "timestamp_ns": record.timestamp_ns,
                "world_from_camera": _flat(camera.world_from_camera),
                **{name: float(getattr(camera, name)) for name in _INTRINSICS},
                "distortion_model": record.distortion.model,
                "distortion_terms": list(record.distortion.terms),
                "width_px": camera.width_px,
                "height_px": camera.height_px,
                "rolling_shutter_s": shutter.duration_s if shutter else None,
                "rolling_shutter_direction": shutter.direction if shutter else None,
                "rolling_shutter_first_row_s": shutter.first_row_s if shutter else None,
                "offset": offset,
                "num_bytes": len(jpeg),
            }
        )

    def add_sweep(
        self,
        lidar_name: str,
        points: SweepPoints,
        *,
        timestamp_ns: int,
        world_from_lidar: Float[Tensor, "4 4"],
        semantics: Integer[Tensor, " points"] | None = None,
        source: str | None = None,
    ) -> None:
        """Store one LiDAR sweep of the current frame; `points.lidar` is set by its name.

        Errors in the points name `source`, the file they came from, if it is given.
        """
        frame_index, where = self._place(lidar_name, "lidar")
        require_pose(world_from_lidar, where)
        require_time(timestamp_ns, where)
        require_points(points.xyz_m.numpy(), source or where)
        if (semantics is not None) != bool(self._header.semantic_classes):
            raise DataError(f"{where}: point classes and their names must come together")
        if lidar_name not in self._lidar_names:
            if len(self._lidar_names) == schema.MAX_LIDARS:
                raise DataError(f"{where}: one LiDAR too many, expected {schema.MAX_LIDARS}")
            self._lidar_names.append(lidar_name)
        columns = {
            "point_xyz_m": points.xyz_m,
            "point_intensity": points.intensity,
            "point_time_offset_ns": points.time_offset_ns,
            "point_ring": points.ring,
            "point_return": points.return_index,
            "point_lidar": torch.full_like(points.lidar, self._lidar_names.index(lidar_name)),
        }
        if semantics is not None:
            columns["point_semantics"] = semantics
        if len({len(column) for column in columns.values()}) != 1:
            raise DataError(f"{where}: the columns of the points differ in length")
        with storage_errors(self.path):
            offsets = {
                name: self._arrays[name].append(column.numpy()) for name, column in columns.items()
            }
        self._rows["sweeps"].append(
            {
                "frame_index": frame_index,
                "lidar": lidar_name,
                "timestamp_ns": timestamp_ns,
                "world_from_lidar": _flat(world_from_lidar),
                "offset": offsets["point_xyz_m"],
                "num_points": points.num_points,
            }
        )

    def add_box(self, box: BoxRecord) -> None:
        """Store one box of the current frame."""
        self.add_boxes([box])

    def add_boxes(self, boxes: Sequence[BoxRecord]) -> None:
        """Store boxes of the current frame; many at once are checked faster than one by one."""
        if not boxes:
            return
        are_rigid = is_rigid(torch.stack([box.world_from_box for box in boxes])).tolist()
        for box, is_sound in zip(boxes, are_rigid, strict=True):
            frame_index, where = self._place(box.actor_id, "actor")
            if not is_sound:
                require_pose(box.world_from_box, where)
            require_size(box.size_m, where)
            require_label(box.category, where)
            require_time(box.timestamp_ns, where)
            earlier = self._box_frames.setdefault((box.actor_id, box.timestamp_ns), frame_index)
            if earlier != frame_index:
                told = f"its box has the time {box.timestamp_ns} ns of the one in frame {earlier}"
                raise DataError(f"{where}: {told}, expected each label once, at its own time")
            length_m, width_m, height_m = box.size_m
            self._rows["boxes"].append(
                {
                    "frame_index": frame_index,
                    "actor_id": box.actor_id,
                    "category": box.category,
                    "timestamp_ns": box.timestamp_ns,
                    "world_from_box": _flat(box.world_from_box),
                    "length_m": length_m,
                    "width_m": width_m,
                    "height_m": height_m,
                    "is_moving": box.is_moving,
                    "num_points": box.num_points,
                }
            )

    def set_provenance(self, provenance: Mapping[str, Any]) -> None:
        """Note in the manifest what the scene was made from (JSON-able; no part of its digest)."""
        self._provenance = provenance

    def _place(self, name: str, kind: str) -> tuple[int, str]:
        """Frame being written and the place to name in errors; each sensor once a frame."""
        require_name(name, kind)
        if not self._rows["frames"]:
            raise SceneError(f"{self._name}: add_frame must come before {kind} {name}")
        frame_index = self._rows["frames"][-1]["frame_index"]
        where = f"{self._name}, frame {frame_index}, {kind} {name}"
        if (kind, frame_index, name) in self._seen:
            raise DataError(f"{where}: given twice, expected once a frame")
        self._seen.add((kind, frame_index, name))
        return frame_index, where

    def _require_complete(self) -> None:
        for table, what in (("frames", "frames"), ("cameras", "images")):
            if not self._rows[table]:
                raise DataError(f"{self._name}: zero {what}, expected at least one")

    def _write_manifest(self) -> str:
        folder = self._aside.path
        arrays = {name: array.finish() for name, array in self._arrays.items()}
        tables = {
            name: write_table(folder, name, self._rows[name], self._name) for name in schema.TABLES
        }
        content = {
            "schema_version": schema.SCHEMA_VERSION,
            **self._identity,
            "global_from_world": _flat(self._header.global_from_world),
            "camera_names": self._camera_names,
            "lidar_names": self._lidar_names,
            "semantic_classes": {str(k): v for k, v in self._header.semantic_classes.items()},
            **self._header.more,
            "tables": tables,
            "arrays": arrays,
        }
        manifest = {
            **content,
            "licence": self._header.licence,
            "provenance": self._provenance,
            "software_version": _software_version(),
            "counts": self._counts(),
            "content_digest": content_digest(content),
            "files": {
                path.relative_to(folder).as_posix(): path.stat().st_size
                for path in sorted(folder.rglob("*"))
                if path.is_file() and not path.name.startswith(".")
            },
            "is_complete": True,
        }
        (folder / schema.MANIFEST_NAME).write_text(json.dumps(manifest, indent=1) + "\n", "utf-8")
        return manifest["content_digest"]

    def _counts(self) -> dict[str, int]:
        return {
            "frames": len(self._rows["frames"]),
            "images": len(self._rows["cameras"]),
            "sweeps": len(self._rows["sweeps"]),
            "points": self._arrays["point_xyz_m"].num_rows,
            "boxes": len(self._rows["boxes"]),
            "actors": len({row["actor_id"] for row in self._rows["boxes"]}),
        }


_INTRINSICS = ("fx_px", "fy_px", "cx_px", "cy_px")


def _flat(target_from_source: Float[Tensor, "4 4"]) -> list[float]:
    return target_from_source.to(torch.float64).reshape(16).tolist()


def _software_version() -> str:
    try:
        return version("lidarpainter")
    except PackageNotFoundError:
        return "not installed"
