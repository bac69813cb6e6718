"""Find where a scene's car drove, and bring the scene with those poses into the store."""

from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from catalog.artefacts import Workplace
from catalog.store import Store, open_store
from lidarpainter_models.errors import ConfigError, SceneError
from lidarpainter_models.geometry.driven_paths import DrivenPath
from lidarpainter_models.lidar.localised import write_localised
from lidarpainter_models.lidar.odometry import drive_of, path_difference
from lidarpainter_models.scenes.driving_scene import DrivingScene, driven_road
from lidarpainter_models.storage.tensor_files import read_tensors, write_tensors
from tasks.ingest.ingest import STAGE as WRITE
from tasks.ingest.ingest import record_scene, writing
from tasks.opened import open_scene
from tasks.progress import Progress, progress_of
from tasks.stages import StageResult, run_stage, stage_task

STAGE = "localise"
KIND = "poses"
FILE = "poses.safetensors"
SUFFIX = "-localised"


@stage_task
def localise(store_path: Path, scene_id: str) -> StageResult:
    """Find the poses of a scene's car from its sweeps.

    The summary says `num_frames` and `way_m`, and of a scene that has poses how far they differ.

    Raises:
        SceneError: there is no such scene, or its sweeps tell nothing.
    """
    store = open_store(store_path)
    scene = open_scene(store, scene_id)
    return run_stage(
        store,
        stage=STAGE,
        kind=KIND,
        inputs={"scene": scene.content_digest},
        config={},
        build=partial(_build, scene=scene),
    )


@stage_task
def ingest_localised(
    store_path: Path, scene_id: str, found: StageResult, sequence: str | None
) -> dict[str, Any]:
    """Write a scene with the poses that were found; returns its row in `scenes`.

    Args:
        store_path: where both scenes are.
        scene_id: whose poses were found.
        found: what `localise` gave.
        sequence: name of the new scene in its dataset; that of the old one and a suffix if None.

    Raises:
        ConfigError: a scene of that name is there that was made otherwise.
    """
    store = open_store(store_path)
    scene = open_scene(store, scene_id)
    name = sequence or scene.sequence + SUFFIX
    told = {"from": scene_id, "digest": scene.content_digest, "artefact": found.ref.artefact_id}
    require_free(store, scene, name, STAGE)
    with writing(store, f"{scene.dataset}/{name}"):
        path = write_localised(
            *(scene, _load(store, found), store.root, name),
            provenance={STAGE: told},
            progress=progress_of(WRITE),
        )
    return record_scene(store, path)


def require_free(store: Store, scene: DrivingScene, name: str, made_by: str) -> None:
    """Refuse the name of a scene that was not made of this one in the same way.

    Raises:
        ConfigError: there is such a scene; runs may have been made of it.
    """
    try:
        known = open_scene(store, f"{scene.dataset}/{name}").manifest["provenance"]
    except SceneError:
        return
    earlier = known.get(made_by)
    if not isinstance(earlier, dict) or earlier.get("from") != f"{scene.dataset}/{scene.sequence}":
        raise ConfigError(
            f"scene {scene.dataset}/{name} is in the store and was not made of "
            f"{scene.dataset}/{scene.sequence} by {made_by}; it was kept, --as names another"
        )


def _build(place: Workplace, progress: Progress, *, scene: DrivingScene) -> dict[str, Any]:
    path = drive_of(scene, progress)
    tensors = {"timestamps_ns": path.timestamps_ns, "world_from_ego": path.world_from_body}
    write_tensors(place.output / FILE, tensors, {})
    difference = path_difference(path, driven_road(scene)) if scene.has_poses else None
    return {
        "num_frames": len(path),
        "way_m": round(float(path.travelled_m[-1]), 3),
        "recorded": None if difference is None else asdict(difference),
    }


def _load(store: Store, found: StageResult) -> DrivenPath:
    store.artefacts.verified(found.ref)
    tensors, _ = read_tensors(store.artefacts.files(found.ref) / FILE, damaged=SceneError)
    return DrivenPath(
        timestamps_ns=tensors["timestamps_ns"], world_from_body=tensors["world_from_ego"]
    )
