"""Read every byte of a store and hold it against what was written.

Artefacts have a digest of every file in their manifest. What a scene's manifest says is known to
whoever reads scenes, so that check is handed in. Tables have no digests of their own: all of their
columns are read and decoded. A bucket has a digest of every file, of scenes too, in its listings:
the bytes are read from there and not kept, whatever the mirror holds of them.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from catalog.artefacts import ArtefactRef
from catalog.errors import CatalogError, StorageError
from catalog.schemas import TABLES
from catalog.store import Store, scene_entry

SceneCheck = Callable[[Path], str | None]
"""What is wrong with the scene in a folder, after reading all of it; None if nothing is."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Checked:
    """One thing that was read."""

    name: str
    """kind/digest of an artefact, id of a scene, or a table."""
    damage: str | None
    """What is wrong with it."""


def verify(store: Store, check_scene: SceneCheck) -> Iterator[Checked]:
    """Check everything that the catalog names or that lies where artefacts and scenes lie."""
    for table in TABLES:
        yield Checked(name=f"table {table}", damage=_table_damage(store, table))
    for name in sorted(store.artefacts.ids() | _ids(store, "artefacts", "artefact_id")):
        yield Checked(name=name, damage=_artefact_damage(store, name))
    for name in sorted({*store.scene_ids()} | _ids(store, "scenes", "scene_id")):
        yield Checked(name=f"scene {name}", damage=_scene_damage(store, name, check_scene))


def _ids(store: Store, table: str, key: str) -> set[str]:
    try:
        return set(store.tables.arrow(table, columns=[key])[key].to_pylist())
    except StorageError:  # it was told of the table
        return set()


def _table_damage(store: Store, table: str) -> str | None:
    try:
        store.tables.arrow(table).validate(full=True)
    except (CatalogError, ValueError) as error:
        return str(error)
    return None


def _scene_damage(store: Store, name: str, check_scene: SceneCheck) -> str | None:
    if store.mirror is None:
        return check_scene(store.scene_folder(name))
    try:
        store.mirror.verify(scene_entry(name))
    except CatalogError as error:
        return str(error)
    return None


def _artefact_damage(store: Store, name: str) -> str | None:
    ref = ArtefactRef.of_id(name)
    try:
        if store.mirror is None:
            manifest = store.artefacts.verified(ref)
        else:
            listed = store.mirror.verify(ref.entry).files
            manifest = store.artefacts.manifest(ref)
            if any(listed.get(file) != known for file, known in manifest.files.items()):
                return "its manifest says otherwise than its listing"
    except (CatalogError, OSError) as error:
        return str(error)
    made = f"{manifest.kind}/{manifest.digest}"
    return None if made == name else f"its manifest is that of {made}"
