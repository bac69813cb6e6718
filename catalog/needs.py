"""Who needs whom in a store: the one notion that deleting, collecting and exporting share.

A run needs its scene, the artefacts that it lists, and the run that it was changed from. An
artefact needs what it was made from. A sequence of a fleet needs its scene, its run and the styles
of that which it asks for, a painter the artefact with its weights. An asset needs run and files of
a sighting, the best, in each scene that shows it: its id follows from all of them; and what was
fused from those. What was fused from others, before one was published anew, nobody needs.
"""

from collections import defaultdict
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from datetime import datetime
from functools import cached_property

from catalog.artefacts import ArtefactRef
from catalog.assets import FUSED_KIND, how_well
from catalog.records import json_of
from catalog.store import Store
from catalog.tables import Row

SCENE_KIND, STYLE = "gaussians", "style"
"""The kind of an artefact that is a fitted scene, and the kind of a change that is a style."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Kept:
    """What somebody needs, by id."""

    runs: set[str]
    artefacts: set[str]
    scenes: set[str]


class Needs:
    """Who needs whom, as the tables are now."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self.runs = store.rows("runs")
        self._painters = store.rows("painters")
        self.artefacts = store.rows("artefacts")
        self._inputs: Mapping[str, set[str]] = {
            row["artefact_id"]: set(json_of(row, "inputs").values()) for row in self.artefacts
        }

    @cached_property
    def scenes(self) -> list[Row]:
        """Rows of the scenes."""
        return self._store.rows("scenes")

    @cached_property
    def wanted(self) -> list[Row]:
        """Rows of the sequences that a fleet asks for."""
        return self._store.rows("sequences")

    @cached_property
    def _sightings(self) -> Collection[Row]:
        """The best sighting of everything that was seen in a scene, and what was fused."""
        columns = ["sighting_id", "occurrence_id", "score", "seen_share", "fused_from"]
        columns += ["run_id", "artefact_id"]
        rows = self._store.tables.arrow("sightings", columns=columns).to_pylist()
        return {
            (row["occurrence_id"], row["fused_from"] is None): row
            for row in sorted(rows, key=how_well)
        }.values()

    @cached_property
    def _users(self) -> Mapping[str, set[str]]:
        """The artefacts that have a digest among their inputs, by the digest."""
        found: dict[str, set[str]] = defaultdict(set)
        for name, inputs in self._inputs.items():
            for digest in inputs:
                found[digest].add(name)
        return dict(found)

    def listed(self, runs: Iterable[str]) -> set[str]:
        """The artefacts that some runs list."""
        names = set(runs)
        lists = (row["artefacts"] or () for row in self.runs if row["run_id"] in names)
        return {name for artefacts in lists for name in artefacts}

    def runs_with(self, artefacts: set[str]) -> set[str]:
        """The runs that list one of them."""
        return {row["run_id"] for row in self.runs if artefacts & set(row["artefacts"] or ())}

    def painters_in(self, artefacts: set[str]) -> set[str]:
        """The painters whose weights lie in one of them."""
        folders = tuple(f"artefacts/{name}/" for name in artefacts)
        return {row["painter_id"] for row in self._painters if row["path"].startswith(folders)}

    def made_of(self, digest: str) -> set[str]:
        """The artefacts with this digest among their inputs, however far back."""
        first = self._users.get(digest, set())
        return first | self.made_from(first)

    def made_from(self, artefacts: set[str]) -> set[str]:
        """The artefacts that were made from these, and from those in turn; without these."""
        found: set[str] = set()
        new = artefacts
        while new:
            digests = (ArtefactRef.of_id(name).digest for name in new)
            new = {user for digest in digests for user in self._users.get(digest, ())}
            new -= found | artefacts
            found |= new
        return found

    def with_inputs(self, artefacts: set[str]) -> set[str]:
        """These, and what they were made from, however far back."""
        by_digest = {name.partition("/")[2]: name for name in self._inputs}
        found, new = set(artefacts), set(artefacts)
        while new:
            digests = {digest for name in new for digest in self._inputs.get(name, ())}
            new = {by_digest[digest] for digest in digests & by_digest.keys()} - found
            found |= new
        return found

    def with_sources(self, runs: Iterable[str]) -> set[str]:
        """These runs, and those that they were changed from, however far back."""
        source = {row["run_id"]: row["derived_from"] for row in self.runs}
        found: set[str] = set()
        for run_id in runs:
            name = run_id
            while name in source and name not in found:
                found.add(name)
                name = source[name] or ""
        return found

    def kept_since(self, since: datetime) -> Kept:
        """What is needed of all that is older than a time, and all that is not.

        Needed are runs that run or ended since then, of wanted sequences and of sightings, with all
        that they need; trained painters; and what is made of a scene that somebody works on now,
        who may take it up any moment. What was made from needed artefacts stays with them, unless
        a run lists it that nobody needs.
        """
        runs = self.with_sources(self._needed_runs(since))
        busy = {row["scene_id"] for row in self.runs if row["status"] == "running"}
        busy |= {row["scene_id"] for row in self.wanted if row["state"] == "waiting"}
        needed = self.listed(runs) | self._needed_by_others(since)
        for row in self.scenes:
            if row["scene_id"] in busy:
                needed |= self.made_of(row["content_digest"])
        kept = self.with_inputs(needed)
        foreign = self.listed(row["run_id"] for row in self.runs if row["run_id"] not in runs)
        foreign -= kept
        made = self.made_from(kept) - foreign - self.made_from(foreign)
        replaced = {name for name in made if ArtefactRef.of_id(name).kind == FUSED_KIND}
        kept |= made - replaced - self.made_from(replaced)
        scenes = {row["scene_id"] for row in self.runs if row["run_id"] in runs} | busy
        scenes |= {row["scene_id"] for row in self.wanted}
        contents = {digest for name in kept for digest in self._inputs.get(name, ())}
        scenes |= {row["scene_id"] for row in self.scenes if row["content_digest"] in contents}
        return Kept(runs=runs, artefacts=kept, scenes=scenes)

    def _needed_runs(self, since: datetime) -> set[str]:
        found = {
            row["run_id"]
            for row in self.runs
            if row["status"] == "running"
            or any(at and at >= since for at in (row["started_at"], row["finished_at"]))
        }
        found |= {row["run_id"] for row in (*self.wanted, *self._sightings) if row["run_id"]}
        return found | self._wanted_styles()

    def _wanted_styles(self) -> set[str]:
        """The runs in styles that sequences ask for, of what their own runs have made."""
        made = {row["run_id"]: row["artefacts"] or () for row in self.runs}
        wanted = {
            (name.partition("/")[2], variant)
            for row in self.wanted
            for variant in row["variants"] or ()
            for name in made.get(row["run_id"], ())
            if ArtefactRef.of_id(name).kind == SCENE_KIND
        }
        if not wanted:
            return set()
        found = set()
        for row in self.runs:
            change = json_of(row, "change") if row["change"] else {}
            if change.get("kind") == STYLE:
                # whole styles are asked for, by their names
                style = change["parameters"]["prompt"].removesuffix(":1")
                given = {one for name in made[row["run_id"]] for one in self._inputs.get(name, ())}
                if any((digest, style) in wanted for digest in given):
                    found.add(row["run_id"])
        return found

    def _needed_by_others(self, since: datetime) -> set[str]:
        """Artefacts that are young, hold a painter, or files of a sighting."""
        weights = [row["path"].split("/") for row in self._painters]
        found = {"/".join(parts[1:3]) for parts in weights if parts[0] == "artefacts"}
        found |= {row["artefact_id"] for row in self._sightings if row["artefact_id"]}
        young = {
            row["artefact_id"]
            for row in self.artefacts
            if row["created_at"] is None or row["created_at"] >= since
        }
        return (found | young) & self._inputs.keys()
