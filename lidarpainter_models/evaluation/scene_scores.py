"""All the figures of one fitted scene, each under the truth it was taken against."""

from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import partial
from typing import Any

from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.evaluation.held_out import HeldOut
from lidarpainter_models.evaluation.view_scores import Renderer, ViewScores, score_views
from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene
from lidarpainter_models.geometry.shifts import Shift
from lidarpainter_models.kernels.side_by_side import side_by_side
from lidarpainter_models.lidar.sparse_depth import FramePoints
from lidarpainter_models.metrics.depth import DepthScores, pooled_inlier_fraction, score_depth
from lidarpainter_models.metrics.perceptual import PerceptualDistances
from lidarpainter_models.scenes.records import RecordedView
from lidarpainter_models.synthetic.street import SyntheticStreet


def _view_scores(scores: ViewScores | None) -> dict[str, Any]:
    """Scores as the report's JSON names them; absent perceptual figures say why."""
    if scores is None:
        return {"psnr": None, "ssim": None, "num_views": 0}
    found = asdict(scores)
    if scores.lpips is not None:
        found.pop("lpips_reason")
    return found


def score_recorded(
    render: Renderer,
    held_out: HeldOut,
    fitted: GaussianScene,
    *,
    distances: PerceptualDistances,
    told: Callable[[], None],
) -> dict[str, Any]:
    """Held-out images with interpolated poses, and beside them with recorded poses.

    `told` is called after every render.
    """
    scored = partial(score_views, render, distances=distances, device=fitted.device, told=told)
    interpolated = scored(held_out.recorded_views(fitted, "interpolated"))
    recorded = scored(held_out.recorded_views(fitted, "recorded"))
    return {**_view_scores(interpolated), "recorded_poses": _view_scores(recorded)}


def score_synthetic(
    render: Renderer,
    held_out: HeldOut,
    fitted: GaussianScene,
    street: SyntheticStreet,
    shifts: Sequence[Shift],
    *,
    distances: PerceptualDistances,
    told: Callable[[], None],
) -> dict[str, Any]:
    """Exact truth beside the path, per trajectory; `told` is called after every render."""
    scored = partial(score_views, render, distances=distances, device=fitted.device, told=told)
    return {
        shift.name: _view_scores(scored(held_out.synthetic_views(fitted, street, shift)))
        for shift in shifts
    }


def score_geometry(
    held_out: HeldOut,
    fitted: GaussianScene,
    shifts: Sequence[Shift],
    *,
    told: Callable[[], None],
) -> dict[str, float | None]:
    """Part of held-out LiDAR pixels that the rendered depth meets within 5 %, per trajectory.

    `told` is called after every render.
    """
    moves = {shift.name: shift for shift in (Shift(), *shifts)}
    scores: dict[str, list[DepthScores]] = {name: [] for name in moves}
    lidar = FramePoints(held_out.scene)

    def scored(seen: tuple[RecordedView, Float[Tensor, "points 3"]]) -> dict[str, DepthScores]:
        view, points = seen
        found = {}
        for name, shift in moves.items():
            camera = held_out.shifted_camera(fitted, view, shift)
            depth_m = fitted.render(camera, view.timestamp_ns).depth_m.cpu()
            found[name] = score_depth(depth_m, camera, points)
        return found

    views = ((view, lidar.at_exposure(view)) for view in held_out.test_views)
    for found in side_by_side(scored, views, fitted.device):
        for name, score in found.items():
            scores[name].append(score)
            told()
    return {name: pooled_inlier_fraction(found) for name, found in scores.items()}
