"""Which Gaussians a view can show, by blocks of them with bounds: frustum culling.

What is left out here is left out by the rasteriser too. Lengths are metres.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

from jaxtyping import Bool, Float, Int
from torch import Tensor

from lidarpainter_models.errors import ShapeError
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.kernels.backends import Backend, implementation
from lidarpainter_models.kernels.gaussian_raster.blending_limits import (
    ALPHA_CUT,
    BLUR_PX2,
    NEAR_M,
    TANGENT_MARGIN,
)

MOST_SIGMAS = math.sqrt(-2.0 * math.log(ALPHA_CUT))
"""An opaque Gaussian reaches this far."""


class Blocks(NamedTuple):
    """Which Gaussians a block holds, and what they keep to in the frame of its body."""

    order: Int[Tensor, " gaussians"]
    """Row numbers, block by block."""
    first: Int[Tensor, " blocks_and_one"]
    """Where each block begins in `order`."""
    body: Int[Tensor, " blocks"]
    low: Float[Tensor, "blocks 3"]
    """Lower bound of the centres, float64; the bounds are changed in place."""
    high: Float[Tensor, "blocks 3"]
    """Under `low` where no Gaussian of the block is finite."""
    reach: Float[Tensor, " blocks"]
    """The farthest that any may reach from its centre."""


class Frustum(NamedTuple):
    """A pinhole camera's view; of two numbers the first is horizontal, the second vertical."""

    lowest: tuple[float, float]
    """Tangents x/z and y/z of the image's left and top edge."""
    highest: tuple[float, float]
    stretch: tuple[float, float]
    """Most that the linearised projection stretches a Gaussian across the ray."""
    near_m: float
    actor_slack_m: float
    """How far the actors may still move before they are drawn."""


class Look(NamedTuple):
    """One view for a backend: where the camera has the bodies, and what it can show."""

    camera_from_body: Float[Tensor, "bodies 4 4"]
    """Rigid, float64, on any device."""
    frustum: Frustum


def refresh_bounds(
    blocks: Blocks,
    means: Float[Tensor, "gaussians 3"],
    log_scale: Float[Tensor, "gaussians 3"],
    is_stale: Bool[Tensor, " blocks"],
    *,
    reach_sigmas: float,
    backend: Backend = "auto",
) -> None:
    """Bound the stale blocks, in place: a Gaussian reaches so many of its longest deviation.

    A Gaussian that is not finite is never drawn and has no part in it.

    Raises:
        ShapeError: the blocks are of another number of Gaussians, or the flags of blocks.
    """
    if means.shape != (len(blocks.order), 3) or log_scale.shape != means.shape:
        raise ShapeError(
            f"blocks of {len(blocks.order)} Gaussians need as many centres and scales, got "
            f"{tuple(means.shape)} and {tuple(log_scale.shape)}"
        )
    if is_stale.shape != blocks.body.shape:
        raise ShapeError(f"{len(blocks.body)} blocks need as many flags, got {len(is_stale)}")
    refresh = implementation("frustum_culling", "refresh_bounds", backend, means.device)
    refresh(blocks, means.detach(), log_scale.detach(), is_stale, reach_sigmas)


def mark_seen(
    blocks: Blocks,
    views: Sequence[tuple[Camera, Float[Tensor, "bodies 4 4"]]],
    is_seen: Bool[Tensor, " gaussians"],
    *,
    actor_slack_m: float = 0.0,
    backend: Backend = "auto",
) -> None:
    """Mark, in place, all Gaussians of blocks that may reach into any of the views.

    A view is a camera and where it has the bodies. `actor_slack_m` is how far actors may still
    move before they are drawn.

    Raises:
        ShapeError: there is not one flag for each Gaussian, or views differ in bodies.
    """
    if is_seen.shape != blocks.order.shape:
        raise ShapeError(f"{len(blocks.order)} Gaussians need as many flags, got {len(is_seen)}")
    counts = sorted({len(camera_from_body) for _, camera_from_body in views})
    if len(counts) > 1:
        raise ShapeError(f"views of one scene have the same bodies, got {counts} of them")
    mark = implementation("frustum_culling", "mark_seen", backend, is_seen.device)
    looks = [
        Look(camera_from_body.detach().double(), frustum_of(camera, actor_slack_m))
        for camera, camera_from_body in views
    ]
    mark(blocks, looks, is_seen)


def frustum_of(camera: Camera, actor_slack_m: float = 0.0) -> Frustum:
    """What a camera can show, the blur of footprints included."""
    blur_px = MOST_SIGMAS * math.sqrt(BLUR_PX2)
    left, right = camera.cx_px + blur_px, camera.width_px - camera.cx_px + blur_px
    top, bottom = camera.cy_px + blur_px, camera.height_px - camera.cy_px + blur_px
    widest_x = (max(left, right) + 0.5 * TANGENT_MARGIN * camera.width_px) / camera.fx_px
    widest_y = (max(top, bottom) + 0.5 * TANGENT_MARGIN * camera.height_px) / camera.fy_px
    return Frustum(
        lowest=(-left / camera.fx_px, -top / camera.fy_px),
        highest=(right / camera.fx_px, bottom / camera.fy_px),
        stretch=(math.hypot(1.0, widest_x), math.hypot(1.0, widest_y)),
        near_m=NEAR_M,
        actor_slack_m=actor_slack_m,
    )


def plane_rows(frustum: Frustum) -> list[list[float]]:
    """The planes of a view: left, right, top, bottom, near.

    How far outside a point is, by its x, y and z; how far the plane's own stretch lets a Gaussian
    reach; and where the plane begins.
    """
    (left, top), (right, bottom) = frustum.lowest, frustum.highest
    across, down = frustum.stretch
    return [
        [-1, 0, left, across, 0],
        [1, 0, -right, across, 0],
        [0, -1, top, down, 0],
        [0, 1, -bottom, down, 0],
        [0, 0, -1, 1, frustum.near_m],
    ]
