"""Views with a known true image, and what it takes to score a renderer on them.

A renderer is any function from a camera and a time to an image: the Gaussian scene itself, or
the scene followed by a painter. So every figure exists painted and unpainted.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lidarpainter_models.geometry.box_masks import box_outlines
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.lidar.moving_boxes import MovingBoxes
from lidarpainter_models.metrics.images import ImageScores, pooled_psnr, score_image
from lidarpainter_models.metrics.perceptual import PerceptualDistances

Renderer = Callable[[Camera, int], Float[Tensor, "height width 3"]]
"""Image of a camera (fit resolution) at a time in nanoseconds."""


@dataclass(frozen=True, kw_only=True, eq=False)
class JudgedView:
    """A view whose true image is known and was never used for fitting."""

    name: str
    camera: Camera
    timestamp_ns: int
    truth_rgb: Float[Tensor, "height width 3"]
    actor_mask: Bool[Tensor, "height width"]
    """Pixels inside the projected boxes of moving actors."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewScores:
    """Means over views; `actors_psnr` pools the pixels of all actor boxes."""

    psnr: float
    ssim: float
    actors_psnr: float | None
    feature_distance: float | None
    lpips: float | None
    lpips_reason: str | None
    """Why there is no LPIPS."""
    num_views: int
    psnr_by_view: dict[str, float]
    """By the names of the views."""


def actor_mask(
    camera: Camera, actors: MovingBoxes, timestamp_ns: int
) -> Bool[Tensor, "height width"]:
    """Pixels inside the projected boxes of the actors present at that time."""
    mask = np.zeros((camera.height_px, camera.width_px), np.uint8)
    if placed := actors.placed(timestamp_ns):
        tracks, poses = zip(*placed, strict=True)
        sizes_m = torch.stack([track.size_m for track in tracks])
        for outline in box_outlines(camera, torch.stack(poses), sizes_m):
            hull = cv2.convexHull(outline.pixels_uv.astype(np.float32))
            cv2.fillConvexPoly(mask, np.round(hull - 0.5).astype(np.int32), 1)
    return torch.from_numpy(mask.astype(bool))


def score_views(
    render: Renderer,
    views: Sequence[JudgedView],
    *,
    distances: PerceptualDistances,
) -> ViewScores | None:
    """Render every view and average its scores; None without views."""
    if not views:
        return None
    scores: list[ImageScores] = []
    features: list[float] = []
    lpips: list[float] = []
    for view in views:
        image = render(view.camera, view.timestamp_ns).clamp(0, 1)
        truth = view.truth_rgb.to(image.device)
        scores.append(score_image(image, truth, view.actor_mask.to(image.device)))
        if distances.features is not None:
            features.append(float(distances.features(image, truth)))
        if distances.lpips is not None:
            lpips.append(float(distances.lpips(image, truth)))
    return ViewScores(
        psnr=sum(score.psnr_db for score in scores) / len(scores),
        ssim=sum(score.ssim for score in scores) / len(scores),
        actors_psnr=pooled_psnr(scores),
        feature_distance=sum(features) / len(features) if features else None,
        lpips=sum(lpips) / len(lpips) if lpips else None,
        lpips_reason=distances.lpips_missing,
        num_views=len(scores),
        psnr_by_view={view.name: score.psnr_db for view, score in zip(views, scores, strict=True)},
    )
