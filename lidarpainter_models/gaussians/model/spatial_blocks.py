"""Blocks of neighbouring Gaussians with bounds, so that a view looks only at those it can show.

A block holds the street's Gaussians of one cell of a grid, whose cells grow with the Gaussians in
them, or all Gaussians of an actor in its box frame. Its bounds hold whatever its Gaussians can
become before they are refreshed, so that a block out of view need not be looked at: what is left
out here is left out by the rasteriser too. Lengths are metres.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lidarpainter_models.gaussians.model.gaussian_set import GaussianSet
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.kernels.frustum_culling import Blocks, mark_seen, refresh_bounds

View = tuple[Camera, Float[Tensor, "bodies 4 4"]]
"""A camera and where it has the bodies of the scene."""

CELL_M = 2.0
"""Side of the smallest cells: of what blocks of 8 m put before a camera half is out of its view."""


@dataclass(eq=False, kw_only=True)
class SpatialBlocks:
    """The blocks of one set of Gaussians."""

    block_of_row: Int[Tensor, " gaussians"]
    blocks: Blocks
    reach_sigmas: float
    """How far a Gaussian may reach until it is refreshed, in its longest deviation then."""

    @classmethod
    def of(cls, gaussians: GaussianSet, reach_sigmas: float) -> "SpatialBlocks":
        """Blocks of a set."""
        block_of_row = _numbered(_cell_keys(gaussians, reach_sigmas))
        return cls.with_rows_in(block_of_row, gaussians, reach_sigmas)

    @classmethod
    def with_rows_in(
        cls, block_of_row: Int[Tensor, " gaussians"], gaussians: GaussianSet, reach_sigmas: float
    ) -> "SpatialBlocks":
        """Blocks of these rows: numbers from 0 on, none of them left out."""
        ordered, order = block_of_row.sort(stable=True)
        count = int(ordered[-1]) + 1 if len(ordered) else 0
        first = torch.searchsorted(ordered, torch.arange(count + 1, device=ordered.device))
        low, high = torch.empty(2, count, 3, dtype=torch.float64, device=ordered.device)
        blocks = Blocks(
            order=order,
            first=first,
            body=gaussians.body_index[order[first[:-1]]],
            low=low,
            high=high,
            reach=torch.empty(count, dtype=torch.float64, device=ordered.device),
        )
        made = cls(block_of_row=block_of_row, blocks=blocks, reach_sigmas=reach_sigmas)
        made.refresh(gaussians)
        return made

    def refresh(self, gaussians: GaussianSet, rows: Int[Tensor, " changed"] | None = None) -> None:
        """Take up where the Gaussians are now: all, or those in the blocks of the given rows."""
        body = self.blocks.body
        is_stale = torch.full((len(body),), rows is None, device=body.device)
        if rows is not None:
            is_stale.index_fill_(0, self.block_of_row[rows], True)
        refresh_bounds(
            self.blocks,
            gaussians.means,
            gaussians.log_scale,
            is_stale,
            reach_sigmas=self.reach_sigmas,
        )

    def in_view(
        self, views: Sequence[View], *, actor_slack_m: float = 0.0
    ) -> Bool[Tensor, " gaussians"]:
        """Which Gaussians any of the views can show, and some more.

        `actor_slack_m` is how far actors may still move before they are drawn.
        """
        is_seen = torch.zeros_like(self.block_of_row, dtype=torch.bool)
        mark_seen(self.blocks, views, is_seen, actor_slack_m=actor_slack_m)
        return is_seen


def _cell_keys(gaussians: GaussianSet, reach_sigmas: float) -> Int[Tensor, "gaussians 5"]:
    """Body, size of the cell and its place in the grid; what is not finite goes anywhere."""
    body = gaussians.body_index.long()
    is_street = body == 0
    reach_m = reach_sigmas * gaussians.log_scale.detach().double().amax(dim=1).exp()
    level = (reach_m.nan_to_num(nan=1.0).clamp(CELL_M, 1e9) / CELL_M).log2().ceil()
    level = torch.where(is_street, level, 0.0)
    cell_m = CELL_M * level.exp2()
    place = (gaussians.means.detach().double() / cell_m[:, None]).floor()
    place = torch.where(is_street[:, None], place.nan_to_num(), 0.0).clamp(-1e9, 1e9)
    return torch.column_stack([body, level.long(), place.long()])


def _numbered(keys: Int[Tensor, "gaussians 5"]) -> Int[Tensor, " gaussians"]:
    """A number for each different key, from 0 on."""
    order = torch.arange(len(keys), device=keys.device)
    for column in keys.unbind(1):  # the last one counts most
        order = order[column[order].argsort(stable=True)]
    differs = (keys[order[1:]] != keys[order[:-1]]).any(dim=1)
    numbers = torch.zeros_like(order)
    numbers[order[1:]] = differs.cumsum(0)
    return numbers
