"""Say how far beside the recorded path a fitted scene can be trusted, stretch by stretch."""

from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from typing import Any

from catalog.artefacts import ArtefactRef, Workplace
from catalog.store import Store
from lidarpainter_models.conditioning.view_evidence import EvidenceGatherer
from lidarpainter_models.evaluation.anchoring import (
    MOST_VIEWS,
    judged_frames,
    predicted_and_measured,
    what_frames_say,
)
from lidarpainter_models.evaluation.envelope import MovedViews, trust_envelope
from lidarpainter_models.evaluation.held_out import HeldOut
from lidarpainter_models.evaluation.score_tables import ENVELOPE, HELD_OUT, least_of
from lidarpainter_models.evaluation.settings import EvaluationConfig
from lidarpainter_models.evaluation.view_confidence import BUNDLED
from tasks.json_files import read_json, write_json
from tasks.opened import OpenedRun, opened
from tasks.progress import Progress
from tasks.specs import FittedRef, RunSpec
from tasks.stages import StageResult, run_stage, stage_task
from tasks.stored import load_observations, load_scene

STAGE = ENVELOPE
FILE = "envelope.json"


@stage_task
def find_envelope(run: RunSpec, fitted: FittedRef, config: EvaluationConfig) -> StageResult:
    """Walk away from the path of a fitted scene, on every stretch, as far as it can be trusted.

    What is promised is anchored on held-out frames of the log, where there are some.
    """
    this = opened(run)
    return run_stage(
        this.store,
        kernels=run.kernels,
        stage=STAGE,
        kind=ENVELOPE,
        inputs=this.inputs(fitted),
        config={"split": run.split, "observation": asdict(config.observation)},
        build=partial(
            _build,
            held_out=this.held_out(config.observation),
            gatherer=partial(_gatherer, this, fitted),
        ),
    )


def load_envelope(store: Store, ref: ArtefactRef) -> dict[str, Any]:
    """Read how far a scene can be trusted."""
    return read_json(store.artefacts.files(ref) / FILE)


def _gatherer(this: OpenedRun, fitted: FittedRef) -> EvidenceGatherer:
    seen = load_observations(this.store, fitted.observations)
    scene = load_scene(this.store, fitted.gaussians).to(this.device)
    return EvidenceGatherer(scene, seen.lidar_map, seen.views)


def _build(
    place: Workplace,
    progress: Progress,
    *,
    held_out: HeldOut,
    gatherer: Callable[[], EvidenceGatherer],
) -> dict[str, Any]:
    evidence = gatherer()
    known = predicted_and_measured(judged_frames(held_out.sampled(MOST_VIEWS), evidence))
    views = MovedViews(scene=held_out.scene, gatherer=evidence, observation=held_out.observation)
    calibration = BUNDLED.anchored(known)
    found = trust_envelope(views, evidence.camera_names, calibration, progress=progress)
    found[HELD_OUT] = what_frames_say(known)
    write_json(place.output / FILE, found)
    return {"num_frames": found["num_frames"], **least_of(found)}
