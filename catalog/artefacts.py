"""Content-addressed artefacts: what a stage made, stored under what it was made from.

`<store>/artefacts/<kind>/<digest>/` holds the files of one artefact and a `manifest.json`. The
digest covers the kind, the digests of the inputs, the configuration and the code that runs (see
`code_closure`), so equal recipes meet and a changed one never finds an old result. A folder is
written aside and renamed whole, with the manifest in it: what has a name is complete.
`<store>/work/<digest>/` is scratch that survives a killed process (checkpoints) and goes when the
artefact is there.
"""

import json
import os
import platform
import shutil
import time
import uuid
from collections.abc import Callable, Collection, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from catalog.code_closure import Code
from catalog.digests import canonical_json, digest_file, digest_text, file_facts, plain
from catalog.errors import CatalogError, DamagedArtefactError, UnknownRecordError, storage_errors
from catalog.locks import held_lock

MANIFEST_NAME = "manifest.json"
MANIFEST_VERSION = 2
"""See `schemas` for what becomes of older ones."""
PACKAGES = ("numpy", "torch", "numba")
"""Whose versions stand in a manifest."""


@dataclass(frozen=True, slots=True, order=True)
class ArtefactRef:
    """A name for a stored artefact, wherever the store lies: the store knows its folder."""

    kind: str
    digest: str

    @classmethod
    def of_id(cls, artefact_id: str) -> "ArtefactRef":
        """The artefact with an id of the catalog.

        Raises:
            UnknownRecordError: that is no such id.
        """
        kind, _, digest = artefact_id.partition("/")
        if not kind or not digest:
            raise UnknownRecordError(f"{artefact_id!r} is no artefact, expected kind/digest")
        return cls(kind, digest)

    @property
    def artefact_id(self) -> str:
        """`kind/digest`, its id in the catalog."""
        return f"{self.kind}/{self.digest}"

    @property
    def entry(self) -> str:
        """Folder of the artefact, from that of the store."""
        return f"artefacts/{self.artefact_id}"


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """What an artefact is made from; equal recipes make equal artefacts."""

    kind: str
    inputs: Mapping[str, str]
    """Digest of every input, by the part it plays."""
    config: Any
    """Any value with a canonical JSON form (see `digests.canonical_json`)."""
    code: Code
    """What runs."""
    software_version: str = ""
    """For the record only: not part of the digest, the code is."""

    @property
    def digest(self) -> str:
        """The name of what this recipe makes."""
        parts = [self.kind, dict(self.inputs), plain(self.config), self.code.digest]
        return digest_text(canonical_json(parts))


@dataclass(frozen=True, kw_only=True)
class Workplace:
    """Where a stage writes while it runs."""

    output: Path
    """Becomes the artefact when the stage returns."""
    scratch: Path
    """Kept when the process dies, found again by the next one; gone once the stage is done."""


@dataclass(frozen=True, kw_only=True)
class Manifest:
    """What is known about a stored artefact."""

    kind: str
    digest: str
    inputs: dict[str, str]
    config: Any
    source_digest: str
    """Digest of the code that ran."""
    software_version: str
    created_at: str
    """ISO 8601, UTC."""
    seconds: float
    """Wall time of the process that finished it; a resumed stage counts its last part only."""
    files: dict[str, dict[str, Any]]
    """Per file name: `num_bytes` and `sha256`."""
    summary: dict[str, Any] = field(default_factory=dict)
    """What the stage wants to have said about its result, such as the number of Gaussians."""
    starts: list[str] = field(default_factory=list)
    """Where the code that ran starts, `module:name`."""
    code: dict[str, str] = field(default_factory=dict)
    """Digest of what it reaches in each module."""
    versions: dict[str, str] = field(default_factory=dict)
    """Python and the packages that compute; a record, not part of the digest."""
    host: str = ""
    """Machine it was made on."""
    manifest_version: int = MANIFEST_VERSION

    def __post_init__(self) -> None:
        """Refuse what a stranger's JSON may hold in place of objects.

        Raises:
            TypeError: the inputs, the files or what is known of a file are no objects.
        """
        parts = [self.inputs, self.files, self.summary, self.code]
        parts += self.files.values() if isinstance(self.files, dict) else []
        if not all(isinstance(one, dict) for one in parts):
            raise TypeError("an object is something else")

    @property
    def num_bytes(self) -> int:
        """Size of all files together."""
        return sum(file["num_bytes"] for file in self.files.values())


Build = Callable[[Workplace], Mapping[str, Any] | None]
"""Writes the files of an artefact below `output`; returns its summary."""


class ArtefactStore:
    """The artefacts below one folder; for a bucket see `mirrored_artefacts`."""

    def __init__(self, root: Path) -> None:
        self.root = root

    def folder(self, ref: ArtefactRef) -> Path:
        """Where the files of an artefact lie on this machine, whether they are there or not."""
        return self.root / ref.entry

    def files(self, ref: ArtefactRef, names: Collection[str] | None = None) -> Path:  # noqa: ARG002
        """Folder of an artefact with its files, all or the named ones; mirrors fetch them."""
        return self.folder(ref)

    def ids(self) -> set[str]:
        """The id of every artefact that has a name."""
        folders = self.root.glob("artefacts/*/[!.]*")
        return {f"{path.parent.name}/{path.name}" for path in folders}

    def find(self, recipe: Recipe) -> ArtefactRef | None:
        """What was made from this recipe before, or None; damaged folders count as absent."""
        ref = ArtefactRef(recipe.kind, recipe.digest)
        return ref if self.is_complete(ref) else None

    def is_complete(self, ref: ArtefactRef) -> bool:
        """Whether all its files are there at their sizes; their bytes are not read."""
        try:
            return _sizes_agree(self.folder(ref), self.manifest(ref))
        except (UnknownRecordError, DamagedArtefactError):
            return False

    def produce(
        self, recipe: Recipe, build: Build, *, on_wait: Callable[[str], None] | None = None
    ) -> tuple[ArtefactRef, bool]:
        """The artefact of a recipe, made now if nobody made it before.

        Of several processes that ask at once, one computes and the others wait for it; where it
        dies, the next one takes over, with the scratch folder as it was left. `on_wait` is told the
        id of a process that must be waited for.

        Returns:
            The artefact, and whether this call computed it.

        Raises:
            StorageError: the disk is full or may not be written; nothing half-written stays.
        """
        if found := self.find(recipe):
            return found, False
        with held_lock(self.root / "locks" / f"{recipe.digest}.lock", on_wait=on_wait):
            if found := self.find(recipe):
                return found, False
            counts = self._build(recipe, build)
        return ArtefactRef(recipe.kind, recipe.digest), counts

    def manifest(self, ref: ArtefactRef) -> Manifest:
        """The manifest of a stored artefact.

        Raises:
            UnknownRecordError: there is no such artefact.
            DamagedArtefactError: its manifest cannot be read.
        """
        path = self.folder(ref) / MANIFEST_NAME
        try:
            content = json.loads(path.read_text("utf-8"))
            if content["manifest_version"] > MANIFEST_VERSION:
                raise CatalogError(f"{path} was written by a newer lidarpainter: update this one")
            return Manifest(**content)
        except (FileNotFoundError, NotADirectoryError):
            raise UnknownRecordError(f"no {ref.kind} artefact at {path.parent}") from None
        except (ValueError, TypeError, KeyError) as error:
            raise DamagedArtefactError(f"unreadable manifest {path}: {error}") from None

    def verified(self, ref: ArtefactRef) -> Manifest:
        """The manifest, after every byte of the artefact was checked against it.

        Raises:
            UnknownRecordError: there is no such artefact.
            DamagedArtefactError: a file is missing or is not what was written.
        """
        manifest, folder = self.manifest(ref), self.files(ref)
        for name, known in manifest.files.items():
            path = folder / name
            if not path.is_file():
                raise DamagedArtefactError(f"{path} is missing; delete {folder} and run again")
            if digest_file(path) != known["sha256"]:
                raise DamagedArtefactError(
                    f"{path} is not what was written; delete {folder} and run again"
                )
        return manifest

    def adopt(self, ref: ArtefactRef, folder: Path) -> None:
        """Take in a folder on the disk of `root`, a checked artefact; one that is there stays.

        Raises:
            StorageError: the store cannot be written.
        """
        with held_lock(self.root / "locks" / f"{ref.digest}.lock"):
            if not self.is_complete(ref):
                self._place(ref, folder)

    def _place(self, ref: ArtefactRef, folder: Path) -> None:
        """Give a folder its name; the caller holds the lock."""
        _put_in_place(folder, self.folder(ref))

    def _build(self, recipe: Recipe, build: Build) -> bool:
        """Write aside, then rename; the caller holds the lock. Whether it is what counts."""
        ref = ArtefactRef(recipe.kind, recipe.digest)
        aside = self.root / "aside"
        scratch = self.root / "work" / recipe.digest
        with storage_errors(f"cannot store {ref.artefact_id} below {self.root}"):
            for leftover in aside.glob(f"{recipe.digest}-*"):  # of a killed process
                shutil.rmtree(leftover)
            output = aside / f"{recipe.digest}-{uuid.uuid4().hex[:8]}"
            output.mkdir(parents=True)
            scratch.mkdir(parents=True, exist_ok=True)
            started = time.perf_counter()
            try:
                summary = build(Workplace(output=output, scratch=scratch))
                _write_manifest(output, recipe, summary or {}, time.perf_counter() - started)
                _put_in_place(output, self.folder(ref))
            finally:
                shutil.rmtree(output, ignore_errors=True)
        shutil.rmtree(scratch, ignore_errors=True)
        return True


def _write_manifest(
    output: Path, recipe: Recipe, summary: Mapping[str, Any], seconds: float
) -> None:
    files = {
        path.relative_to(output).as_posix(): file_facts(path)
        for path in sorted(output.rglob("*"))
        if path.is_file()
    }
    content = {
        "manifest_version": MANIFEST_VERSION,
        "kind": recipe.kind,
        "digest": recipe.digest,
        "inputs": dict(recipe.inputs),
        "config": plain(recipe.config),
        "source_digest": recipe.code.digest,
        "starts": recipe.code.starts,
        "code": dict(recipe.code.modules),
        "versions": _versions(),
        "host": platform.node(),
        "software_version": recipe.software_version,
        "created_at": datetime.now(UTC).isoformat(timespec="milliseconds"),
        "seconds": round(seconds, 3),
        "files": files,
        "summary": plain(summary),
    }
    text = json.dumps(content, indent=1, sort_keys=True, allow_nan=False)
    (output / MANIFEST_NAME).write_text(text + "\n", "utf-8")


def _versions() -> dict[str, str]:
    """The versions of Python and of the packages that are installed."""
    found = {"python": platform.python_version()}
    for name in PACKAGES:
        with suppress(PackageNotFoundError):
            found[name] = version(name)
    return found


def _put_in_place(output: Path, folder: Path) -> None:
    """Rename the finished folder to its name, over a damaged one if there is one."""
    for path in sorted(output.rglob("*")):
        _flush(path)  # names must not reach the disk before the bytes do
    folder.parent.mkdir(parents=True, exist_ok=True)
    if folder.exists():
        shutil.rmtree(folder)
    output.rename(folder)
    _flush(folder.parent)


def _flush(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _sizes_agree(folder: Path, manifest: Manifest) -> bool:
    """Whether every file is there at its size: cheap, finds cut files, not flipped bits."""
    for name, known in manifest.files.items():
        path = folder / name
        if not path.is_file() or path.stat().st_size != known["num_bytes"]:
            return False
    return True
