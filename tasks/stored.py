"""Library objects as artefacts and back: observations, fitted scenes, painted views.

Each kind has one file of tensors (`FILES`); reading one checks every byte first.
"""

from dataclasses import dataclass
from pathlib import Path

from catalog.artefacts import ArtefactRef
from catalog.store import Store
from lidarpainter_models.gaussians.model.scene_graph import GaussianScene
from lidarpainter_models.observations.observations import SceneObservations
from tasks.json_files import read_json, write_json
from tasks.tensors import read_tensors, write_tensors

OBSERVATIONS_FILE = "observations.safetensors"
SCENE_FILE = "scene.safetensors"
HISTORY_FILE = "history.json"


@dataclass(frozen=True, slots=True)
class FittedRef:
    """A fitted scene and what it was fitted to."""

    observations: ArtefactRef
    gaussians: ArtefactRef


History = list[dict[str, float]]


def save_observations(folder: Path, observations: SceneObservations) -> None:
    """Write observations into a folder."""
    write_tensors(folder / OBSERVATIONS_FILE, *observations.to_arrays())


def load_observations(store: Store, ref: ArtefactRef) -> SceneObservations:
    """Read the observations of an artefact."""
    store.artefacts.verified(ref)
    return SceneObservations.from_arrays(*read_tensors(ref.folder / OBSERVATIONS_FILE))


def save_scene(folder: Path, scene: GaussianScene, history: History) -> None:
    """Write a fitted scene and the course of its fit into a folder."""
    write_tensors(folder / SCENE_FILE, *scene.to_arrays())
    write_json(folder / HISTORY_FILE, history)


def load_scene(store: Store, ref: ArtefactRef) -> GaussianScene:
    """Read the fitted scene of an artefact."""
    store.artefacts.verified(ref)
    return GaussianScene.from_arrays(*read_tensors(ref.folder / SCENE_FILE))


def load_history(ref: ArtefactRef) -> History:
    """Read the course of the fit that made an artefact."""
    return read_json(ref.folder / HISTORY_FILE)
