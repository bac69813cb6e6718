"""Paint only what needs it: tiles on which everything known agrees keep the render, bit for bit.

What is known of a pixel beside the render are the LiDAR colour and the warped images. Where they
show what the render shows, painting has nothing to gain; where nothing is known it may gain
something, so such pixels count as doubtful. The other tiles are painted in rectangles with a border
around for the network to see, or, if that is less work, the whole image at once.
"""

from typing import NamedTuple

import cv2
import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812
from jaxtyping import Bool, Float
from torch import Tensor

from lidarpainter_models.painter.examples import Window
from lidarpainter_models.painter.protocol import PaintingConditions

UNKNOWN_DOUBT = 0.05
"""Of a pixel that neither LiDAR nor warp shows: an error at which it would count as wrong."""


TILE_PX = 32
BORDER_PX = 32
"""Seen around what is painted; both are multiples of the network's 16 px."""


class PaintedPart(NamedTuple):
    """A rectangle to be painted."""

    seen: Window
    """What the network is shown."""
    changed: Window
    """What may change; inside of it only tiles that are not kept do."""


def doubt(conditions: PaintingConditions) -> Float[Tensor, "height width"]:
    """How far what is known of a pixel lies from the render: mean absolute rgb difference."""
    known = torch.cat([conditions.lidar_hit[None], conditions.warp_valid]).float()
    shown = torch.cat([conditions.lidar_rgb[None], conditions.warp_rgb])
    gaps = (shown - conditions.render_rgb).abs().mean(dim=-1) * known
    count = known.sum(dim=0)
    return torch.where(count > 0, gaps.sum(dim=0) / count.clamp_min(1), UNKNOWN_DOUBT)


def doubtful_tiles(
    conditions: PaintingConditions, keep_below: float
) -> Bool[Tensor, "rows columns"]:
    """Tiles whose mean doubt is not below a limit; those at the right and lower edge may be cut."""
    found = F.avg_pool2d(
        doubt(conditions)[None, None], TILE_PX, ceil_mode=True, count_include_pad=False
    )
    return found[0, 0] >= keep_below


def painted_parts(
    tiles: Bool[Tensor, "rows columns"], height_px: int, width_px: int
) -> list[PaintedPart]:
    """Rectangles that hold every doubtful tile, or the whole image where that is less work."""
    whole = Window(0, 0, height_px, width_px)
    boxes = _boxes(tiles.cpu().numpy())
    parts = []
    for top, left, rows, columns in boxes:
        changed = _clipped(top, left, rows, columns, 0, whole)
        seen = _clipped(top, left, rows, columns, BORDER_PX, whole)
        parts.append(PaintedPart(seen, changed))
    work_px = sum(part.seen.height_px * part.seen.width_px for part in parts)
    return parts if work_px < height_px * width_px else [PaintedPart(whole, whole)]


def grown_to_pixels(
    tiles: Bool[Tensor, "rows columns"], height_px: int, width_px: int
) -> Bool[Tensor, "height width"]:
    """The tile mask on the image's grid."""
    return tiles.repeat_interleave(TILE_PX, 0).repeat_interleave(TILE_PX, 1)[:height_px, :width_px]


def _boxes(tiles: np.ndarray) -> list[tuple[int, int, int, int]]:
    """Top, left, rows and columns of the connected pieces, joined until none overlap."""
    mask = tiles.astype(np.uint8)
    while True:
        count, _, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=8)
        filled = np.zeros_like(mask)
        boxes = []
        for left, top, columns, rows, _ in stats[1:count].tolist():
            filled[top : top + rows, left : left + columns] = 1
            boxes.append((top, left, rows, columns))
        if np.array_equal(filled, mask):
            return boxes
        mask = filled


def _clipped(top: int, left: int, rows: int, columns: int, border_px: int, whole: Window) -> Window:
    """A box of tiles in pixels, with a border where the image goes on."""
    first_row = max(0, top * TILE_PX - border_px)
    first_column = max(0, left * TILE_PX - border_px)
    last_row = min(whole.height_px, (top + rows) * TILE_PX + border_px)
    last_column = min(whole.width_px, (left + columns) * TILE_PX + border_px)
    return Window(first_row, first_column, last_row - first_row, last_column - first_column)
