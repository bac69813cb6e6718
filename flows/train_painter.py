"""From scenes to a trained painter: harvest pairs, train, judge on pairs held back, publish."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

from prefect import flow

from catalog.store import open_store, split_scene_id
from flows.painter_parameters import HarvestParameters, TrainPainterParameters
from lidarpainter_models.devices import chosen_device
from lidarpainter_models.errors import ConfigError
from lidarpainter_models.evaluation.held_back import (
    check_street_seed,
    check_training_pairs,
    check_training_scene,
    first_targets,
)
from lidarpainter_models.evaluation.painter_training import TrainingRequest
from lidarpainter_models.painter.known_painters import WEIGHTS_SUFFIX
from lidarpainter_models.painter.training_jobs import job_for
from lidarpainter_models.storage.whole_files import write_whole
from lidarpainter_models.training_data.pairs import PairSet, named_sets
from tasks.ingest.ingest import has_street
from tasks.opened import open_split
from tasks.painter.evaluate import (
    feature_distance_of,
    load_painting_scores,
    samples_path,
    score_held_back,
)
from tasks.painter.harvest import harvest_recorded, harvest_street, keep_street, pair_set
from tasks.painter.train import publish_painter, train, training_record, weights_path
from tasks.specs import SplitSpec, street_id
from tasks.stages import StageResult

SYNTHETIC = "synthetic/"


@flow(name="harvest_pairs")
def harvest_pairs(parameters: HarvestParameters, store_path: Path) -> dict[str, Any]:
    """Make training pairs from streets and logs; each scene gives a folder of them."""
    return {"pairs": [_described(*made) for made in _harvested(parameters, store_path)]}


@flow(name="train_painter")
def train_painter(parameters: TrainPainterParameters, store_path: Path) -> dict[str, Any]:
    """Harvest, train, judge on what was held back, and enter the painter into the catalog."""
    check_sources(parameters, store_path)
    harvested, store = _harvested(parameters, store_path), open_store(store_path)
    sets = (*(made for made, _ in harvested), *named_sets(parameters.pair_folders))
    device = str(chosen_device(parameters.device))
    request = TrainingRequest(
        sets=sets,
        config=parameters.training,
        held_back=parameters.held_back,
        start=parameters.base or parameters.start,
        lpips=parameters.lpips,
        device=device,
        num_processes=parameters.processes,
    )
    trained = train(store_path, "train", request)
    scores, samples = None, None
    if parameters.held_back > 0:
        weights = weights_path(store, trained.ref)
        judged = score_held_back(
            store_path,
            "judge",
            weights,
            sets,
            parameters.held_back,
            feature_weights=parameters.feature_weights,
            device=device,
        )
        scores = load_painting_scores(store, judged.ref)
        samples = str(samples_path(store, judged.ref))
    row = publish_painter(store_path, trained.ref, scores)
    return {
        "painter_id": row["painter_id"],
        "weights": str(store.path_of(row["path"])),
        "num_bytes": row["num_bytes"],
        "pairs": [_described(*made) for made in harvested],
        "training": training_cost(trained),
        "held_back": scores,
        "samples": samples,
        "record": training_record(store, trained.ref, scores),
    }


def check_harvest(parameters: HarvestParameters, store_path: Path) -> None:
    """Refuse to harvest nothing, or scenes that are not there or cannot be split.

    Raises:
        ConfigError: there are neither streets nor scenes, the split leaves nothing to train on, or
            a street is in the store with other frames, width or cameras.
        SceneError: a scene is not there, or lacks a camera.
    """
    if not parameters.street_seeds and not parameters.scenes:
        raise ConfigError("nothing to harvest: expected --seeds or --scene")
    _check_scenes(parameters, store_path)


def _check_scenes(parameters: HarvestParameters, store_path: Path) -> None:
    for seed in parameters.street_seeds:
        has_street(open_store(store_path), replace(parameters.street, seed=seed))
    streets = {street_id(seed) for seed in parameters.street_seeds}  # these are drawn
    for scene_id in parameters.scenes:
        if scene_id not in streets:
            split = SplitSpec(scene_id=scene_id, spec=parameters.split, cameras=parameters.cameras)
            open_split(open_store(store_path), split)


def check_sources(parameters: TrainPainterParameters, store_path: Path) -> None:
    """Refuse to train on nothing, or on what judges painters.

    Raises:
        ConfigError: no source of pairs, a street whose seed is kept for judging, a loss that lacks
            what it weighs, or first weights that do not say what they have learnt.
        SceneError: a scene is not there, or lacks a camera.
        DataError: a folder holds no pairs.
        WeightsError: the model, the first weights, or those for a distance cannot be used.
    """
    feature_distance_of(parameters.feature_weights)
    start = parameters.base or parameters.start
    job = job_for(parameters.training, start, parameters.lpips, num_processes=parameters.processes)
    first_targets(job)
    if not (parameters.street_seeds or parameters.scenes or parameters.pair_folders):
        raise ConfigError("nothing to train on: expected street seeds, scenes or folders of pairs")
    for seed in parameters.street_seeds:
        check_street_seed(seed)
    for scene_id in parameters.scenes:
        check_training_scene(*split_scene_id(scene_id))
    _check_scenes(parameters, store_path)
    for one in named_sets(parameters.pair_folders):
        check_training_pairs(one.open())


def _harvested(
    parameters: HarvestParameters, store_path: Path
) -> list[tuple[PairSet, StageResult]]:
    """The pairs of every street and scene, by scene id."""
    scenes = list(parameters.scenes)
    for seed in parameters.street_seeds:
        keep_street(store_path, replace(parameters.street, seed=seed))
        scenes.append(street_id(seed))
    made = []
    for scene_id in dict.fromkeys(scenes):
        stage = f"harvest {scene_id}"
        if scene_id.startswith(SYNTHETIC):
            result = harvest_street(
                store_path, stage, scene_id, parameters.street_plans, parameters.harvest
            )
        else:
            split = SplitSpec(scene_id=scene_id, spec=parameters.split, cameras=parameters.cameras)
            result = harvest_recorded(store_path, stage, split, parameters.harvest)
        made.append((pair_set(open_store(store_path), scene_id, result.ref), result))
    return made


def _described(made: PairSet, result: StageResult) -> dict[str, Any]:
    counts = {key: result.summary[key] for key in ("num_pairs", "num_targets")}
    return {"set": made.name, "folder": str(made.folder), **counts, **training_cost(result)}


def training_cost(result: StageResult) -> dict[str, Any]:
    """Seconds and memory of a stage, as JSON types."""
    return {
        "seconds": result.seconds,
        "cpu_seconds": result.cpu_seconds,
        "peak_memory_bytes": result.peak_memory_bytes,
        "computed_now": result.is_new,
    }


def write_painter(weights: Path, record: dict[str, Any], out: Path) -> dict[str, str]:
    """Copy a painter out of the store; returns where its two files are.

    `out` is a folder, or a `.safetensors` file beside which the record goes.

    Raises:
        WriteError: the disk refuses.
    """
    path = out if out.suffix == WEIGHTS_SUFFIX else out / weights.name
    record_path = path.with_suffix(".json")
    write_whole(path, weights.read_bytes())
    write_whole(record_path, (json.dumps(record, indent=1, sort_keys=True) + "\n").encode())
    return {"weights": str(path), "record_path": str(record_path)}
