"""Take an archive into a store; it comes from outside, so nothing of it is believed.

Every name, kind and size is checked before a byte is written, every digest before anything gets its
name in the store: no path leaves it, links and devices are refused, and no more is written than was
declared and there is room for. What is there already stays, so importing twice changes nothing.
"""

import hashlib
import json
import re
import shutil
import tarfile
import uuid
from collections import defaultdict
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path, PurePosixPath
from typing import IO, Any

import pyarrow as pa

from catalog.archives import ARCHIVE_MANIFEST, ARCHIVE_VERSION, MAX_MANIFEST_BYTES, TABLES_IN_ORDER
from catalog.artefacts import MANIFEST_NAME, ArtefactRef, ArtefactStore
from catalog.digests import canonical_json, digest_text
from catalog.errors import CatalogError, DamagedArtefactError, UnknownRecordError, storage_errors
from catalog.locks import held_lock
from catalog.schemas import TABLES
from catalog.store import Store, digest_in, split_scene_id
from catalog.tables import Row

MAX_FILES = 1_000_000
MAX_NAME = 512
SHOWN = 80
"""Characters of a name in an error."""
LEAST_PARTS = 4
"""Parts of a name at least: artefacts/KIND/DIGEST/FILE, or scenes/DATASET/SEQUENCE/FILE."""
BLOCK_BYTES = 1 << 20
MALFORMED = (ValueError, TypeError, KeyError, AttributeError, RecursionError, UnknownRecordError)
"""What JSON of another shape ends in."""
_ROOTS = ("artefacts", "scenes")
_PART = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")
_SHA256 = re.compile(r"[0-9a-f]{64}")
_ARTEFACT_ID = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]*/[0-9a-f]{16,64}")


class ArchiveError(CatalogError, ValueError):
    """An archive is not one of ours, is damaged, or does not fit this store."""


@dataclass(frozen=True, kw_only=True)
class _Declared:
    """What the manifest of an archive says."""

    rows: Mapping[str, Sequence[Row]]
    files: Mapping[str, Mapping[str, Any]]


def import_archive(store: Store, path: Path) -> dict[str, int]:
    """Take an archive in; returns how many rows of each table were new.

    Raises:
        ArchiveError: it is not as it should be; nothing of it is in the store then.
        StorageError: it cannot be read, or the store not written.
    """
    store.make()
    aside = store.root / "aside" / f"import-{uuid.uuid4().hex}"
    lock = held_lock(store.root / "locks" / "import.lock")  # `gc` leaves what it stands for
    with lock, storage_errors(f"cannot import {path}"):
        try:
            with _opened(path) as tar:
                declared = _read_manifest(tar, path)
                _require_room(store, declared, path)
                _unpack(tar, declared, aside, path)
            staged = _checked(Store(aside), store, declared, path)
            for name in staged:
                _place(store, aside / name, name)
        finally:
            shutil.rmtree(aside, ignore_errors=True)
        return {
            table: store.tables.add_absent(table, declared.rows.get(table, []))
            for table in TABLES_IN_ORDER
        }


@contextmanager
def _opened(path: Path) -> Iterator[tarfile.TarFile]:
    try:
        with tarfile.open(path, "r:") as tar:
            yield tar
    except tarfile.TarError as error:
        raise ArchiveError(f"{path} is no archive of lidarpainter: {error}") from None
    except FileNotFoundError:
        raise ArchiveError(f"no archive {path}") from None


def _read_manifest(tar: tarfile.TarFile, path: Path) -> _Declared:
    first = tar.next()
    if first is None or first.name != ARCHIVE_MANIFEST or not first.isreg():
        raise ArchiveError(f"{path} is no archive of lidarpainter: no {ARCHIVE_MANIFEST} in front")
    if first.size > MAX_MANIFEST_BYTES:
        raise ArchiveError(f"{path}: a manifest of {first.size} bytes is too long")
    try:
        content = json.loads(_content(tar, first).read())
        return _parsed(content)
    except (*MALFORMED, pa.ArrowException) as error:
        why = str(error) if isinstance(error, ValueError) else repr(error)
        raise ArchiveError(f"{path}: its manifest cannot be used: {why[:200]}") from None


def _parsed(content: Mapping[str, Any]) -> _Declared:
    """What a manifest says, if it is one."""
    if content["version"] > ARCHIVE_VERSION:
        raise ValueError("a newer lidarpainter wrote it: update this one")
    files = content["files"]
    if len(files) > MAX_FILES:
        raise ValueError(f"{len(files)} files, expected at most {MAX_FILES}")
    for name, known in files.items():
        _require_name(name)
        if not _is_size(known["num_bytes"]) or not _SHA256.fullmatch(known["sha256"]):
            raise ValueError(f"{name} has no size or digest")
    rows = {table: _rows(table, found) for table, found in content["rows"].items()}
    return _Declared(rows=rows, files=files)


def _is_size(value: object) -> bool:
    return isinstance(value, int) and value >= 0


def _require_name(name: str) -> None:
    """See that a name is one that a store gives to a file of an artefact or a scene."""
    parts = name.split("/")
    is_plain = len(name) <= MAX_NAME and all(map(_PART.fullmatch, parts))
    if not is_plain or len(parts) < LEAST_PARTS or parts[0] not in _ROOTS:
        raise ValueError(f"{name[:SHOWN]!r} is no file of a store")


def _rows(table: str, rows: Sequence[Mapping[str, Any]]) -> list[Row]:
    """Rows as the tables have them, with what points to files seen to stay in the store."""
    if table not in TABLES_IN_ORDER:
        raise ValueError(f"there is no table {table[:40]!r} in archives")
    times = [column.name for column in TABLES[table].columns if column.type == "time"]
    found = []
    for row in rows:
        parsed = {name: datetime.fromisoformat(row[name]) for name in times if row.get(name)}
        found.append({**row, **parsed})
    if unknown := {name for row in found for name in row} - set(TABLES[table].arrow.names):
        raise ValueError(f"{table} has no column {sorted(unknown)[0]!r}: a newer lidarpainter?")
    TABLES[table].rows_as_arrow(found)
    for row in found:
        _require_inside(table, row)
    return found


def _require_inside(table: str, row: Mapping[str, Any]) -> None:
    """See that no name in a row leads out of the store."""
    ids: list[str] = []
    if table == "runs":
        made = json.loads(row["result"])["artefacts"].values()
        ids = [*row["artefacts"], *made]
        if row["status"] != "complete":
            raise ValueError("a run is not complete")
    elif table == "artefacts":
        ids = [row["artefact_id"]]
    if wrong := [one for one in ids if not _ARTEFACT_ID.fullmatch(one)]:
        raise ValueError(f"{wrong[0]!r} is no artefact")
    if table in ("runs", "scenes", "metrics"):
        split_scene_id(row["scene_id"])
    for name in ("report", "path"):
        place = PurePosixPath(row.get(name) or "artefacts")
        if place.is_absolute() or ".." in place.parts:
            raise ValueError(f"{name} leads out of the store")


def _require_room(store: Store, declared: _Declared, path: Path) -> None:
    needed = sum(known["num_bytes"] for known in declared.files.values())
    if needed > store.free_bytes:
        raise ArchiveError(
            f"{path} holds {needed} bytes, {store.free_bytes} are free in {store.root}"
        )


def _unpack(tar: tarfile.TarFile, declared: _Declared, aside: Path, path: Path) -> None:
    """Write what was declared, and nothing else, aside."""
    missing = dict(declared.files)
    while (member := tar.next()) is not None:
        known = missing.pop(member.name, None)
        if known is None or not member.isreg() or member.issparse():
            raise ArchiveError(f"{path}: {member.name[:SHOWN]!r} was not declared as a file")
        if member.size != known["num_bytes"]:
            raise ArchiveError(f"{path}: {member.name} is of another size than was declared")
        target = aside / member.name
        target.parent.mkdir(parents=True, exist_ok=True)
        sha = hashlib.sha256()
        with _content(tar, member) as source, target.open("xb") as file:
            while block := source.read(BLOCK_BYTES):
                sha.update(block)
                file.write(block)
        if sha.hexdigest() != known["sha256"]:
            raise ArchiveError(f"{path}: {member.name} is not what was written")
    if missing:
        raise ArchiveError(f"{path}: {sorted(missing)[0]} is missing, and {len(missing) - 1} more")


def _content(tar: tarfile.TarFile, member: tarfile.TarInfo) -> IO[bytes]:
    found = tar.extractfile(member)
    if found is None:
        raise ArchiveError(f"{member.name[:SHOWN]!r} is no file")
    return found


def _checked(staged: Store, store: Store, declared: _Declared, path: Path) -> list[str]:
    """See that whole artefacts and scenes came, and what rows need; the folders to be placed."""
    folders: dict[str, set[str]] = defaultdict(set)
    for name in declared.files:
        root, kind, digest, rest = name.split("/", 3)
        folders[f"{root}/{kind}/{digest}"].add(rest)
    new = []
    for folder, names in folders.items():
        root, _, name = folder.partition("/")
        if root == "artefacts":
            _require_artefact(staged.artefacts, ArtefactRef.of_id(name), names, path)
            is_there = store.artefacts.is_complete(ArtefactRef.of_id(name))
        else:
            is_there = _has_scene(staged, store, name, path)
        new += [] if is_there else [folder]
    _require_folders(store, declared, folders.keys(), path)
    return new


def _require_folders(
    store: Store, declared: _Declared, folders: Collection[str], path: Path
) -> None:
    """See that what rows name came with them, or is in the store where it is an artefact."""
    for row in (*declared.rows.get("runs", ()), *declared.rows.get("artefacts", ())):
        for artefact_id in row["artefacts"] if "artefacts" in row else [row["artefact_id"]]:
            is_known = f"artefacts/{artefact_id}" in folders
            if not is_known and not store.artefacts.is_complete(ArtefactRef.of_id(artefact_id)):
                raise ArchiveError(f"{path}: {artefact_id} is neither in it nor in the store")
    for row in declared.rows.get("scenes", ()):
        if f"scenes/{row['scene_id']}" not in folders:
            raise ArchiveError(f"{path}: the scene {row['scene_id']} is not in it")


def _require_artefact(staged: ArtefactStore, ref: ArtefactRef, names: set[str], path: Path) -> None:
    try:
        manifest = staged.verified(ref)
    except DamagedArtefactError:
        raise ArchiveError(f"{path}: {ref.artefact_id} is damaged") from None
    parts = [manifest.kind, manifest.inputs, manifest.config, manifest.source_digest]
    if digest_text(canonical_json(parts)) != ref.digest or manifest.kind != ref.kind:
        raise ArchiveError(f"{path}: {ref.artefact_id} is not what its name says")
    if names != {*manifest.files, MANIFEST_NAME}:
        raise ArchiveError(f"{path}: {ref.artefact_id} has other files than its manifest says")


def _has_scene(staged: Store, store: Store, scene_id: str, path: Path) -> bool:
    """Whether the store has a scene with this content."""
    ours, theirs = (one.scene_digest(scene_id) for one in (store, staged))
    if theirs is None:
        raise ArchiveError(f"{path}: the scene {scene_id} has no manifest")
    if ours not in (None, theirs):
        raise ArchiveError(
            f"{path}: scene {scene_id} is in {store.name} with another content; nothing was "
            f"imported, `catalog delete {scene_id}` makes room"
        )
    return ours == theirs


def _place(store: Store, folder: Path, name: str) -> None:
    """Give a checked folder its name, under the lock of whoever makes such."""
    root, _, what = name.partition("/")
    if root == "artefacts":
        store.artefacts.adopt(ArtefactRef.of_id(what), folder)
        return
    if store.scene_digest(what) is not None:  # it came meanwhile
        return
    final = store.scene_folder(what)
    with store.scene_lock(what):
        if digest_in(final) is None:
            final.parent.mkdir(parents=True, exist_ok=True)
            folder.rename(final)
