"""Bring a stored scene into the form that a fit reads."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

from prefect import task

from catalog.artefacts import Workplace
from catalog.store import open_store
from lidarpainter_models.observations.observations import ObservationConfig, prepare_observations
from tasks.progress import listener
from tasks.scenes import SplitSpec, open_split
from tasks.stages import STAGE_OPTIONS, StageResult, run_stage
from tasks.stored import save_observations

STAGE = "prepare"


@task(**STAGE_OPTIONS)
def prepare(store_path: Path, split: SplitSpec, config: ObservationConfig) -> StageResult:
    """Read images, sweeps and boxes of the training side into one artefact."""
    store = open_store(store_path)
    scene, views = open_split(store, split)

    def build(place: Workplace) -> dict[str, Any]:
        observations = prepare_observations(
            scene,
            views,
            config,
            progress=lambda done, total: listener().advanced(STAGE, done, total, ""),
        )
        save_observations(place.output, observations)
        return {
            "num_views": len(observations.views),
            "num_test_views": len(views.test),
            "num_tracks": len(observations.tracks),
            "num_street_points": len(observations.lidar_map.street.xyz_m),
        }

    return run_stage(
        store,
        stage=STAGE,
        kind="observations",
        inputs={"scene": scene.content_digest},
        config={"split": split.spec, "cameras": split.cameras, "observation": asdict(config)},
        build=build,
    )
