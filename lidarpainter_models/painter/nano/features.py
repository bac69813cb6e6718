"""What the fusion network is shown, as channels on the image's own grid.

Beside the images themselves it sees where they disagree: a render that no warp confirms is the
best single hint of damage. Depth enters as a logarithm, 0 where there is none.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.painter.batches import ConditionBatch
from lidarpainter_models.painter.filters import blur, fill_push_pull
from lidarpainter_models.painter.nano.candidates import given_reference

REFERENCE_DEPTH_M = 10.0  # log depth is centred here, mid-range of a street


def count_features(inputs: frozenset[str], num_sources: int) -> int:
    """Channels that `painting_features` gives."""
    pairs = num_sources * (num_sources - 1) // 2
    count = 5 * ("render" in inputs) + 6 * ("lidar" in inputs)
    count += (5 * num_sources + pairs) * ("warp" in inputs)
    return count + ({"render", "lidar"} <= inputs) + 3 * ("reference" in inputs)


def painting_features(
    conditions: ConditionBatch,
    inputs: frozenset[str],
    precision: torch.dtype = torch.float32,
    *,
    composite: bool = False,
) -> tuple[Float[Tensor, "batch features height width"], Float[Tensor, "batch 3 height width"]]:
    """The network's input channels in a precision, and the filled LiDAR image they contain.

    A composite has the render where no point hits; otherwise the points themselves are spread.
    """
    channels: list[Tensor] = []
    lidar_filled = torch.zeros_like(conditions.lidar)
    if "render" in inputs:
        depth = _log_depth(conditions.render_depth_m)
        channels += [conditions.render - 0.5, conditions.render_alpha, depth]
    if "lidar" in inputs:
        hit = conditions.lidar_hit
        if composite:
            lidar_filled = torch.where(hit > 0, conditions.lidar, conditions.render)
        else:
            lidar_filled = fill_push_pull(conditions.lidar, hit)
        depth = _log_depth(conditions.lidar_depth_m)
        channels += [lidar_filled - 0.5, hit, blur(hit, sigma_px=3.0), depth]
    if "warp" in inputs:
        channels += _warp_features(conditions)
    if {"render", "lidar"} <= inputs:
        gap = _difference(conditions.render, conditions.lidar)
        channels.append(gap * conditions.lidar_hit)
    if "reference" in inputs:
        channels.append(given_reference(conditions) - 0.5)
    return _joined(channels, precision), lidar_filled


def _joined(
    channels: Sequence[Float[Tensor, "batch _ height width"]], precision: torch.dtype
) -> Float[Tensor, "batch features height width"]:
    """All channels in a precision; converted where they come to lie."""
    size, _, height_px, width_px = channels[0].shape
    counts = [channel.shape[1] for channel in channels]
    joined = channels[0].new_empty(size, sum(counts), height_px, width_px, dtype=precision)
    for place, channel in zip(joined.split(counts, dim=1), channels, strict=True):
        place.copy_(channel)
    return joined


def _warp_features(conditions: ConditionBatch) -> list[Tensor]:
    """Warps (the render where invalid), their masks, and their disagreements."""
    channels: list[Tensor] = []
    num_sources = conditions.warp.shape[1]
    for source in range(num_sources):
        valid = conditions.warp_valid[:, source, None]
        shown = torch.lerp(conditions.render, conditions.warp[:, source], valid)  # 0 or 1
        gap = _difference(conditions.render, shown)
        channels += [shown - 0.5, valid, gap]
    for first in range(num_sources):
        for second in range(first + 1, num_sources):
            both = conditions.warp_valid[:, first, None] * conditions.warp_valid[:, second, None]
            gap = _difference(conditions.warp[:, first], conditions.warp[:, second])
            channels.append(gap * both)
    return channels


def _difference(
    first: Float[Tensor, "batch 3 height width"], second: Float[Tensor, "batch 3 height width"]
) -> Float[Tensor, "batch 1 height width"]:
    """Mean absolute difference, on a scale where 0.25 of rgb is 1."""
    return 4 * (first - second).abs().mean(dim=1, keepdim=True)


def _log_depth(
    depth_m: Float[Tensor, "batch 1 height width"],
) -> Float[Tensor, "batch 1 height width"]:
    logarithm = 0.5 * torch.log(depth_m.clamp_min(0.1) / REFERENCE_DEPTH_M)
    return torch.where(depth_m > 0, logarithm, 0)
