"""Bring a recording with a fault into the store and the catalog."""

from functools import partial
from pathlib import Path
from typing import Any

from catalog.store import Store, open_store
from lidarpainter_models.errors import SceneError
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.stress.spoiling import (
    DATASET,
    STRESS,
    spoilt_from,
    spoilt_name,
    write_spoilt,
)
from tasks.ingest.ingest import STAGE, record_scene, writing
from tasks.opened import open_posed, open_scene
from tasks.progress import progress_of
from tasks.stages import stage_task


@stage_task
def ingest_spoilt(store_path: Path, scene_id: str, cause: str, level: float) -> str:
    """Write a stored scene anew with a fault, unless that is there; returns its scene id."""
    store = open_store(store_path)
    scene = open_posed(store, scene_id)
    name = spoilt_id(scene, cause, level)
    if not _is_stored(store, name, spoilt_from(scene, cause, level)):
        with writing(store, name):
            told = partial(progress_of(STAGE), note=name)
            path = write_spoilt(scene, cause, level, store.root, progress=told)
        record_scene(store, path)
    return name


def spoilt_id(scene: DrivingScene, cause: str, level: float) -> str:
    """Scene id of what a fault makes of a scene."""
    return f"{DATASET}/{spoilt_name(scene, cause, level)}"


def _is_stored(store: Store, scene_id: str, told: dict[str, Any]) -> bool:
    """Whether the store holds a spoilt scene that says this of itself."""
    try:
        return bool(open_scene(store, scene_id).manifest[STRESS] == told)
    except (SceneError, KeyError):
        return False
