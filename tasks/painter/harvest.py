"""Make training pairs from stored scenes: recorded logs and synthetic streets.

A harvest that was killed goes on with the pairs it had stored. The pairs lie in a folder of their
own inside the artefact, which any command that takes pairs can be given.
"""

from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from catalog.artefacts import ArtefactRef, Workplace
from catalog.store import Store, open_store
from lidarpainter_models.errors import DataError
from lidarpainter_models.evaluation.held_back import target_of
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.splits import ViewSplit
from lidarpainter_models.synthetic.config import SyntheticStreetConfig
from lidarpainter_models.synthetic.street import SyntheticStreet
from lidarpainter_models.training_data.harvest import default_plans, harvest_left_out
from lidarpainter_models.training_data.pairs import PairFolder, PairSet, PairWriter
from lidarpainter_models.training_data.settings import HarvestConfig, StreetPlan
from lidarpainter_models.training_data.street_harvest import harvest_shifted_street
from tasks.ingest.ingest import has_street, ingest_street
from tasks.opened import open_scene, open_split
from tasks.progress import Progress
from tasks.specs import SplitSpec, street_id
from tasks.stages import StageResult, run_stage, stage_task

PAIRS_FOLDER = "pairs"


@stage_task
def keep_street(store_path: Path, config: SyntheticStreetConfig) -> str:
    """Write a synthetic street unless the store has exactly this one; returns its scene id.

    Raises:
        ConfigError: the store has the street of this seed with other frames, width or cameras.
    """
    if not has_street(open_store(store_path), config):
        ingest_street.fn(store_path, config)
    return street_id(config.seed)


@stage_task
def harvest_recorded(
    store_path: Path, stage: str, split: SplitSpec, config: HarvestConfig
) -> StageResult:
    """Judge weak fits of a log at training frames they left out; test frames are never read."""
    store = open_store(store_path)
    scene, views = open_split(store, split)
    return run_stage(
        store,
        stage=stage,
        kind="pairs",
        inputs={"scene": scene.content_digest},
        config={"split": split.spec, "cameras": split.cameras, "harvest": asdict(config)},
        build=partial(_build_recorded, scene=scene, views=views, config=config),
    )


@stage_task
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
    return run_stage(
        store,
        stage=stage,
        kind="pairs",
        inputs={"scene": scene.content_digest},
        config={"plans": [asdict(plan) for plan in plans], "harvest": asdict(config)},
        build=partial(_build_street, scene=scene, plans=plans, config=config),
    )


def pair_set(store: Store, name: str, ref: ArtefactRef) -> PairSet:
    """The pairs of an artefact."""
    return PairSet(name=name, folder=store.artefacts.files(ref) / PAIRS_FOLDER)


def _build_recorded(
    place: Workplace,
    progress: Progress,
    *,
    scene: DrivingScene,
    views: ViewSplit,
    config: HarvestConfig,
) -> dict[str, Any]:
    plans = default_plans(views.train_frames)
    harvest_left_out(scene, views, plans, _unfinished(place), config=config, progress=progress)
    return _finished(place, scene)


def _build_street(
    place: Workplace,
    progress: Progress,
    *,
    scene: DrivingScene,
    plans: tuple[StreetPlan, ...],
    config: HarvestConfig,
) -> dict[str, Any]:
    street, pairs = SyntheticStreet.from_manifest(scene.manifest), _unfinished(place)
    harvest_shifted_street(street, scene, plans, pairs, config=config, progress=progress)
    return _finished(place, scene)


def _unfinished(place: Workplace) -> PairWriter:
    """Keeps finished pairs in the scratch folder of a stage until all are there."""
    return PairWriter(place.scratch / PAIRS_FOLDER)


def _finished(place: Workplace, scene: DrivingScene) -> dict[str, Any]:
    """Move the pairs to where they stay, and count them."""
    unfinished = place.scratch / PAIRS_FOLDER
    if not unfinished.exists():
        raise DataError(f"{scene.path}: no view could be made into a pair")
    folder = PairFolder(unfinished.rename(place.output / PAIRS_FOLDER))
    targets = {target_of(folder, index) for index in range(len(folder))}
    return {"num_pairs": len(folder), "num_targets": len(targets)}
