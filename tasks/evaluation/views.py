"""Judge a fitted scene, as it is or painted at view time, by what its fit never saw.

Held-out views and views beside the path, cameras left out where they overlap one that was fitted,
and neighbouring frames of shifted paths, which should not flicker.
"""

from collections.abc import Callable, Mapping
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from catalog.artefacts import ArtefactRef, Workplace
from catalog.store import Store
from lidarpainter_models.conditioning.settings import SequenceConfig
from lidarpainter_models.errors import ConfigError
from lidarpainter_models.evaluation.flicker import FlickerEvaluation
from lidarpainter_models.evaluation.held_out import HeldOut
from lidarpainter_models.evaluation.markings import markings_scores
from lidarpainter_models.evaluation.neurad_protocol import SPLIT, neurad_scores
from lidarpainter_models.evaluation.scene_evaluation import SceneEvaluation
from lidarpainter_models.evaluation.score_tables import FLICKER, MARKINGS, NEURAD, Scores
from lidarpainter_models.evaluation.settings import EvaluationConfig
from lidarpainter_models.evaluation.shown import ShownScene, ViewTimePainting
from lidarpainter_models.evaluation.strips import StripEvaluation
from lidarpainter_models.geometry.shifts import Shift
from lidarpainter_models.metrics.perceptual import load_distances
from tasks.evaluation.shown import painted_by, shown_by
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
    held_out = opened(run).held_out(config.observation)
    build = partial(_build, evaluation=SceneEvaluation(held_out=held_out, config=config))
    more = {"scoring": asdict(config.scoring)}
    asked = _Asked(run, stage, fitted, config, view_time)
    return _judged(asked, build, more=more, weights=config.weight_files)


@stage_task
def evaluate_by_neurad(
    run: RunSpec,
    stage: str,
    fitted: FittedRef,
    config: EvaluationConfig,
    *,
    view_time: bool = False,
) -> StageResult:
    """Score every held-out image by the protocol of neurad-studio.

    Raises:
        ConfigError: the run was not fitted to the split of that protocol.
    """
    if run.split.spec != SPLIT:
        raise ConfigError(
            f"--protocol {NEURAD} judges runs that were fitted with --split {SPLIT}, this one was "
            f"with --split {run.split.spec}"
        )
    held_out = opened(run).held_out(config.observation)
    build = partial(_build_neurad, held_out=held_out, config=config)
    asked = _Asked(run, stage, fitted, config, view_time)
    return _judged(asked, build, weights=config.weight_files)


@stage_task
def evaluate_markings(
    run: RunSpec,
    stage: str,
    fitted: FittedRef,
    config: EvaluationConfig,
    *,
    view_time: bool = False,
) -> StageResult:
    """Score the painted lines that a scene shows on its path and beside it."""
    held_out, shifts = opened(run).held_out(config.observation), config.scoring.shifts
    build = partial(_build_markings, held_out=held_out, shifts=shifts)
    more = {"shifts": [asdict(shift) for shift in shifts]}
    return _judged(_Asked(run, stage, fitted, config, view_time), build, more=more)


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
    build = partial(_build_strips, evaluation=evaluation)
    return _judged(_Asked(run, stage, fitted, config, view_time), build, kind="strips")


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
        config=_settings(run, config)
        | {
            "shifts": [asdict(shift) for shift in shifts],
            "previous": [asdict(use) for use in previous],
        },
        build=partial(
            _build_flicker,
            evaluation=FlickerEvaluation(
                held_out=this.held_out(config.observation),
                camera_name=this.views.train[0].camera_name,
                shifts=shifts,
                previous=previous,
            ),
            painting=painted_by(this, fitted, config.conditions),
        ),
    )


class _Asked(NamedTuple):
    """What is judged: a fitted scene of a run, as it is or painted at view time."""

    run: RunSpec
    stage: str
    fitted: FittedRef
    config: EvaluationConfig
    view_time: bool


def _judged(
    asked: _Asked,
    build: Callable[..., dict[str, Any]],
    *,
    kind: str = "evaluation",
    more: Mapping[str, Any] | None = None,
    weights: Mapping[str, Path] | None = None,
) -> StageResult:
    """Judge what a scene shows, which `build` is given as `shown`.

    `more` are settings beside those of every evaluation, `weights` files that distances read.
    """
    run, stage, fitted, config, view_time = asked
    this = opened(run)
    return run_stage(
        this.store,
        kernels=run.kernels,
        stage=stage,
        kind=kind,
        inputs=evaluation_inputs(this, fitted, view_time=view_time) | file_digests(weights or {}),
        config=_settings(run, config) | dict(more or {}),
        build=partial(build, shown=shown_by(this, fitted, config, view_time=view_time)),
    )


def _settings(run: RunSpec, config: EvaluationConfig) -> dict[str, Any]:
    return {
        "split": run.split,
        "observation": asdict(config.observation),
        "conditions": asdict(config.conditions),
    }


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


def _build_neurad(
    place: Workplace,
    progress: Progress,
    *,
    held_out: HeldOut,
    config: EvaluationConfig,
    shown: Callable[[], ShownScene],
) -> dict[str, Any]:
    scene = shown()
    distances = load_distances(
        config.feature_weights, config.lpips, scene.scene.device, inception=config.inception
    )
    scores = neurad_scores(held_out, scene, distances, progress)
    write_json(place.output / SCORES_FILE, scores)
    return {name: scores[NEURAD]["all"][name] for name in ("psnr", "num_views")}


def _build_markings(
    place: Workplace,
    progress: Progress,
    *,
    held_out: HeldOut,
    shifts: tuple[Shift, ...],
    shown: Callable[[], ShownScene],
) -> dict[str, Any]:
    scores = markings_scores(held_out, shown(), shifts, progress)
    write_json(place.output / SCORES_FILE, scores)
    return {name: found["auc"] for name, found in scores[MARKINGS].items()}


def _build_strips(
    place: Workplace,
    progress: Progress,
    *,
    evaluation: StripEvaluation,
    shown: Callable[[], ShownScene],
) -> dict[str, Any]:
    write_json(place.output / SCORES_FILE, evaluation.scores(shown(), progress))
    return {"num_cameras": len(evaluation.cameras)}


def _build_flicker(
    place: Workplace,
    progress: Progress,
    *,
    evaluation: FlickerEvaluation,
    painting: Callable[[], ViewTimePainting],
) -> dict[str, Any]:
    write_json(place.output / SCORES_FILE, {FLICKER: evaluation.scores(painting(), progress)})
    return {"num_shifts": len(evaluation.shifts)}
