"""Take a run, an artefact or a scene out of the store, with what nobody else then needs.

With a run go its metrics, the artefacts that no other run lists, and what was made from those.
What was made from an artefact or a scene depends on it, and goes only if that is said. Rows go
first, then every folder is renamed aside before its files are removed: whoever is interrupted
leaves nothing half-deleted under a name.
"""

import re
import shutil
import uuid
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from catalog.assets import forget_sightings
from catalog.errors import CatalogError, UnknownRecordError, storage_errors
from catalog.needs import Needs
from catalog.store import Store
from catalog.tables import Row

KEYS = {"runs": "run_id", "painters": "painter_id"}
KEYS |= {"artefacts": "artefact_id", "scenes": "scene_id"}  # these have folders: they go last
NAMED = ("runs", "artefacts", "scenes")
"""The tables of what can be named; a painter goes with the artefact that holds it."""
_PLAIN = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]*")


@dataclass(frozen=True, kw_only=True)
class Doomed:
    """One thing that goes."""

    table: str
    row_id: str
    folder: Path | None
    """Folder of its files; a run has none of its own."""
    num_bytes: int
    objects: tuple[str, ...] = ()
    """Objects of a bucket that go, where they are no entry with a folder."""


@dataclass(frozen=True, kw_only=True)
class Deletion:
    """What goes, and what cannot stay without it."""

    own: tuple[Doomed, ...]
    """What was named and what nobody else needs."""
    dependents: tuple[Doomed, ...]
    """What was made from it."""


def plan_deletion(store: Store, table: str, row: Row) -> Deletion:
    """What goes with a row of the catalog.

    Raises:
        UnknownRecordError: rows of that table are not deleted.
        CatalogError: the run is running, or a name in the catalog leads out of the store.
    """
    if table not in NAMED:
        raise UnknownRecordError(
            f"rows of {table} are not deleted, expected a run, an artefact or a scene"
        )
    needs, name = Needs(store), row[KEYS[table]]
    named = doomed_rows(store, table, [name])
    if table == "runs":
        if row["status"] == "running":
            raise CatalogError(f"run {name} is running, expected one that has ended")
        listed = needs.listed(run["run_id"] for run in needs.runs if run["run_id"] != name)
        own = set(row["artefacts"] or ()) - listed
        own |= needs.made_from(own) - listed
        return Deletion(own=(*named, *doomed_rows(store, "artefacts", own)), dependents=())
    if table == "artefacts":
        made = needs.made_from({name})
        runs = needs.runs_with({name, *made})
    else:
        made = needs.made_of(row["content_digest"])
        runs = {run["run_id"] for run in needs.runs if run["scene_id"] == name}
        runs |= needs.runs_with(made)
    gone = {*made, *([name] if table == "artefacts" else [])}
    dependents = (
        *doomed_rows(store, "runs", runs),
        *doomed_rows(store, "painters", needs.painters_in(gone)),
        *doomed_rows(store, "artefacts", made),
    )
    return Deletion(own=tuple(named), dependents=dependents)


def delete(store: Store, doomed: Sequence[Doomed]) -> None:
    """Remove the rows, then the folders.

    Raises:
        StorageError: the store cannot be written.
        ConflictError: other writers won every attempt.
    """
    names = {table: [one.row_id for one in doomed if one.table == table] for table in KEYS}
    store.tables.delete("metrics", "run_id", names["runs"])
    for table, key in KEYS.items():
        store.tables.delete(table, key, names[table])
    for table in ("runs", "artefacts"):  # assets are what is left of their sightings
        forget_sightings(store, KEYS[table], names[table])
    for one in doomed:
        if store.mirror is not None:
            store.mirror.bucket.remove(one.objects)
        if one.folder is None:
            continue
        if store.mirror is not None:
            store.mirror.remove(one.folder.relative_to(store.root).as_posix())
            continue
        with storage_errors(f"cannot delete {one.folder}"), suppress(FileNotFoundError):
            aside = store.root / "aside" / f"deleted-{uuid.uuid4().hex}"
            aside.parent.mkdir(exist_ok=True)
            one.folder.rename(aside)
            shutil.rmtree(aside)


def doomed_rows(store: Store, table: str, names: Iterable[str]) -> list[Doomed]:
    """Rows of a table by id, with their folders and sizes.

    Raises:
        CatalogError: a name leads out of the store.
    """
    found = []
    for name in sorted(names):
        folder = _folder(store, table, name) if table in ("artefacts", "scenes") else None
        num_bytes = 0 if folder is None else store.entry_bytes(folder)
        found.append(Doomed(table=table, row_id=name, folder=folder, num_bytes=num_bytes))
    return found


def _folder(store: Store, table: str, name: str) -> Path:
    """Where the files lie; the name comes from a table that anybody may have written."""
    parts = name.split("/")
    if len(parts) != 2 or (table == "artefacts" and not all(map(_PLAIN.fullmatch, parts))):
        raise CatalogError(f"{table} name {name!r} is no place in the store, nothing was deleted")
    folder = store.root / "artefacts" / parts[0] / parts[1]
    if table == "scenes":
        folder = store.scene_folder(name)
    if not folder.resolve().is_relative_to(store.root.resolve()):
        raise CatalogError(f"{folder} leads out of the store, nothing was deleted")
    return folder
