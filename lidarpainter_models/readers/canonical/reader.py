"""Bring a scene folder that was written elsewhere into the store (docs/canonical-format.md).

The folder is checked before a library opens any of it (canonical_checks.py), then everything is
read once and compared with the digests of its manifest, then written anew, frame by frame, through
the same `SceneWriter` as every dataset: poses, lenses, points, images and names are held to the
same rules, and nothing that the format does not know is carried over. The scene keeps the dataset
and sequence of its own manifest.
"""

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch

from lidarpainter_models.errors import DataError
from lidarpainter_models.readers.canonical.checks import read_foreign_manifest, read_small_json
from lidarpainter_models.readers.source_logs.log import chosen_cameras, chosen_frames, naming
from lidarpainter_models.scenes import schema
from lidarpainter_models.scenes.driving_scene import image_of_row
from lidarpainter_models.scenes.frame_content import FrameContent, SourceImage, SourceSweep
from lidarpainter_models.scenes.records import BoxRecord, SweepPoints
from lidarpainter_models.scenes.rewriting import FURTHER_ENTRIES
from lidarpainter_models.scenes.stored import StoredScene
from lidarpainter_models.scenes.validation import SHUTTER_DIRECTIONS, require_name, require_pose
from lidarpainter_models.scenes.writer import SceneHeader

MAX_SPEED_MPS = 500.0
"""Of any vehicle: eight times what the doctor takes for a car."""
_MAX_JPEG_BYTES = 64_000_000
_MAX_SWEEP_POINTS = 10_000_000
_STRETCHES = (("cameras", "num_bytes", "image_bytes"), ("sweeps", "num_points", "point_xyz_m"))
"""Tables whose rows are stretches of an array, and the column with their lengths."""


def list_canonical_scenes(root: Path) -> tuple[str, ...]:
    """Names of the scene folders below a root, sorted; the root's own if it is one."""
    if (root / schema.MANIFEST_NAME).is_file():
        return (root.resolve().name,)
    return tuple(sorted(file.parent.name for file in root.glob(f"*/{schema.MANIFEST_NAME}")))


def own_scene_id(root: Path, sequence: str) -> str:
    """The dataset and sequence that the manifest of a scene folder says; nothing else is read.

    Raises:
        DataError: there is no manifest, or it says no names.
    """
    file = _scene_folder(root, sequence) / schema.MANIFEST_NAME
    manifest = read_small_json(file)
    names = (str(manifest.get(key, "")) for key in ("dataset", "sequence"))
    return "/".join(require_name(name, f"{file}: dataset or sequence") for name in names)


def _require_possible_speeds(frames: Sequence[dict[str, Any]], folder: Path) -> None:
    """Refuse times in another unit, which make a car faster than a rocket."""
    for before, after in pairwise(frames):
        way = _pose(after["world_from_ego"])[:3, 3] - _pose(before["world_from_ego"])[:3, 3]
        moved_m = float(way.norm())
        seconds = (after["timestamp_ns"] - before["timestamp_ns"]) * 1e-9
        if moved_m > MAX_SPEED_MPS * seconds > 0:
            raise DataError(
                f"{folder / 'frames.parquet'}: from frame {before['frame_index']} to "
                f"{after['frame_index']} the ego moves {moved_m:.2f} m in {seconds:.3g} s, "
                f"expected {MAX_SPEED_MPS:.0f} m/s at most: are the times in nanoseconds?"
            )


def _scene_folder(root: Path, sequence: str) -> Path:
    is_scene = (root / schema.MANIFEST_NAME).is_file() and root.resolve().name == sequence
    return root if is_scene else root / sequence


class ForeignScene:
    """The tables of a checked scene folder, by frame."""

    is_drive = False

    def __init__(
        self, root: Path, sequence: str, frames: slice | None, cameras: tuple[str, ...] | None
    ) -> None:
        """Check one scene folder, all of it, see `open_log`; the root may be the folder itself."""
        self.folder = _scene_folder(root, sequence)
        if not self.folder.is_dir():
            raise DataError(f"{self.folder}: no such scene folder")
        self.place = str(self.folder)
        with naming(self.place):
            self._open(frames, cameras)

    def _open(self, frames: slice | None, cameras: tuple[str, ...] | None) -> None:
        folder = self.folder
        self.manifest = read_foreign_manifest(folder)
        self.dataset, self.sequence = self.manifest["dataset"], self.manifest["sequence"]
        self.stored = StoredScene(folder)
        self.stored.verify_content()
        self._require_own_stretches()
        used = chosen_cameras(cameras, self.manifest["camera_names"], folder)
        all_frames = self.stored.table("frames").to_pylist()
        known = {row["frame_index"] for row in all_frames}
        self._rows = {name: self._by_frame(name, known) for name in ("cameras", "sweeps", "boxes")}
        self._rows["cameras"] = {
            frame: [row for row in rows if row["camera"] in used]
            for frame, rows in self._rows["cameras"].items()
        }
        _require_possible_speeds(all_frames, folder)
        chosen = [all_frames[i] for i in chosen_frames(len(all_frames), frames, folder)]
        self.frames = {row["frame_index"]: row for row in chosen}
        self.frame_indices = list(self.frames)
        self.header = SceneHeader(
            licence=self.manifest["licence"],
            global_from_world=require_pose(
                _pose(self.manifest["global_from_world"]), f"{folder}: global_from_world"
            ),
            semantic_classes={
                int(number): name for number, name in self.manifest["semantic_classes"].items()
            },
            more={k: self.manifest[k] for k in FURTHER_ENTRIES if k in self.manifest},
        )

    def provenance(self) -> dict[str, object]:
        """Where the scene lay, and the digest of its content."""
        digest = str(self.manifest.get("content_digest"))[:64]
        return {"root": self.folder.name, "content_digest": digest}

    def read_frame(self, frame_index: int) -> FrameContent:
        """Everything of one frame, as the writer takes it."""
        row = self.frames[frame_index]
        return FrameContent(
            frame_index=frame_index,
            place=self.place,
            timestamp_ns=row["timestamp_ns"],
            world_from_ego=_pose(row["world_from_ego"]),
            images=[self._image(found) for found in self._rows["cameras"].get(frame_index, [])],
            sweeps=[self._sweep(found) for found in self._rows["sweeps"].get(frame_index, [])],
            boxes=[self._box(found) for found in self._rows["boxes"].get(frame_index, [])],
        )

    def _require_own_stretches(self) -> None:
        """Refuse rows that share bytes or points: a small folder would become a large scene."""
        for table, column, array in _STRETCHES:
            lengths = self.stored.table(table)[column].to_pylist()
            total = sum(max(0, count) for count in lengths)
            length = self.manifest["arrays"][array]["shape"][0]
            if total > length:
                raise DataError(
                    f"{self.folder / table}.parquet: {total} {column} in all, expected at most "
                    f"the {length} of {array}: no rows share any"
                )

    def _by_frame(self, table: str, known: set[int]) -> dict[int, list[dict[str, Any]]]:
        rows_of: dict[int, list[dict[str, Any]]] = {}
        for row in self.stored.table(table).to_pylist():
            if row["frame_index"] not in known:
                raise DataError(
                    f"{self.folder / table}.parquet: frame {row['frame_index']} is not in the "
                    "table of frames"
                )
            rows_of.setdefault(row["frame_index"], []).append(row)
        return rows_of

    def _image(self, row: dict[str, Any]) -> SourceImage:
        where = f"{self.folder}: frame {row['frame_index']}, camera {row['camera']!r:.60}"
        if not 0 <= row["num_bytes"] <= _MAX_JPEG_BYTES:
            raise DataError(f"{where}: an image of {row['num_bytes']} bytes")
        jpeg = self.stored.read_rows("image_bytes", row["offset"], row["num_bytes"])
        is_rolling = row["rolling_shutter_s"] is not None
        if is_rolling and row["rolling_shutter_direction"] not in SHUTTER_DIRECTIONS:
            raise DataError(f"{where}: the rolling shutter reads in no known direction")
        pose = require_pose(_pose(row["world_from_camera"]), where)
        if any(term is None for term in row["distortion_terms"]):
            raise DataError(f"{where}: a distortion term is empty")
        record = image_of_row(row, pose)
        return SourceImage(record=record, jpeg=jpeg.tobytes(), source=where)

    def _sweep(self, row: dict[str, Any]) -> SourceSweep:
        where = f"{self.folder}: frame {row['frame_index']}, lidar {row['lidar']!r:.60}"
        if not 0 <= row["num_points"] <= _MAX_SWEEP_POINTS:
            raise DataError(f"{where}: a sweep of {row['num_points']} points")
        rows = {
            name: torch.from_numpy(self.stored.read_rows(name, row["offset"], row["num_points"]))
            for name in schema.POINT_ARRAYS
            if self.stored.has_array(name)
        }
        if not bool(torch.isfinite(rows["point_intensity"]).all()):
            raise DataError(f"{where}: an intensity is not finite")
        points = SweepPoints(
            xyz_m=rows["point_xyz_m"],
            intensity=rows["point_intensity"],
            time_offset_ns=rows["point_time_offset_ns"],
            ring=rows["point_ring"],
            return_index=rows["point_return"],
            lidar=rows["point_lidar"],
        )
        return SourceSweep(
            lidar_name=row["lidar"],
            points=points,
            timestamp_ns=row["timestamp_ns"],
            world_from_lidar=_pose(row["world_from_lidar"]),
            semantics=rows.get("point_semantics"),
            source=where,
        )

    def _box(self, row: dict[str, Any]) -> BoxRecord:
        where = f"{self.folder}: frame {row['frame_index']}, actor {row['actor_id']!r:.60}"
        if row["num_points"] < 0:
            raise DataError(f"{where}: holds {row['num_points']} points")
        return BoxRecord(
            actor_id=row["actor_id"],
            category=row["category"],
            timestamp_ns=row["timestamp_ns"],
            world_from_box=_pose(row["world_from_box"]),
            size_m=(row["length_m"], row["width_m"], row["height_m"]),
            is_moving=row["is_moving"],
            num_points=row["num_points"],
        )


def _pose(numbers: list[float]) -> torch.Tensor:
    return torch.tensor(numbers, dtype=torch.float64).reshape(4, 4)
