"""What a worker does with one sequence: bring it into the store, reconstruct, dress, publish it.

Where a Prefect API is configured, each sequence is one flow run there, and its stages are task
runs. Else they are plain functions, and no server is started: who works on what and what is done
stands in the store either way.
"""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from prefect import flow
from prefect.settings import PREFECT_API_URL

from catalog.artefacts import ArtefactRef
from catalog.store import Store, open_store
from flows.assets import publish_run
from flows.dress import dress_run
from flows.fleet.asked import Asked
from flows.reconstruct import reconstruct
from lidarpainter_models.errors import ConfigError, SceneError
from lidarpainter_models.synthetic.street import WORLD_VERSION
from lidarpainter_models.weather.mix import StyleMix
from tasks.ingest.ingest import ingest_street
from tasks.ingest.jobs import IngestRequest, ingest_or_recall
from tasks.opened import open_scene


@dataclass(frozen=True, slots=True, kw_only=True)
class Made:
    """What came of one sequence."""

    run_id: str
    is_new: bool
    """Whether any stage was computed."""
    num_bytes: int
    """Size of what was computed."""
    peak_memory_bytes: int | None = None


Work = Callable[[Asked, Path], Made]
"""Makes one sequence in a store."""


def make_sequence(asked: Asked, store_path: Path) -> Made:
    """Make a sequence, as a flow run where Prefect is configured."""
    if PREFECT_API_URL.value():
        named = fleet_sequence.with_options(flow_run_name=asked.scene_id)
        return named(asked.model_dump_json(), store_path)
    return _made(asked, store_path)


@flow(name="fleet-sequence", persist_result=False)
def fleet_sequence(asked: str, store_path: Path) -> Made:
    """Make one sequence of a fleet.

    Args:
        asked: as the catalog keeps it, JSON.
        store_path: folder of the store.
    """
    return _made(Asked.model_validate_json(asked), store_path)


def _made(asked: Asked, store_path: Path) -> Made:
    store = open_store(store_path)
    _bring_in(asked, store)
    run = reconstruct.fn(asked.parameters, store.address)
    results = [run]
    for variant in asked.variants:
        mix = StyleMix.parse(variant)
        results.append(dress_run(store, run["run_id"], mix, seed=0))
    new = [result for result in results if any(result["computed_now"].values())]
    refs = [
        _ref(path)
        for result in new
        for name, path in result["artefacts"].items()
        if result["computed_now"].get(name)
    ]
    if asked.assets:
        published = [publish_run(store, result["run_id"]) for result in results]
        refs += [_ref(one["artefact"]) for one in published if one["is_new"]]
    peaks = [result["peak_memory_bytes"] for result in new]
    return Made(
        run_id=run["run_id"],
        is_new=bool(refs),
        num_bytes=sum(store.artefacts.manifest(ref).num_bytes for ref in refs),
        peak_memory_bytes=max(peaks, default=None),
    )


def _ref(folder: str) -> ArtefactRef:
    return ArtefactRef(Path(folder).parent.name, Path(folder).name)


def _bring_in(asked: Asked, store: Store) -> None:
    """Read or draw the scene unless the store has it as it is asked for.

    Raises:
        SceneError: the store was to have it.
        ConfigError: the store has it, read or drawn otherwise; other runs may stand on it.
    """
    if asked.is_stored:
        open_scene(store, asked.scene_id)
        return
    if asked.seed is None:
        frames = None if asked.frames is None else slice(*asked.frames)
        root = asked.root or Path()
        request = IngestRequest(store.address, asked.dataset, root, frames, asked.read_cameras)
        ingest_or_recall(request, asked.sequence, again=False)
        return
    try:
        drawn = open_scene(store, asked.scene_id).manifest.get("generator", {})
    except SceneError:
        drawn = {}
    if drawn.get("world_version") != WORLD_VERSION:
        ingest_street(store.address, asked.street)
    elif drawn.get("config") != json.loads(json.dumps(asked.street.to_dict())):
        raise ConfigError(
            f"scene {asked.scene_id} is in the store with other frames, width or cameras; it was "
            f"kept, `catalog delete {asked.scene_id}` makes room for another"
        )
