"""Judge how steady a scene looks along shifted paths, as rendered and as painted at view time."""

from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from typing import Any

from catalog.artefacts import Workplace
from lidarpainter_models.conditioning.settings import SequenceConfig
from lidarpainter_models.evaluation.flicker_paths import FlickerEvaluation
from lidarpainter_models.evaluation.score_tables import FLICKER
from lidarpainter_models.evaluation.settings import EvaluationConfig
from lidarpainter_models.evaluation.shown import ViewTimePainting
from tasks.evaluation.shown import view_time_painting
from tasks.evaluation.views import SCORES_FILE, evaluation_inputs
from tasks.json_files import write_json
from tasks.opened import opened
from tasks.progress import Progress
from tasks.specs import FittedRef, RunSpec
from tasks.stages import StageResult, run_stage, stage_task


@stage_task
def evaluate_flicker(
    run: RunSpec,
    stage: str,
    fitted: FittedRef,
    config: EvaluationConfig,
    previous: tuple[SequenceConfig, ...],
) -> StageResult:
    """Compare neighbouring frames of the first trained camera at every judged shift.

    `previous` says what else may become of the frame painted before.
    """
    this = opened(run)
    shifts = config.scoring.shifts
    return run_stage(
        this.store,
        kernels=run.kernels,
        stage=stage,
        kind="evaluation",
        inputs=evaluation_inputs(this, fitted, view_time=True),
        config={
            "split": run.split,
            "observation": asdict(config.observation),
            "conditions": asdict(config.conditions),
            "shifts": [asdict(shift) for shift in shifts],
            "previous": [asdict(use) for use in previous],
        },
        build=partial(
            _build,
            evaluation=FlickerEvaluation(
                held_out=this.held_out(config.observation),
                camera_name=this.views.train[0].camera_name,
                shifts=shifts,
                previous=previous,
            ),
            painting=partial(
                view_time_painting,
                this.store,
                fitted,
                config.conditions,
                this.painter,
                this.device,
            ),
        ),
    )


def _build(
    place: Workplace,
    progress: Progress,
    *,
    evaluation: FlickerEvaluation,
    painting: Callable[[], ViewTimePainting],
) -> dict[str, Any]:
    write_json(place.output / SCORES_FILE, {FLICKER: evaluation.scores(painting(), progress)})
    return {"num_shifts": len(evaluation.shifts)}
