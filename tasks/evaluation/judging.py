"""Every figure of one fitted scene under one way of rendering it, camera by camera."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from lidarpainter_models.evaluation.held_out import HeldOut
from lidarpainter_models.evaluation.judged_views import Renderer
from lidarpainter_models.evaluation.scene_scores import (
    score_geometry,
    score_recorded,
    score_synthetic,
)
from lidarpainter_models.gaussians.model.scene_graph import GaussianScene
from lidarpainter_models.geometry.trajectories import Shift
from lidarpainter_models.metrics.perceptual import PerceptualDistances
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.synthetic.street import SyntheticStreet
from tasks.evaluation.scores import DEPTH, Scores

GENERATOR_ENTRY = "generator"
"""Entry of a scene's manifest by which the synthetic street is built again."""
NO_IMAGES = "nobody took images there"
NO_INCEPTION = "Inception weights are user-supplied and none were given"


@dataclass(frozen=True, kw_only=True, eq=False)
class Judgement:
    """What is judged, and how it is rendered."""

    held_out: HeldOut
    fitted: GaussianScene
    render_as: Callable[[str], Renderer]
    """Renderer in the colours of a camera."""
    shifts: Sequence[Shift]
    distances: PerceptualDistances
    progress: Callable[[int, int], None]

    def scores(self) -> Scores:
        """Recorded views, views beside the path, and depth at both."""
        cameras = tuple(dict.fromkeys(view.camera_name for view in self.held_out.test_views))
        parts = {name: self._of_camera(name) for name in cameras}
        recorded = _mean([recorded for recorded, _novel in parts.values()])
        novel = {
            shift.name: _mean([novel[shift.name] for _recorded, novel in parts.values()])
            for shift in self.shifts
        }
        fractions = score_geometry(self.held_out, self.fitted, self.shifts, progress=self.progress)
        for name, fraction in fractions.items():
            novel.get(name, recorded)[DEPTH] = fraction
        by_camera = {name: recorded for name, (recorded, _novel) in parts.items()}
        return {"recorded": recorded, "novel": novel, "recorded_by_camera": by_camera}

    def _of_camera(self, name: str) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
        views = [view for view in self.held_out.test_views if view.camera_name == name]
        part, render = replace(self.held_out, test_views=views), self.render_as(name)
        recorded = score_recorded(render, part, self.fitted, distances=self.distances)
        street = known_street(part.scene)
        if street is None:
            return recorded, {shift.name: _unknown(len(views)) for shift in self.shifts}
        novel = score_synthetic(
            render, part, self.fitted, street, self.shifts, distances=self.distances
        )
        return recorded, novel


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
    merged: dict[str, Any] = {}
    for name, first in parts[0].items():
        values = [part[name] for part in parts]
        if name == "num_views":
            merged[name] = sum(values)
        elif isinstance(first, Mapping):
            merged[name] = _mean(values)
        elif all(isinstance(value, (int, float)) for value in values):
            weights = [part["num_views"] for part in parts]
            total = sum(value * weight for value, weight in zip(values, weights, strict=True))
            merged[name] = total / sum(weights)
        else:
            merged[name] = first if isinstance(first, str) else None
    return merged


def _unknown(num_views: int) -> dict[str, Any]:
    """The figures of a place where nobody took an image."""
    reasons = dict.fromkeys(("psnr", "ssim", "lpips"), NO_IMAGES)
    reasons |= dict.fromkeys(("fid", "kid"), NO_INCEPTION)
    return {
        **dict.fromkeys(reasons),
        **{f"{name}_reason": reason for name, reason in reasons.items()},
        "num_views": num_views,
    }
