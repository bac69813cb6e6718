"""The stored form of a scene: every table column and array, defined once.

The writer, the reader, the checks and the documentation of the format all take their names, types
and units from here. Every `a_from_b` is a row-major 4x4 rigid transform in float64.
"""

import re
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa

SCHEMA_VERSION = 2
"""Raised when a reader of the last version could misread the new one; 2 brought
`rolling_shutter_first_row_s`."""
READABLE_VERSIONS = (1, 2)
MANIFEST_NAME = "manifest.json"
ARRAYS_NAME = "scene.zarr"
GLOBAL_FRAME = "global_frame"
"""Entry of a manifest that may be left out: scenes with the same name in it share that frame."""
POSES, NO_POSES, LOCALISED = "poses", "none", "localised"
"""Entry of a manifest that may be left out where poses were recorded, and what it may say."""
LABELLED = "labelled"
"""Entry of a manifest that may be left out: actors whose boxes were found, each with its score."""
MAX_NAME_LENGTH = 128
"""File systems allow a folder 255 bytes, and names are parts of longer ones."""
NAME_PATTERN = re.compile(rf"[A-Za-z0-9][A-Za-z0-9._-]{{0,{MAX_NAME_LENGTH - 1}}}")
"""Datasets, sequences, cameras and LiDARs are named so: safe as a folder of their own."""

MAX_LIDARS = 256
"""`point_lidar` counts them in a byte."""

POSE_TYPE = pa.list_(pa.float64(), 16)


@dataclass(frozen=True, slots=True)
class Column:
    """One column of a Parquet table."""

    name: str
    type: pa.DataType
    unit: str
    description: str
    is_optional: bool = False
    """Whether a row may leave it empty."""
    since: int = 1
    """The first schema version that has it; tables of an older one read as if it were empty."""


@dataclass(frozen=True, slots=True)
class ArrayLayout:
    """One array of `scene.zarr`; its first axis grows while the scene is written."""

    name: str
    dtype: np.dtype
    row_shape: tuple[int, ...]
    chunk_rows: int
    unit: str
    description: str
    is_optional: bool = False


_FRAME_INDEX = Column("frame_index", pa.int64(), "1", "number of the frame in its log")
_TIMESTAMP = "since the epoch of the dataset"

FRAMES = (
    _FRAME_INDEX,
    Column("timestamp_ns", pa.int64(), "ns", f"when the ego pose holds, {_TIMESTAMP}"),
    Column("world_from_ego", POSE_TYPE, "m", "ego: x forward, y left, z up"),
)
CAMERAS = (
    _FRAME_INDEX,
    Column("camera", pa.string(), "", "name of the camera"),
    Column("timestamp_ns", pa.int64(), "ns", f"when the pose holds, {_TIMESTAMP}"),
    Column("world_from_camera", POSE_TYPE, "m", "at the timestamp; x right, y down, z forward"),
    Column("fx_px", pa.float64(), "px", "focal length along x"),
    Column("fy_px", pa.float64(), "px", "focal length along y"),
    Column("cx_px", pa.float64(), "px", "principal point; the first pixel's centre is 0.5"),
    Column("cy_px", pa.float64(), "px", "principal point; the first pixel's centre is 0.5"),
    Column("distortion_model", pa.string(), "", "none, brown, fisheye, mei: as in OpenCV"),
    Column("distortion_terms", pa.list_(pa.float64()), "1", "in OpenCV's order; mei: xi first"),
    Column("width_px", pa.int64(), "px", "width of the stored image"),
    Column("height_px", pa.int64(), "px", "height of the stored image"),
    Column("rolling_shutter_s", pa.float64(), "s", "first to last row read", is_optional=True),
    Column("rolling_shutter_direction", pa.string(), "", "down, up, left, right", is_optional=True),
    Column(
        "rolling_shutter_first_row_s",
        pa.float64(),
        "s",
        "first row read this long after the timestamp; empty: the middle row is read then",
        is_optional=True,
        since=2,
    ),
    Column("offset", pa.int64(), "byte", "start of the JPEG in image_bytes"),
    Column("num_bytes", pa.int64(), "byte", "length of the JPEG"),
)
SWEEPS = (
    _FRAME_INDEX,
    Column("lidar", pa.string(), "", "name of the LiDAR"),
    Column("timestamp_ns", pa.int64(), "ns", f"middle of the sweep, {_TIMESTAMP}"),
    Column("world_from_lidar", POSE_TYPE, "m", "at the timestamp; the origin is the sensor"),
    Column("offset", pa.int64(), "1", "first row of the sweep in the point arrays"),
    Column("num_points", pa.int64(), "1", "rows of the sweep"),
)
BOXES = (
    _FRAME_INDEX,
    Column("actor_id", pa.string(), "", "the same over all frames of one actor"),
    Column("category", pa.string(), "", "the dataset's class name"),
    Column("timestamp_ns", pa.int64(), "ns", f"when the box holds, {_TIMESTAMP}"),
    Column("world_from_box", POSE_TYPE, "m", "x along the length, y left, z up, origin central"),
    Column("length_m", pa.float64(), "m", "size along the box's x"),
    Column("width_m", pa.float64(), "m", "size along the box's y"),
    Column("height_m", pa.float64(), "m", "size along the box's z"),
    Column("is_moving", pa.bool_(), "", "whether the actor moves at any time of the log"),
    Column("num_points", pa.int64(), "1", "LiDAR points of this frame inside"),
)
TABLES: dict[str, tuple[Column, ...]] = {
    "frames": FRAMES,
    "cameras": CAMERAS,
    "sweeps": SWEEPS,
    "boxes": BOXES,
}

_POINT_CHUNK = 1 << 18


def _points(
    name: str,
    dtype: str,
    unit: str,
    description: str,
    *,
    row_shape: tuple[int, ...] = (),
    is_optional: bool = False,
) -> ArrayLayout:
    return ArrayLayout(
        name, np.dtype(dtype), row_shape, _POINT_CHUNK, unit, description, is_optional
    )


ARRAYS: dict[str, ArrayLayout] = {
    layout.name: layout
    for layout in (
        ArrayLayout(
            "image_bytes", np.dtype("uint8"), (), 1 << 20, "byte", "the JPEG files, one by one"
        ),
        _points("point_xyz_m", "float32", "m", "motion-compensated, in the world", row_shape=(3,)),
        _points("point_intensity", "float32", "1", "returned strength as the dataset scales it"),
        _points("point_time_offset_ns", "int32", "ns", "measured this long after the sweep's time"),
        _points("point_ring", "int16", "1", "laser of the sensor, -1 where unknown"),
        _points("point_return", "int8", "1", "number of the echo, 0 the strongest or only one"),
        _points("point_lidar", "uint8", "1", "position of the LiDAR's name in the manifest"),
        _points(
            "point_semantics", "uint8", "1", "class number; names in the manifest", is_optional=True
        ),
    )
}
POINT_ARRAYS = tuple(name for name in ARRAYS if name.startswith("point_"))


def arrow_schema(table: str, version: int = SCHEMA_VERSION) -> pa.Schema:
    """The Arrow schema of a table, with units and descriptions as field metadata."""
    return pa.schema(
        [
            pa.field(
                column.name,
                column.type,
                nullable=column.is_optional,
                metadata={"unit": column.unit, "description": column.description},
            )
            for column in TABLES[table]
            if column.since <= version
        ]
    )


def as_current(table: pa.Table, name: str) -> pa.Table:
    """A table of any readable version with all of today's columns, empty where it had none."""
    for place, column in enumerate(arrow_schema(name)):
        if column.name not in table.schema.names:
            table = table.add_column(place, column, pa.nulls(len(table), column.type))
    return table


def zarr_metadata(layout: ArrayLayout, num_rows: int) -> dict[str, Any]:
    """What the `zarr.json` of an array must say; zstd may have any level (left out here)."""
    encoding: dict[str, Any] = {"name": "bytes"}
    if layout.dtype.itemsize > 1:
        encoding["configuration"] = {"endian": "little"}
    return {
        "zarr_format": 3,
        "node_type": "array",
        "shape": [num_rows, *layout.row_shape],
        "data_type": layout.dtype.name,
        "chunk_grid": {
            "name": "regular",
            "configuration": {"chunk_shape": [layout.chunk_rows, *layout.row_shape]},
        },
        "chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}},
        "fill_value": 0,
        "codecs": [encoding, {"name": "zstd"}, {"name": "crc32c"}],
        "storage_transformers": [],
    }


def is_safe_name(name: str) -> bool:
    """Whether a name can be a folder below the store and nothing else."""
    return NAME_PATTERN.fullmatch(name) is not None
