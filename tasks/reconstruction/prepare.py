"""Bring a stored scene into the form that a fit reads."""

import math
from dataclasses import asdict
from functools import partial
from typing import Any

from catalog.artefacts import Workplace
from lidarpainter_models.observations.preparation import prepare_observations
from lidarpainter_models.observations.settings import ObservationConfig
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.splits import ViewSplit
from tasks.opened import opened
from tasks.progress import Progress
from tasks.specs import RunSpec
from tasks.stages import StageResult, run_stage, stage_task
from tasks.stored import save_observations

STAGE = "prepare"


@stage_task
def prepare(run: RunSpec, config: ObservationConfig) -> StageResult:
    """Read images, sweeps and boxes of the training side into one artefact."""
    this = opened(run)
    return run_stage(
        this.store,
        stage=STAGE,
        kind="observations",
        inputs={"scene": this.scene.content_digest},
        config={
            "split": run.split.spec,
            "cameras": run.split.cameras,
            "observation": asdict(config),
        },
        build=partial(_build, scene=this.scene, views=this.views, config=config),
    )


def _build(
    place: Workplace,
    progress: Progress,
    *,
    scene: DrivingScene,
    views: ViewSplit,
    config: ObservationConfig,
) -> dict[str, Any]:
    observations = prepare_observations(scene, views, config, progress=progress)
    save_observations(place.output, observations)
    return {
        "num_views": len(observations.views),
        "num_test_views": len(views.test),
        "num_tracks": len(observations.tracks),
        "num_street_points": len(observations.lidar_map.street.xyz_m),
        "median_turn_deg": math.degrees(observations.path.median_turn_rad),
        "camera_faults": [
            f"{name} {fault}; corrected" for name, fault in observations.faults.items()
        ],
    }
