"""Paint views that nobody recorded, to guide the fit on."""

from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from torch import Tensor

from catalog.artefacts import ArtefactRef, Workplace
from catalog.store import Store
from lidarpainter_models.conditioning.novel_guidance import (
    NovelPainting,
    guidance_views,
    novel_cameras,
    paint_novel_views,
)
from lidarpainter_models.conditioning.settings import ConditionConfig, NovelGuidanceConfig
from lidarpainter_models.evaluation.shown import ViewTimePainting
from lidarpainter_models.export.images import write_png
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.observations.views import GuidanceView
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.storage.tensor_files import read_tensors, write_tensors
from tasks.evaluation.shown import painted_by
from tasks.opened import opened
from tasks.progress import Progress
from tasks.specs import FittedRef, RunSpec
from tasks.stages import StageResult, run_stage, stage_task

GUIDANCE_FILE = "guidance.safetensors"
IMAGE_FOLDER = "images"
FULL_BYTE = 255
LENS = ("fx_px", "fy_px", "cx_px", "cy_px", "width_px", "height_px")


def save_guidance(folder: Path, paintings: Sequence[NovelPainting]) -> None:
    """Write the views that guide, and the middle view of every shift as images."""
    arrays: dict[str, Tensor] = {}
    records: list[dict[str, Any]] = []
    for index, view in enumerate(guidance_views(paintings)):
        arrays[f"{index}.rgb_u8"] = view.rgb_u8
        arrays[f"{index}.weight_u8"] = view.weight_u8
        arrays[f"{index}.lidar_depth_m"] = view.lidar_depth_f16
        arrays[f"{index}.world_from_camera"] = view.camera.world_from_camera
        lens = {name: getattr(view.camera, name) for name in LENS}
        records.append({"timestamp_ns": view.timestamp_ns, "lens": lens})
    write_tensors(folder / GUIDANCE_FILE, arrays, {"views": records})
    for painting in paintings:
        for name, rgb_u8 in painting.images.items():
            path = folder / IMAGE_FOLDER / painting.novel.shift.name / f"{name}.png"
            write_png(rgb_u8.float() / FULL_BYTE, path)


def load_guidance(store: Store, ref: ArtefactRef) -> tuple[GuidanceView, ...]:
    """Read the views that guide."""
    store.artefacts.verified(ref)
    arrays, metadata = read_tensors(store.artefacts.files(ref) / GUIDANCE_FILE)
    return tuple(
        GuidanceView(
            camera=Camera(world_from_camera=arrays[f"{index}.world_from_camera"], **row["lens"]),
            timestamp_ns=row["timestamp_ns"],
            rgb_u8=arrays[f"{index}.rgb_u8"],
            weight_u8=arrays[f"{index}.weight_u8"],
            lidar_depth_f16=arrays[f"{index}.lidar_depth_m"],
        )
        for index, row in enumerate(metadata["views"])
    )


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
        inputs=this.inputs(fitted, paints=True),
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
        shown.conditions, shown.painter.load(shown.device), cameras, config=novel, progress=progress
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
