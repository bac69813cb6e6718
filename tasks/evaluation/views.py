"""Judge a fitted scene on views it never saw, as it is or painted at view time."""

from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from typing import Any

from catalog.artefacts import ArtefactRef, Workplace
from catalog.store import Store
from lidarpainter_models.evaluation.scene_evaluation import SceneEvaluation
from lidarpainter_models.evaluation.score_tables import Scores
from lidarpainter_models.evaluation.settings import EvaluationConfig
from lidarpainter_models.evaluation.shown import ShownScene
from tasks.evaluation.shown import shown_by
from tasks.json_files import read_json, write_json
from tasks.opened import OpenedRun, opened
from tasks.progress import Progress
from tasks.specs import FittedRef, RunSpec
from tasks.stages import StageResult, run_stage, stage_task
from tasks.weights import file_digests

SCORES_FILE = "scores.json"


@stage_task
def evaluate(
    run: RunSpec,
    stage: str,
    fitted: FittedRef,
    config: EvaluationConfig,
    *,
    view_time: bool = False,
) -> StageResult:
    """Score a scene as it is, or what it shows once the run's painter has painted it."""
    this = opened(run)
    return run_stage(
        this.store,
        kernels=run.kernels,
        stage=stage,
        kind="evaluation",
        inputs=evaluation_inputs(this, fitted, view_time=view_time)
        | file_digests(config.weight_files),
        config={
            "split": run.split,
            "observation": asdict(config.observation),
            "scoring": asdict(config.scoring),
            "conditions": asdict(config.conditions),
        },
        build=partial(
            _build,
            evaluation=SceneEvaluation(held_out=this.held_out(config.observation), config=config),
            shown=shown_by(this, fitted, config, view_time=view_time),
        ),
    )


def evaluation_inputs(this: OpenedRun, fitted: FittedRef, *, view_time: bool) -> dict[str, str]:
    """Digests of what every evaluation of a fitted scene depends on."""
    inputs = {
        "scene": this.scene.content_digest,
        "observations": fitted.observations.digest,
        "gaussians": fitted.gaussians.digest,
    }
    return inputs | ({"painter": this.painter.digest} if view_time else {})


def load_scores(store: Store, ref: ArtefactRef) -> Scores:
    """Read the scores of an evaluation."""
    return read_json(store.artefacts.files(ref) / SCORES_FILE)


def _build(
    place: Workplace,
    progress: Progress,
    *,
    evaluation: SceneEvaluation,
    shown: Callable[[], ShownScene],
) -> dict[str, Any]:
    scores = evaluation.scores(shown(), progress)
    write_json(place.output / SCORES_FILE, scores)
    return {"psnr": scores["recorded"]["psnr"], "num_views": scores["recorded"]["num_views"]}
