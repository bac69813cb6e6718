"""Every figure of one fitted scene under one way of rendering it, camera by camera.

Each figure stands under the truth that it was taken against.
"""

import itertools
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from typing import Any

from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.evaluation.fid_scores import fid_scores, shown_images
from lidarpainter_models.evaluation.held_out import HeldOut
from lidarpainter_models.evaluation.score_tables import DEPTH, Scores
from lidarpainter_models.evaluation.settings import EvaluationConfig
from lidarpainter_models.evaluation.shown import ShownScene
from lidarpainter_models.evaluation.view_scores import ScoredView, ViewScores, score_views
from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene
from lidarpainter_models.geometry.shifts import Shift
from lidarpainter_models.kernels.side_by_side import side_by_side
from lidarpainter_models.lidar.sparse_depth import FramePoints
from lidarpainter_models.metrics.depth import DepthScores, pooled_inlier_fraction, score_depth
from lidarpainter_models.metrics.images import psnr_from_error
from lidarpainter_models.metrics.perceptual import PerceptualDistances, load_distances
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.records import RecordedView
from lidarpainter_models.scenes.splits import sampled_views
from lidarpainter_models.synthetic.street import SyntheticStreet

GENERATOR_ENTRY = "generator"
"""Entry of a scene's manifest by which the synthetic street is built again."""
NO_IMAGES = "nobody took images there"


@dataclass(frozen=True, kw_only=True, eq=False)
class SceneEvaluation:
    """How fitted scenes are held against the views that no fit saw."""

    held_out: HeldOut
    config: EvaluationConfig

    def scores(self, shown: ShownScene, progress: Callable[[int, int], None]) -> Scores:
        """Recorded views, views beside the path, and depth at both, over a sample of the views."""
        config = self.config
        shifts = config.scoring.shifts
        held_out = self.held_out.sampled(config.scoring.most_views)
        distances = load_distances(
            config.feature_weights, config.lpips, shown.scene.device, inception=config.inception
        )
        cameras = tuple(dict.fromkeys(view.camera_name for view in held_out.test_views))
        num_views, is_known = len(held_out.test_views), known_street(held_out.scene)
        # each view at both poses, where truth is known at every shift, and everywhere for depth
        times = 2 + (len(shifts) if is_known else 0) + 1 + len(shifts)
        times += 0 if distances.inception is None else len(shifts)
        renders = itertools.count(1)

        def told() -> None:
            progress(next(renders), num_views * times)

        parts = {name: self._of_camera(shown, held_out, name, distances, told) for name in cameras}
        recorded = _mean([recorded for recorded, _novel in parts.values()])
        novel = {
            shift.name: _mean([novel[shift.name] for _recorded, novel in parts.values()])
            for shift in shifts
        }
        for name, found in self._likeness(shown, held_out, distances, told).items():
            novel[name] |= found
        fractions = score_geometry(held_out, shown.scene, shifts, told=told)
        for name, fraction in fractions.items():
            novel.get(name, recorded)[DEPTH] = fraction
        recorded["num_held_out"] = len(self.held_out.test_views)
        by_camera = {name: recorded for name, (recorded, _novel) in parts.items()}
        return {"recorded": recorded, "novel": novel, "recorded_by_camera": by_camera}

    def _likeness(
        self,
        shown: ShownScene,
        held_out: HeldOut,
        distances: PerceptualDistances,
        told: Callable[[], None],
    ) -> dict[str, dict[str, Any]]:
        """FID and KID beside the path, per trajectory, against recorded images.

        The paper compares what is rendered beside the path with the recorded video: of that, as
        many images are taken as views are judged, evenly over cameras and time.
        """
        scene = held_out.scene
        views = [] if distances.inception is None else held_out.test_views
        names = {view.camera_name for view in views}
        recorded = [view for view in scene.views if view.camera_name in names]
        real = sampled_views(recorded, len(views))
        beside = {
            shift.name: shown_images(
                shown,
                [(view, held_out.shifted_camera(shown.scene, view, shift)) for view in views],
                told,
            )
            for shift in self.config.scoring.shifts
        }
        return fid_scores(distances.inception, map(held_out.image_of, real), beside)

    def _of_camera(
        self,
        shown: ShownScene,
        held_out: HeldOut,
        name: str,
        distances: PerceptualDistances,
        told: Callable[[], None],
    ) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
        """Scores of the held-out images, and of exact truth beside the path by trajectory."""
        shifts = self.config.scoring.shifts
        views = [view for view in held_out.test_views if view.camera_name == name]
        part = replace(held_out, test_views=views)
        fitted, street, render = shown.scene, known_street(part.scene), shown.renderer(name)

        def scored(judged: Sequence[ScoredView]) -> dict[str, Any]:
            return _view_scores(
                score_views(render, judged, distances=distances, device=fitted.device, told=told)
            )

        recorded = scored(part.recorded_views(fitted, "interpolated"))
        recorded["recorded_poses"] = scored(part.recorded_views(fitted, "recorded"))
        if street is None:
            return recorded, {shift.name: _unknown(len(views)) for shift in shifts}
        return recorded, {
            shift.name: scored(part.synthetic_views(fitted, street, shift)) for shift in shifts
        }


def _view_scores(scores: ViewScores | None) -> dict[str, Any]:
    """Scores as the report's JSON names them; absent perceptual figures say why."""
    if scores is None:
        return {"psnr": None, "ssim": None, "num_views": 0}
    found = asdict(scores)
    if scores.lpips is not None:
        found.pop("lpips_reason")
    return found


def score_geometry(
    held_out: HeldOut, fitted: GaussianScene, shifts: Sequence[Shift], *, told: Callable[[], None]
) -> dict[str, float | None]:
    """Part of held-out LiDAR pixels that the rendered depth meets within 5 %, per trajectory.

    `told` is called after every render.
    """
    moves = {shift.name: shift for shift in (Shift(), *shifts)}
    scores: dict[str, list[DepthScores]] = {name: [] for name in moves}
    lidar = FramePoints(held_out.scene.corrected(fitted.cameras.path))

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


@lru_cache(maxsize=1)
def known_street(scene: DrivingScene) -> SyntheticStreet | None:
    """The world that a scene was drawn from; None for a recorded one."""
    if GENERATOR_ENTRY not in scene.manifest:
        return None
    return SyntheticStreet.from_manifest(scene.manifest)


def _mean(parts: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Scores of several cameras as one: means over views, reasons kept, one camera unchanged."""
    if len(parts) == 1:
        return dict(parts[0])
    if not parts:
        return _unknown(0)
    joins: dict[str, Callable[[Sequence[Any]], Any]] = {
        "num_views": sum,
        "psnr_by_view": lambda values: {
            view: psnr for part in values for view, psnr in part.items()
        },
        "psnr_by_actor": _pooled,
    }
    merged: dict[str, Any] = {}
    for name, first in parts[0].items():
        values = [part[name] for part in parts]
        if name in joins:
            merged[name] = joins[name](values)
        elif isinstance(first, Mapping):
            merged[name] = _mean(values)
        elif all(isinstance(value, (int, float)) for value in values):
            weights = [part["num_views"] for part in parts]
            total = sum(value * weight for value, weight in zip(values, weights, strict=True))
            merged[name] = total / sum(weights)
        else:
            merged[name] = first if isinstance(first, str) else None
    if "psnr_by_actor" in merged:
        actors = merged["psnr_by_actor"].values()
        num, error = sum(one["num_pixels"] for one in actors), sum(map(_summed_error, actors))
        merged["actors_psnr"] = psnr_from_error(error / num) if num else None
    return merged


def _summed_error(found: Mapping[str, Any]) -> float:
    return float(found["num_pixels"] * 10 ** (-found["psnr"] / 10))


def _pooled(parts: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """PSNR of each actor over the pixels of all cameras together."""
    pixels, errors = Counter[str](), dict[str, float]()
    for part in parts:
        for actor_id, found in part.items():
            pixels[actor_id] += found["num_pixels"]
            errors[actor_id] = errors.get(actor_id, 0.0) + _summed_error(found)
    return {
        actor_id: {"psnr": psnr_from_error(errors[actor_id] / num), "num_pixels": num}
        for actor_id, num in pixels.items()
    }


def _unknown(num_views: int) -> dict[str, Any]:
    """The figures of a place where nobody took an image."""
    reasons = dict.fromkeys(("psnr", "ssim", "lpips"), NO_IMAGES)
    return {
        **dict.fromkeys(reasons),
        **{f"{name}_reason": reason for name, reason in reasons.items()},
        "num_views": num_views,
    }
