"""The plan of a fit: steps, Gaussians, learning rates, memory and time, made once and followed.

What the views show (`seen_surface`) times the effort gives the steps and the most Gaussians; what
is set stays as it is; a limit of memory lowers the Gaussians. Nothing changes a plan afterwards: a
limit of time only ends the fit after fewer steps (`clock`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from statistics import fmean
from typing import Any

import torch

from lidarpainter_models.gaussians.fitting.config import START_SHARE, FitConfig
from lidarpainter_models.gaussians.fitting.memory import (
    FitMemory,
    gaussians_within_limit,
    planned_memory,
)
from lidarpainter_models.gaussians.fitting.seen_surface import (
    SeenSurface,
    seen_surface,
    with_shown_beside,
)
from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene
from lidarpainter_models.gaussians.model.sky import sky_layout
from lidarpainter_models.observations.views import GuidanceView, SceneObservations


@dataclass(frozen=True, kw_only=True, eq=False)
class FitPlan:
    """What a fit is going to do."""

    settings: FitConfig
    """As asked for, with every number that was left open."""
    surface: SeenSurface
    """What the recorded and the painted views show."""
    memory: FitMemory
    device: torch.device
    num_views: int
    """Recorded views."""
    pixels_per_view: float
    """Mean over the recorded views."""
    keeps_images: bool = True
    """Whether images lie on the device, or are sent there one by one."""

    @property
    def planned_bytes(self) -> int:
        """Memory of the whole process on a CPU, of the device elsewhere."""
        return self.memory.of_process if self.device.type == "cpu" else self.memory.total

    def numbers(self) -> dict[str, Any]:
        """Return the plan as JSON values, such as are stored beside the fitted scene."""
        settings = self.settings
        return {
            "steps": settings.steps,
            "most_gaussians": settings.densification.budget,
            "first_gaussians": settings.initialisation.num_gaussians,
            "num_views": self.num_views,
            "surface_pixels": self.surface.num_pixels,
            "whole_views": self.surface.whole_views,
            "planned_bytes": self.planned_bytes,
            "memory_limit_bytes": settings.memory_bytes,
            "time_limit_s": settings.time_limit_s,
        }

    def in_words(self) -> str:
        """Return such as `84 views, 0.9 Mpx of surface, at most 210k Gaussians, 4,800 steps`."""
        most = self.settings.densification.budget
        limit_s = self.settings.time_limit_s
        return (
            f"{self.num_views} views, {self.surface.num_pixels / 1e6:.2g} Mpx of surface, "
            f"at most {in_thousands(most)} Gaussians, {self.settings.steps:,} steps"
            f"{'' if limit_s is None else f' or {limit_s:,.0f} s'}, "
            f"{self.planned_bytes / 1e9:.2g} GB on {self.device}"
        )


def plan_fit(
    observations: SceneObservations,
    config: FitConfig,
    *,
    start: GaussianScene | None = None,
    guidance: Sequence[GuidanceView] = (),
    device: torch.device,
    keeps_images: bool = True,
) -> FitPlan:
    """Plan a fit from what its views show; a number of the settings that is 0 follows from them.

    A `start` is not made smaller. Painted views show more surface and take memory, of which only a
    CPU has a limit; `keeps_images` says whether images lie on the device.

    Raises:
        ConfigError: the memory allowed holds no fit.
    """
    street = observations.lidar_map.street.xyz_m if observations.is_estimated else None
    views = observations.views
    surface = with_shown_beside(seen_surface(views, street), views, guidance)
    settings = planned_settings(config, surface)
    gaussians = None if start is None else start.gaussians
    sky = sky_layout([view.camera for view in views])
    if device.type == "cpu" and config.memory_bytes is not None:
        most = gaussians_within_limit(
            observations, settings, sky, start=gaussians, guidance=guidance
        )
        settings = planned_settings(config, surface, most)
    memory = planned_memory(
        observations, settings, sky, start=gaussians, guidance=guidance, keeps_images=keeps_images
    )
    return FitPlan(
        settings=settings,
        surface=surface,
        memory=memory,
        device=device,
        num_views=len(views),
        pixels_per_view=fmean(view.camera.width_px * view.camera.height_px for view in views),
        keeps_images=keeps_images,
    )


def planned_settings(
    config: FitConfig, surface: SeenSurface, most_gaussians: int | None = None
) -> FitConfig:
    """Return the settings with every number that was left open; what is set stays.

    Where memory is limited there may be `most_gaussians`, at first and later.
    """
    effort, growth, start = config.effort, config.densification, config.initialisation
    budget = growth.budget or max(round(effort.gaussians_per_pixel * surface.num_detailed), 1)
    num_gaussians = start.num_gaussians or max(round(START_SHARE * budget), 1)
    if most_gaussians is not None:
        budget, num_gaussians = min(budget, most_gaussians), min(num_gaussians, most_gaussians)
    steps = config.steps or max(round(effort.looks * surface.whole_views), 1)
    return replace(
        config,
        steps=steps,
        densification=replace(growth, budget=budget),
        initialisation=replace(start, num_gaussians=num_gaussians),
        learning_rates=config.learning_rates.over(steps / max(surface.whole_views, 1.0)),
    )


def in_thousands(count: float) -> str:
    """Return such as `850`, `9.8k`, `210k` or `3,050k`."""
    if count < 1000:
        return f"{count:.0f}"
    return f"{count / 1000:,.{1 if count < 10_000 else 0}f}k"
