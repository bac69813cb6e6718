"""Where everything is: scenes, artefacts, tables, leases, in a folder or below an `s3://` address.

On a folder, locks of the kernel keep writers of one thing apart. On a bucket, `root` is a mirror of
it on this machine (see `mirrors`): those locks then hold between the processes of one machine, and
between machines nothing needs to be locked, since artefacts and scenes are published on a
condition. That a run is going on is told by a lock in a folder, by a lease in a bucket.
"""

import json
import os
import re
import secrets
import shutil
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass, field
from datetime import datetime
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

from catalog.artefacts import MANIFEST_NAME, ArtefactStore
from catalog.errors import CatalogError, UnknownRecordError
from catalog.folders import CACHE_ENVIRONMENT, changed_at, expanded, make_writable, nearest_existing
from catalog.leases import ConditionalObjects, FolderObjects, Leases
from catalog.locks import held_lock, is_held, shared_lock

if TYPE_CHECKING:
    from catalog.mirrors import EntryFiles, Mirror
    from catalog.tables import CatalogTables, Row

STORE_ENVIRONMENT = "LIDARPAINTER_STORE"
DEFAULT_STORE = "lidarpainter-store"
LATEST = "latest"

_UNSTORABLE = re.compile(r"%[0-9A-Fa-f]{2}|[\x00-\x1f\x7f\\]")
"""What Delta Lake misreads in the path of a table, however it is written (deltalake 1.6)."""
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")


@dataclass(frozen=True)
class Store:
    """A LidarPainter store."""

    root: Path
    """Folder on this machine: the store, or what mirrors its bucket."""
    mirror: "Mirror | None" = field(default=None, compare=False)

    @property
    def address(self) -> Path:
        """What `open_store` opens it by, on any machine that sees it."""
        return Path(self.name)

    @property
    def name(self) -> str:
        """The address of the store, for people: a folder or `s3://BUCKET/PREFIX`."""
        return str(self.root) if self.mirror is None else self.mirror.bucket.address

    @cached_property
    def artefacts(self) -> ArtefactStore:
        """The content-addressed artefacts."""
        if self.mirror is None:
            return ArtefactStore(self.root)
        from catalog.mirrored_artefacts import MirroredArtefacts

        return MirroredArtefacts(self.mirror)

    @cached_property
    def tables(self) -> "CatalogTables":
        """The catalog's tables."""
        from catalog.tables import CatalogTables  # Arrow and Delta: help does without

        if self.mirror is None:
            return CatalogTables(str(self.root / "tables"), alone=self.alone)
        from catalog.buckets import table_options

        options = table_options()
        return CatalogTables(f"{self.name}/tables", storage_options=options, alone=self.alone)

    def objects(self, folder: str) -> ConditionalObjects:
        """The small objects of a folder of the store."""
        if self.mirror is None:
            return FolderObjects(self.root / folder)
        from catalog.buckets import BucketObjects

        return BucketObjects(self.mirror.bucket, folder)

    def make(self) -> None:
        """Make the folder of the store where it is not there, and see that it takes a file.

        Raises:
            StorageError: it cannot be made or written, or there is no such bucket.
        """
        make_writable(self.root, "the store" if self.mirror is None else "the cache")
        if self.mirror is not None:
            self.mirror.bucket.holds("tables")

    def scene_folder(self, scene_id: str) -> Path:
        """Folder of the scene `<dataset>/<sequence>` on this machine, whether it exists or not.

        Raises:
            UnknownRecordError: the id is no dataset and sequence, or tries to leave the store.
        """
        return self.root / scene_entry(scene_id)

    def scene_files(self, scene_id: str) -> "EntryFiles | None":
        """What fetches the files of a scene into its folder; None where they lie there.

        Raises:
            UnknownRecordError: there is no such scene in the bucket.
        """
        return None if self.mirror is None else self.mirror.opened(scene_entry(scene_id))

    def scene_digest(self, scene_id: str) -> str | None:
        """What a scene holds, by its manifest; None where there is no scene."""
        with suppress(UnknownRecordError):
            if (files := self.scene_files(scene_id)) is not None:
                files([MANIFEST_NAME])
        return digest_in(self.scene_folder(scene_id))

    def whole_scene(self, scene_id: str) -> Path:
        """Folder of a scene with all its files; from a bucket they are fetched.

        Raises:
            UnknownRecordError: there is no such scene in the bucket.
        """
        if self.mirror is not None:
            self.mirror.fetch(scene_entry(scene_id))
        return self.scene_folder(scene_id)

    def changed(self, kind: str) -> dict[str, datetime]:
        """When the entries of `artefacts` or `scenes` got their names, by folder from the root."""
        if self.mirror is not None:
            return self.mirror.entries(kind)
        return {
            path.relative_to(self.root).as_posix(): changed_at(path)
            for path in self.root.glob(f"{kind}/*/[!.]*")
        }

    def scene_ids(self) -> list[str]:
        """The scenes whose folders are there."""
        if self.mirror is not None:
            return sorted(one.removeprefix("scenes/") for one in self.mirror.entries("scenes"))
        folders = self.root.glob("scenes/*/[!.]*")
        return sorted(f"{path.parent.name}/{path.name}" for path in folders)

    @contextmanager
    def scene_lock(
        self, scene_id: str, *, on_wait: Callable[[str], None] | None = None
    ) -> Iterator[None]:
        """What whoever writes this scene must hold; a bucket has the scene when the block ends.

        Of two machines that write one scene at once the second takes over what the first wrote.
        """
        dataset, sequence = split_scene_id(scene_id)
        path = self.root / "locks" / f"scene-{dataset}-{sequence}.lock"
        with held_lock(path, on_wait=on_wait):
            if self.mirror is None:
                yield
                return
            entry = scene_entry(scene_id)
            before = self.mirror.version(entry)
            self.mirror.forget(entry)
            yield
            self.mirror.publish(entry, replacing=before)

    def name_of(self, path: Path) -> str:
        """A path as rows hold it: from the folder of the store; outside it, absolute."""
        path = path.absolute()
        return str(path.relative_to(self.root) if path.is_relative_to(self.root) else path)

    def path_of(self, name: str) -> Path:
        """The path that a row holds, see `name_of`; its artefact is fetched where it must be."""
        parts = Path(name).parts
        if self.mirror is not None and parts[0] == "artefacts":
            self.mirror.fetch("/".join(parts[:3]))
        return self.root / name

    def place_of(self, name: str) -> str:
        """Where something of the store lies, for people; nothing is fetched."""
        return str(self.root / name) if self.mirror is None else f"{self.name}/{name}"

    def entry_bytes(self, folder: Path) -> int:
        """Size of all files of an artefact or a scene, by its folder."""
        if self.mirror is not None:
            listing = self.mirror.listing(folder.relative_to(self.root).as_posix())
            return 0 if listing is None else sum(listing.sizes.values())
        return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())

    @property
    def free_bytes(self) -> int:
        """Room on the disk of `root`, which need not be there yet."""
        return shutil.disk_usage(nearest_existing(self.root)).free

    def release(self) -> None:
        """What this process has fetched is no longer in use, and may be let go."""
        if self.mirror is not None:
            self.mirror.release()

    def run_lock(self, run_id: str) -> AbstractContextManager[None]:
        """What every process which works on this run holds."""
        if self.mirror is None:
            return shared_lock(self._run_lock(run_id))
        return self._run_leases.kept(f"{run_id}.{secrets.token_hex(4)}")

    def alone(
        self, what: str, *, on_wait: Callable[[str], None] | None = None
    ) -> AbstractContextManager[object]:
        """Held by one process at a time, of all that see this store; others wait.

        `on_wait` is told who holds it, once.
        """
        if self.mirror is None:
            return held_lock(self.root / "locks" / f"{what}.lock", on_wait=on_wait)
        return Leases(self.objects("locks")).alone(what, on_wait=on_wait)

    def rows(self, table: str) -> "list[Row]":
        """All rows of a table, by id; a run that was killed does not count as running."""
        rows = self.tables.rows(table)
        return self._as_they_are(rows) if table == "runs" else rows

    def row(self, table: str, id_or_prefix: str) -> "Row":
        """The one row with this id, or whose id starts with it; see `rows`.

        Raises:
            UnknownRecordError: none matches, or more than one.
        """
        row = self.tables.row(table, id_or_prefix)
        return self._as_they_are([row])[0] if table == "runs" else row

    def _as_they_are(self, runs: "list[Row]") -> "list[Row]":
        begun = {row["run_id"] for row in runs if row["status"] == "running"}
        over = begun - self._going_on(begun)
        return [{**row, "status": "interrupted"} if row["run_id"] in over else row for row in runs]

    def _going_on(self, run_ids: set[str]) -> set[str]:
        """Those of some runs on which a process works."""
        if self.mirror is None:
            return {run_id for run_id in run_ids if is_held(self._run_lock(run_id))}
        leases = self._run_leases
        held = leases.held() if run_ids else []
        return {one.name.partition(".")[0] for one in held if not leases.has_expired(one)}

    @cached_property
    def _run_leases(self) -> Leases:
        return Leases(self.objects("running"))

    def _run_lock(self, run_id: str) -> Path:
        return self.root / "locks" / f"run-{run_id}.lock"

    def run(self, name: str) -> "Row":
        """The row of a run.

        Args:
            name: id of the run, a unique prefix of one, a scene (its newest complete run), or
                `latest` (the newest complete run of all).

        Raises:
            UnknownRecordError: there is no such run.
        """
        if name != LATEST and "/" not in name:
            return self.row("runs", name)
        scene = None if name == LATEST else "/".join(split_scene_id(name))
        complete = [
            row
            for row in self.tables.rows("runs")
            if row["status"] == "complete" and scene in (None, row["scene_id"])
        ]
        if not complete:
            raise UnknownRecordError(
                f"no complete run {f'of {scene} ' if scene else ''}in {self.name}"
            )
        return max(complete, key=lambda row: row["finished_at"])


def open_store(path: Path | str | None = None) -> Store:
    """The store at a folder or an address, else at `LIDARPAINTER_STORE`, else here.

    `s3://BUCKET/PREFIX` is a bucket, also as a `Path`, which makes one slash of the two. Nothing is
    made before something is written.

    Raises:
        CatalogError: no folder can be there, its path cannot hold tables, or the address is none.
    """
    text = str(path or os.environ.get(STORE_ENVIRONMENT) or DEFAULT_STORE)
    if text.startswith("s3:/"):
        mirror = _mirror(text, os.environ.get(CACHE_ENVIRONMENT))
        return Store(mirror.root, mirror)
    root = expanded(text)
    if found := _UNSTORABLE.search(str(root)):
        told = f"Delta tables cannot have {found[0]!r} in a path, choose a folder without it"
        raise CatalogError(f"{str(root)!r}, the store: {told}")
    try:
        if root.is_dir() or not root.exists():
            return Store(root)
    except OSError as error:  # a name of more than 255 bytes
        raise CatalogError(f"the store {root} cannot be there: {error.strerror}") from None
    raise CatalogError(f"the store {root} is a file, expected a folder")


@lru_cache(maxsize=8)  # its connections are kept
def _mirror(address: str, _cache: str | None) -> "Mirror":
    from catalog.buckets import Bucket  # HTTP: who has a folder does without
    from catalog.mirrors import Mirror

    return Mirror(Bucket(address))


def existing_store() -> Store:
    """The store of `open_store`, for whoever only asks what it holds.

    Raises:
        CatalogError: there is none, or something that is not a folder is in the way.
        StorageError: there is no such bucket.
    """
    store = open_store()
    mirror = store.mirror
    holds = (lambda name: (store.root / name).is_dir()) if mirror is None else mirror.bucket.holds
    if not any(map(holds, ("tables", "scenes"))):
        raise CatalogError(f"no store at {store.name}: `ingest` or `demo` makes one, see --store")
    return store


def digest_in(scene_folder: Path) -> str | None:
    """The content digest in a scene's manifest; None where it cannot be read."""
    try:
        manifest = json.loads((scene_folder / MANIFEST_NAME).read_text("utf-8"))
        return str(manifest["content_digest"])
    except (OSError, ValueError, KeyError, TypeError):
        return None


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


def scene_entry(scene_id: str) -> str:
    """The folder of a scene, from that of the store; raises what `split_scene_id` does."""
    return "/".join(["scenes", *split_scene_id(scene_id)])
