"""A folder of this machine in front of a bucket: what is made is published, what is read fetched.

The folder is laid out as a store is. An entry is an artefact or a scene, named by its folder, such
as `artefacts/fit/DIGEST`. In the bucket its files lie at `ENTRY/PLACE/FILE`, PLACE being a new word
each time, and `published/ENTRY.json` lists them with size and SHA-256. That listing is written
last, on the condition that nobody has written it meanwhile: an entry is there whole or not at all,
and of two that publish one entry at once neither touches a file of the other. The second takes its
own files away and goes on with those of the first. So writers need no lock across machines.

What is read is fetched file by file, checked against the listing as it arrives, and kept. Where
more is kept than `LIDARPAINTER_CACHE_GB`, entries go that were not used for longest. One that a
process has in use never does: it holds a lock of the kernel until it says `release`, or ends.
"""

import fcntl
import json
import os
import secrets
import shutil
from collections.abc import Collection, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path, PurePosixPath
from typing import Any

from catalog.buckets import SCHEME, Bucket
from catalog.digests import file_facts
from catalog.errors import CatalogError, DamagedArtefactError, UnknownRecordError, storage_errors
from catalog.folders import cache_folder, changed_at
from catalog.locks import held_lock, open_lock

LIMIT_ENVIRONMENT = "LIDARPAINTER_CACHE_GB"
DEFAULT_LIMIT_GB = 20.0
AT_ONCE = 8
"""Files that go up or come down at the same time."""
LISTINGS = "published"

_NOWHERE = Path(os.devnull)
_IN_USE: dict[Path, int] = {}
"""Lock files of this process and their descriptors."""


@dataclass(frozen=True, slots=True)
class Listing:
    """What is published of an entry."""

    place: str
    files: dict[str, dict[str, Any]]
    """Per file name: `num_bytes` and `sha256`."""

    @property
    def sizes(self) -> dict[str, int]:
        """Bytes of each file."""
        return {name: known["num_bytes"] for name, known in self.files.items()}


class Mirror:
    """The folder of this machine in front of one bucket."""

    def __init__(self, bucket: Bucket) -> None:
        self.bucket = bucket
        self.root = cache_folder() / "s3" / bucket.address.removeprefix(SCHEME)

    def listing(self, entry: str) -> Listing | None:
        """What is published of an entry now; None where nothing is.

        Raises:
            DamagedArtefactError: the listing is none.
        """
        found = self.bucket.read(_listing_name(entry))
        return None if found is None else _parsed(self.bucket.where(entry), found[0])

    def version(self, entry: str) -> str | None:
        """Version of the listing of an entry, be it damaged, for whoever replaces it."""
        found = self.bucket.read(_listing_name(entry))
        return None if found is None else found[1]

    def is_whole(self, entry: str, listing: Listing) -> bool:
        """Whether the bucket has every file at its size."""
        place = f"{entry}/{listing.place}"
        there = self.bucket.sizes(place)
        return all(there.get(f"{place}/{name}") == size for name, size in listing.sizes.items())

    def verify(self, entry: str) -> Listing:
        """What is published of an entry, after every byte of it was read from the bucket.

        Raises:
            UnknownRecordError: nothing is published under this name.
            DamagedArtefactError: a file is not there or is not what was published.
        """
        listing = self._published(entry)
        with ThreadPoolExecutor(AT_ONCE) as pool:
            read = self._download
            list(pool.map(lambda name: read(entry, name, listing, _NOWHERE), listing.files))
        return listing

    def entries(self, kind: str) -> dict[str, datetime]:
        """Names of all that is published below a folder, and when it was."""
        return {
            one["path"].removeprefix(f"{LISTINGS}/").removesuffix(".json"): one["last_modified"]
            for one in self.bucket.objects(f"{LISTINGS}/{kind}")
        }

    def fetch(self, entry: str, names: Collection[str] | None = None) -> Path:
        """Folder with the files of an entry, all or the named ones, in use from now on.

        Raises:
            UnknownRecordError: nothing is published under this name.
            DamagedArtefactError: a file is not there or is not what was published.
        """
        files = self.opened(entry)
        files(files.listing.files if names is None else names)
        return self.root / entry

    def opened(self, entry: str) -> "EntryFiles":
        """The files of an entry as it is published now, in use from now on; none is fetched yet.

        Raises:
            UnknownRecordError: nothing is published under this name.
        """
        listing = self._published(entry)
        with self._used(entry):
            self._agree(entry, listing)
        return EntryFiles(entry, listing.place, self, listing)

    def bring(self, entry: str, listing: Listing, names: Collection[str]) -> None:
        """Fetch those files of an entry that are not here; raises what `fetch` does."""

        def missing() -> list[str]:
            known = (name for name in names if name in listing.files)
            return [name for name in known if not self._has(entry, name, listing)]

        if not missing():
            return
        with self._used(entry), ThreadPoolExecutor(AT_ONCE) as pool:
            list(pool.map(lambda name: self._fetch(entry, name, listing), missing()))
        self.tidy()

    def publish(self, entry: str, *, replacing: str | None) -> bool:
        """Publish the folder of an entry; False, with nothing changed, if another came first.

        `replacing` is the version of the listing that it takes the place of, or None.
        """
        folder, place = self.root / entry, secrets.token_hex(8)
        files = {
            path.relative_to(folder).as_posix(): path
            for path in sorted(folder.rglob("*"))
            if path.is_file()
        }
        with ThreadPoolExecutor(AT_ONCE) as pool:
            send = self.bucket.upload
            list(pool.map(lambda one: send(f"{entry}/{place}/{one[0]}", one[1]), files.items()))
        known = {name: file_facts(path) for name, path in files.items()}
        content = json.dumps({"place": place, "files": known}, indent=1).encode()
        if self.bucket.write(_listing_name(entry), content, replacing=replacing) is None:
            self.bucket.remove(f"{entry}/{place}/{name}" for name in files)
            self.forget(entry)
            return False
        with self._used(entry):
            self._note(entry, place)
        if replacing is not None:
            others = self.bucket.sizes(entry)
            self.bucket.remove(one for one in others if not one.startswith(f"{entry}/{place}/"))
        self.tidy()
        return True

    def remove(self, entry: str) -> None:
        """Take an entry out of the bucket and out of this folder: the listing first."""
        self.bucket.remove([_listing_name(entry)])
        self.bucket.remove(self.bucket.sizes(entry))
        self.forget(entry)

    def forget(self, entry: str) -> None:
        """Take an entry out of this folder alone."""
        self._note_path(entry).unlink(missing_ok=True)
        with suppress(FileNotFoundError), storage_errors(f"cannot delete {self.root / entry}"):
            shutil.rmtree(self.root / entry)

    def tidy(self) -> None:
        """Let go what was not used for longest, until no more is kept than is allowed."""
        # a note is touched when its entry is used; another process may have let go of it
        notes = sorted(self.root.glob(f"{LISTINGS}/**/*.json"), key=changed_at)
        sizes = {note: self._kept_bytes(self._entry_of(note)) for note in notes}
        excess = sum(sizes.values()) - _limit_bytes()
        for note, num_bytes in sizes.items():
            if excess <= 0:
                return
            with self._alone(self._entry_of(note)) as is_free:
                if is_free:
                    self.forget(self._entry_of(note))
                    excess -= num_bytes

    def release(self) -> None:
        """Nothing of this folder is in use by this process any more."""
        for path in [path for path in _IN_USE if path.is_relative_to(self.root)]:
            os.close(_IN_USE.pop(path))

    def _published(self, entry: str) -> Listing:
        listing = self.listing(entry)
        if listing is None:
            raise UnknownRecordError(f"nothing is published as {self.bucket.where(entry)}")
        return listing

    def _agree(self, entry: str, listing: Listing) -> None:
        """Let go what is kept of something else that was published under this name."""
        with suppress(OSError, ValueError, KeyError):
            if json.loads(self._note_path(entry).read_text("utf-8"))["place"] == listing.place:
                os.utime(self._note_path(entry))
                return
        self.forget(entry)
        self._note(entry, listing.place)

    def _note(self, entry: str, place: str) -> None:
        path = self._note_path(entry)
        with storage_errors(f"cannot write {path}"):
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(json.dumps({"place": place}), "utf-8")

    def _note_path(self, entry: str) -> Path:
        return self.root / _listing_name(entry)

    def _entry_of(self, note: Path) -> str:
        return note.relative_to(self.root / LISTINGS).as_posix().removesuffix(".json")

    def _kept_bytes(self, entry: str) -> int:
        with suppress(FileNotFoundError):  # another process lets go of it now
            files = (path for path in (self.root / entry).rglob("*") if path.is_file())
            return sum(path.stat().st_size for path in files)
        return 0

    def _has(self, entry: str, name: str, listing: Listing) -> bool:
        path = self.root / entry / name
        return path.is_file() and path.stat().st_size == listing.sizes[name]

    def _fetch(self, entry: str, name: str, listing: Listing) -> None:
        """Bring one file here, whole and checked, or not at all."""
        path = self.root / entry / name
        aside = self.root / "aside" / f"fetched-{secrets.token_hex(8)}"  # a folder: `gc` finds it
        with storage_errors(f"cannot write {path}"):
            path.parent.mkdir(parents=True, exist_ok=True)
            aside.mkdir(parents=True)
            try:
                self._download(entry, name, listing, aside / path.name)
                (aside / path.name).replace(path)
            finally:
                shutil.rmtree(aside, ignore_errors=True)

    def _download(self, entry: str, name: str, listing: Listing, path: Path) -> None:
        where = f"{entry}/{listing.place}/{name}"
        if self.bucket.download(where, path) != listing.files[name]["sha256"]:
            raise DamagedArtefactError(
                f"{self.bucket.where(where)} is missing or not what was published; "
                f"delete {self.bucket.where(entry)} and make it again"
            )

    @contextmanager
    def _used(self, entry: str) -> Iterator[None]:
        """Have an entry in use from now on, alone on this machine while the block runs."""
        path = self._lock_path(entry)
        if path not in _IN_USE:
            opened = open_lock(path)
            fcntl.flock(opened, fcntl.LOCK_SH)
            if _IN_USE.setdefault(path, opened) != opened:  # another thread was faster
                os.close(opened)
        with held_lock(path.with_suffix(".fetching")):
            yield

    @contextmanager
    def _alone(self, entry: str) -> Iterator[bool]:
        """Whether no process has an entry in use, and none can while the block runs."""
        with self._lock_path(entry).open("a+b") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                yield False
            else:
                yield True

    def _lock_path(self, entry: str) -> Path:
        return self.root / "locks" / f"use-{entry.replace('/', '-')}.lock"


@dataclass(frozen=True)
class EntryFiles:
    """Fetches files of an entry as it was published once; equal where that is the same."""

    entry: str
    place: str
    mirror: Mirror = field(compare=False)
    listing: Listing = field(compare=False)

    def __call__(self, names: Collection[str]) -> None:
        """See that these files are in the folder of the entry, those of them that it has.

        Raises:
            DamagedArtefactError: a file is not there or is not what was published.
        """
        self.mirror.bring(self.entry, self.listing, names)


def _listing_name(entry: str) -> str:
    return f"{LISTINGS}/{entry}.json"


def _limit_bytes() -> float:
    text = os.environ.get(LIMIT_ENVIRONMENT) or DEFAULT_LIMIT_GB
    try:
        return float(text) * 1e9
    except ValueError:
        raise CatalogError(f"{LIMIT_ENVIRONMENT} is {text!r}, expected gigabytes") from None


def _parsed(where: str, content: bytes) -> Listing:
    """A listing, whose names cannot lead anywhere else."""
    try:
        values = json.loads(content)
        files = {
            str(name): {"num_bytes": int(one["num_bytes"]), "sha256": str(one["sha256"])}
            for name, one in values["files"].items()
        }
        place = str(values["place"])
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise DamagedArtefactError(f"the listing of {where} is damaged: {error!r}") from None
    for name in [place, *files]:
        if not name or PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts:
            raise DamagedArtefactError(f"the listing of {where} names {name!r}, outside of it")
    return Listing(place, files)
