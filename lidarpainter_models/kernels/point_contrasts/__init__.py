"""What an image shows of LiDAR points if its camera is turned, late or read slowly by so much.

Arrays in, arrays out, float64, on the CPU. Camera frame: x right, y down, z forward; lengths are
metres. Derivatives are those of a small further turn, and of rows that are read when they were
last guessed to be: enough for a step of Gauss-Newton.
"""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Float32
from numpy import ndarray

from lidarpainter_models.errors import ShapeError
from lidarpainter_models.kernels.backends import Backend, implementation

_CPU = torch.device("cpu")
TURN, LATE, READOUT = slice(0, 3), 3, 4
"""Where a camera's turn (rad), lateness and readout (s) stand among its five parameters."""
LEVELS_PER_OCTAVE = 2
"""A surface that is twice as near is looked at so many levels of contrasts higher."""
NEAR_M = 1.0
"""Nothing nearer is compared."""
BORDER_PX = 3
HIDDEN, HIDDEN_M = 1.15, 0.5
"""A point farther behind a return than this share and length is hidden."""
GUESSES = 3
"""How often the time at which a pixel is read is guessed anew."""
LEAST_AHEAD_M, LEAST_DEPTH_M, LEAST_SCALE_M = 0.1, 0.5, 1.0
"""What depths are taken for where less would be divided by."""


class AssumedCamera(NamedTuple):
    """One image's camera under some parameters: turned, late, and reading its rows in a time."""

    camera_from_world: Float[ndarray, "4 4"]
    """The camera's pose as recorded."""
    twist_per_s: Float[ndarray, "6"]
    """Its turn (rad/s) and velocity (m/s) in its own frame."""
    turned_from_camera: Float[ndarray, "3 3"]
    lens: Float[ndarray, "6"]
    """Focal lengths, centre, width and height, pixels."""
    late_s: float
    across_s: Float[ndarray, "2"]
    """It takes so long to read from the left to the right, and from the top to the bottom."""


class SeenContrasts(NamedTuple):
    """What one image shows of some points."""

    contrast: Float[ndarray, " points"]
    is_seen: Bool[ndarray, " points"]
    slope: Float[ndarray, "points 5"]
    """Derivative of the contrast by the parameters."""
    gradient: Float[ndarray, "points 2"]
    """Change of the contrast per metre of the surface along u and v; 0 where a point is unseen."""
    motion: Float[ndarray, "points 2 5"]
    """How many metres along its surface a point moves with each parameter."""


def depths_before(
    points: Float[ndarray, "points 3"], camera: AssumedCamera, *, backend: Backend = "auto"
) -> Float[ndarray, " points"]:
    """How far before a camera points of the world lie."""
    return implementation("point_contrasts", "depths_before", backend, _CPU)(points, camera)


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
    return look(points, camera, levels, nearest_m, level, hub_depth_m)
