"""One sequence, from stored scene to a fitted, painted, judged and reported one."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from prefect import flow

from catalog.records import RunRecord
from catalog.store import open_store
from flows.overrides import with_overrides
from flows.parameters import ReconstructParameters
from flows.presets import preset as preset_named
from lidarpainter_models.metrics.perceptual import load_distances
from lidarpainter_models.painter import load_painter
from tasks.evaluation.scene import evaluate
from tasks.evaluation.scores import Scores, load_scores
from tasks.painter.painters import NO_PAINTER
from tasks.reconstruction.fit import fit, refine
from tasks.reconstruction.paint import paint
from tasks.reconstruction.prepare import prepare
from tasks.reconstruction.publish import begin_run, complete_run, fail_run
from tasks.reconstruction.report import ReportInputs, report_path, write_report
from tasks.reconstruction.report_figures import GUIDANCE_COLUMNS
from tasks.scenes import open_split
from tasks.stages import StageResult
from tasks.stored import FittedRef

DEVICE = "cpu"


@dataclass
class Course:
    """What happened in a run so far, stage by stage."""

    stages: dict[str, StageResult] = field(default_factory=dict)

    def add(self, stage: str, result: StageResult) -> StageResult:
        """Remember a stage and hand its result on."""
        self.stages[stage] = result
        return result


@flow(name="reconstruct")
def reconstruct(parameters: ReconstructParameters, store_path: Path) -> dict[str, Any]:
    """Fit a scene, paint shifted views of it, go on fitting with them, judge and report."""
    check_inputs(parameters, store_path)
    record = begin_run(store_path, parameters, DEVICE)
    with failure_recorded(store_path, record):
        return _run(parameters, store_path, record)


def check_inputs(parameters: ReconstructParameters, store_path: Path) -> None:
    """Find at once what would otherwise be found after minutes of fitting.

    Raises:
        SceneError: the scene is not there, or lacks a camera.
        ConfigError: the split leaves nothing to train on.
        WeightsError: the painter or the weights of a perceptual distance cannot be used.
    """
    open_split(open_store(store_path), parameters.split_spec)
    load_painter(parameters.painter)
    load_distances(parameters.feature_weights, parameters.lpips)


@flow(name="reconstruct-scene")
def reconstruct_scene(
    scene: str, preset: str = "balanced", settings: tuple[str, ...] = (), store: str | None = None
) -> dict[str, Any]:
    """Reconstruct a scene by name, as a worker is asked to.

    Args:
        scene: `<dataset>/<sequence>` of the store.
        preset: `preview`, `balanced` or `paper`.
        settings: other settings, `key=value` as the command's `--set`.
        store: folder of the store; by default what `LIDARPAINTER_STORE` says on the worker.
    """
    parameters = with_overrides(preset_named(preset, scene), settings)
    return reconstruct.fn(parameters, open_store(store).root)


def _run(parameters: ReconstructParameters, store_path: Path, record: RunRecord) -> dict[str, Any]:
    started = time.perf_counter()
    course = Course()
    seen = course.add("prepare", prepare(store_path, parameters.split_spec, parameters.observation))
    first = course.add("fit", fit(store_path, seen.ref, parameters.fit))
    fitted = FittedRef(seen.ref, first.ref)
    final = _rounds(parameters, store_path, course, fitted)
    scores = _judged(parameters, store_path, course, fitted, final)
    result = _result(parameters, record, course, scores, final)
    report = course.add(
        "report",
        write_report(
            store_path,
            ReportInputs(
                result=result,
                split=parameters.split_spec,
                settings=parameters.judge_settings,
                painter=parameters.painter,
                unpainted=fitted,
                final=final,
                stages=dict(course.stages),
            ),
        ),
    )
    result["report"] = str(report_path(report.ref))
    result["seconds"]["report"] = report.seconds
    result["cpu_seconds"]["report"] = report.cpu_seconds
    result["seconds"]["total"] = time.perf_counter() - started
    refs = tuple(stage.ref for stage in course.stages.values())
    return complete_run(store_path, record, result, scores, refs)


def _rounds(
    parameters: ReconstructParameters, store_path: Path, course: Course, fitted: FittedRef
) -> FittedRef:
    """Paint and go on fitting; without a painter the fit goes on alone, just as long."""
    for number in range(1, parameters.rounds + 1):
        guidance = None
        if parameters.painter != NO_PAINTER:
            stage = f"paint-{number}"
            guidance = course.add(
                stage,
                paint(
                    store_path,
                    stage,
                    parameters.scene,
                    fitted,
                    parameters.paint_settings,
                    number - 1,
                ),
            ).ref
        stage = f"refine-{number}"
        refined = refine(
            store_path, stage, fitted.observations, fitted.gaussians, guidance, parameters.refine
        )
        fitted = FittedRef(fitted.observations, course.add(stage, refined).ref)
    return fitted


def _judged(
    parameters: ReconstructParameters,
    store_path: Path,
    course: Course,
    unpainted: FittedRef,
    final: FittedRef,
) -> dict[str, Scores]:
    """Scores before painting, after it, and if asked for, painted at view time."""
    split, settings = parameters.split_spec, parameters.judge_settings
    before = evaluate(store_path, "evaluate-unpainted", split, unpainted, settings)
    scores = {"unpainted": load_scores(course.add("evaluate-unpainted", before).ref)}
    after = evaluate(store_path, "evaluate", split, final, settings)
    scores["painted"] = load_scores(course.add("evaluate", after).ref)
    if parameters.judge_view_time and parameters.painter != NO_PAINTER:
        stage = "evaluate-view-time"
        shown = evaluate(store_path, stage, split, final, settings, parameters.painter)
        scores["view-time"] = load_scores(course.add(stage, shown).ref)
    return scores


def _result(
    parameters: ReconstructParameters,
    record: RunRecord,
    course: Course,
    scores: dict[str, Scores],
    final: FittedRef,
) -> dict[str, Any]:
    """What `reconstruct --json` prints, but for the report."""
    stages = course.stages
    last_fit = next(stage for stage in stages.values() if stage.ref == final.gaussians)
    return {
        "run_id": record.run_id,
        "scene": parameters.scene,
        "preset": parameters.preset,
        "painter": parameters.painter,
        "split": parameters.split,
        "rounds": parameters.rounds,
        "seconds": {name: stage.seconds for name, stage in stages.items()},
        "cpu_seconds": {name: stage.cpu_seconds for name, stage in stages.items()},
        "computed_now": {name: stage.is_new for name, stage in stages.items()},
        "peak_memory_bytes": max(stage.peak_memory_bytes for stage in stages.values()),
        "num_gaussians": last_fit.summary["num_gaussians"],
        **scores["painted"],
        "unpainted": scores["unpainted"],
        "view_time": scores.get("view-time"),
        "guidance": {
            name: {key: stage.summary[key] for key in GUIDANCE_COLUMNS}
            for name, stage in stages.items()
            if stage.ref.kind == "guidance"
        },
        "artefacts": {name: stage.ref.path for name, stage in stages.items()},
    }


@contextmanager
def failure_recorded(store_path: Path, record: RunRecord) -> Iterator[None]:
    """Enter into the catalog why a run failed, and let the error go on."""
    try:
        yield
    except Exception as error:
        fail_run(store_path, record, f"{type(error).__name__}: {error}")
        raise
