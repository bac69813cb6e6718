"""Paint views that nobody recorded, to guide the fit on."""

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from prefect import task

from catalog.artefacts import Workplace
from catalog.store import open_store
from lidarpainter_models.conditioning.conditions import ConditionBuilder, ConditionConfig
from lidarpainter_models.conditioning.novel_guidance import (
    NovelGuidanceConfig,
    NovelPainting,
    novel_cameras,
    paint_novel_views,
)
from lidarpainter_models.gaussians.model.scene_graph import GaussianScene
from lidarpainter_models.observations.observations import TrainingView
from lidarpainter_models.painter import load_painter
from tasks.painter.painters import painter_digest
from tasks.progress import listener
from tasks.reconstruction.painted_views import save_guidance
from tasks.scenes import open_scene
from tasks.stages import STAGE_OPTIONS, StageResult, run_stage
from tasks.stored import FittedRef, load_observations, load_scene


@dataclass(frozen=True, slots=True, kw_only=True)
class PaintSettings:
    """How novel views are painted."""

    painter: str
    """Name of a painter or path of its weights."""
    novel: NovelGuidanceConfig
    conditions: ConditionConfig


@task(**STAGE_OPTIONS)
def paint(
    store_path: Path,
    stage: str,
    scene_id: str,
    fitted: FittedRef,
    settings: PaintSettings,
    start_frame: int,
) -> StageResult:
    """Render shifted views of a fitted scene, paint them and weigh every pixel.

    Args:
        store_path: the store.
        stage: name of this round's painting.
        scene_id: whose recorded path is shifted.
        fitted: what is rendered.
        settings: see there.
        start_frame: training frame counted from, so that rounds paint different frames.
    """
    store = open_store(store_path)
    recorded = open_scene(store, scene_id)

    def build(place: Workplace) -> dict[str, Any]:
        seen = load_observations(store, fitted.observations)
        scene = load_scene(store, fitted.gaussians)
        builder = ConditionBuilder(scene, seen.lidar_map, seen.views, config=settings.conditions)
        cameras = novel_cameras(
            [refined_view(scene, view) for view in seen.views],
            recorded.frame_indices,
            recorded.world_from_ego,
            config=settings.novel,
            start=start_frame,
        )
        paintings = paint_novel_views(
            builder,
            load_painter(settings.painter),
            cameras,
            config=settings.novel,
            progress=lambda done, total: listener().advanced(stage, done, total, ""),
        )
        save_guidance(place.output, paintings)
        return _summary(paintings, len(cameras))

    return run_stage(
        store,
        stage=stage,
        kind="guidance",
        inputs={
            "scene": recorded.content_digest,
            "observations": fitted.observations.digest,
            "gaussians": fitted.gaussians.digest,
            "painter": painter_digest(settings.painter),
        },
        config={
            "novel": asdict(settings.novel),
            "conditions": asdict(settings.conditions),
            "start": start_frame,
        },
        build=build,
    )


def refined_view(scene: GaussianScene, view: TrainingView) -> TrainingView:
    """A training view with its camera where the fit found it to be."""
    camera = scene.corrected_camera(
        view.camera, timestamp_ns=view.timestamp_ns, camera_name=view.key[1], key=view.key
    )
    return replace(view, camera=camera)


def _summary(paintings: list[NovelPainting], num_cameras: int) -> dict[str, Any]:
    used = [painting for painting in paintings if not painting.gate.is_refused]
    weights = [painting.mean_weight for painting in used]
    return {
        "num_cameras": num_cameras,
        "num_without_room": num_cameras - len(paintings),
        "num_refused": len(paintings) - len(used),
        "num_views": len(used),
        "mean_weight": sum(weights) / len(weights) if weights else 0.0,
    }
