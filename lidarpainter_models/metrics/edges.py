"""Whether a restyled image keeps the structure of the clear one: agreement of their edges.

An edge is a pixel whose gradient, relative to the gradients around it, belongs to the strongest
share of the pixels judged, and is the largest across its own direction (the thinning of Canny,
1986). Relative, because fog and lamps scale contrast smoothly over the image and leave structure
as it is; the same share in both images, because a threshold of grey values would mean something
else in each. Precision and recall allow for a small distance, as in the boundary benchmark of
Martin et al. (2004). Only pixels near LiDAR hits are judged, where the depth that drove the style
was measured.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import fmean

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lidarpainter_models.errors import ShapeError

_GREY = np.array([0.2126, 0.7152, 0.0722], np.float32)
_LEAST_GRADIENT = 1e-3  # of display white per pixel: below it is rounding and sensor noise
STRONGEST_SHARE = 0.1  # share of the pixels judged that may be edges, before thinning
SMOOTHING_PX = 1.2  # blur before the gradient; lifts edges above noise and rain
AROUND_PX = 12.0  # reach of the mean gradient that a pixel's own is compared with
TOLERANCE_PX = 2  # an edge is found again if the other image has one within this distance
SUPPORT_PX = 3  # pixels within this distance of a LiDAR hit are judged
FARTHEST_M = 40.0
"""Hits beyond this are left out: fog may hide what is there, which is what fog does."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EdgeScores:
    """How well the edges of a restyled image are those of the clear one."""

    f1: float
    precision: float
    """Share of the restyled image's edges that the clear one has."""
    recall: float
    """Share of the clear image's edges that are kept."""
    judged_share: float
    """Share of the image's pixels near enough to a LiDAR hit to be compared."""


def edge_agreement(
    styled: Float[Tensor, "height width 3"],
    clear: Float[Tensor, "height width 3"],
    lidar_depth_m: Float[Tensor, "rows columns"],
) -> EdgeScores | None:
    """Compare edges near LiDAR hits; None where the clear image has none to keep.

    Raises:
        ShapeError: the images or the depth differ in size.
    """
    if styled.shape != clear.shape or lidar_depth_m.shape != clear.shape[:2]:
        raise ShapeError(
            f"need images and depth of one size, got {tuple(styled.shape)}, "
            f"{tuple(clear.shape)} and {tuple(lidar_depth_m.shape)}"
        )
    judged = supported_pixels(lidar_depth_m).numpy()
    if not judged.any():
        return None
    found, wanted = (_edges(image, judged) for image in (styled, clear))
    if not wanted.any():
        return None
    precision = _share_near(found, wanted, TOLERANCE_PX)
    recall = _share_near(wanted, found, TOLERANCE_PX)
    total = precision + recall
    return EdgeScores(
        f1=2 * precision * recall / total if total else 0.0,
        precision=precision,
        recall=recall,
        judged_share=float(judged.mean()),
    )


def supported_pixels(lidar_depth_m: Float[Tensor, "height width"]) -> Bool[Tensor, "height width"]:
    """Pixels near a LiDAR hit that is not too far."""
    hits = ((lidar_depth_m > 0) & (lidar_depth_m <= FARTHEST_M)).numpy().astype(np.uint8)
    return torch.from_numpy(_grown(hits, SUPPORT_PX) > 0)


def _edges(image: Float[Tensor, "height width 3"], judged: np.ndarray) -> np.ndarray:
    """The thinned strongest edges among the pixels judged."""
    grey = image.detach().clamp(0, 1).numpy().astype(np.float32) @ _GREY
    smooth = cv2.GaussianBlur(grey, (0, 0), SMOOTHING_PX)
    across, down = (cv2.Sobel(smooth, cv2.CV_32F, *axis, scale=1 / 8) for axis in ((1, 0), (0, 1)))
    strength = np.hypot(across, down)
    relative = strength / (cv2.GaussianBlur(strength, (0, 0), AROUND_PX) + _LEAST_GRADIENT)
    threshold = np.quantile(relative[judged], 1 - STRONGEST_SHARE)
    strong = judged & (relative > max(threshold, 1e-6)) & (strength > _LEAST_GRADIENT)
    return strong & _is_ridge(strength, across, down)


def _is_ridge(strength: np.ndarray, across: np.ndarray, down: np.ndarray) -> np.ndarray:
    """Whether a gradient is as large as both its neighbours along its direction."""
    padded = np.pad(strength, 1, mode="edge")
    octant = np.round(np.arctan2(down, across) / (np.pi / 4)).astype(int) % 4
    height, width = strength.shape
    ridge = np.zeros(strength.shape, bool)
    for number, (row, column) in enumerate(((0, 1), (1, 1), (1, 0), (1, -1))):
        ahead = padded[1 + row : 1 + row + height, 1 + column : 1 + column + width]
        behind = padded[1 - row : 1 - row + height, 1 - column : 1 - column + width]
        ridge |= (octant == number) & (strength >= ahead) & (strength >= behind)
    return ridge


def _share_near(edges: np.ndarray, others: np.ndarray, reach_px: int) -> float:
    if not edges.any():
        return 0.0
    return float((_grown(others.astype(np.uint8), reach_px)[edges] > 0).mean())


def _grown(mask: np.ndarray, reach_px: int) -> np.ndarray:
    side = 2 * reach_px + 1
    return cv2.dilate(mask, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side)))


def mean_edge_scores(scores: Sequence[EdgeScores]) -> dict[str, float | None]:
    """Means over images, `edge_` before their names; None where no image has edges near LiDAR."""
    return {
        f"edge_{name}": fmean(getattr(score, name) for score in scores) if scores else None
        for name in ("f1", "precision", "recall", "judged_share")
    }
