"""A recording fitted, painted and fitted further in seconds, with the library and without a store.

What the product promises is asked of these scenes: the steps are those of `reconstruct`, with half
of the preset `brief`'s views painted and one round.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import torch

import lidarpainter_models as lp
from lidarpainter_models.conditioning.novel_guidance import (
    guidance_views,
    novel_cameras,
    paint_novel_views,
)
from lidarpainter_models.conditioning.settings import NovelGuidanceConfig
from lidarpainter_models.evaluation.held_out import HeldOut
from lidarpainter_models.evaluation.shown import ShownScene, ViewTimePainting
from lidarpainter_models.evaluation.strips import StripEvaluation
from lidarpainter_models.gaussians.fitting.config import (
    EffortConfig,
    FitConfig,
    GuidanceConfig,
    continuation,
)
from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene
from lidarpainter_models.painter.selection import PainterChoice

FRONT = "front_camera"
BESIDE = NovelGuidanceConfig(
    shifts=(lp.Shift(lateral_m=2.0), lp.Shift(lateral_m=-2.0)), every_nth=2
)
ROUND_LOOKS = 75.0


@dataclass(frozen=True, kw_only=True, eq=False)
class ShortReconstruction:
    """One recording and what becomes of it, each part made when it is first asked for."""

    folder: Path
    width_px: int
    painter: str = "nano"
    seed: int = 0
    looks: float = 150.0

    @cached_property
    def recording(self):
        return lp.open_scene(self.folder)

    @cached_property
    def split(self):
        return lp.split_views(self.recording, "alternate", (FRONT,))

    @cached_property
    def size(self) -> lp.ObservationConfig:
        return lp.ObservationConfig(width_px=self.width_px)

    @cached_property
    def seen(self):
        return lp.prepare_observations(self.recording, self.split, self.size)

    @cached_property
    def config(self) -> FitConfig:
        effort = EffortConfig(looks=self.looks, gaussians_per_pixel=0.2)
        return FitConfig(effort=effort, seed=self.seed)

    @cached_property
    def first(self) -> GaussianScene:
        """The first fit."""
        return lp.fit_gaussians(self.seen, self.config).scene

    @cached_property
    def painted(self) -> GaussianScene:
        """The first fit after one round."""
        views = novel_cameras(
            self.painting.conditions.refined_views,
            self.recording.frame_indices,
            self.recording.world_from_ego,
            config=BESIDE,
        )
        painter = self.painting.painter.load(self.painting.device)
        paintings = paint_novel_views(self.painting.conditions, painter, views, config=BESIDE)
        return self._continued(guidance_views(paintings))

    @cached_property
    def unpainted(self) -> GaussianScene:
        """The first fit after as many more steps without painted views."""
        return self._continued([])

    @cached_property
    def painting(self) -> ViewTimePainting:
        """What the painter is told of views of the first fit."""
        return self.painting_of(self.first)

    def painting_of(self, scene: GaussianScene) -> ViewTimePainting:
        """What the painter is told of views of a scene."""
        known = lp.ConditionBuilder(scene, self.seen.lidar_map, self.seen.views)
        return ViewTimePainting(
            conditions=known, painter=PainterChoice.of(self.painter), device=torch.device("cpu")
        )

    def scores(self, scene: GaussianScene, shifts=BESIDE.shifts):
        """`recorded` and `novel` figures of a scene, as `reconstruct --json` has them."""
        return lp.evaluate(scene, self.recording, self.split, self.size, shifts=shifts)

    def strips(self, scene: GaussianScene, *, is_painted: bool) -> dict[str, float]:
        """PSNR of each camera that no fit saw, where it sees what a fitted one sees."""
        held_out = HeldOut(scene=self.recording, test_views=self.split.test, observation=self.size)
        painting = self.painting_of(scene) if is_painted else None
        shown = ShownScene(scene=scene, painting=painting)
        strips = StripEvaluation(held_out=held_out, views=self.split)
        scores = strips.scores(shown, lambda _done, _total: None)
        return {name: found["psnr"] for name, found in scores.items()}

    def _continued(self, guidance) -> GaussianScene:
        config = replace(
            continuation(self.config, looks=ROUND_LOOKS, guidance=GuidanceConfig()), seed=self.seed
        )
        return lp.fit_gaussians(self.seen, config, start=self.first, guidance=guidance).scene


def beside(scores) -> float:
    """Mean PSNR of the shifted views of a street."""
    found = [values["psnr"] for values in scores["novel"].values()]
    return sum(found) / len(found)


def depth_beside(scores) -> float:
    """Mean share of LiDAR depths within 5 % beside the path."""
    found = [values["depth_within_5_percent"] for values in scores["novel"].values()]
    return sum(found) / len(found)
