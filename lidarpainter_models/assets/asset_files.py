"""An actor, or a block of street, as a folder of files; Gaussians as every splat viewer reads them.

`gaussians.ply` and `points.safetensors` stand in the box frame (x along the length, y left, z up,
origin at the centre; metres); `origin.safetensors` says of each Gaussian whether it was seen,
mirrored or guessed (`vehicle_colours.ORIGINS`); `asset.json` holds the rest.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Int
from torch import Tensor

from lidarpainter_models.editing.actor_models import ActorModel
from lidarpainter_models.errors import DataError
from lidarpainter_models.gaussians.model.ply_files import read_ply, write_ply
from lidarpainter_models.lidar.lidar_map import MapPoints
from lidarpainter_models.storage.tensor_files import read_tensors, write_tensors
from lidarpainter_models.storage.whole_files import write_whole

GAUSSIANS_FILE = "gaussians.ply"
POINTS_FILE = "points.safetensors"
ORIGIN_FILE = "origin.safetensors"
ABOUT_FILE = "asset.json"
FRAME = "box frame: x along the length, y left, z up, origin at the centre; metres"
SIZE_COMMENT = "size_m"
"""Begins the comment of an exported PLY file that says length, width and height."""


def write_asset(
    folder: Path,
    model: ActorModel,
    about: Mapping[str, Any],
    *,
    origin: Int[Tensor, " gaussians"] | None = None,
) -> None:
    """Write a model and what is known about it.

    Raises:
        WriteError: the disk refuses.
    """
    folder.mkdir(parents=True)
    write_ply(folder / GAUSSIANS_FILE, model.gaussians, (model.category, FRAME))
    if len(model.points):
        write_tensors(folder / POINTS_FILE, model.points.to_arrays(), {})
    if origin is not None:
        write_tensors(folder / ORIGIN_FILE, {"origin": origin.to(torch.uint8)}, {})
    road_rgb = None if model.road_rgb is None else model.road_rgb.tolist()
    known = {"category": model.category, "size_m": model.size_m.tolist(), "road_rgb": road_rgb}
    write_whole(folder / ABOUT_FILE, json.dumps({**about, **known}, indent=1).encode())


def read_asset(folder: Path) -> ActorModel:
    """Read a model that `write_asset` wrote.

    Raises:
        DataError: it is no such folder, or a file is damaged.
    """
    path = folder / ABOUT_FILE
    try:
        about = json.loads(path.read_text("utf-8"))
        category, size_m, road_rgb = (about[name] for name in ("category", "size_m", "road_rgb"))
        size = torch.tensor([float(side) for side in size_m])
        road = None if road_rgb is None else torch.tensor([float(one) for one in road_rgb])
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise DataError(f"{path} cannot be read as an asset: {error}") from None
    if size.shape != (3,) or (road is not None and road.shape != (3,)):
        raise DataError(f"{path}: expected three numbers in size_m and in road_rgb")
    points = MapPoints.concatenate([])
    if (folder / POINTS_FILE).exists():
        arrays, _ = read_tensors(folder / POINTS_FILE)
        try:
            points = MapPoints(**arrays)
        except TypeError as error:
            raise DataError(f"{folder / POINTS_FILE}: expected LiDAR points: {error}") from None
    return ActorModel(
        gaussians=read_ply(folder / GAUSSIANS_FILE),
        points=points,
        size_m=size,
        category=str(category),
        road_rgb=road,
    )
