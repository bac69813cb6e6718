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

from lidarpainter_models.gaussians.fitting.settings import LearningRates
from lidarpainter_models.gaussians.model.gaussian_set import GaussianSet
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.kernels.frustum_culling import (
    MOST_SIGMAS,
    Blocks,
    mark_seen,
    refresh_bounds,
)
from lidarpainter_models.kernels.sparse_adam import MOST_UNITS

View = tuple[Camera, Float[Tensor, "bodies 4 4"]]
"""A camera and where it has the bodies of the scene."""

CELL_M = 8.0
"""Side of the smallest cells: a few hundred blocks for a street."""


@dataclass(eq=False, kw_only=True)
class SpatialBlocks:
    """The blocks of one set of Gaussians."""

    block_of_row: Int[Tensor, " gaussians"]
    blocks: Blocks
    reach_sigmas: float

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
        low, high = torch.empty(2, count, 3, dtype=torch.float64)
        blocks = Blocks(
            order=torch.from_numpy(order),
            first=torch.from_numpy(first),
            body=torch.from_numpy(gaussians.body_index.numpy()[order[first[:-1]]]),
            low=low,
            high=high,
            reach=torch.empty(count, dtype=torch.float64),
        )
        made = cls(block_of_row=block_of_row, blocks=blocks, reach_sigmas=_reach_sigmas(rates))
        made.refresh(gaussians)
        return made

    def refresh(self, gaussians: GaussianSet, rows: Int[Tensor, " changed"] | None = None) -> None:
        """Take up where the Gaussians are now: all, or those in the blocks of the given rows."""
        is_stale = torch.full((len(self.blocks.body),), rows is None)
        if rows is not None:
            is_stale[self.block_of_row[rows]] = True
        refresh_bounds(
            self.blocks,
            gaussians.means,
            gaussians.log_scale,
            is_stale,
            reach_sigmas=self.reach_sigmas,
        )

    def rows_in_view(
        self, views: Sequence[View], *, actor_slack: tuple[float, float] = (0.0, 0.0)
    ) -> Int[Tensor, " seen"]:
        """Rows, in order, of all Gaussians that any of the views can show, and some more.

        `actor_slack` is how far actors may still move (metres, radians) before they are drawn.
        """
        is_seen = torch.zeros(len(self.block_of_row), dtype=torch.bool)
        for camera, camera_from_body in views:
            mark_seen(self.blocks, camera, camera_from_body, is_seen, actor_slack=actor_slack)
        return torch.from_numpy(np.flatnonzero(is_seen.numpy()))


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
