"""Library objects as artefacts and back: observations, fitted scenes, painted views.

Each kind has one file of tensors (`FILES`); reading one checks every byte first.
"""

import csv
from functools import lru_cache
from pathlib import Path

from catalog.artefacts import ArtefactRef
from catalog.store import Store
from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene
from lidarpainter_models.gaussians.model.stored_scene import scene_from_arrays, scene_to_arrays
from lidarpainter_models.observations.stored_form import (
    observations_from_arrays,
    observations_to_arrays,
)
from lidarpainter_models.observations.views import SceneObservations
from lidarpainter_models.storage.tensor_files import read_tensors, write_tensors
from tasks.json_files import read_json, write_json

OBSERVATIONS_FILE = "observations.safetensors"
SCENE_FILE = "scene.safetensors"
HISTORY_FILE, HISTORY_TABLE = "history.json", "history.csv"


History = list[dict[str, float]]


def save_observations(folder: Path, observations: SceneObservations) -> None:
    """Write observations into a folder."""
    write_tensors(folder / OBSERVATIONS_FILE, *observations_to_arrays(observations))


def load_observations(store: Store, ref: ArtefactRef) -> SceneObservations:
    """The observations of an artefact, read and checked once in a process."""
    path = store.artefacts.files(ref) / OBSERVATIONS_FILE
    return _observations(store, ref, path, *_as_it_is(path))


@lru_cache(maxsize=1)
def _observations(store: Store, ref: ArtefactRef, path: Path, *_as_it_is: int) -> SceneObservations:
    store.artefacts.verified(ref)
    return observations_from_arrays(*read_tensors(path))


def save_scene(folder: Path, scene: GaussianScene, history: History) -> None:
    """Write a fitted scene and the course of its fit, as JSON and as a table, into a folder."""
    write_tensors(folder / SCENE_FILE, *scene_to_arrays(scene))
    write_json(folder / HISTORY_FILE, history)
    if history:
        with (folder / HISTORY_TABLE).open("w", encoding="ascii", newline="") as file:
            table = csv.DictWriter(file, history[0].keys())
            table.writeheader()
            table.writerows(history)


def load_scene(store: Store, ref: ArtefactRef) -> GaussianScene:
    """The fitted scene of an artefact, read and checked once in a process.

    It is shared: whoever changes it takes a copy.
    """
    path = store.artefacts.files(ref) / SCENE_FILE
    return _scene(store, ref, path, *_as_it_is(path))


@lru_cache(maxsize=2)  # the first fit and the last one are judged side by side
def _scene(store: Store, ref: ArtefactRef, path: Path, *_as_it_is: int) -> GaussianScene:
    store.artefacts.verified(ref)
    return scene_from_arrays(*read_tensors(path))


def forget_stored() -> None:
    """Let go of the artefacts that this process has read."""
    _observations.cache_clear()
    _scene.cache_clear()


def _as_it_is(path: Path) -> tuple[int, int]:
    """What changes when a file does: what was kept of it is then read and checked again."""
    try:
        found = path.stat()
    except OSError:
        return 0, 0
    return found.st_size, found.st_mtime_ns


def load_history(store: Store, ref: ArtefactRef) -> History:
    """Read the course of the fit that made an artefact."""
    return read_json(store.artefacts.files(ref) / HISTORY_FILE)
