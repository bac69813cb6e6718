"""Where everything is: one folder with scenes, artefacts, tables and locks."""

import os
import re
import tempfile
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from catalog.artefacts import ArtefactStore
from catalog.errors import CatalogError, StorageError, UnknownRecordError
from catalog.locks import held_lock, is_held, shared_lock

if TYPE_CHECKING:
    from catalog.tables import CatalogTables, Row

STORE_ENVIRONMENT = "LIDARPAINTER_STORE"
DEFAULT_STORE = "lidarpainter-store"
LATEST = "latest"

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")


@dataclass(frozen=True)
class Store:
    """A LidarPainter store."""

    root: Path

    @cached_property
    def artefacts(self) -> ArtefactStore:
        """The content-addressed artefacts."""
        return ArtefactStore(self.root)

    @cached_property
    def tables(self) -> "CatalogTables":
        """The catalog's tables."""
        from catalog.tables import CatalogTables  # Arrow and Delta: help does without

        return CatalogTables(str(self.root / "tables"))

    def make(self) -> None:
        """Make the folder of the store where it is not there, and see that it takes a file.

        Raises:
            StorageError: it cannot be made or written.
        """
        make_writable(self.root, "the store")

    def scene_folder(self, scene_id: str) -> Path:
        """Folder of the scene `<dataset>/<sequence>`, whether it exists or not.

        Raises:
            UnknownRecordError: the id is no dataset and sequence, or tries to leave the store.
        """
        dataset, sequence = split_scene_id(scene_id)
        return self.root / "scenes" / dataset / sequence

    def name_of(self, path: Path) -> str:
        """A path as rows hold it: from the folder of the store; outside it, absolute."""
        path = path.absolute()
        return str(path.relative_to(self.root) if path.is_relative_to(self.root) else path)

    def path_of(self, name: str) -> Path:
        """The path that a row holds, see `name_of`."""
        return self.root / name

    def scene_lock(
        self, scene_id: str, *, on_wait: Callable[[str], None] | None = None
    ) -> AbstractContextManager[bool]:
        """The lock that whoever writes this scene must hold."""
        dataset, sequence = split_scene_id(scene_id)
        return held_lock(self.root / "locks" / f"scene-{dataset}-{sequence}.lock", on_wait=on_wait)

    def run_lock(self, run_id: str) -> AbstractContextManager[None]:
        """The lock that every process which works on this run holds."""
        return shared_lock(self._run_lock(run_id))

    def rows(self, table: str) -> "list[Row]":
        """All rows of a table, by id; a run that was killed does not count as running."""
        return [self._as_it_is(table, row) for row in self.tables.rows(table)]

    def row(self, table: str, id_or_prefix: str) -> "Row":
        """The one row with this id, or whose id starts with it; see `rows`.

        Raises:
            UnknownRecordError: none matches, or more than one.
        """
        return self._as_it_is(table, self.tables.row(table, id_or_prefix))

    def _as_it_is(self, table: str, row: "Row") -> "Row":
        is_over = table == "runs" and row["status"] == "running"
        if is_over and not is_held(self._run_lock(row["run_id"])):
            return {**row, "status": "interrupted"}
        return row

    def _run_lock(self, run_id: str) -> Path:
        return self.root / "locks" / f"run-{run_id}.lock"

    def run(self, run_id: str) -> "Row":
        """The row of a run by id, unique prefix, or `latest` (the last that completed).

        Raises:
            UnknownRecordError: there is no such run.
        """
        if run_id != LATEST:
            return self.row("runs", run_id)
        complete = [row for row in self.tables.rows("runs") if row["status"] == "complete"]
        if not complete:
            raise UnknownRecordError(f"no complete run in {self.root}")
        return max(complete, key=lambda row: row["finished_at"])


def open_store(path: Path | str | None = None) -> Store:
    """The store at a path, else at `LIDARPAINTER_STORE`, else at `./lidarpainter-store`.

    Nothing is made before something is written.

    Raises:
        CatalogError: something that is not a folder is in the way.
    """
    chosen = Path(path or os.environ.get(STORE_ENVIRONMENT) or DEFAULT_STORE).expanduser()
    root = chosen.absolute()
    if root.exists() and not root.is_dir():
        raise CatalogError(f"the store {root} is a file, expected a folder")
    return Store(root)


def existing_store() -> Store:
    """The store of `open_store`, for whoever only asks what it holds.

    Raises:
        CatalogError: there is none, or something that is not a folder is in the way.
    """
    store = open_store()
    if not any((store.root / name).is_dir() for name in ("tables", "scenes")):
        raise CatalogError(f"no store at {store.root}: `ingest` or `demo` makes one, see --store")
    return store


def make_writable(folder: Path, what: str) -> None:
    """Make a folder where it is not there, and see that it takes a file.

    Raises:
        StorageError: it cannot be made or written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as probe:
            probe.write(b"-")
    except OSError as error:
        raise StorageError(
            f"{what} {folder} cannot be written: {error.strerror}; expected a folder with room"
        ) from None


def split_scene_id(scene_id: str) -> tuple[str, str]:
    """Dataset and sequence of a scene id.

    Raises:
        UnknownRecordError: the id is not `<dataset>/<sequence>` of plain names.
    """
    parts = scene_id.split("/")
    if len(parts) != 2 or not all(_NAME.fullmatch(part) for part in parts):
        raise UnknownRecordError(
            f"{scene_id!r} is no scene id, expected dataset/sequence such as pandaset/002"
        )
    return parts[0], parts[1]
