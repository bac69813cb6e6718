"""Blurring images and filling their gaps.

The filling is the push-pull pyramid of Gortler et al., "The Lumigraph" (1996), section 3.4.
"""

import math
from collections.abc import Callable, Iterator, Sequence, Set
from typing import NamedTuple

import torch
import torch.nn.functional as F  # noqa: N812 - the name everyone knows
from jaxtyping import Bool, Float
from torch import Tensor

from lidarpainter_models.painter.protocol import PaintingConditions

HULL_SIDE_PX = 9
"""Side of the square that counts as nearby."""
ALL_INPUTS = frozenset({"render", "lidar", "warp"})
"""What stands in the view itself; the nearest recorded image does not."""
HULL_MARGIN = 0.05
"""Of rgb, beyond which a colour counts as outside."""


class InputHull(NamedTuple):
    """Lowest and highest value of each channel nearby, margin included."""

    lower: Float[Tensor, "height width 3"]
    upper: Float[Tensor, "height width 3"]


def input_hull(conditions: PaintingConditions, *, inputs: Set[str] = ALL_INPUTS) -> InputHull:
    """The hull of render, LiDAR hits and valid warps around every pixel.

    `inputs` are those that count beside the render, of `lidar`, `warp` and `reference`.
    """
    render = conditions.render_rgb.permute(2, 0, 1).contiguous()
    lower = upper = render
    for rgb, known in _shown_beside_the_render(conditions, inputs):
        # what does not exist neither widens nor narrows what the render shows
        rgb_or_render = torch.lerp(render, rgb.permute(2, 0, 1).contiguous(), known.to(render))
        lower, upper = torch.minimum(lower, rgb_or_render), torch.maximum(upper, rgb_or_render)
    return InputHull(
        lower=_most_nearby(lower, torch.minimum, torch.inf).sub_(HULL_MARGIN).permute(1, 2, 0),
        upper=_most_nearby(upper, torch.maximum, -torch.inf).add_(HULL_MARGIN).permute(1, 2, 0),
    )


def _shown_beside_the_render(
    conditions: PaintingConditions, inputs: Set[str]
) -> Iterator[tuple[Float[Tensor, "height width 3"], Bool[Tensor, "height width"]]]:
    """Images and where they exist."""
    if "lidar" in inputs:
        yield conditions.lidar_rgb, conditions.lidar_hit
    if "warp" in inputs:
        yield from zip(conditions.warp_rgb, conditions.warp_valid, strict=True)
    if "reference" in inputs and conditions.reference_rgb is not None:
        yield conditions.reference_rgb, torch.ones_like(conditions.lidar_hit)


def _most_nearby(
    values: Float[Tensor, "3 height width"],
    choose: Callable[[Tensor, Tensor], Tensor],
    beyond: float,
) -> Float[Tensor, "3 height width"]:
    """The least or largest value in the square around every pixel, one direction at a time.

    Runs of 1, 2, 4, 8 pixels are compared with themselves a run further on, then the longest with
    itself at the end of the side: fewer and simpler passes than a pooling with windows.
    """
    for dim in (1, 2):
        rim = torch.full_like(values.narrow(dim, 0, 1), beyond)
        rim = rim.expand(*(HULL_SIDE_PX // 2 if d == dim else -1 for d in range(3)))
        run, run_px = torch.cat([rim, values, rim], dim=dim), 1
        while run_px < HULL_SIDE_PX:
            step_px = min(run_px, HULL_SIDE_PX - run_px)
            left = run.shape[dim] - step_px
            run = choose(run.narrow(dim, 0, left), run.narrow(dim, step_px, left))
            run_px += step_px
        values = run
    return values


BLUR_SIGMA_PX = 1.5  # about the size of a speckle at 480 pixels across


def blur(
    image: Float[Tensor, "batch channels height width"], *, sigma_px: float = BLUR_SIGMA_PX
) -> Float[Tensor, "batch channels height width"]:
    """A Gaussian blur that repeats the border."""
    radius_px = round(2.5 * sigma_px)
    shares = [math.exp(-0.5 * (offset / sigma_px) ** 2) for offset in range(radius_px + 1)]
    total = shares[0] + 2 * sum(shares[1:])
    shares = [share / total for share in shares]
    padded = F.pad(image, (radius_px, radius_px, radius_px, radius_px), mode="replicate")
    return _weighted_shifts(_weighted_shifts(padded, shares, dim=3), shares, dim=2)


def _weighted_shifts(padded: Tensor, shares: Sequence[float], *, dim: int) -> Tensor:
    """A symmetric filter along one dimension, which loses its padding.

    Sums of shifted images: four times as fast on a CPU as a convolution channel by channel.
    """
    radius_px = len(shares) - 1
    size_px = padded.shape[dim] - 2 * radius_px
    total = padded.narrow(dim, radius_px, size_px) * shares[0]
    for offset, share in enumerate(shares[1:], start=1):
        total.add_(padded.narrow(dim, radius_px - offset, size_px), alpha=share)
        total.add_(padded.narrow(dim, radius_px + offset, size_px), alpha=share)
    return total


def masked_blur(
    image: Float[Tensor, "batch 3 height width"], valid: Float[Tensor, "batch 1 height width"]
) -> Float[Tensor, "batch 3 height width"]:
    """A Gaussian blur over the valid pixels alone; 0 where none is near."""
    blurred = blur(torch.cat([image * valid, valid], dim=1))
    return blurred[:, :3] / blurred[:, 3:].clamp_min(1e-3)


def fill_push_pull(
    image: Float[Tensor, "batch 3 height width"], known: Float[Tensor, "batch 1 height width"]
) -> Float[Tensor, "batch 3 height width"]:
    """Keep the known pixels and fill the others from a pyramid of their averages.

    An image without any known pixel becomes black.
    """
    pyramid = [torch.cat([image * known, known], dim=1)]
    while max(pyramid[-1].shape[2:]) > 1:
        pyramid.append(_halved(pyramid[-1]))
    filled = pyramid[-1][:, :3] / pyramid[-1][:, 3:].clamp_min(1e-6)
    for level in reversed(pyramid[:-1]):
        coarse = F.interpolate(filled, size=level.shape[2:], mode="bilinear", align_corners=False)
        weight = level[:, 3:]
        # half covered cells lean on the coarser level, so that single points do not spread
        share = (2 * weight).clamp_max(1)
        filled = torch.lerp(coarse, level[:, :3] / weight.clamp_min(1e-6), share)
    return filled


def _halved(
    image: Float[Tensor, "batch channels height width"],
) -> Float[Tensor, "batch channels rows columns"]:
    """Means of two by two pixels; of those that there are at an odd edge.

    Sums of every other pixel: on a CPU much faster than pooling.
    """
    height_px, width_px = image.shape[2:]
    odd = (0, width_px % 2, 0, height_px % 2)
    even = F.pad(image, odd, mode="replicate") if any(odd) else image
    rows = even[:, :, ::2] + even[:, :, 1::2]
    return (rows[..., ::2] + rows[..., 1::2]).mul_(0.25)
