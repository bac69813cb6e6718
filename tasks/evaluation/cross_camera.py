"""Judge a fitted scene by cameras it was not trained on, where they overlap one that it was."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from prefect import task

from catalog.artefacts import Workplace
from catalog.store import open_store
from lidarpainter_models.conditioning.conditions import ConditionBuilder
from lidarpainter_models.errors import ConfigError, DataError
from lidarpainter_models.evaluation.held_out import HeldOut
from lidarpainter_models.evaluation.judged_views import Renderer
from lidarpainter_models.evaluation.scene_scores import painted_renderer, scene_renderer
from lidarpainter_models.evaluation.strip_views import judging_cameras, strip_views
from lidarpainter_models.evaluation.strips import calibrate_strip, score_strips
from lidarpainter_models.gaussians.model.scene_graph import GaussianScene
from lidarpainter_models.painter import load_painter
from lidarpainter_models.scenes.splits import ViewSplit
from tasks.evaluation.scene import JudgeSettings
from tasks.evaluation.scores import SCORES_FILE
from tasks.json_files import write_json
from tasks.painter.painters import painter_digest
from tasks.progress import listener
from tasks.scenes import SplitSpec, open_split
from tasks.stages import STAGE_OPTIONS, StageResult, run_stage
from tasks.stored import FittedRef, load_observations, load_scene


@dataclass(frozen=True, kw_only=True, eq=False)
class _Judged:
    """What the side cameras look at."""

    held_out: HeldOut
    views: ViewSplit
    fitted: GaussianScene
    fitted_camera: str
    render: Renderer


@task(**STAGE_OPTIONS)
def evaluate_strips(
    store_path: Path,
    stage: str,
    split: SplitSpec,
    fitted: FittedRef,
    settings: JudgeSettings,
    view_time_painter: str | None = None,
) -> StageResult:
    """Score held-out frames of every camera that the fit did not see.

    Raises:
        ConfigError: the fit saw every camera of the scene.
    """
    store = open_store(store_path)
    recorded, views = open_split(store, split)
    held_out = HeldOut(scene=recorded, test_views=views.test, observation=settings.observation)
    trained = tuple(dict.fromkeys(view.camera_name for view in views.train))
    cameras = judging_cameras(held_out, trained)
    if not cameras:
        raise ConfigError(
            f"the fit saw every camera of {split.scene_id}; leave one out with --train-cameras"
        )

    def build(place: Workplace) -> dict[str, Any]:
        scene = load_scene(store, fitted.gaussians)
        render = scene_renderer(scene, trained[0])
        if view_time_painter is not None:
            seen = load_observations(store, fitted.observations)
            builder = ConditionBuilder(
                scene, seen.lidar_map, seen.views, config=settings.conditions
            )
            render = painted_renderer(builder, load_painter(view_time_painter), trained[0])
        judged = _Judged(
            held_out=held_out, views=views, fitted=scene, fitted_camera=trained[0], render=render
        )
        scores = {}
        for done, name in enumerate(cameras, start=1):
            scores[name] = _score(judged, name)
            listener().advanced(stage, done, len(cameras), "")
        write_json(place.output / SCORES_FILE, scores)
        return {"num_cameras": len(cameras)}

    return run_stage(
        store,
        stage=stage,
        kind="strips",
        inputs={
            "scene": recorded.content_digest,
            "observations": fitted.observations.digest,
            "gaussians": fitted.gaussians.digest,
            "painter": painter_digest(view_time_painter or "none"),
        },
        config={
            "split": split,
            "observation": asdict(settings.observation),
            "conditions": asdict(settings.conditions),
        },
        build=build,
    )


def _score(judged: _Judged, name: str) -> dict[str, Any]:
    """One camera's scores, or why there are none."""

    def views_of(frames: tuple[int, ...]) -> list[Any]:
        return strip_views(
            judged.held_out,
            judged.fitted,
            judging_camera=name,
            fitted_camera=judged.fitted_camera,
            frames=frames,
        )

    try:
        calibration = calibrate_strip(judged.render, views_of(judged.views.train_frames))
        return asdict(score_strips(judged.render, views_of(judged.views.test_frames), calibration))
    except DataError as error:
        return {"psnr": None, "psnr_reason": str(error)}
