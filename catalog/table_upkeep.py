"""What tables need now and then: fewer files, and no old versions for ever.

Delta Lake writes a file for every commit and removes none, so that every version can be read.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import timedelta

from deltalake.exceptions import CommitFailedError

from catalog.schemas import TABLES
from catalog.tables import CatalogTables, damage_told


@dataclass(frozen=True, slots=True, kw_only=True)
class Compacted:
    """One table before and after."""

    table: str
    version: int
    files_before: int
    files_after: int


def compact(tables: CatalogTables) -> list[Compacted]:
    """Write the files of every table together, and its log up to now as one checkpoint.

    A table that others write meanwhile is left as it is: the next time will do.

    Raises:
        StorageError: a table cannot be written.
    """
    done = []
    for name in TABLES:
        with damage_told(f"cannot compact table {name} in {tables.root}"):
            found = tables.delta(name)
            if found is None:
                continue
            before = len(found.file_uris())
            with suppress(CommitFailedError):
                found.optimize.compact()
                found.create_checkpoint()
            after = len(found.file_uris())
        one = Compacted(table=name, version=found.version(), files_before=before, files_after=after)
        done.append(one)
    return done


def vacuum(tables: CatalogTables, keep: timedelta, *, dry_run: bool) -> dict[str, Sequence[str]]:
    """Remove the files that no version of the last while needs; their names by table.

    Versions since then can be read as before, older ones no more.

    Raises:
        StorageError: a table cannot be written.
    """
    hours = int(keep.total_seconds() // 3600)
    removed: dict[str, Sequence[str]] = {}
    for name in TABLES:
        with damage_told(f"cannot vacuum table {name} in {tables.root}"):
            found = tables.delta(name)
            if found is not None:
                removed[name] = found.vacuum(
                    hours, dry_run=dry_run, enforce_retention_duration=False
                )
    return removed
