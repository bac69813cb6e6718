"""Judge a fitted scene on views it never saw, as it is or painted at view time."""

from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from prefect import task

from catalog.artefacts import Workplace
from catalog.digests import DIGEST_LENGTH, digest_file
from catalog.store import Store, open_store
from lidarpainter_models.conditioning.conditions import ConditionBuilder, ConditionConfig
from lidarpainter_models.errors import WeightsError
from lidarpainter_models.evaluation.held_out import HeldOut
from lidarpainter_models.evaluation.judged_views import Renderer
from lidarpainter_models.evaluation.scene_scores import (
    ScoringConfig,
    painted_renderer,
    scene_renderer,
)
from lidarpainter_models.gaussians.model.scene_graph import GaussianScene
from lidarpainter_models.metrics.lpips import LpipsFiles
from lidarpainter_models.metrics.perceptual import load_distances
from lidarpainter_models.observations.observations import ObservationConfig
from lidarpainter_models.painter import load_painter
from tasks.evaluation.judging import Judgement
from tasks.evaluation.scores import SCORES_FILE
from tasks.json_files import write_json
from tasks.painter.painters import painter_digest
from tasks.progress import listener
from tasks.scenes import SplitSpec, open_split
from tasks.stages import STAGE_OPTIONS, StageResult, run_stage
from tasks.stored import FittedRef, load_observations, load_scene


@dataclass(frozen=True, slots=True, kw_only=True)
class JudgeSettings:
    """How a fitted scene is judged."""

    observation: ObservationConfig
    scoring: ScoringConfig
    conditions: ConditionConfig
    feature_weights: Path | None = None
    """SqueezeNet 1.1 weights for the feature distance; None leaves it out."""
    lpips: LpipsFiles = field(default_factory=LpipsFiles)
    """Weights for LPIPS; without both files it is left out."""


@task(**STAGE_OPTIONS)
def evaluate(
    store_path: Path,
    stage: str,
    split: SplitSpec,
    fitted: FittedRef,
    settings: JudgeSettings,
    view_time_painter: str | None = None,
) -> StageResult:
    """Score a scene; with a painter, what it shows after painting at view time."""
    store = open_store(store_path)
    recorded, views = open_split(store, split)
    inputs = {
        "scene": recorded.content_digest,
        "observations": fitted.observations.digest,
        "gaussians": fitted.gaussians.digest,
    }
    if view_time_painter is not None:
        inputs["painter"] = painter_digest(view_time_painter)
    inputs |= _weights_digests(settings)

    def build(place: Workplace) -> dict[str, Any]:
        scene = load_scene(store, fitted.gaussians)
        held_out = HeldOut(scene=recorded, test_views=views.test, observation=settings.observation)
        judgement = Judgement(
            held_out=held_out,
            fitted=scene,
            render_as=_renderer(store, fitted, scene, settings.conditions, view_time_painter),
            shifts=settings.scoring.shifts,
            distances=load_distances(settings.feature_weights, settings.lpips),
            progress=lambda done, total: listener().advanced(stage, done, total, ""),
        )
        scores = judgement.scores()
        write_json(place.output / SCORES_FILE, scores)
        return {"psnr": scores["recorded"]["psnr"], "num_views": scores["recorded"]["num_views"]}

    return run_stage(
        store,
        stage=stage,
        kind="evaluation",
        inputs=inputs,
        config={
            "split": split,
            "observation": asdict(settings.observation),
            "scoring": asdict(settings.scoring),
            "conditions": asdict(settings.conditions),
        },
        build=build,
    )


def _renderer(
    store: Store,
    fitted: FittedRef,
    scene: GaussianScene,
    conditions: ConditionConfig,
    painter: str | None,
) -> Callable[[str], Renderer]:
    """Renderers by the camera whose exposure they take."""
    if painter is None:
        return lambda camera_name: scene_renderer(scene, camera_name)
    seen = load_observations(store, fitted.observations)
    builder = ConditionBuilder(scene, seen.lidar_map, seen.views, config=conditions)
    loaded = load_painter(painter)
    return lambda camera_name: painted_renderer(builder, loaded, camera_name)


def _weights_digests(settings: JudgeSettings) -> dict[str, str]:
    """What the perceptual distances depend on."""
    files = {
        "features": settings.feature_weights,
        "lpips backbone": settings.lpips.backbone,
        "lpips heads": settings.lpips.heads,
    }
    return {name: _digest_of(path) for name, path in files.items() if path is not None}


def _digest_of(path: Path) -> str:
    try:
        return digest_file(path)[:DIGEST_LENGTH]
    except OSError as error:
        raise WeightsError(f"no weights at {path}: {error.strerror}") from None
