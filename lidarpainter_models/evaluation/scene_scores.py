"""All the figures of one fitted scene, each under the truth it was taken against."""

from collections.abc import Callable, Sequence
from dataclasses import asdict
from typing import Any

from lidarpainter_models.evaluation.held_out import HeldOut
from lidarpainter_models.evaluation.judged_views import Renderer, ViewScores, score_views
from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene
from lidarpainter_models.geometry.shifts import Shift
from lidarpainter_models.lidar.sparse_depth import FramePoints
from lidarpainter_models.metrics.depth import DepthScores, pooled_inlier_fraction, score_depth
from lidarpainter_models.metrics.perceptual import PerceptualDistances
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
) -> dict[str, Any]:
    """Held-out images with interpolated poses, and beside them with recorded poses."""
    interpolated = score_views(
        render,
        held_out.recorded_views(fitted, "interpolated"),
        distances=distances,
    )
    recorded = score_views(render, held_out.recorded_views(fitted, "recorded"), distances=distances)
    return {**_view_scores(interpolated), "recorded_poses": _view_scores(recorded)}


def score_synthetic(
    render: Renderer,
    held_out: HeldOut,
    fitted: GaussianScene,
    street: SyntheticStreet,
    shifts: Sequence[Shift],
    *,
    distances: PerceptualDistances,
) -> dict[str, Any]:
    """Exact truth beside the path, per trajectory."""
    return {
        shift.name: _view_scores(
            score_views(
                render,
                held_out.synthetic_views(fitted, street, shift),
                distances=distances,
            )
        )
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
    scores: dict[str, list[DepthScores]] = {shift.name: [] for shift in (Shift(), *shifts)}
    lidar = FramePoints(held_out.scene)
    for view in held_out.test_views:
        points = lidar.at_exposure(view)
        for shift in (Shift(), *shifts):
            camera = held_out.shifted_camera(fitted, view, shift)
            depth_m = fitted.render(camera, view.timestamp_ns).depth_m.cpu()
            scores[shift.name].append(score_depth(depth_m, camera, points))
            told()
    return {name: pooled_inlier_fraction(found) for name, found in scores.items()}
