"""Blend the points that lie on a visible surface into an image: the second pass of splatting.

A first pass finds the surface each pixel sees; this pass averages every point whose disc covers
the pixel and whose depth agrees with that surface, so dense points give a smooth image and no
point of another surface leaks in (surface splatting, Zwicker et al. 2001).
"""

from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.errors import ShapeError
from lidarpainter_models.kernels.backends import Backend, implementation


def blend_points(  # noqa: PLR0913 -- one option each
    positions_uv: Float[Tensor, "points 2"],
    depth_m: Float[Tensor, " points"],
    attributes: Float[Tensor, "points channels"],
    surface_depth_m: Float[Tensor, "height width"],
    *,
    weight: Float[Tensor, " points"],
    radius_px: Float[Tensor, " points"],
    tolerance: float = 0.03,
    backend: Backend = "auto",
) -> tuple[Float[Tensor, "height width channels"], Float[Tensor, "height width"]]:
    """Weighted mean of point attributes per pixel, and the sum of weights (0 = no point).

    A point adds `weight * exp(-2 (d / radius)^2)` to every pixel whose centre lies at a distance
    d <= radius from `positions_uv` (continuous pixels) and whose surface depth it meets within
    `tolerance` (relative, to both sides). Pixels with surface depth 0 take nothing.

    Raises:
        ShapeError: the inputs do not agree on the number of points.
    """
    num_points = depth_m.shape[0]
    for name, tensor in [
        ("positions_uv", positions_uv),
        ("attributes", attributes),
        ("weight", weight),
        ("radius_px", radius_px),
    ]:
        if tensor.shape[0] != num_points:
            raise ShapeError(f"{num_points} depths need as many {name}, got {tensor.shape[0]}")
    blend = implementation("point_blend", "blend_points", backend, depth_m.device)
    return blend(
        positions_uv, depth_m, attributes, surface_depth_m, weight, radius_px, float(tolerance)
    )
