"""Whether going on with painted views made a scene better, told without any true image.

Asked where views were painted and half as far from the recorded path, where what a round spoils
shows first: how good a frame is likely to be there by what recorded images, LiDAR and surface vouch
for (`view_confidence`), which no painting takes part in. World: x forward, y left, z up; metres.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import fmean

from lidarpainter_models.conditioning.view_evidence import EvidenceGatherer
from lidarpainter_models.evaluation.view_confidence import BUNDLED
from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.observations.views import GuidanceView, SceneObservations, TrainingView
from lidarpainter_models.scenes.splits import evenly_taken

MOST_VIEWS = 4
"""Painted views that are asked for, each at two places."""
MOST_LOST_DB = 0.1
"""What the likely PSNR of two equally good scenes may differ by."""


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
    """What a round gained.

    Args:
        before: the scene that the views were painted of.
        after: the one that was fitted on with them.
        observations: what was recorded.
        guidance: painted views, one at least.
    """
    chosen = evenly_taken(guidance, MOST_VIEWS)
    views = [(view.camera, view.timestamp_ns) for view in chosen]
    views += [(_halfway(view, observations.views), view.timestamp_ns) for view in chosen]

    def likely_db(scene: GaussianScene) -> float:
        gatherer = EvidenceGatherer(scene, observations.lidar_map, observations.views)
        return fmean(BUNDLED.of(gatherer.of(*view)).predicted_db for view in views)

    return RoundGain(before_db=likely_db(before), after_db=likely_db(after))


def _halfway(painted: GuidanceView, views: Sequence[TrainingView]) -> Camera:
    """The painted view's camera, half as far from the nearest one that was there at that time."""
    pose = painted.camera.world_from_camera
    present = [view for view in views if view.timestamp_ns == painted.timestamp_ns] or views
    centres = [view.camera.centre_world.to(pose) for view in present]
    nearest = min(centres, key=lambda centre: float((centre - pose[:3, 3]).norm()))
    halfway = pose.clone()
    halfway[:3, 3] = 0.5 * (pose[:3, 3] + nearest)
    return painted.camera.at(halfway)
