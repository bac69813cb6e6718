"""Painters that learn nothing: what a network has to beat.

Their confidence says where something measured stands behind the colour, not how large the error
is: it is meant for weighting guidance.
"""

from collections.abc import Callable

import torch

from lidarpainter_models.painter.protocol import Painter, Painting, PaintingConditions

DISAGREEMENT_SCALE = 0.1
"""Mean absolute rgb difference at which two images no longer support each other (1/e)."""


class UnpaintedPainter:
    """Gives the render back.

    Confidence: the opacity of the Gaussians, so sky and holes count as unknown.
    """

    name = "none"

    def paint(self, conditions: PaintingConditions) -> Painting:
        """Return the render as it is."""
        return Painting(rgb=conditions.render_rgb, confidence=conditions.render_alpha.clamp(0, 1))


class OverlayPainter:
    """Lays the LiDAR colours over the render.

    Confidence: 1 on LiDAR hits, the opacity of the Gaussians elsewhere.
    """

    name = "overlay"

    def paint(self, conditions: PaintingConditions) -> Painting:
        """Return LiDAR colours where they hit and the render elsewhere."""
        hit = conditions.lidar_hit
        rgb = torch.where(hit[..., None], conditions.lidar_rgb, conditions.render_rgb)
        confidence = torch.where(hit, 1.0, conditions.render_alpha.clamp(0, 1))
        return Painting(rgb=rgb, confidence=confidence)


class WarpPainter:
    """Averages the render with the recorded images warped into the view.

    Confidence: exp(-d / 0.1) with d the mean absolute difference of render and valid warps; 0
    where no warp is valid, because nothing there speaks for the render.
    """

    name = "warp"

    def paint(self, conditions: PaintingConditions) -> Painting:
        """Return the mean of render and valid warps; the render where none is valid."""
        valid = conditions.warp_valid[..., None].to(conditions.render_rgb)
        count = valid.sum(dim=0)
        total = conditions.render_rgb + (conditions.warp_rgb * valid).sum(dim=0)
        gaps = (conditions.warp_rgb - conditions.render_rgb).abs() * valid
        gap = (gaps.sum(dim=0) / count.clamp_min(1)).mean(dim=-1)
        confidence = torch.exp(-gap / DISAGREEMENT_SCALE) * (count[..., 0] > 0)
        return Painting(rgb=total / (1 + count), confidence=confidence)


RULES: dict[str, Callable[[], Painter]] = {
    UnpaintedPainter.name: UnpaintedPainter,
    OverlayPainter.name: OverlayPainter,
    WarpPainter.name: WarpPainter,
}
