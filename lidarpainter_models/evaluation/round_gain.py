"""Whether going on with painted views made a scene better, told without any true image.

Asked where views were painted and half as far from the recorded path: how good a frame is likely
to be there by what recorded images, LiDAR and surface vouch for (`view_confidence`), which no
painting takes part in. How closely the training views are shown does not count: more steps always
sharpen them. World: x forward, y left, z up; metres.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from statistics import fmean

from lidarpainter_models.conditioning.view_evidence import EvidenceGatherer, ViewEvidence
from lidarpainter_models.evaluation.view_confidence import BUNDLED
from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.observations.views import GuidanceView, SceneObservations, TrainingView
from lidarpainter_models.scenes.splits import evenly_taken

MOST_VIEWS = 10
"""Views that are asked for: of the five shifts painted by default one there and one halfway."""
MOST_LOST_DB = 0.1
"""Sound rounds of two streets and PandaSet 002 gained between -0.01 and 0.27 (docs/measuring.md);
views painted in false colours lose decibels."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RoundGain:
    """Likely PSNR before and after a round, means over the views asked for."""

    before_db: float
    after_db: float

    @property
    def is_worse(self) -> bool:
        """Whether the round is better taken back."""
        return self.after_db < self.before_db - MOST_LOST_DB


def round_gain(
    before: GaussianScene,
    after: GaussianScene,
    observations: SceneObservations,
    guidance: Sequence[GuidanceView],
) -> RoundGain:
    """What a scene gained by being fitted on with views, one at least, that were painted of it."""
    chosen = evenly_taken(guidance, MOST_VIEWS)
    views = [(view.camera, view.timestamp_ns) for view in chosen[::2]]
    views += [(_halfway(view, observations.views), view.timestamp_ns) for view in chosen[1::2]]

    def evidence(scene: GaussianScene) -> list[ViewEvidence]:
        gatherer = EvidenceGatherer(scene, observations.lidar_map, observations.views)
        return [gatherer.of(*view) for view in views]

    first = evidence(before)
    second = [
        replace(late, recorded_db=early.recorded_db)
        for early, late in zip(first, evidence(after), strict=True)
    ]
    return RoundGain(before_db=_likely_db(first), after_db=_likely_db(second))


def _likely_db(evidence: Sequence[ViewEvidence]) -> float:
    return fmean(BUNDLED.of(one).predicted_db for one in evidence)


def _halfway(painted: GuidanceView, views: Sequence[TrainingView]) -> Camera:
    """The painted view's camera, half as far from the nearest one that was there at that time."""
    pose = painted.camera.world_from_camera
    present = [view for view in views if view.timestamp_ns == painted.timestamp_ns] or views
    centres = [view.camera.centre_world.to(pose) for view in present]
    nearest = min(centres, key=lambda centre: float((centre - pose[:3, 3]).norm()))
    halfway = pose.clone()
    halfway[:3, 3] = 0.5 * (pose[:3, 3] + nearest)
    return painted.camera.at(halfway)
