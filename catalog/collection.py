"""Find what nobody needs any more, and what killed processes left behind.

What is needed is said in `needs`. Young things stay: a stage may just have made them. What a
process holds a lock on is not touched, and `leases/` and `locks/` are left alone: whoever deletes
a lock file lets two processes hold locks of one name, and a bucket deletes without a condition,
maybe what was taken up this moment.

In a bucket other machines hold no locks that could be seen here. What is published there got its
listing last, so files that no listing names are of somebody who publishes now, or was killed. A
lease in `running/` or `flow-runs/` has a name that is used once, so one without a heartbeat for
long is nobody's, given back or not.
"""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING

from catalog.artefacts import ArtefactRef
from catalog.deletion import Doomed, doomed_rows
from catalog.errors import DamagedArtefactError
from catalog.folders import changed_at
from catalog.locks import is_held
from catalog.needs import Needs
from catalog.store import Store, scene_entry

if TYPE_CHECKING:
    from obstore import ObjectMeta

    from catalog.mirrors import Mirror

LEFTOVERS = "leftovers"
"""In place of a table: files that no row stands for."""
SETTLED_AFTER = timedelta(hours=1)
"""Older folders that nobody has locked belong to nobody."""
ABANDONED_AFTER = timedelta(days=1)
"""Age of what nobody owns in a bucket: no upload and no heartbeat takes so long."""
OWN_NAMES = ("running", "flow-runs")
"""Folders of leases whose names are used once."""
ENTRY_PARTS = 3
"""Parts of the name of an entry; the place of a publication follows them."""


def plan_collection(store: Store, since: datetime) -> list[Doomed]:
    """All that may go, rows with their files and leftovers alike.

    What ran or was made after `since` stays, with all that it needs.
    """
    needs = Needs(store)
    kept = needs.kept_since(since)
    runs = {row["run_id"] for row in needs.runs} - kept.runs
    known = {row["artefact_id"] for row in needs.artefacts}
    free = {name for name in known - kept.artefacts if not _is_locked(store, name)}
    scenes = {row["scene_id"] for row in needs.scenes} - kept.scenes
    changed = store.changed("scenes")
    young = {entry for entry, at in changed.items() if at >= since}
    return [
        *doomed_rows(store, "runs", runs),
        *doomed_rows(store, "artefacts", free),
        *doomed_rows(store, "scenes", (one for one in scenes if scene_entry(one) not in young)),
        *_leftovers(store, known | kept.artefacts, since),
        *([] if store.mirror is None else _abandoned(store.mirror, since)),
    ]


def _leftovers(store: Store, known: set[str], since: datetime) -> Iterator[Doomed]:
    """Unknown artefacts, scratch of nobody, folders that were being written or removed."""
    settled = datetime.now(UTC) - SETTLED_AFTER
    made = store.changed("artefacts")
    unknown = made.keys() - {ArtefactRef.of_id(name).entry for name in known}
    for entry in sorted(unknown):
        if made[entry] < since and not _is_locked(store, entry):
            yield _leftover(store, store.root / entry)
    digests = {entry.rpartition("/")[2] for entry in made}
    for folder in store.root.glob("work/*"):
        is_old = folder.name in digests or changed_at(folder) < since
        if is_old and not _is_locked(store, folder.name):
            yield _leftover(store, folder)
    for folder in (*store.root.glob("aside/*/"), *store.root.glob("scenes/*/.*")):
        owner = folder.name.partition("-")[0]
        if (
            changed_at(folder) < settled
            and not _is_locked(store, owner)
            # of a scene, see the library's `storage.whole_folders`
            and not is_held(folder / ".writing")
        ):
            yield _leftover(store, folder)


def _abandoned(mirror: "Mirror", since: datetime) -> Iterator[Doomed]:
    """Files of publications that were never finished, and leases of nobody."""
    settled = min(since, datetime.now(UTC) - ABANDONED_AFTER)
    places: dict[str, dict[str, list[ObjectMeta]]] = defaultdict(lambda: defaultdict(list))
    for one in (*mirror.bucket.objects("artefacts"), *mirror.bucket.objects("scenes")):
        parts = one["path"].split("/")
        places["/".join(parts[:ENTRY_PARTS])][parts[ENTRY_PARTS]].append(one)
    listed = {*mirror.entries("artefacts"), *mirror.entries("scenes")}
    for entry, found in places.items():
        if entry in listed and len(found) == 1:  # the listed one: no need to ask
            continue
        with suppress(DamagedArtefactError):  # `verify` names it
            listing = mirror.listing(entry)
            for place, files in found.items():
                is_old = max(one["last_modified"] for one in files) < settled
                if is_old and (listing is None or place != listing.place):
                    yield _objects(f"{entry}/{place}", files)
    for folder in OWN_NAMES:
        old = [one for one in mirror.bucket.objects(folder) if one["last_modified"] < settled]
        if old:
            yield _objects(folder, old)


def _objects(name: str, found: "Sequence[ObjectMeta]") -> Doomed:
    names = tuple(one["path"] for one in found)
    num_bytes = sum(one["size"] for one in found)
    return Doomed(table=LEFTOVERS, row_id=name, folder=None, num_bytes=num_bytes, objects=names)


def _leftover(store: Store, folder: Path) -> Doomed:
    name = str(folder.relative_to(store.root))
    return Doomed(table=LEFTOVERS, row_id=name, folder=folder, num_bytes=store.entry_bytes(folder))


def _is_locked(store: Store, name: str) -> bool:
    """Whether somebody makes the artefact of an id or a digest just now."""
    return is_held(store.root / "locks" / f"{name.rpartition('/')[2]}.lock")
