"""Paint views that nobody recorded, to guide the fit on."""

from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from typing import Any

from catalog.artefacts import Workplace
from lidarpainter_models.conditioning.novel_guidance import (
    NovelPainting,
    novel_cameras,
    paint_novel_views,
)
from lidarpainter_models.conditioning.settings import ConditionConfig, NovelGuidanceConfig
from lidarpainter_models.evaluation.shown import ViewTimePainting
from lidarpainter_models.scenes.driving_scene import DrivingScene
from tasks.evaluation.shown import painted_by
from tasks.opened import opened
from tasks.progress import Progress
from tasks.reconstruction.painted_views import save_guidance
from tasks.specs import FittedRef, RunSpec
from tasks.stages import StageResult, run_stage, stage_task


@stage_task
def paint(
    run: RunSpec,
    stage: str,
    fitted: FittedRef,
    novel: NovelGuidanceConfig,
    conditions: ConditionConfig,
    *,
    start_frame: int,
) -> StageResult:
    """Render shifted views of a fitted scene, paint them and weigh every pixel.

    Training frames are counted from `start_frame`, so that rounds paint different frames.
    """
    this = opened(run)
    return run_stage(
        this.store,
        kernels=run.kernels,
        stage=stage,
        kind="guidance",
        inputs={
            "scene": this.scene.content_digest,
            "observations": fitted.observations.digest,
            "gaussians": fitted.gaussians.digest,
            "painter": this.painter.digest,
        },
        config={"novel": asdict(novel), "conditions": asdict(conditions), "start": start_frame},
        build=partial(
            _build,
            scene=this.scene,
            painting=painted_by(this, fitted, conditions),
            novel=novel,
            start_frame=start_frame,
        ),
    )


def _build(
    place: Workplace,
    progress: Progress,
    *,
    scene: DrivingScene,
    painting: Callable[[], ViewTimePainting],
    novel: NovelGuidanceConfig,
    start_frame: int,
) -> dict[str, Any]:
    shown = painting()
    cameras = novel_cameras(
        shown.conditions.refined_views,
        scene.frame_indices,
        scene.world_from_ego,
        config=novel,
        start=start_frame,
    )
    paintings = paint_novel_views(
        shown.conditions,
        shown.painter.load(shown.device),
        cameras,
        config=novel,
        progress=progress,
    )
    shown.conditions.forget_sources()  # the fit that is continued has no use for a gigabyte of them
    save_guidance(place.output, paintings)
    return _summary(paintings, len(cameras))


def _summary(paintings: list[NovelPainting], num_cameras: int) -> dict[str, Any]:
    used = [painting for painting in paintings if not painting.is_refused]
    weights = [painting.mean_weight for painting in used]
    return {
        "num_cameras": num_cameras,
        "num_without_room": num_cameras - len(paintings),
        "num_refused": len(paintings) - len(used),
        "num_views": len(used),
        "mean_weight": sum(weights) / len(weights) if weights else 0.0,
    }
