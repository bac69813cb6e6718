"""What a run printed when it was made: the same run is not made twice.

Kept apart from `reconstruct`, so that a command that computes nothing imports neither Prefect nor
what a fit needs.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from catalog.artefacts import ArtefactRef
from catalog.digests import plain
from catalog.records import RunRecord, json_of, run_id_of
from catalog.store import Store, open_store
from flows.interruption import at_interruption
from flows.parameters import ReconstructParameters
from lidarpainter_models.painter.selection import PainterChoice
from tasks.opened import open_scene
from tasks.reconstruction.publish import end_run
from tasks.stages import code_behind
from tasks.weights import file_digests


@contextmanager
def early_end_recorded(store_path: Path, record: RunRecord) -> Iterator[None]:
    """Enter into the catalog that a run failed or was interrupted, and let the error go on."""
    interrupted = partial(end_run.fn, store_path, record, "interrupted", None)  # asks no server
    with at_interruption(interrupted):
        try:
            yield
        except Exception as error:
            end_run(store_path, record, "failed", f"{type(error).__name__}: {error}")
            raise


START = "flows.reconstruct:reconstruct"
"""The code of a run is what this flow reaches."""


def run_identity(parameters: ReconstructParameters, store: Store) -> str:
    """The id of a run: the same scene content, parameters, weights and code are the same run."""
    scene = open_scene(store, parameters.scene)
    weights = file_digests(parameters.evaluation_config.weight_files)
    return run_id_of(
        scene.content_digest,
        [plain(parameters), PainterChoice.of(parameters.painter).digest, weights],
        code_behind(START).digest,
    )


def recalled(parameters: ReconstructParameters, store_path: Path) -> dict[str, Any] | None:
    """The result of this run if it is complete and all that it made is there, else None.

    Raises:
        SceneError: the scene is not there.
        WeightsError: the painter or the weights of a perceptual distance cannot be used.
    """
    store = open_store(store_path)
    return recalled_run(store, run_identity(parameters, store))


def recalled_run(store: Store, run_id: str) -> dict[str, Any] | None:
    """The result of a run if it is complete and all that it made is there, else None."""
    row = store.tables.find("runs", run_id)
    if row is None or row["status"] != "complete":
        return None
    made = [ArtefactRef.of_id(artefact_id) for artefact_id in row["artefacts"]]
    if not all(store.artefacts.is_complete(ref) for ref in made):
        return None
    result = json_of(row, "result")
    result["computed_now"] = dict.fromkeys(result["computed_now"], False)
    return located(result, store)


def located(result: dict[str, Any], store: Store) -> dict[str, Any]:
    """A stored result with paths in place of what the store calls things."""
    refs = {name: ArtefactRef.of_id(one) for name, one in result["artefacts"].items()}
    return {
        **result,
        "artefacts": {name: store.place_of(ref.entry) for name, ref in refs.items()},
        "report": result["report"] and store.place_of(result["report"]),
    }
