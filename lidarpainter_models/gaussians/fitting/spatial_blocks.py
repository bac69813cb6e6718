"""Blocks of neighbouring Gaussians with bounds, so that a step looks only at those in view.

A block holds the street's Gaussians of one cell of a grid, whose cells grow with the Gaussians in
them, or all Gaussians of an actor in its box frame. Its bounds hold whatever its Gaussians can
become without a gradient, so that a block out of view need not be looked at: what is left out here
is left out by the rasteriser too. Lengths are metres.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from lidarpainter_models.gaussians.fitting.optimiser import LearningRates
from lidarpainter_models.gaussians.model.gaussian_set import GaussianSet
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.kernels.frustum_culling.cpu import (
    Bounds,
    Frustum,
    mark_seen,
    refresh_bounds,
)
from lidarpainter_models.kernels.gaussian_raster.blending_limits import (
    ALPHA_CUT,
    BLUR_PX2,
    NEAR_M,
    TANGENT_MARGIN,
)
from lidarpainter_models.kernels.sparse_adam.cpu import MOST_UNITS

View = tuple[Camera, Float[Tensor, "bodies 4 4"]]
"""A camera and where it has the bodies of the scene."""

CELL_M = 8.0
"""Side of the smallest cells: a few hundred blocks for a street."""
MOST_SIGMAS = math.sqrt(-2.0 * math.log(ALPHA_CUT))
"""An opaque Gaussian reaches this far."""


@dataclass(eq=False, kw_only=True)
class SpatialBlocks:
    """The blocks of one set of Gaussians."""

    block_of_row: Int[Tensor, " gaussians"]
    order: Int[np.ndarray, " gaussians"]
    """Row numbers, block by block."""
    first: Int[np.ndarray, " blocks_and_one"]
    """Where each block begins in `order`."""
    body: Int[np.ndarray, " blocks"]
    reach_sigmas: float
    bounds: Bounds

    @classmethod
    def of(cls, gaussians: GaussianSet, rates: LearningRates) -> "SpatialBlocks":
        """Blocks of a set whose Gaussians move at these rates at most."""
        block_of_row = _numbered(_cell_keys(gaussians, _reach_sigmas(rates)))
        return cls.with_rows_in(torch.from_numpy(block_of_row), gaussians, rates)

    @classmethod
    def with_rows_in(
        cls, block_of_row: Int[Tensor, " gaussians"], gaussians: GaussianSet, rates: LearningRates
    ) -> "SpatialBlocks":
        """Blocks of these rows: numbers from 0 on, none of them left out."""
        numbers = block_of_row.numpy()
        order = np.argsort(numbers, kind="stable")
        count = int(numbers.max(initial=-1)) + 1
        first = np.searchsorted(numbers[order], np.arange(count + 1))
        blocks = cls(
            block_of_row=block_of_row,
            order=order,
            first=first,
            body=gaussians.body_index.numpy()[order[first[:-1]]],
            reach_sigmas=_reach_sigmas(rates),
            bounds=Bounds(*(np.empty(shape) for shape in ((count, 3), (count, 3), count))),
        )
        blocks.refresh(gaussians)
        return blocks

    def refresh(self, gaussians: GaussianSet, rows: Int[Tensor, " changed"] | None = None) -> None:
        """Take up where the Gaussians are now: all, or those in the blocks of the given rows."""
        is_stale = np.full(len(self.body), rows is None)
        if rows is not None:
            is_stale[self.block_of_row[rows].numpy()] = True
        refresh_bounds(
            self.order,
            self.first,
            is_stale,
            gaussians.means.detach().numpy(),
            gaussians.log_scale.detach().numpy(),
            self.reach_sigmas,
            self.bounds,
        )

    def rows_in_view(
        self, views: Sequence[View], *, actor_slack: tuple[float, float] = (0.0, 0.0)
    ) -> Int[Tensor, " seen"]:
        """Rows, in order, of all Gaussians that any of the views can show, and some more.

        `actor_slack` is how far actors may still move (metres, radians) before they are drawn.
        """
        is_seen = np.zeros(len(self.order), np.bool_)
        for camera, camera_from_body in views:
            bodies = camera_from_body.detach().double().numpy()
            frustum = _frustum(camera, actor_slack)
            mark_seen(self.order, self.first, self.body, self.bounds, bodies, frustum, is_seen)
        return torch.from_numpy(np.flatnonzero(is_seen))


def _reach_sigmas(rates: LearningRates) -> float:
    """How far a Gaussian that is not stepped reaches at most, in its deviations when it was."""
    growth = math.exp(MOST_UNITS * max(rates.log_scale))
    return 1.001 * growth * (MOST_SIGMAS + MOST_UNITS * max(rates.means))


def _cell_keys(gaussians: GaussianSet, reach_sigmas: float) -> Int[np.ndarray, "gaussians 5"]:
    """Body, size of the cell and its place in the grid; what is not finite goes anywhere."""
    body = gaussians.body_index.numpy().astype(np.int64)
    reach_m = reach_sigmas * gaussians.log_scale.detach().double().amax(dim=1).exp().numpy()
    level = np.log2(np.clip(np.nan_to_num(reach_m, nan=1.0), CELL_M, 1e9) / CELL_M)
    level = np.where(body == 0, np.ceil(level), 0.0)
    cell_m = CELL_M * np.exp2(level)
    place = np.floor(gaussians.means.detach().double().numpy() / cell_m[:, None])
    place = np.where((body == 0)[:, None], np.nan_to_num(place, posinf=0.0, neginf=0.0), 0.0)
    cells = np.column_stack([level, np.clip(place, -1e9, 1e9)]).astype(np.int64)
    return np.column_stack([body, cells])


def _numbered(keys: Int[np.ndarray, "gaussians 5"]) -> Int[np.ndarray, " gaussians"]:
    """A number for each different key, from 0 on."""
    order = np.lexsort(keys.T)
    differs = (keys[order[1:]] != keys[order[:-1]]).any(axis=1)
    numbers = np.zeros(len(keys), np.int64)
    numbers[order[1:]] = np.cumsum(differs)
    return numbers


def _frustum(camera: Camera, actor_slack: tuple[float, float]) -> Frustum:
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
        actor_slack=actor_slack,
    )
