"""What an image shows of LiDAR points if its camera is turned, late or read slowly by so much.

Arrays in, arrays out, float64, on the CPU. Camera frame: x right, y down, z forward; lengths are
metres. Derivatives are those of a small further turn, and of rows that are read when they were
last guessed to be: enough for a step of Gauss-Newton.
"""

import torch
from jaxtyping import Float, Float32
from numpy import ndarray

from lidarpainter_models.errors import ShapeError
from lidarpainter_models.kernels.backends import Backend, implementation
from lidarpainter_models.kernels.point_contrasts.seen_parts import (
    LATE,
    LEVELS_PER_OCTAVE,
    NEAR_M,
    READOUT,
    TURN,
    AssumedCamera,
    SeenContrasts,
)

__all__ = [
    "LATE",
    "LEVELS_PER_OCTAVE",
    "NEAR_M",
    "READOUT",
    "TURN",
    "AssumedCamera",
    "SeenContrasts",
    "depths_before",
    "seen_contrasts",
]

_CPU = torch.device("cpu")


def depths_before(
    points: Float[ndarray, "points 3"], camera: AssumedCamera, *, backend: Backend = "auto"
) -> Float[ndarray, " points"]:
    """How far before a camera points of the world lie."""
    measure = implementation("point_contrasts", "depths_before", backend, _CPU)
    depth_m: ndarray = measure(points, camera)
    return depth_m


def seen_contrasts(
    points: Float[ndarray, "points 3"],
    camera: AssumedCamera,
    levels: Float32[ndarray, "levels height width 3"],
    nearest_m: Float32[ndarray, "height width"],
    level: int,
    hub_depth_m: Float[ndarray, " points"],
    *,
    backend: Backend = "auto",
) -> SeenContrasts:
    """Look at points of the world in an image's contrasts, at a level by how near they are.

    A level holds contrast and its derivatives along u and v. Points are looked at at `level` where
    they are as near as `hub_depth_m`, finer where they are farther. `nearest_m` is the nearest
    return around each pixel.

    Raises:
        ShapeError: there is not one depth for each point, or the images differ in size.
    """
    if len(hub_depth_m) != len(points):
        raise ShapeError(f"{len(points)} points need as many depths, got {len(hub_depth_m)}")
    if levels.shape[1:3] != nearest_m.shape:
        raise ShapeError(f"contrasts of {levels.shape[1:3]} px with returns of {nearest_m.shape}")
    look = implementation("point_contrasts", "seen_contrasts", backend, _CPU)
    seen: SeenContrasts = look(points, camera, levels, nearest_m, level, hub_depth_m)
    return seen
