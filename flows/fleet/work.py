"""What a worker does with one sequence: bring it into the store, reconstruct, dress, publish it.

Where a Prefect API is configured, each sequence is one flow run there, and its stages are task
runs. Else they are plain functions, and no server is started: who works on what and what is done
stands in the store either way. What Prefect cannot be told of changes nothing about it.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from prefect import flow, tags
from prefect.settings import PREFECT_API_URL

from catalog.artefacts import ArtefactRef
from catalog.store import Store, open_store
from flows.assets import publish_run
from flows.derive import style_run
from flows.fleet.asked_sequences import Asked
from flows.fleet.flow_runs import SEQUENCE, store_tag
from flows.reconstruct import reconstruct
from lidarpainter_models.evaluation.scene_evaluation import known_street
from lidarpainter_models.weather.mix import StyleMix
from tasks.evaluation.shown import forget_shown
from tasks.ingest.ingest import has_street, ingest_street
from tasks.ingest.jobs import IngestRequest, ingest_or_recall, sole_reader
from tasks.opened import forget_opened, open_scene
from tasks.stored import forget_stored


@dataclass(frozen=True, slots=True, kw_only=True)
class Made:
    """What came of one sequence."""

    run_id: str
    is_whole: bool
    """Whether all stages were computed, so that it took what such a sequence takes."""
    num_bytes: int
    """Size of what was computed."""
    peak_memory_bytes: int | None = None


Work = Callable[[Asked, Path, str], Made]
"""Makes one sequence in a store, in the attempt of an id."""


def make_sequence(asked: Asked, store_path: Path, attempt: str) -> Made:
    """Make a sequence, as a flow run where Prefect is configured.

    What came of the work counts; an error of Prefect does where the work did not begin.
    """
    if not PREFECT_API_URL.value():
        return _made(asked, store_path)
    ended: list[Made | Exception] = []

    def fleet_sequence(asked: str, store_path: str, attempt: str) -> None:  # noqa: ARG001
        try:
            ended.append(_made(Asked.model_validate_json(asked), Path(store_path)))
        except Exception as error:
            ended.append(error)
            raise

    run = flow(name=SEQUENCE, flow_run_name=asked.scene_id, persist_result=False)(fleet_sequence)
    with tags(store_tag(store_path)):
        try:
            run(asked.model_dump_json(), str(store_path), attempt)
        except Exception:
            if not ended:
                raise
    if isinstance(ended[0], Exception):
        raise ended[0]
    return ended[0]


def _made(asked: Asked, store_path: Path) -> Made:
    for forget in (forget_opened, forget_stored, forget_shown, known_street.cache_clear):
        forget()  # what stages kept of the sequence before
    store = open_store(store_path)
    _bring_in(asked, store)
    run = reconstruct(asked.parameters, store.address)
    results = [run]
    for variant in asked.variants:
        mix = StyleMix.parse(variant)
        results.append(style_run(store, run["run_id"], mix, seed=0))
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
        is_whole=bool(refs) and all(all(one["computed_now"].values()) for one in results),
        num_bytes=sum(store.artefacts.manifest(ref).num_bytes for ref in refs),
        peak_memory_bytes=max(peaks, default=None),
    )


def _ref(folder: str) -> ArtefactRef:
    return ArtefactRef(Path(folder).parent.name, Path(folder).name)


def _bring_in(asked: Asked, store: Store) -> None:
    """Read or draw the scene unless the store has it as it is asked for."""
    if asked.is_stored:
        open_scene(store, asked.scene_id)
        return
    if asked.seed is None:
        frames = None if asked.frames is None else slice(*asked.frames)
        root = asked.root or Path()
        request = IngestRequest(
            store.address, asked.dataset, root, frames, asked.read_cameras, asked.rig
        )
        ingest_or_recall(request, asked.sequence, again=False)
        return
    if has_street(store, asked.street):
        return
    with sole_reader(store, asked.scene_id):
        if not has_street(store, asked.street):
            ingest_street(store.address, asked.street)
