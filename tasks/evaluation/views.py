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
from tasks.evaluation.shown import painted_by, shown_scene
from tasks.json_files import read_json, write_json
from tasks.opened import OpenedRun, opened
from tasks.progress import Progress
from tasks.specs import FittedRef, RunSpec
from tasks.stages import StageResult, run_stage, stage_task
from tasks.weights import file_digests

SCORES_FILE = "scores.json"
PAPER, TRUTH, CROSS_CAMERA = "paper", "truth", "cross-camera"
"""Protocols beside those that `score_tables` names."""


@stage_task
def evaluate(
    run: RunSpec,
    stage: str,
    fitted: FittedRef,
    config: EvaluationConfig,
    *,
    protocol: str = PAPER,
    view_time: bool = False,
) -> StageResult:
    """Score a scene as it is, or what it shows once the run's painter has painted it.

    Raises:
        ConfigError: the scene cannot be judged under this protocol.
    """
    if protocol not in JUDGES:
        raise ConfigError(f"no protocol {protocol!r}, expected one of {', '.join(JUDGES)}")
    this = opened(run)
    judge = JUDGES[protocol](this, config)
    painter = this.painter if view_time else None
    shown = partial(shown_scene, this.store, fitted, config.conditions, painter, this.device)
    return run_stage(
        this.store,
        kernels=run.kernels,
        stage=stage,
        kind=judge.kind,
        inputs=this.inputs(fitted, paints=view_time) | file_digests(judge.weights),
        config=_settings(run, config) | dict(judge.settings),
        build=partial(judge.build, shown=shown),
    )


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
        inputs=this.inputs(fitted, paints=True),
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


class _Judge(NamedTuple):
    """How a scene is judged."""

    build: Callable[..., dict[str, Any]]
    """Is given what the scene shows as `shown`."""
    kind: str = "evaluation"
    settings: Mapping[str, Any] = {}
    """What decides beside the settings of every evaluation."""
    weights: Mapping[str, Path] = {}
    """Files that distances read."""


def _by_paper(this: OpenedRun, config: EvaluationConfig) -> _Judge:
    """By views that its fit never saw, and by views beside the path."""
    evaluation = SceneEvaluation(held_out=this.held_out(config.observation), config=config)
    return _Judge(
        partial(_build, evaluation=evaluation),
        settings={"scoring": asdict(config.scoring)},
        weights=config.weight_files,
    )


def _by_neurad(this: OpenedRun, config: EvaluationConfig) -> _Judge:
    """By every held-out image, as neurad-studio does."""
    split = this.spec.split.spec
    if split != SPLIT:
        raise ConfigError(
            f"--protocol {NEURAD} judges runs that were fitted with --split {SPLIT}, this one was "
            f"with --split {split}"
        )
    held_out = this.held_out(config.observation)
    build = partial(_build_neurad, held_out=held_out, config=config)
    return _Judge(build, weights=config.weight_files)


def _by_markings(this: OpenedRun, config: EvaluationConfig) -> _Judge:
    """By the painted lines that it shows on its path and beside it."""
    held_out, shifts = this.held_out(config.observation), config.scoring.shifts
    build = partial(_build_markings, held_out=held_out, shifts=shifts)
    return _Judge(build, settings={"shifts": [asdict(shift) for shift in shifts]})


def _by_strips(this: OpenedRun, config: EvaluationConfig) -> _Judge:
    """By held-out frames of every camera that the fit did not see."""
    evaluation = StripEvaluation(held_out=this.held_out(config.observation), views=this.views)
    if not evaluation.cameras:
        raise ConfigError(
            f"the fit saw every camera of {this.spec.split.scene_id}; "
            "leave one out with --train-cameras"
        )
    return _Judge(partial(_build_strips, evaluation=evaluation), kind="strips")


JUDGES: Mapping[str, Callable[[OpenedRun, EvaluationConfig], _Judge]] = {
    PAPER: _by_paper,
    TRUTH: _by_paper,
    NEURAD: _by_neurad,
    CROSS_CAMERA: _by_strips,
    MARKINGS: _by_markings,
}
"""By protocol."""


def _settings(run: RunSpec, config: EvaluationConfig) -> dict[str, Any]:
    return {
        "split": run.split,
        "observation": asdict(config.observation),
        "conditions": asdict(config.conditions),
    }


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
