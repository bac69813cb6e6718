"""Images with their poses and the LiDAR map, as COLMAP and nerfstudio read them.

COLMAP holds `camera_from_world` with the camera x right, y down, z forward, as we do; nerfstudio
holds `world_from_camera` with the camera x right, y up, z back (OpenGL). The world stays ours: z
up, metres. In both, (0, 0) is the corner of the top-left pixel.
"""

import json
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.geometry.transforms import quaternion_from_rotation
from lidarpainter_models.lidar.lidar_map import MapPoints
from lidarpainter_models.storage.whole_files import write_whole

IMAGE_FOLDER = "images"
MAX_POINTS = 1_000_000
"""Of the map: as many as others start from; a seeded choice of a larger one."""
_PINHOLE = 1  # COLMAP's number of the model with fx, fy, cx, cy
_OPENGL_FROM_CAMERA = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))


@dataclass(frozen=True, kw_only=True, eq=False)
class PosedImage:
    """An image of a dataset; its file is written by whoever has its pixels."""

    name: str
    """Name of its file, below the folder of images."""
    camera: Camera
    timestamp_ns: int


def map_sample(points: MapPoints) -> MapPoints:
    """The coloured points, or as many of them as a dataset takes."""
    rows = points.has_colour.nonzero()[:, 0]
    if len(rows) > MAX_POINTS:
        random = torch.Generator().manual_seed(0)
        rows = rows[torch.randperm(len(rows), generator=random)[:MAX_POINTS].sort().values]
    return points.keep(rows)


def write_colmap(folder: Path, images: Sequence[PosedImage], points: MapPoints) -> None:
    """Write `sparse/0/{cameras,images,points3D}.bin`; images of one lens share a camera.

    Raises:
        WriteError: the disk refuses.
    """
    lenses: dict[tuple[int, int, float, float, float, float], int] = {}
    posed = bytearray(struct.pack("<Q", len(images)))
    for number, image in enumerate(images, start=1):
        camera = image.camera
        lens = (
            *(camera.width_px, camera.height_px),
            *(camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px),
        )
        camera_number = lenses.setdefault(lens, len(lenses) + 1)
        camera_from_world = camera.camera_from_world.double()
        rotation_wxyz = quaternion_from_rotation(camera_from_world[:3, :3]).tolist()
        posed += struct.pack("<I4d", number, *rotation_wxyz)
        posed += struct.pack("<3dI", *camera_from_world[:3, 3].tolist(), camera_number)
        posed += image.name.encode("utf-8") + b"\0" + struct.pack("<Q", 0)  # no matched features
    taken = bytearray(struct.pack("<Q", len(lenses)))
    for (width_px, height_px, *focal_and_centre), number in lenses.items():
        taken += struct.pack("<IiQQ4d", number, _PINHOLE, width_px, height_px, *focal_and_centre)
    sparse = folder / "sparse" / "0"
    write_whole(sparse / "cameras.bin", bytes(taken))
    write_whole(sparse / "images.bin", bytes(posed))
    write_whole(sparse / "points3D.bin", _colmap_points(points))


def _colmap_points(points: MapPoints) -> bytes:
    row = np.dtype(
        [("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("track", "<u8")]
    )
    table = np.zeros(len(points), dtype=row)
    table["id"] = np.arange(1, len(points) + 1)
    table["xyz"] = points.xyz_m.numpy()
    table["rgb"] = points.rgb_u8.numpy()
    return struct.pack("<Q", len(table)) + table.tobytes()


def write_nerfstudio(folder: Path, images: Sequence[PosedImage], points: MapPoints) -> None:
    """Write `transforms.json` and `points.ply`, which it names as the points to start from.

    Raises:
        WriteError: the disk refuses.
    """
    transforms = {
        "camera_model": "OPENCV",
        "ply_file_path": "points.ply",
        "frames": [_nerfstudio_frame(image) for image in images],
    }
    write_whole(folder / "points.ply", _point_ply(points))
    write_whole(folder / "transforms.json", json.dumps(transforms, indent=1).encode("utf-8"))


def _nerfstudio_frame(image: PosedImage) -> dict[str, Any]:
    camera = image.camera
    return {
        "file_path": f"{IMAGE_FOLDER}/{image.name}",
        "transform_matrix": (camera.world_from_camera.double() @ _OPENGL_FROM_CAMERA).tolist(),
        "fl_x": camera.fx_px,
        "fl_y": camera.fy_px,
        "cx": camera.cx_px,
        "cy": camera.cy_px,
        "w": camera.width_px,
        "h": camera.height_px,
        "timestamp_ns": image.timestamp_ns,
    }


def _point_ply(points: MapPoints) -> bytes:
    row = np.dtype([("xyz", "<f4", 3), ("rgb", "u1", 3)])
    table = np.zeros(len(points), dtype=row)
    table["xyz"], table["rgb"] = points.xyz_m.numpy(), points.rgb_u8.numpy()
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(table)}"]
    header += [f"property float {axis}" for axis in "xyz"]
    header += [f"property uchar {channel}" for channel in ("red", "green", "blue")]
    return ("\n".join([*header, "end_header"]) + "\n").encode("ascii") + table.tobytes()
