"""Read every byte of a store and hold it against what was written.

Artefacts have a digest of every file in their manifest. What a scene's manifest says is known to
whoever reads scenes, so that check is handed in. Tables have no digests of their own: all of their
columns are read and decoded.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from catalog.artefacts import ArtefactRef
from catalog.errors import CatalogError, StorageError
from catalog.schemas import TABLES
from catalog.store import Store

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
        yield Checked(name=f"scene {name}", damage=check_scene(store.scene_folder(name)))


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


def _artefact_damage(store: Store, name: str) -> str | None:
    try:
        manifest = store.artefacts.verified(ArtefactRef.of_id(name))
    except (CatalogError, OSError) as error:
        return str(error)
    made = f"{manifest.kind}/{manifest.digest}"
    return None if made == name else f"its manifest is that of {made}"
