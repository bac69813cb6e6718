"""One sequence, from stored scene to a fitted, painted, evaluated and reported one."""

import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from prefect import flow

from catalog.records import RunRecord
from catalog.store import Store, open_store
from flows.overrides import with_overrides
from flows.parameters import ReconstructParameters
from flows.presets import preset as preset_named
from flows.recall import START, early_end_recorded, located, recalled, run_identity
from lidarpainter_models.errors import ConfigError
from lidarpainter_models.evaluation.markings import views_ahead
from lidarpainter_models.evaluation.score_tables import LIDAR, MARKINGS, Scores, fitted_on
from lidarpainter_models.export.run_page import GUIDANCE_COLUMNS
from lidarpainter_models.gaussians.lidar_returns.settings import LidarConfig
from lidarpainter_models.metrics.perceptual import load_distances
from lidarpainter_models.observations.image_shrinking import require_recorded_width
from lidarpainter_models.painter.known_painters import NO_PAINTER
from tasks.evaluation.envelope import STAGE as ENVELOPE
from tasks.evaluation.envelope import find_envelope, load_envelope
from tasks.evaluation.views import evaluate, load_scores
from tasks.lidar.channel import learn_lidar
from tasks.lidar.evaluate import evaluate_lidar
from tasks.opened import opened
from tasks.progress import working_on
from tasks.reconstruction.examine import STAGE as EXAMINE
from tasks.reconstruction.examine import examine, suspicions
from tasks.reconstruction.fit import fit, refine
from tasks.reconstruction.paint import paint
from tasks.reconstruction.prepare import prepare
from tasks.reconstruction.publish import begin_run, complete_run
from tasks.reconstruction.report import REPORT_FILE, ReportInputs, write_report
from tasks.specs import FittedRef, RunSpec
from tasks.stages import StageResult, code_behind

UNJUDGED: Scores = {"recorded": None, "novel": None, "recorded_by_camera": None, ENVELOPE: None}


@dataclass(frozen=True, kw_only=True)
class Course:
    """One run on its way: what is asked for, and what happened so far, stage by stage."""

    parameters: ReconstructParameters
    run: RunSpec
    record: RunRecord
    stages: dict[str, StageResult] = field(default_factory=dict)

    def add(self, stage: str, result: StageResult) -> StageResult:
        """Remember a stage and hand its result on."""
        self.stages[stage] = result
        return result


def reconstruct(parameters: ReconstructParameters, store_path: Path) -> dict[str, Any]:
    """Fit a scene, paint shifted views of it, continue the fit with them, evaluate and report.

    A run that is complete and unchanged is recalled: nothing is computed or written.

    Returns:
        What `lidarpainter reconstruct --json` prints.

    Raises:
        LidarPainterError: see `check_inputs`.
    """
    if (known := recalled(parameters, store_path)) is not None:
        return known
    check_inputs(parameters, store_path)
    return reconstruct_flow.fn(parameters, store_path)


@flow(name="reconstruct")
def reconstruct_flow(parameters: ReconstructParameters, store_path: Path) -> dict[str, Any]:
    """Make a run whose inputs are checked, see `reconstruct`; Prefect shows its stages."""
    run, store = parameters.run_spec(store_path), open_store(store_path)
    run_id, source_digest = run_identity(parameters, store), code_behind(START).digest
    with store.run_lock(run_id), working_on(scene=parameters.scene, run=run_id):
        record = begin_run(run, run_id, source_digest, parameters.preset, parameters)
        course = Course(parameters=parameters, run=run, record=record)
        with early_end_recorded(store_path, record):
            started = time.perf_counter()
            seen = course.add("prepare", prepare(run, parameters.observation))
            first = fit(run, "fit", seen.ref, parameters.fit, lpips=parameters.lpips)
            fitted = final = FittedRef(seen.ref, course.add("fit", first).ref)
            for number in range(1, parameters.rounds + 1):
                final = _round(course, final, number)
            if parameters.examines:
                course.add(EXAMINE, examine(run))
            scores = _judged(course, store, fitted, final) if parameters.judge else {}
            result = _result(course, scores, final)
            if parameters.report:
                _report(course, store, result, fitted, final)
            result["seconds"]["total"] = time.perf_counter() - started
            refs = tuple(stage.ref for stage in course.stages.values())
            # the catalog calls it what it is
            named = {
                fitted_on(parameters.painter) if name == "painted" else name: found
                for name, found in scores.items()
            }
            return located(complete_run(store.address, record, result, named, refs), store)


def check_inputs(parameters: ReconstructParameters, store_path: Path) -> None:
    """Find at once what would otherwise be found after minutes of fitting.

    Raises:
        SceneError: the scene is not there, or lacks a camera.
        ConfigError: the split leaves nothing to train on, images are wanted wider than recorded,
            painted lines are to be judged and no held-out view looks ahead, the device is not
            there, a fit weighs a distance without weights, or a round paints too far away.
        WeightsError: the painter or the weights of a perceptual distance cannot be used.
    """
    run = opened(parameters.run_spec(store_path))
    if parameters.rounds and parameters.painter != NO_PAINTER:
        parameters.novel.in_round(parameters.rounds, parameters.rounds)
    width_px = parameters.observation.width_px
    if width_px != preset_named(parameters.preset, parameters.scene).observation.width_px:
        require_recorded_width(width_px, run.views.train, "observation.width_px")
    if parameters.judge and parameters.judge_markings:
        views_ahead(run.scene, run.views.test)
    run.painter.load(run.device)
    load_distances(parameters.feature_weights, parameters.lpips, inception=parameters.inception)
    missing = parameters.lpips.missing
    if missing and (parameters.fit.weighs_perceptual or parameters.refine.weighs_perceptual):
        raise ConfigError(f"a fit weighs a perceptual distance: {missing}")


@flow(name="reconstruct-scene")
def reconstruct_scene(
    scene: str, preset: str = "balanced", settings: tuple[str, ...] = (), store: str | None = None
) -> dict[str, Any]:
    """Reconstruct a scene by name, as a worker is asked to.

    Args:
        scene: `<dataset>/<sequence>` of the store.
        preset: `brief`, `preview`, `balanced` or `paper`.
        settings: other settings, `key=value` as the command's `--set`.
        store: folder of the store; by default what `LIDARPAINTER_STORE` says on the worker.
    """
    parameters = with_overrides(preset_named(preset, scene), settings)
    return reconstruct(parameters, open_store(store).address)


def _round(course: Course, fitted: FittedRef, number: int) -> FittedRef:
    """Paint views of a fitted scene and continue its fit with them.

    Without a painter the fit is continued alone, just as long. A round that made views worse is
    taken back and made again like that, so that painting costs time there and nothing else.
    """
    parameters, run, stage = course.parameters, course.run, f"refine-{number}"
    if parameters.painter != NO_PAINTER:
        novel = parameters.novel.in_round(number, parameters.rounds)
        conditions, name = parameters.conditions, f"paint-{number}"
        painted = paint(run, name, fitted, novel, conditions, start_frame=number - 1)
        guidance = course.add(name, painted).ref
        config, lpips = parameters.refine, parameters.lpips
        refined = refine(run, stage, fitted, config, guidance=guidance, lpips=lpips)
        course.add(stage, refined)
        gain = refined.summary["gain"]
        if gain is None or not gain["is_taken_back"]:
            return FittedRef(fitted.observations, refined.ref)
        stage = f"{stage}-unpainted"
    alone = fit(
        run,
        stage,
        fitted.observations,
        parameters.refine,
        start=fitted.gaussians,
        lpips=parameters.lpips,
    )
    return FittedRef(fitted.observations, course.add(stage, alone).ref)


def _report(
    course: Course, store: Store, result: dict[str, Any], unpainted: FittedRef, final: FittedRef
) -> None:
    """Write the page about a run, and enter it into the result."""
    page = ReportInputs(
        result=result,
        source_digest=course.record.source_digest,
        unpainted=unpainted,
        final=final,
        stages=dict(course.stages),
    )
    report = course.add(
        "report", write_report(course.run, page, course.parameters.evaluation_config)
    )
    result["artefacts"]["report"] = report.ref.artefact_id
    result["report"] = store.name_of(store.artefacts.folder(report.ref) / REPORT_FILE)
    result["seconds"]["report"] = report.seconds
    result["cpu_seconds"]["report"] = report.cpu_seconds
    result["computed_now"]["report"] = report.is_new


def _judged(
    course: Course, store: Store, unpainted: FittedRef, final: FittedRef
) -> dict[str, Scores]:
    """Scores before painting, after it, and if asked for, painted at view time."""
    judged = {"unpainted": ("evaluate-unpainted", unpainted), "painted": ("evaluate", final)}
    if course.parameters.judge_view_time and course.parameters.painter != NO_PAINTER:
        judged["view-time"] = ("evaluate-view-time", final)
    scores = {}
    for variant, (stage, fitted) in judged.items():
        found = evaluate(
            course.run,
            stage,
            fitted,
            course.parameters.evaluation_config,
            view_time=variant == "view-time",
        )
        scores[variant] = load_scores(store, course.add(stage, found).ref)
    walked = find_envelope(course.run, final, course.parameters.evaluation_config)
    scores["painted"][ENVELOPE] = load_envelope(store, course.add(ENVELOPE, walked).ref)
    if course.parameters.judge_lidar:
        learnt = course.add(LIDAR, learn_lidar(course.run, final, LidarConfig()))
        told = course.add(f"evaluate-{LIDAR}", evaluate_lidar(course.run, final, learnt.ref))
        scores["painted"] |= load_scores(store, told.ref)
    if course.parameters.judge_markings:
        name, config = f"evaluate-{MARKINGS}", course.parameters.evaluation_config
        lines = evaluate(course.run, name, final, config, protocol=MARKINGS)
        scores["painted"] |= load_scores(store, course.add(name, lines).ref)
    return scores


def _result(course: Course, scores: dict[str, Scores], final: FittedRef) -> dict[str, Any]:
    """Return what `reconstruct --json` prints, but for the report."""
    parameters, stages = course.parameters, course.stages
    last_fit = next(stage for stage in stages.values() if stage.ref == final.gaussians)
    return {
        "run_id": course.record.run_id,
        "scene": parameters.scene,
        "preset": parameters.preset,
        "painter": parameters.painter,
        "device": course.record.device,
        "split": parameters.split,
        "rounds": parameters.rounds,
        "seconds": {name: stage.seconds for name, stage in stages.items()},
        "cpu_seconds": {name: stage.cpu_seconds for name, stage in stages.items()},
        "memory_bytes": {name: stage.peak_memory_bytes for name, stage in stages.items()},
        "computed_now": {name: stage.is_new for name, stage in stages.items()},
        "peak_memory_bytes": max(stage.peak_memory_bytes for stage in stages.values()),
        "num_gaussians": last_fit.summary["num_gaussians"],
        "stopped_early": any(
            stage.summary.get("stopped_early", False) for stage in stages.values()
        ),
        **scores.get("painted", UNJUDGED),
        "unpainted": scores.get("unpainted"),
        "view_time": scores.get("view-time"),
        "guidance": {
            name: {key: stage.summary[key] for key in GUIDANCE_COLUMNS}
            for name, stage in stages.items()
            if stage.ref.kind == "guidance"
        },
        "gains": {
            name: gain for name, stage in stages.items() if (gain := stage.summary.get("gain"))
        },
        "suspicions": suspicions(stages[EXAMINE]) if EXAMINE in stages else None,
        "artefacts": {name: stage.ref.artefact_id for name, stage in stages.items()},
        "report": None,
    }
