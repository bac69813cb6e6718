"""Every figure of one fitted scene under one way of rendering it, camera by camera."""

import itertools
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

from lidarpainter_models.evaluation.held_out import HeldOut
from lidarpainter_models.evaluation.scene_scores import (
    score_geometry,
    score_recorded,
    score_synthetic,
)
from lidarpainter_models.evaluation.score_tables import DEPTH, Scores
from lidarpainter_models.evaluation.settings import EvaluationConfig
from lidarpainter_models.evaluation.shown import ShownScene
from lidarpainter_models.metrics.images import psnr_from_error
from lidarpainter_models.metrics.perceptual import PerceptualDistances, load_distances
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.synthetic.street import SyntheticStreet

GENERATOR_ENTRY = "generator"
"""Entry of a scene's manifest by which the synthetic street is built again."""
NO_IMAGES = "nobody took images there"
NO_INCEPTION = "Inception weights are user-supplied and none were given"


@dataclass(frozen=True, kw_only=True, eq=False)
class SceneEvaluation:
    """How fitted scenes are held against the views that no fit saw."""

    held_out: HeldOut
    config: EvaluationConfig

    def scores(self, shown: ShownScene, progress: Callable[[int, int], None]) -> Scores:
        """Recorded views, views beside the path, and depth at both, over a sample of the views."""
        shifts = self.config.scoring.shifts
        held_out = self.held_out.sampled(self.config.scoring.most_views)
        distances = load_distances(
            self.config.feature_weights, self.config.lpips, shown.scene.device
        )
        cameras = tuple(dict.fromkeys(view.camera_name for view in held_out.test_views))
        num_views, is_known = len(held_out.test_views), known_street(held_out.scene)
        # each view at both poses, where truth is known at every shift, and everywhere for depth
        times = 2 + (len(shifts) if is_known else 0) + 1 + len(shifts)
        renders = itertools.count(1)

        def told() -> None:
            progress(next(renders), num_views * times)

        parts = {name: self._of_camera(shown, held_out, name, distances, told) for name in cameras}
        recorded = _mean([recorded for recorded, _novel in parts.values()])
        novel = {
            shift.name: _mean([novel[shift.name] for _recorded, novel in parts.values()])
            for shift in shifts
        }
        fractions = score_geometry(held_out, shown.scene, shifts, told=told)
        for name, fraction in fractions.items():
            novel.get(name, recorded)[DEPTH] = fraction
        recorded["num_held_out"] = len(self.held_out.test_views)
        by_camera = {name: recorded for name, (recorded, _novel) in parts.items()}
        return {"recorded": recorded, "novel": novel, "recorded_by_camera": by_camera}

    def _of_camera(
        self,
        shown: ShownScene,
        held_out: HeldOut,
        name: str,
        distances: PerceptualDistances,
        told: Callable[[], None],
    ) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
        shifts = self.config.scoring.shifts
        views = [view for view in held_out.test_views if view.camera_name == name]
        part = replace(held_out, test_views=views)
        fitted = shown.scene
        render = shown.renderer(name)
        recorded = score_recorded(render, part, fitted, distances=distances, told=told)
        street = known_street(part.scene)
        if street is None:
            return recorded, {shift.name: _unknown(len(views)) for shift in shifts}
        return recorded, score_synthetic(
            render, part, fitted, street, shifts, distances=distances, told=told
        )


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
        merged["actors_psnr"] = _of_all(merged["psnr_by_actor"])
    return merged


def _of_all(actors: Mapping[str, Mapping[str, Any]]) -> float | None:
    """PSNR over the pixels of all actors; None without any."""
    num = sum(found["num_pixels"] for found in actors.values())
    if not num:
        return None
    return psnr_from_error(sum(map(_summed_error, actors.values())) / num)


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
    reasons |= dict.fromkeys(("fid", "kid"), NO_INCEPTION)
    return {
        **dict.fromkeys(reasons),
        **{f"{name}_reason": reason for name, reason in reasons.items()},
        "num_views": num_views,
    }
