"""Find what nobody needs any more, and what killed processes left behind.

What is needed is said in `needs`. Young things stay: a stage may just have made them. What a
process holds a lock on is not touched, and `leases/` and `locks/` are left alone: whoever deletes
a lock file lets two processes hold locks of one name.
"""

from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

from catalog.artefacts import ArtefactRef
from catalog.deletion import Doomed, doomed_rows
from catalog.locks import is_held
from catalog.needs import Needs
from catalog.store import Store

LEFTOVERS = "leftovers"
"""In place of a table: files that no row stands for."""
SETTLED_AFTER = timedelta(hours=1)
"""Older folders that nobody has locked belong to nobody."""


def plan_collection(store: Store, since: datetime) -> list[Doomed]:
    """All that may go, rows with their files and leftovers alike.

    Args:
        store: where to look.
        since: what ran or was made later stays, with all that it needs.
    """
    needs = Needs(store)
    kept = needs.kept_since(since)
    runs = {row["run_id"] for row in needs.runs} - kept.runs
    known = {row["artefact_id"] for row in needs.artefacts}
    free = {name for name in known - kept.artefacts if not _is_locked(store, name)}
    scenes = {row["scene_id"] for row in needs.scenes} - kept.scenes
    old = [name for name in scenes if _changed_at(store.scene_folder(name)) < since]
    return [
        *doomed_rows(store, "runs", runs),
        *doomed_rows(store, "artefacts", free),
        *doomed_rows(store, "scenes", old),
        *_leftovers(store, known, since),
    ]


def _leftovers(store: Store, known: set[str], since: datetime) -> Iterator[Doomed]:
    """Artefacts without a row, scratch of nobody, folders that were being written or removed."""
    settled = datetime.now(UTC) - SETTLED_AFTER
    for name in sorted(store.artefacts.ids() - known):
        folder = store.artefacts.folder(ArtefactRef.of_id(name))
        if _changed_at(folder) < since and not _is_locked(store, name):
            yield _leftover(store, folder)
    for folder in store.root.glob("work/*"):
        is_made = any(store.root.glob(f"artefacts/*/{folder.name}"))
        if (is_made or _changed_at(folder) < since) and not _is_locked(store, folder.name):
            yield _leftover(store, folder)
    for folder in (*store.root.glob("aside/*"), *store.root.glob("scenes/*/.*")):
        owner = folder.name.partition("-")[0]
        if (
            _changed_at(folder) < settled
            and not _is_locked(store, owner)
            and not _is_written(folder)
        ):
            yield _leftover(store, folder)


def _leftover(store: Store, folder: Path) -> Doomed:
    name = str(folder.relative_to(store.root))
    return Doomed(table=LEFTOVERS, row_id=name, folder=folder, num_bytes=store.entry_bytes(folder))


def _is_locked(store: Store, name: str) -> bool:
    """Whether somebody makes the artefact of an id or a digest just now."""
    return is_held(store.root / "locks" / f"{name.rpartition('/')[2]}.lock")


def _is_written(folder: Path) -> bool:
    """Whether somebody writes a scene there, see the library's `storage.whole_folders`."""
    return is_held(folder / ".writing")


def _changed_at(folder: Path) -> datetime:
    """When the folder was last changed; long ago if it is gone."""
    try:
        return datetime.fromtimestamp(folder.stat().st_mtime, UTC)
    except FileNotFoundError:
        return datetime.fromtimestamp(0, UTC)
