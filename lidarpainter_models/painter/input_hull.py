"""What the inputs of a view show near each pixel: the range that a repaired colour should keep to.

A painter that mixes what is known has no reason to show a colour that none of its inputs shows
nearby; one that does has invented it.
"""

from collections.abc import Callable, Iterator, Set
from typing import NamedTuple

import torch
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
