"""Say how far beside the recorded path a fitted scene can be trusted, stretch by stretch."""

from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from typing import Any

from catalog.artefacts import ArtefactRef, Workplace
from catalog.store import Store
from lidarpainter_models.conditioning.view_evidence import EvidenceGatherer
from lidarpainter_models.evaluation.envelope import MovedViews, trust_envelope
from lidarpainter_models.evaluation.score_tables import ENVELOPE, least_of
from lidarpainter_models.evaluation.settings import EvaluationConfig
from lidarpainter_models.evaluation.view_confidence import BUNDLED
from lidarpainter_models.observations.settings import ObservationConfig
from lidarpainter_models.scenes.driving_scene import DrivingScene
from tasks.evaluation.views import evaluation_inputs
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
    """Walk away from the path of a fitted scene, on every stretch, as far as it can be trusted."""
    this = opened(run)
    return run_stage(
        this.store,
        kernels=run.kernels,
        stage=STAGE,
        kind=ENVELOPE,
        inputs=evaluation_inputs(this, fitted, view_time=False),
        config={"observation": asdict(config.observation)},
        build=partial(
            _build,
            scene=this.scene,
            gatherer=partial(_gatherer, this, fitted),
            observation=config.observation,
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
    scene: DrivingScene,
    gatherer: Callable[[], EvidenceGatherer],
    observation: ObservationConfig,
) -> dict[str, Any]:
    evidence = gatherer()
    views = MovedViews(scene=scene, gatherer=evidence, observation=observation)
    found = trust_envelope(views, evidence.camera_names, BUNDLED, progress=progress)
    write_json(place.output / FILE, found)
    return {"num_frames": found["num_frames"], **least_of(found)}
