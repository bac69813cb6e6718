"""What speaks for a view of a fitted scene, measured without the view's true image.

Recorded images are carried into the view by depth and compared with the render; what they, the
LiDAR and the surface vouch for is counted pixel by pixel (`confidence`). That is done on a small
copy of the view, `EVIDENCE_WIDTH_PX` wide, so that it costs little whatever the size of the images;
how closely a fit shows at its own size what it saw is measured once for each camera.
World: x forward, y left, z up; metres.
"""

import math
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from statistics import fmean

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lidarpainter_models.conditioning.conditions import ConditionBuilder
from lidarpainter_models.conditioning.pixel_confidence import view_support
from lidarpainter_models.conditioning.settings import ConditionConfig
from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.lidar.lidar_map import LidarMap
from lidarpainter_models.observations.image_shrinking import shrink_image
from lidarpainter_models.observations.views import TrainingView
from lidarpainter_models.painter.protocol import PaintingConditions
from lidarpainter_models.scenes.splits import evenly_taken

EVIDENCE_WIDTH_PX = 160
"""Confidences are calibrated with it."""
SPACING_RAD = 0.003
"""Between points of the map that it is gathered with, half a pixel: on PandaSet 002 all of them
cost twice as much and predicted 0.04 dB more."""
MOST_CHECKED = 6
"""Training views of a camera whose own images say how closely the fit shows what it saw."""
GATHERED = ConditionConfig(num_references=2, num_sources=3)
"""What is carried into a view to be compared: fewer images than a painter is shown, and the same
whatever a run's painter is shown, since confidences are calibrated with it."""
LEAST_ERROR = 1e-5
"""Squared differences below it are noise of the sensor: 50 dB."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewEvidence:
    """What was measured of one view; decibels are those of a mean squared difference, peak 1.

    More of each speaks for a better frame.
    """

    recorded_db: float
    """PSNR of the fit on training views of the camera, at the size of the fit."""
    expected_db: float
    """Render against recorded images carried here; where none reaches, the render's own contrast
    counts as the difference."""
    support: float
    """Mean geometric confidence, 0 to 1: what warped images, LiDAR and surface vouch for."""


class EvidenceGatherer:
    """Measures what speaks for views of one scene."""

    def __init__(
        self, scene: GaussianScene, lidar_map: LidarMap, training_views: Sequence[TrainingView]
    ) -> None:
        """Take the scene as it is now, and what the fit saw."""
        self.scene = scene
        self._lidar_map, self._views = lidar_map, tuple(training_views)
        self._recorded_db: dict[str | None, float] = {}

    @cached_property
    def builder(self) -> ConditionBuilder:
        """Carries what is known into views, at their small size."""
        small = [_small_view(view) for view in self._views]
        coarse = self._lidar_map.measured().thinned(SPACING_RAD)
        return ConditionBuilder(self.scene, coarse, small, config=GATHERED)

    def showing(self, scene: GaussianScene) -> "EvidenceGatherer":
        """Measures what speaks for views of the scene with its actors elsewhere.

        Recorded images show them where they were, and so speak against what shows them elsewhere.
        """
        other = copy(self)
        other.builder = self.builder.showing(scene, self.builder.boxes)
        return other

    @property
    def camera_names(self) -> tuple[str, ...]:
        """Cameras that the fit saw, sorted."""
        return tuple(sorted({view.key[1] for view in self._views}))

    def of(self, camera: Camera, timestamp_ns: int, camera_name: str | None = None) -> ViewEvidence:
        """What speaks for the image of a camera, taken as it stands, at a time."""
        camera = camera.no_wider(EVIDENCE_WIDTH_PX)
        conditions = self.builder.conditions(camera, timestamp_ns, camera_name=camera_name)
        support = view_support(conditions, camera, self.builder.recorded_cameras)
        return ViewEvidence(
            recorded_db=self._measured_db(camera_name),
            expected_db=_decibels(_difference(conditions).mean()),
            support=float(support.mean()),
        )

    def _measured_db(self, camera_name: str | None) -> float:
        """Mean PSNR of training views of a camera, evenly over time; of all for a strange one."""
        if camera_name not in self._recorded_db:
            chosen = evenly_taken(self._showing(camera_name), MOST_CHECKED)
            self._recorded_db[camera_name] = fmean(self._training_db(view) for view in chosen)
        return self._recorded_db[camera_name]

    def _showing(self, camera_name: str | None) -> list[TrainingView]:
        """Training views of a camera that show more than the own car; all for a strange one."""
        showing = [view for view in self._views if view.hidden is None or not view.hidden.all()]
        return [view for view in showing if view.key[1] == camera_name] or showing

    def _training_db(self, view: TrainingView) -> float:
        frame_index, name = view.key
        render = self.scene.render(
            view.camera, view.timestamp_ns, camera_name=name, view_key=(frame_index, name)
        )
        truth = view.rgb.to(render.rgb)
        error = (render.rgb.clamp(0, 1) - truth).square().mean(dim=-1)
        if view.hidden is not None:
            error = error[~view.hidden.to(error.device)]
        return _decibels(error.mean())


def _difference(conditions: PaintingConditions) -> Float[Tensor, "height width"]:
    """Squared difference of the render from what was carried here; else the render's contrast."""
    valid = conditions.warp_valid
    count = valid.sum(dim=0)
    mean = (conditions.warp_rgb * valid[..., None]).sum(dim=0) / count.clamp(min=1)[..., None]
    error = (conditions.render_rgb - mean).square().mean(dim=-1)
    contrast = conditions.render_rgb.flatten(0, 1).var(dim=0).mean()
    return torch.where(count > 0, error, contrast)


def _decibels(mean_square: Float[Tensor, ""]) -> float:
    return -10 * math.log10(max(float(mean_square), LEAST_ERROR))


def _small_view(view: TrainingView) -> TrainingView:
    """A training view as wide as the evidence is gathered; masks and depth of the nearest pixel."""
    camera = view.camera.no_wider(EVIDENCE_WIDTH_PX)
    if camera.width_px == view.camera.width_px:
        return view
    rows = _nearest(camera.height_px, view.camera.height_px)[:, None]
    columns = _nearest(camera.width_px, view.camera.width_px)
    size = {"width_px": camera.width_px, "height_px": camera.height_px}
    return replace(
        view,
        camera=camera,
        rgb_u8=shrink_image(view.rgb_u8, **size),
        sky_mask=view.sky_mask[rows, columns],
        lidar_depth_m=view.lidar_depth_m[rows, columns],
        hidden=None if view.hidden is None else view.hidden[rows, columns],
    )


def _nearest(count: int, of: int) -> Int[Tensor, " count"]:
    """Of so many pixels, those under the centres of `count` cells."""
    return ((torch.arange(count) + 0.5) * of / count).long()
