"""Painting conditions stacked for a network: channels first, one row per view.

Images are (batch, channels, height, width), rgb in [0, 1]; depth is camera z in metres with 0
where there is none; masks are float, 1 where true. Warps beyond those a view has are invalid.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import torch
import torch.nn.functional as F  # noqa: N812
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.errors import ShapeError
from lidarpainter_models.painter.protocol import PaintingConditions


@dataclass(frozen=True, kw_only=True, eq=False)
class ConditionBatch:
    """The conditions of several views of one size."""

    render: Float[Tensor, "batch 3 height width"]
    render_depth_m: Float[Tensor, "batch 1 height width"]
    render_alpha: Float[Tensor, "batch 1 height width"]
    lidar: Float[Tensor, "batch 3 height width"]
    lidar_depth_m: Float[Tensor, "batch 1 height width"]
    lidar_hit: Float[Tensor, "batch 1 height width"]
    warp: Float[Tensor, "batch sources 3 height width"]
    warp_valid: Float[Tensor, "batch sources height width"]
    reference: Float[Tensor, "batch 3 height width"] | None = None
    """None if any of the views lacks it."""

    def map(self, change: Callable[[Tensor], Tensor]) -> "ConditionBatch":
        """Every image and mask changed alike."""
        found = {name: one for name, one in vars(self).items() if one is not None}
        return replace(self, **{name: change(one) for name, one in found.items()})

    def to(self, device: torch.device) -> "ConditionBatch":
        """The same batch on another device; the host waits for it only on the CPU."""
        return self.map(partial(moved, device=device))

    def pin_memory(self) -> "ConditionBatch":
        """The same batch in pinned memory; a loader of batches asks for it by this name."""
        return self.map(lambda values: values.pin_memory())


def moved(values: Tensor, device: torch.device) -> Tensor:
    """The same numbers on another device; from pinned memory to a GPU the host goes on meanwhile.

    On the way back it waits, or it would read what has not arrived.
    """
    return values.to(device, non_blocking=device.type != "cpu")


def in_planes(conditions: PaintingConditions) -> PaintingConditions:
    """The same view with the channels of every image apart in memory.

    A batch and a hull need them so; a view that is given to both is converted but once.
    """
    apart = {
        name: rgb.movedim(-1, -3).contiguous().movedim(-3, -1)
        for name, rgb in vars(conditions).items()
        if name.endswith("rgb") and rgb is not None
    }
    return replace(conditions, **apart)


def stack_conditions(views: Sequence[PaintingConditions], *, num_sources: int) -> ConditionBatch:
    """Stack views of one size, keeping the best `num_sources` warps of each.

    Raises:
        ShapeError: no view, or views of different sizes.
    """
    sizes = sorted({view.height_width_px for view in views})
    if len(sizes) != 1:
        raise ShapeError(f"a batch needs views of one size (height, width), got {sizes}")
    warps = [_first_sources(view, num_sources) for view in views]
    references = [view.reference_rgb for view in views if view.reference_rgb is not None]
    return ConditionBatch(
        render=_stack_rgb([view.render_rgb for view in views]),
        render_depth_m=_stack_map([view.render_depth_m for view in views]),
        render_alpha=_stack_map([view.render_alpha for view in views]),
        lidar=_stack_rgb([view.lidar_rgb for view in views]),
        lidar_depth_m=_stack_map([view.lidar_depth_m for view in views]),
        lidar_hit=_stack_map([view.lidar_hit for view in views]),
        warp=torch.stack([rgb for rgb, _ in warps]),
        warp_valid=torch.stack([valid for _, valid in warps]),
        reference=_stack_rgb(references) if len(references) == len(views) else None,
    )


def _stack_rgb(images: Sequence[Tensor]) -> Float[Tensor, "batch 3 height width"]:
    return torch.stack([image.permute(2, 0, 1) for image in images]).contiguous()


def _stack_map(maps: Sequence[Tensor]) -> Float[Tensor, "batch 1 height width"]:
    return torch.stack([one.float() for one in maps])[:, None]


def _first_sources(
    view: PaintingConditions, num_sources: int
) -> tuple[Float[Tensor, "sources 3 height width"], Float[Tensor, "sources height width"]]:
    valid = view.warp_valid[:num_sources].to(view.render_rgb)
    rgb = view.warp_rgb[:num_sources].permute(0, 3, 1, 2).contiguous() * valid[:, None]
    missing = (0, num_sources - len(valid))
    return F.pad(rgb, (0, 0) * 3 + missing), F.pad(valid, (0, 0) * 2 + missing)
