"""Judge a fitted scene by cameras it was not trained on, where they overlap one that it was."""

from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from typing import Any

from catalog.artefacts import Workplace
from lidarpainter_models.errors import ConfigError
from lidarpainter_models.evaluation.settings import EvaluationConfig
from lidarpainter_models.evaluation.shown import ShownScene
from lidarpainter_models.evaluation.strip_views import StripEvaluation
from tasks.evaluation.shown import shown_by
from tasks.evaluation.views import SCORES_FILE, evaluation_inputs
from tasks.json_files import write_json
from tasks.opened import opened
from tasks.progress import Progress
from tasks.specs import FittedRef, RunSpec
from tasks.stages import StageResult, run_stage, stage_task


@stage_task
def evaluate_strips(
    run: RunSpec,
    stage: str,
    fitted: FittedRef,
    config: EvaluationConfig,
    *,
    view_time: bool = False,
) -> StageResult:
    """Score held-out frames of every camera that the fit did not see.

    Raises:
        ConfigError: the fit saw every camera of the scene.
    """
    this = opened(run)
    evaluation = StripEvaluation(held_out=this.held_out(config.observation), views=this.views)
    if not evaluation.cameras:
        raise ConfigError(
            f"the fit saw every camera of {run.split.scene_id}; leave one out with --train-cameras"
        )
    return run_stage(
        this.store,
        kernels=run.kernels,
        stage=stage,
        kind="strips",
        inputs=evaluation_inputs(this, fitted, view_time=view_time),
        config={
            "split": run.split,
            "observation": asdict(config.observation),
            "conditions": asdict(config.conditions),
        },
        build=partial(
            _build,
            evaluation=evaluation,
            shown=shown_by(this, fitted, config, view_time=view_time),
        ),
    )


def _build(
    place: Workplace,
    progress: Progress,
    *,
    evaluation: StripEvaluation,
    shown: Callable[[], ShownScene],
) -> dict[str, Any]:
    write_json(place.output / SCORES_FILE, evaluation.scores(shown(), progress))
    return {"num_cameras": len(evaluation.cameras)}
