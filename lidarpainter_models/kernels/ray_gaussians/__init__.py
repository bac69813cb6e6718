"""What rays meet of 3D Gaussians: how far it is, how much of it there is, and what it is like.

Each ray has an origin, a direction and a time of its own, as the rays of a sensor that turns and
drives have. A Gaussian answers a ray where its density along the ray is greatest (Wu et al., 3DGUT,
2025), as strongly as it is dense there, and answers are blended front to back in the order of their
distance (Kerbl et al., 2023). Origins and Gaussians stand in one frame, z up, near whose origin the
rays begin: float32 counts millimetres there, not far from it. Metres, seconds.
"""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lidarpainter_models.errors import ShapeError
from lidarpainter_models.kernels.backends import Backend, implementation

FAINTEST = 1 / 255
"""An answer weaker than this is none, as in an image."""
MOST_OPAQUE = 0.999
LEFT_OVER = 1e-3
"""A ray of which less than this goes on is followed no further."""
NEAREST_M = 1e-3
"""What answers nearer than this, or behind the sensor, is none."""
NOTHING = -1
"""Row of the Gaussian at the median of a ray that is never half stopped."""


class Rays(NamedTuple):
    """Rays near one moment."""

    origin_m: Float[Tensor, "rays 3"]
    direction: Float[Tensor, "rays 3"]
    """Unit vectors."""
    after_s: Float[Tensor, " rays"]
    """When each is sent, after the moment at which the Gaussians stand where they do."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Ellipsoids:
    """Gaussians as they stand at one moment."""

    means: Float[Tensor, "gaussians 3"]
    axes: Float[Tensor, "gaussians 3 3"]
    """Unit vectors along a Gaussian's own axes, in rows."""
    scale_m: Float[Tensor, "gaussians 3"]
    """Standard deviations along them."""
    opacity: Float[Tensor, " gaussians"]
    """In [0, 1]."""
    velocity_mps: Float[Tensor, "gaussians 3"]
    """How each moves around that moment, without turning."""
    channels: Float[Tensor, "gaussians channels"]
    """What is blended beside the range."""


class RayHits(NamedTuple):
    """The nearest answers of every ray, front to back; places that hold none have row -1."""

    row: Int[Tensor, "rays hits"]
    response: Float[Tensor, "rays hits"]
    """Density at the answer over that at the centre; times opacity it is what stops there."""
    range_m: Float[Tensor, "rays hits"]
    slope: Float[Tensor, "rays hits"]
    """How much farther the answer is, per metre that the Gaussian moves along its thinnest axis."""
    cosine: Float[Tensor, "rays hits"]
    """Of the angle between the ray and that axis, not negative."""


class RayReturns(NamedTuple):
    """What rays met."""

    range_m: Float[Tensor, " rays"]
    """Mean distance of what stopped the ray; 0 where nothing did."""
    median_m: Float[Tensor, " rays"]
    """Where the first half of the ray has been stopped; inf where that is nowhere."""
    alpha: Float[Tensor, " rays"]
    """How much of the ray was stopped."""
    cosine: Float[Tensor, " rays"]
    """Mean cosine of incidence, weighted by `alpha`'s parts and not divided by their sum."""
    channels: Float[Tensor, "rays channels"]
    """Blended likewise."""
    nearest: Int[Tensor, " rays"]
    """Row of the Gaussian at the median, or `NOTHING`."""
    hits: RayHits
    """As many as were asked for."""


BLENDED = tuple(name for name in RayReturns._fields if name != "hits")
"""What has one row for each ray."""


def trace_rays(
    rays: Rays, gaussians: Ellipsoids, *, most_hits: int = 0, backend: Backend = "auto"
) -> RayReturns:
    """Follow rays through Gaussians; without gradient (`blended_hits` has one).

    Args:
        rays: where they start, where to and when.
        gaussians: what they meet.
        most_hits: how many answers of each ray are listed, the nearest first.
        backend: who computes.

    Raises:
        ShapeError: columns of the rays or the Gaussians differ in length.
    """
    counts = {len(column) for column in rays}
    if len(counts) != 1:
        raise ShapeError(f"rays need as many origins as directions and times, got {sorted(counts)}")
    counts = {len(column) for column in vars(gaussians).values()}
    if len(counts) != 1:
        raise ShapeError(f"columns of Gaussians differ in length: {sorted(counts)}")
    trace = implementation(
        "ray_gaussians", "trace_rays", backend, rays.origin_m.device, dtype=rays.origin_m.dtype
    )
    with torch.no_grad():
        return trace(rays, gaussians, most_hits)


def blended_hits(hits: RayHits, opacity: Float[Tensor, " gaussians"]) -> Float[Tensor, "rays hits"]:
    """How much of each ray every listed answer stops; differentiable in the opacities."""
    is_there = hits.row >= 0
    alpha = opacity[hits.row.clamp(min=0)] * hits.response * is_there
    alpha = alpha.clamp(max=MOST_OPAQUE)
    through = torch.cumprod(1 - alpha, dim=1)
    before = torch.cat([torch.ones_like(through[:, :1]), through[:, :-1]], dim=1)
    return before * alpha
