"""Bring a sequence of a dataset, or the synthetic street, into the store and the catalog."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import lidarpainter_models
from catalog.store import Store, open_store
from lidarpainter_models.errors import ConfigError, SceneError
from lidarpainter_models.readers import open_log, scene_id_of
from lidarpainter_models.readers.source_logs.log import write_log
from lidarpainter_models.synthetic import SyntheticStreetConfig, write_street
from lidarpainter_models.synthetic.street import WORLD_VERSION
from tasks.ingest.bucket_roots import root_at_hand
from tasks.measuring import measured
from tasks.opened import open_scene
from tasks.progress import listener, progress_of
from tasks.specs import street_id
from tasks.stages import stage_task

STAGE = "ingest"
NS_PER_S = 1e9


@stage_task
def ingest_sequence(
    store_path: Path,
    dataset: str,
    root: Path,
    sequence: str,
    frames: slice | None = None,
    cameras: tuple[str, ...] | None = None,
    rig: Path | None = None,
) -> dict[str, Any]:
    """Read one sequence of a dataset into the store; returns its row in `scenes`."""
    store = open_store(store_path)
    store.make()
    with (
        root_at_hand(root, sequence) as folder,
        writing(store, scene_id_of(dataset, folder, sequence)),
    ):
        log = open_log(dataset, folder, sequence, frames=frames, cameras=cameras, rig=rig)
        path = write_log(log, store.root, progress=progress_of(STAGE))
    return record_scene(store, path)


@stage_task
def ingest_street(store_path: Path, config: SyntheticStreetConfig) -> dict[str, Any]:
    """Render a synthetic street into the store; returns its row in `scenes`."""
    store = open_store(store_path)
    store.make()
    with writing(store, street_id(config.seed)):
        path = write_street(config, store.root, progress=progress_of(STAGE))
    return record_scene(store, path)


def has_street(store: Store, config: SyntheticStreetConfig) -> bool:
    """Whether the store has exactly this street; one of an older world does not count.

    Raises:
        ConfigError: the street of this seed is there otherwise; runs may have been made of it.
    """
    scene_id = street_id(config.seed)
    try:
        drawn = open_scene(store, scene_id).manifest.get("generator", {})
    except SceneError:
        return False
    if drawn.get("world_version") != WORLD_VERSION:
        return False
    if drawn.get("config") != json.loads(json.dumps(config.to_dict())):
        raise ConfigError(
            f"scene {scene_id} is in the store with other frames, width or cameras; it was "
            f"kept, `catalog delete {scene_id}` makes room for another"
        )
    return True


@contextmanager
def writing(store: Store, scene_id: str) -> Iterator[None]:
    """Tell the listener, and keep other writers of the scene out."""
    listener().started(STAGE)
    with measured() as cost:
        waiting = partial(listener().waiting, STAGE)
        with store.scene_lock(scene_id, on_wait=waiting):
            yield
    listener().finished(STAGE, cost.seconds, is_new=True)


def record_scene(store: Store, path: Path) -> dict[str, Any]:
    """Enter the scene whose folder is at a path of the store into the catalog; returns its row."""
    scene = open_scene(store, f"{path.parent.name}/{path.name}")
    times_ns = scene.frame_timestamps_ns
    row = {
        "scene_id": f"{scene.dataset}/{scene.sequence}",
        "dataset": scene.dataset,
        "sequence": scene.sequence,
        "content_digest": scene.content_digest,
        "licence": scene.manifest["licence"],
        "num_frames": len(scene.frame_indices),
        "num_views": len(scene.views),
        "cameras": list(scene.camera_names),
        "num_points": sum(sweep.num_points for sweep in scene.sweeps),
        "num_actors": len(scene.tracks),
        "num_moving_actors": sum(track.is_moving for track in scene.tracks),
        "duration_s": float(times_ns[-1] - times_ns[0]) / NS_PER_S,
        "num_bytes": sum(scene.manifest["files"].values()),
        "software_version": lidarpainter_models.__version__,
    }
    store.tables.merge("scenes", [row])
    return row
