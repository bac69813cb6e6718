"""Blocks of Gaussians with bounds, and what a camera can show at most. Lengths are metres."""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.kernels.gaussian_raster.blending_limits import (
    ALPHA_CUT,
    BLUR_PX2,
    NEAR_M,
    TANGENT_MARGIN,
)

MOST_SIGMAS = math.sqrt(-2.0 * math.log(ALPHA_CUT))
"""An opaque Gaussian reaches this far."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Blocks:
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

    @cached_property
    def of_ordered(self) -> Int[Tensor, " gaussians"]:
        """The block of each entry of `order`."""
        sizes = self.first[1:] - self.first[:-1]
        return torch.repeat_interleave(sizes, output_size=len(self.order))


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
