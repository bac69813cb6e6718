"""What stored things were made from, and whether today's code would make them again.

An artefact is explained by its manifest: its inputs back to the scene and the files that was read
from, its settings, its code, and where, when and by which versions it was made. It is stale when
the code that it starts at is not what it was, or when an input is stale or gone. The catalog knows
no tasks, so whoever asks hands in what the code is today.
"""

import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

from catalog.artefacts import MANIFEST_NAME, ArtefactRef, Manifest
from catalog.code_closure import Code
from catalog.digests import DIGEST_LENGTH
from catalog.errors import IdentityError, UnknownRecordError
from catalog.records import json_of
from catalog.store import Store
from catalog.tables import Row

CodeToday = Callable[[Iterable[str]], Code]
"""The code that is reached today from symbols, each `module:name`."""
FOLLOWS = "is stale"
"""In a reason that only follows from another one."""
SCENE = "scene"
"""The part that a scene plays among the inputs of an artefact."""


@dataclass(frozen=True, kw_only=True)
class Explanation:
    """One stored thing, and what it was made from."""

    name: str
    """kind/digest of an artefact, the id of a run or a scene, or the digest of something else."""
    facts: dict[str, Any] = field(default_factory=dict)
    """When, where, by what and with which settings it was made."""
    stale: tuple[str, ...] = ()
    """Why it would not be made again as it is; nothing where it is up to date."""
    newest: dict[str, Any] | None = None
    """The newest one made for the same purpose, and where that one differs."""
    inputs: dict[str, "Explanation"] = field(default_factory=dict)
    """What it was made from, by the part it plays; of a run, the artefacts."""

    @property
    def verdict(self) -> str:
        """One sentence: that it is up to date, or what of it is stale and why."""
        if not self.stale:
            return f"{self.name} is up to date: today's code would make it again as it is."
        # of a run the kinds of its artefacts
        parts = [part.partition("/")[0] for part, made in self.inputs.items() if made.stale]
        what = f" in {', '.join(dict.fromkeys(parts))}" if parts else ""
        return f"{self.name} is stale{what}: {'; '.join(dict.fromkeys(self._causes()))}."

    def _causes(self) -> Iterator[str]:
        """Why it and what it was made from are stale, but for what only follows from that."""
        yield from (reason for reason in self.stale if FOLLOWS not in reason)
        for made in self.inputs.values():
            yield from made._causes()

    def to_dict(self) -> dict[str, Any]:
        """All of it as JSON types."""
        return {
            "name": self.name,
            "is_stale": bool(self.stale),
            "stale": list(self.stale),
            **self.facts,
            "newest": self.newest,
            "inputs": {part: made.to_dict() for part, made in self.inputs.items()},
        }


class Explainer:
    """Explains what one store holds; reads its tables once."""

    def __init__(self, store: Store, today: CodeToday) -> None:
        self._store = store
        self._today = today
        self._known: dict[str, Explanation] = {}

    def run(self, row: Row) -> Explanation:
        """A run: its settings and everything it made or reused."""
        made = {name: self.artefact(ArtefactRef.of_id(name)) for name in row["artefacts"]}
        facts = ("scene_id", "status", "started_at", "seconds", "host", "software_version")
        others = [
            other
            for other in self._runs
            if other["scene_id"] == row["scene_id"]
            and other["status"] == "complete"
            and other["derived_from"] == row["derived_from"]
        ]
        newest = max(others, key=lambda other: other["finished_at"], default=row)
        settings = _changes(json_of(row, "parameters"), json_of(newest, "parameters"))
        return Explanation(
            name=row["run_id"],
            facts={
                **{name: row[name] for name in facts},
                "started_at": row["started_at"].isoformat(),
                "settings": json_of(row, "parameters"),
                "code": row["source_digest"],
                "derived_from": row["derived_from"],
                "change": json_of(row, "change") if row["change"] else None,
            },
            stale=tuple(f"{name} {FOLLOWS}" for name, one in made.items() if one.stale),
            newest=None
            if newest["run_id"] == row["run_id"]
            else {"name": newest["run_id"], "settings": settings},
            inputs=made,
        )

    def artefact(self, ref: ArtefactRef) -> Explanation:
        """An artefact and, one within the other, what it was made from.

        Raises:
            UnknownRecordError: there is no such artefact.
            DamagedArtefactError: its manifest cannot be read.
        """
        if ref.artefact_id not in self._known:
            manifest = self._store.artefacts.manifest(ref)
            inputs = {part: self._input(one) for part, one in manifest.inputs.items()}
            self._known[ref.artefact_id] = Explanation(
                name=ref.artefact_id,
                facts={
                    "created_at": manifest.created_at,
                    "seconds": manifest.seconds,
                    "host": manifest.host,
                    "software_version": manifest.software_version,
                    "versions": manifest.versions,
                    "settings": manifest.config,
                    "code": manifest.source_digest,
                    "starts": list(manifest.starts),
                },
                stale=(*self._stale_code(manifest), *_stale_inputs(inputs)),
                newest=self._newest(ref, manifest),
                inputs=inputs,
            )
        return self._known[ref.artefact_id]

    @cached_property
    def _artefacts(self) -> list[Row]:
        return self._store.tables.rows("artefacts")

    def _made_beside(self, artefact_id: str) -> set[str]:
        """The other artefacts of all runs that list one."""
        lists = [set(row["artefacts"] or ()) for row in self._runs]
        return set().union(*(made for made in lists if artefact_id in made)) - {artefact_id}

    @cached_property
    def _runs(self) -> list[Row]:
        return self._store.tables.rows("runs")

    @cached_property
    def _scenes(self) -> dict[str, str]:
        rows = self._store.tables.rows("scenes")
        return {row["content_digest"]: row["scene_id"] for row in rows}

    def _input(self, digest: str) -> Explanation:
        """Whatever has this digest: an artefact, a scene, or a file of somewhere else."""
        for row in self._artefacts:
            if row["digest"] == digest:
                try:
                    return self.artefact(ArtefactRef(row["kind"], digest))
                except UnknownRecordError:
                    return Explanation(name=row["artefact_id"], stale=("it is gone",))
        if scene_id := self._scenes.get(digest):
            file = self._store.scene_folder(scene_id) / MANIFEST_NAME
            provenance = {}
            with suppress(UnknownRecordError):
                if files := self._store.scene_files(scene_id):
                    files([MANIFEST_NAME])
            with suppress(OSError, ValueError, KeyError, TypeError):  # gone or damaged: not known
                provenance = json.loads(file.read_text("utf-8"))["provenance"]
            return Explanation(name=scene_id, facts={"content": digest, "read_from": provenance})
        return Explanation(name=digest)

    def _stale_code(self, manifest: Manifest) -> Iterator[str]:
        if not manifest.starts:
            yield "made before the code behind an artefact was recorded"
            return
        try:
            today = self._today(manifest.starts)
        except IdentityError as error:
            yield f"its code is gone: {error}"
            return
        if changed := changed_modules(manifest.code, today.modules):
            yield f"code changed: {', '.join(changed)}"

    def _newest(self, ref: ArtefactRef, manifest: Manifest) -> dict[str, Any] | None:
        """The newest artefact of the same kind and parts that shares an input with this one."""
        beside = self._made_beside(ref.artefact_id)
        rows = [
            row
            for row in self._artefacts
            if row["kind"] == ref.kind and row["artefact_id"] not in beside
        ]
        ours, alike = manifest.inputs, []
        for row in rows:
            theirs = json_of(row, "inputs")
            if ours.keys() == theirs.keys() and ours.items() & theirs.items():
                alike.append(row)
        newest = max(alike, key=lambda row: row["created_at"], default=None)
        if newest is None or newest["digest"] == ref.digest:
            return None
        other = self._store.artefacts.manifest(ArtefactRef(ref.kind, newest["digest"]))
        return {
            "name": newest["artefact_id"],
            "inputs": _changes(manifest.inputs, other.inputs),
            "settings": _changes(manifest.config, other.config),
            "code": changed_modules(manifest.code, other.code),
        }


def _stale_inputs(inputs: Mapping[str, Explanation]) -> Iterator[str]:
    for part, made in inputs.items():
        if made.stale:
            yield f"input changed: {part} ({made.name} {FOLLOWS})"
        elif part == SCENE and not made.facts:
            yield f"input changed: no scene has the content {made.name[:DIGEST_LENGTH]} any more"


def changed_modules(before: Mapping[str, str], after: Mapping[str, str]) -> list[str]:
    """The modules of which other code is reached than before, by their digests."""
    return sorted(name for name in {*before, *after} if before.get(name) != after.get(name))


def _changes(before: Any, after: Any, where: str = "") -> dict[str, Any]:  # noqa: ANN401 - JSON
    """Where two JSON values differ, as `a.b: [before, after]`; null stands for what is absent."""
    if isinstance(before, dict) and isinstance(after, dict):
        found: dict[str, Any] = {}
        for name in sorted({*before, *after}):
            path = f"{where}.{name}" if where else name
            found |= _changes(before.get(name), after.get(name), path)
        return found
    return {} if before == after else {where: [before, after]}
