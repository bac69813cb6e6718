"""Colours of points from images: project, take samples, keep the best, combine them.

Arrays in, arrays out, on the CPU: what is kept of millions of points is changed in place.
Projections alone are asked for on any device. Pixels are continuous, the top-left one has its
centre at (0.5, 0.5); depth is camera z.
"""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from lidarpainter_models.errors import ShapeError
from lidarpainter_models.kernels.backends import Backend, implementation

_CPU = torch.device("cpu")
SLOTS = 4
"""Best samples that a point keeps."""
READ_MARGIN = 0.25
"""How far beside a rolling shutter's image, in parts of its size, what stands may be and yet be
read in it: at 30 m/s and 30 ms all that is 1 m before the camera or further."""
AGREEMENT = 32.0
"""Samples further than this (of 255, in any channel) from the typical one are outliers."""


class BestSamples(NamedTuple):
    """The best samples of every point, heaviest first."""

    weight: np.ndarray
    """(points, slots) float32, 0 where a slot is empty."""
    rgb: np.ndarray
    """(points, slots, 3) uint8."""
    view: np.ndarray
    """(points, slots) int16, or int32 of many views: number of the one each sample is from."""

    @classmethod
    def none_yet(cls, num_points: int, num_views: int) -> "BestSamples":
        """Empty slots, for samples of so many views."""
        number = np.result_type(np.int16, np.min_scalar_type(-num_views))
        return cls(
            weight=np.zeros((num_points, SLOTS), np.float32),
            rgb=np.zeros((num_points, SLOTS, 3), np.uint8),
            view=np.zeros((num_points, SLOTS), number),
        )


def project_inside(
    xyz_m: Float[Tensor, "points 3"],
    pixels_from_points: Float[Tensor, "3 4"],
    width_px: int,
    height_px: int,
    near_m: float,
    *,
    backend: Backend = "auto",
) -> tuple[Int[Tensor, " rows"], Float[Tensor, "rows 2"], Float[Tensor, " rows"]]:
    """Rows, continuous pixels and depth of the points that fall into an image, where these lie.

    Raises:
        ShapeError: the points or the matrix have another shape.
    """
    if xyz_m.ndim != 2 or xyz_m.shape[1] != 3 or pixels_from_points.shape != (3, 4):
        raise ShapeError(
            f"need points (points, 3) and a matrix (3, 4), got {tuple(xyz_m.shape)} and "
            f"{tuple(pixels_from_points.shape)}"
        )
    project = implementation("colour_sampling", "project_inside", backend, xyz_m.device)
    return project(xyz_m, pixels_from_points, width_px, height_px, near_m)


def read_inside(
    xyz_m: Float[Tensor, "points 3"],
    camera: Float[Tensor, "26"],
    margin_px: float,
    near_m: float,
    rounds: int,
    *,
    backend: Backend = "auto",
) -> tuple[Int[Tensor, " rows"], Float[Tensor, "rows 2"], Float[Tensor, " rows"]]:
    """Like `project_inside`, of points that stand while a rolling shutter reads the image.

    Pixels are those of the image with its margin; `camera` is `Camera.packed`. Where a point is
    read is guessed so many rounds again, from the middle of the image's time.

    Raises:
        ShapeError: the points or the camera have another shape.
    """
    if xyz_m.ndim != 2 or xyz_m.shape[1] != 3 or camera.shape != (26,):
        raise ShapeError(
            f"need points (points, 3) and a camera of 26 numbers, got {tuple(xyz_m.shape)} and "
            f"{tuple(camera.shape)}"
        )
    read = implementation("colour_sampling", "read_inside", backend, xyz_m.device)
    return read(xyz_m, camera, margin_px, near_m, rounds)


def in_any_image(
    xyz_m: Float[Tensor, "points 3"],
    cameras: Float[Tensor, "cameras 26"],
    near_m: float,
    rounds: int,
    *,
    backend: Backend = "auto",
) -> Bool[Tensor, " points"]:
    """Whether each point falls into the image of a camera, as its shutter reads it.

    The cameras (`Camera.packed`) are asked in their order, none after one that has the point.

    Raises:
        ShapeError: the points or the cameras have another shape.
    """
    if xyz_m.ndim != 2 or xyz_m.shape[1] != 3 or cameras.shape[1:] != (26,):
        raise ShapeError(
            f"need points (points, 3) and cameras of 26 numbers, got {tuple(xyz_m.shape)} and "
            f"{tuple(cameras.shape)}"
        )
    ask = implementation("colour_sampling", "in_any_image", backend, xyz_m.device)
    return ask(xyz_m, cameras, near_m, rounds)


def insert_samples(
    best: BestSamples,
    rows: Int[np.ndarray, " samples"],
    weight: Float[np.ndarray, " samples"],
    rgb: UInt8[np.ndarray, "samples 3"],
    view: int,
    *,
    backend: Backend = "auto",
) -> None:
    """Put one image's samples among the best of their points, heaviest first, in place.

    A point occurs once in `rows`; of equal weights the earlier sample stays first.

    Raises:
        ShapeError: the samples differ in number.
    """
    if not len(rows) == len(weight) == len(rgb):
        raise ShapeError(f"{len(rows)} samples, {len(weight)} weights and {len(rgb)} colours")
    insert = implementation("colour_sampling", "insert_samples", backend, _CPU)
    insert(best, rows, weight, rgb, view)


def steps_inside(
    cells_uv: Int[np.ndarray, "points 2"],
    depth_m: Float[np.ndarray, " points"],
    inner_m: Float[np.ndarray, "rows columns"],
    reach: int,
    tolerance: float,
    *,
    backend: Backend = "auto",
) -> tuple[Float[np.ndarray, "points 2"], Bool[np.ndarray, " points"]]:
    """For points on a rim, the step (columns, rows) to the nearest inner cell of their surface.

    Where none lies within reach the step is zero and the flag false; of equally near cells the
    first in reading order is taken.

    Raises:
        ShapeError: there is not one cell for each depth.
    """
    if cells_uv.shape != (len(depth_m), 2):
        raise ShapeError(f"{len(depth_m)} depths need a cell each, got {cells_uv.shape}")
    step = implementation("colour_sampling", "steps_inside", backend, _CPU)
    return step(cells_uv, depth_m, inner_m, reach, tolerance)


def sample_levels(
    pixels_uv: Float[np.ndarray, "rows 2"],
    level: Int[np.ndarray, " rows"],
    finest: UInt8[np.ndarray, "height width 3"],
    middle: UInt8[np.ndarray, "height2 width2 3"],
    coarsest: UInt8[np.ndarray, "height4 width4 3"],
    *,
    backend: Backend = "auto",
) -> UInt8[np.ndarray, "rows 3"]:
    """Bilinear colours from the level of a pyramid that each row names.

    Each level has half the pixels of the one before; positions are those of the finest.

    Raises:
        ShapeError: there is not one level for each position.
    """
    if pixels_uv.shape != (len(level), 2):
        raise ShapeError(f"{len(level)} levels need a position each, got {pixels_uv.shape}")
    sample = implementation("colour_sampling", "sample_levels", backend, _CPU)
    return sample(pixels_uv, level, finest, middle, coarsest)


def combine_samples(
    best: BestSamples, view_gain: Float[np.ndarray, "views 3"], *, backend: Backend = "auto"
) -> tuple[UInt8[np.ndarray, "points 3"], Bool[np.ndarray, " points"]]:
    """One colour per point from its samples, and whether it has any.

    Samples are brought to one exposure by the gain of their view. The weighted median in
    brightness is the typical one; the colour is the mean, weighted by the square of the weights,
    of the samples that agree with it.

    Raises:
        ShapeError: the slots do not belong together.
    """
    if best.view.shape != best.weight.shape or best.rgb.shape != (*best.weight.shape, 3):
        raise ShapeError(
            f"slots differ: weights {best.weight.shape}, colours {best.rgb.shape}, views "
            f"{best.view.shape}"
        )
    combine = implementation("colour_sampling", "combine_samples", backend, _CPU)
    return combine(best, view_gain)
