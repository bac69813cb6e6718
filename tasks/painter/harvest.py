"""Make training pairs from stored scenes: recorded logs and synthetic streets.

A harvest that was killed goes on with the pairs it had stored. The pairs lie in a folder of their
own inside the artefact, which any command that takes pairs can be given.
"""

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from prefect import task

from catalog.artefacts import ArtefactRef, Workplace
from catalog.store import Store, open_store
from lidarpainter_models.errors import DataError, SceneError
from lidarpainter_models.evaluation.held_back import target_of
from lidarpainter_models.synthetic.config import SyntheticStreetConfig
from lidarpainter_models.synthetic.street import WORLD_VERSION, SyntheticStreet
from lidarpainter_models.training_data.harvest import (
    HarvestConfig,
    HarvestProgress,
    default_plans,
    harvest_left_out,
)
from lidarpainter_models.training_data.pairs import PairFolder, PairWriter
from lidarpainter_models.training_data.street_harvest import StreetPlan, harvest_shifted_street
from tasks.ingest.ingest import ingest_street
from tasks.opened import SplitSpec, open_scene, open_split
from tasks.progress import Progress, listener
from tasks.stages import STAGE_OPTIONS, StageResult, run_stage

PAIRS_FOLDER = "pairs"


@dataclass(frozen=True, slots=True, kw_only=True)
class PairSet:
    """A folder of pairs and what tables call it."""

    name: str
    folder: Path

    def open(self) -> PairFolder:
        """The pairs.

        Raises:
            DataError: there are none.
        """
        return PairFolder(self.folder)


@task(**STAGE_OPTIONS)
def keep_street(store_path: Path, config: SyntheticStreetConfig) -> str:
    """Write a synthetic street unless the store has exactly this one; returns its scene id."""
    store = open_store(store_path)
    scene_id = street_id(config.seed)
    if not _has_street(store, scene_id, config):
        ingest_street.fn(store_path, config)
    return scene_id


@task(**STAGE_OPTIONS)
def harvest_recorded(
    store_path: Path, stage: str, split: SplitSpec, config: HarvestConfig
) -> StageResult:
    """Judge weak fits of a log at training frames they left out; test frames are never read."""
    store = open_store(store_path)
    scene, views = open_split(store, split)

    def harvest(writer: PairWriter, told: HarvestProgress) -> None:
        plans = default_plans(views.train_frames)
        harvest_left_out(scene, views, plans, writer, config=config, progress=told)

    return run_stage(
        store,
        stage=stage,
        kind="pairs",
        inputs={"scene": scene.content_digest},
        config={"split": split.spec, "cameras": split.cameras, "harvest": asdict(config)},
        build=_writing_pairs(stage, harvest),
    )


@task(**STAGE_OPTIONS)
def harvest_street(
    store_path: Path,
    stage: str,
    scene_id: str,
    plans: tuple[StreetPlan, ...],
    config: HarvestConfig,
) -> StageResult:
    """Pair shifted renders of fits to a synthetic street with the exact truth."""
    store = open_store(store_path)
    scene = open_scene(store, scene_id)

    def harvest(writer: PairWriter, told: HarvestProgress) -> None:
        street = SyntheticStreet.from_manifest(scene.manifest)
        harvest_shifted_street(street, scene, plans, writer, config=config, progress=told)

    return run_stage(
        store,
        stage=stage,
        kind="pairs",
        inputs={"scene": scene.content_digest},
        config={"plans": [asdict(plan) for plan in plans], "harvest": asdict(config)},
        build=_writing_pairs(stage, harvest),
    )


def street_id(seed: int) -> str:
    """Scene id of the synthetic street of a seed."""
    return f"synthetic/street-{seed:04d}"


def pair_set(store: Store, name: str, ref: ArtefactRef) -> PairSet:
    """The pairs of an artefact."""
    return PairSet(name=name, folder=store.artefacts.folder(ref) / PAIRS_FOLDER)


def _has_street(store: Store, scene_id: str, config: SyntheticStreetConfig) -> bool:
    try:
        generator = open_scene(store, scene_id).manifest.get("generator", {})
    except SceneError:
        return False
    wanted = json.loads(json.dumps(config.to_dict()))
    return generator.get("config") == wanted and generator.get("world_version") == WORLD_VERSION


def _writing_pairs(
    stage: str, harvest: Callable[[PairWriter, HarvestProgress], None]
) -> Callable[[Workplace, Progress], dict[str, Any]]:
    """A stage that keeps finished pairs in its scratch folder until all are there."""

    def build(place: Workplace, _progress: Progress) -> dict[str, Any]:
        unfinished = place.scratch / PAIRS_FOLDER
        harvest(
            PairWriter(unfinished), lambda done, total: listener().advanced(stage, done, total, "")
        )
        if not unfinished.exists():
            raise DataError(f"{stage}: no view could be made into a pair")
        finished = place.output / PAIRS_FOLDER
        unfinished.rename(finished)
        folder = PairFolder(finished)
        targets = {target_of(folder, index) for index in range(len(folder))}
        return {"num_pairs": len(folder), "num_targets": len(targets)}

    return build
