"""A selection of a store as one tar, with a manifest in front that says all that follows.

    lidarpainter-archive.json   version, rows by table, and size and SHA-256 of every file
    artefacts/KIND/DIGEST/...   files by their names in a store
    scenes/DATASET/SEQUENCE/...

The tar is not compressed: what it holds is, and a size that is declared is the size that comes.
"""

import io
import json
import secrets
import tarfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from catalog.artefacts import ArtefactRef
from catalog.deletion import KEYS
from catalog.digests import file_facts
from catalog.errors import CatalogError, UnknownRecordError, storage_errors
from catalog.needs import Needs
from catalog.store import Store
from catalog.tables import Row

ARCHIVE_MANIFEST = "lidarpainter-archive.json"
ARCHIVE_VERSION = 1
MAX_MANIFEST_BYTES = 256 << 20
TABLES_IN_ORDER = ("scenes", "artefacts", "painters", "metrics", "runs")
"""Tables in the order of entering: a run comes last, when all that it needs is there."""


@dataclass(frozen=True, kw_only=True)
class Selection:
    """What goes into an archive: rows, and the folders that they stand for."""

    rows: Mapping[str, Sequence[Row]]
    folders: Sequence[Path]


def select(store: Store, named: Iterable[tuple[str, Row]]) -> Selection:
    """Choose runs with all that they need, or scenes and artefacts by themselves.

    A run needs its scene, its artefacts and metrics, and the run that it was changed from. From a
    bucket all of it is fetched. What is `named` are rows with their tables.

    Raises:
        UnknownRecordError: what is named is neither a run nor an artefact nor a scene.
        CatalogError: a run is not complete.
    """
    wanted: dict[str, set[str]] = {"runs": set(), "artefacts": set(), "scenes": set()}
    for table, row in named:
        if table not in wanted:
            raise UnknownRecordError(f"{table} are not exported, expected runs, artefacts, scenes")
        wanted[table].add(row[KEYS[table]])
    needs = Needs(store)
    wanted["runs"] = needs.with_sources(wanted["runs"])
    runs = [row for row in needs.runs if row["run_id"] in wanted["runs"]]
    if ended := [row["run_id"] for row in runs if row["status"] != "complete"]:
        raise CatalogError(f"run {ended[0]} is not complete, expected one that is")
    wanted["artefacts"] |= needs.listed(wanted["runs"])
    wanted["scenes"] |= {row["scene_id"] for row in runs}
    wanted["painters"] = needs.painters_in(wanted["artefacts"])
    rows = {
        table: [row for row in store.rows(table) if row[KEYS[table]] in ids]
        for table, ids in wanted.items()
    }
    rows["metrics"] = [r for r in store.rows("metrics") if r["run_id"] in wanted["runs"]]
    refs = [ArtefactRef.of_id(row["artefact_id"]) for row in rows["artefacts"]]
    scenes = [store.whole_scene(row["scene_id"]) for row in rows["scenes"]]
    return Selection(rows=rows, folders=[*map(store.artefacts.files, refs), *scenes])


def write_archive(store: Store, selection: Selection, out: Path) -> int:
    """Write a selection; returns the size of its files.

    Raises:
        DamagedArtefactError: an artefact is not what was written.
        StorageError: the archive cannot be written; nothing of it stays.
    """
    for row in selection.rows["artefacts"]:
        store.artefacts.verified(ArtefactRef.of_id(row["artefact_id"]))
    paths = [path for folder in selection.folders for path in _files(folder)]
    files = {path.relative_to(store.root).as_posix(): file_facts(path) for path in paths}
    content = {
        "version": ARCHIVE_VERSION,
        "rows": {
            table: [{name: _plain(value) for name, value in row.items()} for row in rows]
            for table, rows in selection.rows.items()
        },
        "files": files,
    }
    manifest = json.dumps(content, sort_keys=True).encode()
    aside = out.with_name(f".{out.name}.{secrets.token_hex(4)}")
    with storage_errors(f"cannot write {out}"):
        try:
            with tarfile.open(aside, "w", format=tarfile.PAX_FORMAT) as tar:
                tar.addfile(_entry(ARCHIVE_MANIFEST, len(manifest)), io.BytesIO(manifest))
                for path, name in zip(paths, files, strict=True):
                    with path.open("rb") as file:
                        tar.addfile(_entry(name, files[name]["num_bytes"]), file)
            aside.replace(out)
        finally:
            aside.unlink(missing_ok=True)
    return sum(facts["num_bytes"] for facts in files.values())


def _files(folder: Path) -> list[Path]:
    """The files of a folder, hidden ones of writers left out."""
    if not folder.is_dir():
        raise UnknownRecordError(f"{folder} is gone, though the catalog has it")
    return sorted(path for path in folder.rglob("*") if path.is_file())


def _entry(name: str, num_bytes: int) -> tarfile.TarInfo:
    """An entry that is the same whoever writes it, and whenever."""
    entry = tarfile.TarInfo(name)
    entry.size = num_bytes
    return entry


def _plain(value: Any) -> Any:  # noqa: ANN401 - any value of a table
    return value.isoformat() if isinstance(value, datetime) else value
