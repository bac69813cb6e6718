"""Which point is seen in each pixel: a z-buffer of discs (Catmull, 1974).

Pixel (column, row) holds the continuous positions [column, column + 1) x [row, row + 1). A point
of radius r covers the pixels whose offset (du, dv) from its own has du^2 + dv^2 <= r (r + 1): one
pixel for r = 0, 3 x 3 for r = 1, rounder from there on.
"""

import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor

from lidarpainter_models.errors import ShapeError
from lidarpainter_models.kernels.backends import Backend, implementation


def splat_points(
    pixels_uv: Shaped[Tensor, "points 2"],
    depth_m: Float[Tensor, " points"],
    *,
    height_px: int,
    width_px: int,
    radius_px: Int[Tensor, " points"] | int = 0,
    backend: Backend = "auto",
) -> Int[Tensor, "height width"]:
    """Index (int64) of the nearest point in each pixel, or -1; ties go to the lower index.

    Args:
        pixels_uv: Column and row of each point's pixel; continuous positions are floored. A point
            outside the image still covers what its disc reaches of it.
        depth_m: Camera z. Points at or behind the camera (<= 0) and at no finite depth are skipped.
        height_px: Rows of the image.
        width_px: Columns of the image.
        radius_px: Radius of the discs, one for all or one per point, >= 0.
        backend: `auto` takes numba on the CPU, Triton on a GPU; all keep the same points.

    Raises:
        ShapeError: the points do not fit together, or a radius or the image size is negative.
        BackendError: the numba version was asked for and the points are not on the CPU.
    """
    points = depth_m.shape[0]
    if depth_m.ndim != 1 or pixels_uv.shape != (points, 2):
        raise ShapeError(
            f"need pixels (points, 2) and one depth per point, got {tuple(pixels_uv.shape)} and "
            f"{tuple(depth_m.shape)}"
        )
    if min(height_px, width_px) < 0:
        raise ShapeError(f"need an image size >= 0, got {width_px} x {height_px} px")
    return implementation("point_splat", "splat_points", backend, depth_m.device)(
        pixels_uv, depth_m.detach(), _one_per_point(radius_px, depth_m), height_px, width_px
    )


def _one_per_point(radius_px: Tensor | int, depth_m: Tensor) -> Tensor:
    if isinstance(radius_px, int):
        if radius_px < 0:
            raise ShapeError(f"a radius must be >= 0, got {radius_px}")
        return torch.full_like(depth_m, radius_px, dtype=torch.int64)
    if radius_px.shape != depth_m.shape:
        raise ShapeError(
            f"need one radius per point, got {tuple(radius_px.shape)} for {len(depth_m)} points"
        )
    if bool((radius_px < 0).any()):
        raise ShapeError(f"a radius must be >= 0, got {int(radius_px.min())}")
    return radius_px
