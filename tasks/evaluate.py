"""Judge a fitted scene on views it never saw, as it is or painted at view time."""

from collections.abc import Callable
from dataclasses import asdict, dataclass
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
    score_geometry,
    score_recorded,
    score_synthetic,
)
from lidarpainter_models.gaussians.observations import ObservationConfig
from lidarpainter_models.gaussians.scene_graph import GaussianScene
from lidarpainter_models.metrics.squeezenet import SqueezeNetDistance, load_squeezenet_distance
from lidarpainter_models.painter import load_painter
from lidarpainter_models.scenes.synthetic.street import SyntheticStreet
from tasks.painters import painter_digest
from tasks.progress import listener
from tasks.scenes import SplitSpec, open_split
from tasks.scores import SCORES_FILE
from tasks.stages import STAGE_OPTIONS, StageResult, run_stage
from tasks.stored import FittedRef, load_observations, load_scene, write_json

GENERATOR_ENTRY = "generator"
"""Entry of a scene's manifest by which the synthetic street is built again."""


@dataclass(frozen=True, slots=True, kw_only=True)
class JudgeSettings:
    """How a fitted scene is judged."""

    observation: ObservationConfig
    scoring: ScoringConfig
    conditions: ConditionConfig
    feature_weights: Path | None = None
    """SqueezeNet 1.1 weights for the feature distance; None leaves it out."""


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
    if settings.feature_weights is not None:
        inputs["features"] = _digest_of(settings.feature_weights)

    def build(place: Workplace) -> dict[str, Any]:
        scene = load_scene(store, fitted.gaussians)
        held_out = HeldOut(scene=recorded, test_views=views.test, observation=settings.observation)
        render = _renderer(store, fitted, scene, settings.conditions, view_time_painter)
        scores = _scores(held_out, scene, render, settings, stage)
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
) -> Callable[[str | None], Renderer]:
    """Renderers by the camera whose exposure they take."""
    if painter is None:
        return lambda camera_name: scene_renderer(scene, camera_name)
    seen = load_observations(store, fitted.observations)
    builder = ConditionBuilder(scene, seen.lidar_map, seen.views, config=conditions)
    renderer = painted_renderer(builder, load_painter(painter))
    return lambda _camera_name: renderer


def _scores(
    held_out: HeldOut,
    scene: GaussianScene,
    render: Callable[[str | None], Renderer],
    settings: JudgeSettings,
    stage: str,
) -> dict[str, Any]:
    shifts = settings.scoring.shifts
    distance = _feature_distance(settings.feature_weights)
    told = _Steps(stage, 3)
    cameras = tuple(dict.fromkeys(view.camera_name for view in held_out.test_views))
    only_camera = cameras[0] if len(cameras) == 1 else None
    recorded = score_recorded(render(only_camera), held_out, scene, feature_distance=distance)
    told.next()
    num_views = len(held_out.test_views)
    novel = {shift.name: _without_truth(num_views) for shift in shifts}
    if GENERATOR_ENTRY in held_out.scene.manifest:
        street = SyntheticStreet.from_manifest(held_out.scene.manifest)
        novel = score_synthetic(
            render(only_camera), held_out, scene, street, shifts, feature_distance=distance
        )
    told.next()
    for name, fraction in score_geometry(held_out, scene, shifts).items():
        place = novel.get(name, recorded)
        place["depth_within_5_percent"] = fraction
    told.next()
    return {"recorded": recorded, "novel": novel}


def _without_truth(num_views: int) -> dict[str, Any]:
    """The figures of a place where nobody took a picture."""
    missing = dict.fromkeys(("psnr", "ssim", "lpips", "fid", "kid"))
    return {
        **missing,
        "psnr_reason": "nobody took pictures there",
        "ssim_reason": "nobody took pictures there",
        "lpips_reason": "nobody took pictures there",
        "fid_reason": "Inception weights are user-supplied and none were given",
        "kid_reason": "Inception weights are user-supplied and none were given",
        "num_views": num_views,
    }


class _Steps:
    """Tells the listener about steps of one stage."""

    def __init__(self, stage: str, total: int) -> None:
        self._stage, self._total, self._done = stage, total, 0

    def next(self) -> None:
        """One more step is done."""
        self._done += 1
        listener().advanced(self._stage, self._done, self._total, "")


def _feature_distance(path: Path | None) -> SqueezeNetDistance | None:
    return None if path is None else load_squeezenet_distance(path)


def _digest_of(path: Path) -> str:
    try:
        return digest_file(path)[:DIGEST_LENGTH]
    except OSError as error:
        raise WeightsError(f"no SqueezeNet weights at {path}: {error.strerror}") from None
