"""Views with a known true image, and what it takes to score a renderer on them.

A renderer is any function from a camera and a time to an image: the Gaussian scene itself, or
the scene followed by a painter. So every figure exists painted and unpainted.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lidarpainter_models.geometry.box_masks import box_outlines
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.kernels.side_by_side import side_by_side
from lidarpainter_models.lidar.points_on_actors import MovingBoxes
from lidarpainter_models.metrics.images import (
    ImageScores,
    pooled_psnr,
    psnr_from_error,
    score_image,
    squared_error,
)
from lidarpainter_models.metrics.perceptual import PerceptualDistances

Renderer = Callable[[Camera, int], Float[Tensor, "height width 3"]]
"""Image of a camera (fit resolution) at a time in nanoseconds."""
NOBODY = -1
"""Actor index of a pixel outside all boxes."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ScoredView:
    """A view whose true image is known and was never used for fitting."""

    name: str
    camera: Camera
    timestamp_ns: int
    truth_rgb: Float[Tensor, "judged_rows width 3"]
    """The rows that are judged, from the top: all of them, unless a protocol cuts some off."""
    actor_ids: tuple[str, ...]
    """The moving actors that are there."""
    actor_index: Int[Tensor, "judged_rows width"]
    """Whose projected box is in front, by position in `actor_ids`, or `NOBODY`."""
    hidden: Bool[Tensor, "judged_rows width"] | None = None
    """Where the truth shows the recording car itself: not judged."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ActorScore:
    """PSNR over the pixels of an actor's box in all views together."""

    psnr: float
    num_pixels: int


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
    psnr_by_actor: dict[str, ActorScore]
    """By the ids of the moving actors that any view sees."""


def actors_in_view(
    camera: Camera, actors: MovingBoxes, timestamp_ns: int
) -> tuple[tuple[str, ...], Int[Tensor, "height width"]]:
    """Ids of the actors present at a time, and whose projected box is in front at each pixel.

    In front is the box whose furthest corner is nearest.
    """
    index = np.full((camera.height_px, camera.width_px), NOBODY, np.int32)
    placed = actors.placed(timestamp_ns)
    if placed:
        tracks, poses = zip(*placed, strict=True)
        sizes_m = torch.stack([track.size_m for track in tracks])
        outlines = box_outlines(camera, torch.stack(poses), sizes_m)
        for outline in sorted(outlines, key=lambda outline: -outline.far_m):
            cv2.fillConvexPoly(index, outline.hull, outline.box)
    return tuple(track.actor_id for track, _pose in placed), torch.from_numpy(index)


def score_views(
    render: Renderer,
    views: Sequence[ScoredView],
    *,
    distances: PerceptualDistances,
    device: torch.device | None = None,
    told: Callable[[], None] = lambda: None,
) -> ViewScores | None:
    """Render every view and average its scores; None without views.

    Perceptual distances take the truth for what is hidden. Views are rendered on the `device`, on
    a CPU several at once; `told` is called after each.
    """
    if not views:
        return None
    found: list[_Scored] = []
    of_actors: dict[str, list[Tensor]] = {}
    judged = partial(_one_scored, render, distances=distances)
    for one in side_by_side(judged, views, device):
        found.append(one)
        for actor_id, errors in one.actor_errors.items():
            of_actors.setdefault(actor_id, []).append(errors)
        told()
    scores = [one.image for one in found]
    return ViewScores(
        psnr=sum(score.psnr_db for score in scores) / len(scores),
        ssim=sum(score.ssim for score in scores) / len(scores),
        actors_psnr=pooled_psnr(scores),
        feature_distance=_mean([one.feature_distance for one in found]),
        lpips=_mean([one.lpips for one in found]),
        lpips_reason=distances.lpips_missing,
        num_views=len(scores),
        psnr_by_view={view.name: score.psnr_db for view, score in zip(views, scores, strict=True)},
        psnr_by_actor={name: _actor_score(torch.cat(own)) for name, own in of_actors.items()},
    )


def _mean(values: Sequence[float | None]) -> float | None:
    """None where the distance was not asked for."""
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known else None


class _Scored(NamedTuple):
    """What is found of one view."""

    image: ImageScores
    actor_errors: dict[str, Float[Tensor, " pixels"]]
    feature_distance: float | None
    lpips: float | None


def _one_scored(render: Renderer, view: ScoredView, *, distances: PerceptualDistances) -> _Scored:
    image = render(view.camera, view.timestamp_ns).clamp(0, 1)[: len(view.truth_rgb)]
    truth = view.truth_rgb.to(image.device)
    is_actor = (view.actor_index != NOBODY).to(image.device)
    hidden = None if view.hidden is None else view.hidden.to(image.device)
    if hidden is not None:
        image = torch.where(hidden[..., None], truth, image)
    features, lpips = distances.features, distances.lpips
    return _Scored(
        image=score_image(image, truth, is_actor, hidden=hidden),
        actor_errors=_actor_errors(image, truth, view),
        feature_distance=None if features is None else float(features(image, truth)),
        lpips=None if lpips is None else float(lpips(image, truth)),
    )


def _actor_errors(
    image: Float[Tensor, "height width 3"], truth: Float[Tensor, "height width 3"], view: ScoredView
) -> dict[str, Float[Tensor, " pixels"]]:
    """Squared errors of the pixels of each actor that the view sees."""
    error = squared_error(image, truth).double().cpu()
    seen = view.actor_index[view.actor_index != NOBODY].unique().tolist()
    return {view.actor_ids[number]: error[view.actor_index == number] for number in seen}


def _actor_score(errors: Float[Tensor, " pixels"]) -> ActorScore:
    return ActorScore(psnr=psnr_from_error(float(errors.mean())), num_pixels=len(errors))
