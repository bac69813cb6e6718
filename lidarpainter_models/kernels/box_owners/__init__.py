"""Which moving box holds a point: boxes grown a little, but not into the road under them.

Box frame: x along the length, y left, z up, origin at the centre; metres.
"""

from jaxtyping import Float, Int
from torch import Tensor

from lidarpainter_models.errors import ShapeError
from lidarpainter_models.kernels.backends import Backend, implementation

NO_BOX = -1
"""Owner of a point that no box holds."""


def box_owners(
    points_m: Float[Tensor, "points 3"],
    box_from_points: Float[Tensor, "boxes 4 4"],
    size_m: Float[Tensor, "boxes 3"],
    *,
    margin_m: float,
    floor_m: float,
    backend: Backend = "auto",
) -> Int[Tensor, " points"]:
    """Index of the last box that holds each point, or `NO_BOX`.

    A box holds what lies within its sides grown by `margin_m`; but of that, points lower than
    `floor_m` over its bottom only above the bottom and inside its true sides.

    Raises:
        ShapeError: boxes and sizes differ in number.
    """
    if box_from_points.shape[0] != size_m.shape[0]:
        raise ShapeError(f"{box_from_points.shape[0]} boxes need a size each, got {len(size_m)}")
    owners = implementation("box_owners", "box_owners", backend, points_m.device)
    return owners(points_m, box_from_points.to(points_m), size_m.to(points_m), margin_m, floor_m)
