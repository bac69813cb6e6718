"""The small painter as users meet it: one view in, one repaired view out.

Runs on the device its network lies on. The U-Net runs in the type that this device computes faster
(`precision.py`); images, mixing and confidence stay in float32.
"""

from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812  # noqa: N812
from jaxtyping import Bool, Float
from torch import Tensor

from lidarpainter_models.errors import ConfigError
from lidarpainter_models.painter.batches import in_planes, stack_conditions
from lidarpainter_models.painter.examples import Window
from lidarpainter_models.painter.filters import input_hull
from lidarpainter_models.painter.nano.network import CELL_PX, NanoNetwork
from lidarpainter_models.painter.precision import faster_type
from lidarpainter_models.painter.protocol import DEFAULT_PROMPT, Painting, PaintingConditions

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


class NanoPainter:
    """Repairs a view by mixing what is known about it.

    For the prompt it restores with, no colour leaves the hull of what the inputs show nearby
    (`input_hull`): the network's residual may sharpen, not invent. Only a painter that sees the
    render is held to that; the LiDAR alone shows nothing in most places.

    Confidence: exp(-e / 0.05) with e the mean absolute error the network expects around the pixel
    (its scale is `NanoConfig.confidence_error`), without the steps between the cells it sees by;
    for e, a tile that was not painted takes what is known beside the render.
    """

    name = "nano"

    def __init__(
        self,
        network: NanoNetwork,
        *,
        provenance: dict[str, Any] | None = None,
        precision: torch.dtype | None = None,
        keep_below: float | None = None,
    ) -> None:
        """Take a trained network.

        It is frozen and laid out for speed here; it stays in its own precision, and a copy of it
        paints: in bfloat16 or float32, None takes the faster one. Tiles on which what is known
        differs from the render by less than `keep_below` on average are left unpainted.

        Raises:
            ConfigError: a negative limit.
        """
        frozen = network.eval().requires_grad_(False)
        # torch's stub lacks memory_format
        self.network = frozen.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.precision = precision or faster_type(network.head.weight.device)
        is_halved = self.precision == torch.bfloat16
        self._network = self.network.halved() if is_halved else self.network
        self.provenance = provenance or {}
        if keep_below is not None and not keep_below >= 0:
            raise ConfigError(f"keep_below must not be negative, got {keep_below}")
        self.keep_below = keep_below

    def sparing(self, keep_below: float) -> "NanoPainter":
        """The same painter, painting only tiles that need it."""
        return NanoPainter(
            self.network,
            provenance=self.provenance,
            precision=self.precision,
            keep_below=keep_below,
        )

    @torch.inference_mode()
    def paint(self, conditions: PaintingConditions) -> Painting:
        """Repair one view of any size.

        Raises:
            ConfigError: the network was not trained for the prompt.
        """
        self.network.prompt_index(conditions.prompt)
        # a style changes every pixel
        if self.keep_below is None or conditions.prompt != DEFAULT_PROMPT:
            return self._painted(conditions)
        return self._painted_where_needed(conditions, self.keep_below)

    def _painted_where_needed(self, conditions: PaintingConditions, keep_below: float) -> Painting:
        """Paint the doubtful tiles; a kept one is as sure as what is known agrees with it."""
        height_px, width_px = conditions.height_width_px
        tiles = doubtful_tiles(conditions, keep_below)
        is_doubtful = grown_to_pixels(tiles, height_px, width_px)
        rgb = conditions.render_rgb.clone()
        confidence = torch.exp(-doubt(conditions) / self.network.config.confidence_error)
        for seen, changed in painted_parts(tiles, height_px, width_px):
            part = self._painted(conditions.cropped(*seen.slices))
            inside = Window(
                changed.top_px - seen.top_px,
                changed.left_px - seen.left_px,
                changed.height_px,
                changed.width_px,
            ).slices
            rows, columns = changed.slices
            chosen = is_doubtful[rows, columns]
            rgb[rows, columns][chosen] = part.rgb[inside][chosen]
            confidence[rows, columns][chosen] = part.confidence[inside][chosen]
        return Painting(
            rgb=rgb, confidence=confidence, kept_share=1 - float(is_doubtful.float().mean())
        )

    def _painted(self, conditions: PaintingConditions) -> Painting:
        """Paint every pixel."""
        config = self.network.config
        device = self.network.head.weight.device
        conditions = in_planes(conditions)
        batch = stack_conditions([conditions], num_sources=config.num_sources).to(device)
        output = self._network(batch, [conditions.prompt])
        log_error = without_cells(output.log_error[0])
        confidence = torch.exp(-log_error.exp() / config.confidence_error)
        home = conditions.render_rgb.device
        rgb = output.rgb[0].permute(1, 2, 0).to(home)
        if conditions.prompt == DEFAULT_PROMPT and "render" in config.inputs:
            hull = input_hull(conditions, inputs=config.inputs)
            rgb = torch.minimum(torch.maximum(rgb, hull.lower), hull.upper)
        return Painting(rgb=rgb.clamp(0, 1).contiguous(), confidence=confidence.to(home))


def without_cells(image: Float[Tensor, "height width"]) -> Float[Tensor, "height width"]:
    """An image without steps between the network's cells, nor a pattern that repeats in them.

    Each pixel becomes the mean over the cell's width around it, half of the two pixels at its ends:
    a step between two cells becomes an even slope, and what repeats every cell becomes its mean.
    """
    weights = torch.tensor([0.5, *[1.0] * (CELL_PX - 1), 0.5], device=image.device) / CELL_PX
    reach = CELL_PX // 2
    height_px, width_px = image.shape
    rows = torch.arange(-reach, height_px + reach, device=image.device).clamp(0, height_px - 1)
    columns = torch.arange(-reach, width_px + reach, device=image.device).clamp(0, width_px - 1)
    padded = image[rows[:, None], columns][None, None]
    down = F.conv2d(padded, weights.view(1, 1, -1, 1))
    return F.conv2d(down, weights.view(1, 1, 1, -1))[0, 0]
