"""What a finished run left in the store."""

from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from catalog.artefacts import ArtefactRef
from catalog.errors import CatalogError, UnknownRecordError
from catalog.records import json_of
from catalog.store import Store
from tasks.specs import FittedRef


@dataclass(frozen=True, kw_only=True)
class FinishedRun:
    """A complete run and its artefacts."""

    run_id: str
    scene_id: str
    parameters: dict[str, Any]
    """Parameters as JSON; the flow's model reads them."""
    result: dict[str, Any]
    unpainted: FittedRef
    """After the first fit."""
    final: FittedRef
    """After the last round."""
    preset: str
    finished_at: datetime
    derived_from: str | None = None
    """The run that this one was changed from; None where it was reconstructed."""
    change: dict[str, Any] | None = None
    """`kind` and `parameters` of the change."""


def open_run(store: Store, run_id: str) -> FinishedRun:
    """A complete run by id, unique prefix, or `latest`.

    Raises:
        UnknownRecordError: there is no such run, or it did not complete.
        CatalogError: its row is damaged, or its scene has another content by now.
    """
    row = store.run(run_id)
    if row["status"] != "complete":
        why = f": {row['error']}" if row["error"] else ""
        raise UnknownRecordError(f"run {row['run_id']} is {row['status']}, not complete{why}")
    refs = [ArtefactRef.of_id(artefact_id) for artefact_id in row["artefacts"] or ()]
    seen = [ref for ref in refs if ref.kind == "observations"]
    fits = [ref for ref in refs if ref.kind == "gaussians"]
    if not seen or not fits:
        raise CatalogError(f"run {row['run_id']} lists no fit: reconstruct the scene again")
    if not is_of_its_scene(store, row):
        raise CatalogError(
            f"run {row['run_id']} was made of another content of {row['scene_id']}: "
            "reconstruct the scene again"
        )
    return FinishedRun(
        run_id=row["run_id"],
        scene_id=row["scene_id"],
        parameters=json_of(row, "parameters"),
        result=json_of(row, "result"),
        unpainted=FittedRef(seen[0], fits[0]),
        final=FittedRef(seen[0], fits[-1]),
        preset=row["preset"],
        finished_at=row["finished_at"],
        derived_from=row["derived_from"],
        change=json_of(row, "change") if row["change"] else None,
    )


def lineage(store: Store, run: FinishedRun) -> tuple[FinishedRun, ...]:
    """A run and those that it was changed from, the nearest first, as far as they are there."""
    found = [run]
    with suppress(UnknownRecordError):  # a source may have been deleted
        while found[-1].derived_from is not None:
            found.append(open_run(store, found[-1].derived_from))
    return tuple(found)


def is_of_its_scene(store: Store, row: dict[str, Any]) -> bool:
    """Whether the scene of a run's row still is what it was made of; True where one is unknown."""
    made_of = row["scene_digest"]
    return not made_of or store.scene_digest(row["scene_id"]) in (None, made_of)
