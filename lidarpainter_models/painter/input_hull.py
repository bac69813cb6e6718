"""What the inputs of a view show near each pixel: the range that a repaired colour should keep to.

A painter that mixes what is known has no reason to show a colour that none of its inputs shows
nearby; one that does has invented it.
"""

from typing import NamedTuple

import torch
import torch.nn.functional as F  # noqa: N812 - the name everyone knows
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.painter.protocol import PaintingConditions

HULL_SIDE_PX = 9
"""Side of the square that counts as nearby."""
HULL_MARGIN = 0.05
"""Of rgb, beyond which a colour counts as outside."""


class InputHull(NamedTuple):
    """Lowest and highest value of each channel nearby, margin included."""

    lower: Float[Tensor, "height width 3"]
    upper: Float[Tensor, "height width 3"]


def input_hull(conditions: PaintingConditions, *, margin: float = HULL_MARGIN) -> InputHull:
    """The hull of render, LiDAR hits and valid warps around every pixel."""
    shown = torch.stack([conditions.render_rgb, conditions.lidar_rgb, *conditions.warp_rgb])
    everywhere = torch.ones_like(conditions.lidar_hit)
    exists = torch.stack([everywhere, conditions.lidar_hit, *conditions.warp_valid])[..., None]
    upper = _largest_nearby(torch.where(exists, shown, -torch.inf).amax(dim=0))
    lower = -_largest_nearby(torch.where(exists, -shown, -torch.inf).amax(dim=0))
    return InputHull(lower=lower - margin, upper=upper + margin)


def _largest_nearby(values: Float[Tensor, "height width 3"]) -> Float[Tensor, "height width 3"]:
    reach = HULL_SIDE_PX // 2
    planes = values.permute(2, 0, 1)[None]
    rows = F.max_pool2d(planes, (1, HULL_SIDE_PX), stride=1, padding=(0, reach))
    both = F.max_pool2d(rows, (HULL_SIDE_PX, 1), stride=1, padding=(reach, 0))
    return both[0].permute(1, 2, 0)
