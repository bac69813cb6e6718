"""Fitted scenes of the store, ready to be judged or shown: as they are or painted at view time."""

from collections.abc import Callable
from functools import lru_cache, partial

import torch

from catalog.store import Store
from lidarpainter_models.conditioning.conditions import ConditionBuilder
from lidarpainter_models.conditioning.settings import ConditionConfig
from lidarpainter_models.evaluation.shown import ShownScene, ViewTimePainting
from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene
from lidarpainter_models.observations.views import SceneObservations
from lidarpainter_models.painter.selection import PainterChoice
from tasks.opened import OpenedRun
from tasks.specs import FittedRef
from tasks.stored import load_observations, load_scene


def painted_by(
    this: OpenedRun, fitted: FittedRef, conditions: ConditionConfig
) -> Callable[[], ViewTimePainting]:
    """Gathers what the run's painter needs to paint a fitted scene at view time."""
    return partial(view_time_painting, this.store, fitted, conditions, this.painter, this.device)


def shown_scene(
    store: Store,
    fitted: FittedRef,
    conditions: ConditionConfig,
    painter: PainterChoice | None,
    device: torch.device,
) -> ShownScene:
    """A fitted scene as it is, or as a painter paints it at view time."""
    if painter is None:
        return ShownScene(scene=load_scene(store, fitted.gaussians).to(device))
    painting = view_time_painting(store, fitted, conditions, painter, device)
    return ShownScene(scene=painting.conditions.scene, painting=painting)


def view_time_painting(
    store: Store,
    fitted: FittedRef,
    conditions: ConditionConfig,
    painter: PainterChoice,
    device: torch.device,
) -> ViewTimePainting:
    """What a painter needs to paint a fitted scene at view time."""
    builder = condition_builder(store, fitted, conditions, device)
    return ViewTimePainting(conditions=builder, painter=painter, device=device)


def condition_builder(
    store: Store, fitted: FittedRef, config: ConditionConfig, device: torch.device
) -> ConditionBuilder:
    """What a painter is shown of a fitted scene, gathered on a device; kept, with what it found."""
    seen = load_observations(store, fitted.observations)
    return _builder(load_scene(store, fitted.gaussians), seen, config, device)


def forget_shown() -> None:
    """Let go of what was gathered for a painter: views of up to 2 GB."""
    _builder.cache_clear()


@lru_cache(maxsize=1)
def _builder(
    scene: GaussianScene, seen: SceneObservations, config: ConditionConfig, device: torch.device
) -> ConditionBuilder:
    return ConditionBuilder(scene.to(device), seen.lidar_map, seen.views, config=config)
