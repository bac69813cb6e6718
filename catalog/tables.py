"""Delta Lake tables with deterministic ids: merging the same row twice changes nothing.

Writers take turns by a lock where one reaches all of them. Delta Lake commits are optimistic: the
loser of a race reloads and tries again, a bounded number of times with growing, jittered pauses.
The root is a folder or a URI such as `s3://bucket/store`.
"""

import errno
import os
import random
import shutil
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from datetime import datetime
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import pyarrow as pa
import pyarrow.compute as pc
from deltalake import DeltaTable, Field
from deltalake.exceptions import CommitFailedError, DeltaError, TableNotFoundError
from deltalake.table import TableMerger

from catalog.errors import (
    ConflictError,
    StorageError,
    UnknownRecordError,
    UnreachableError,
    reason_of,
    storage_errors,
)
from catalog.schemas import TABLES, TableSchema
from catalog.stored_rows import read_rows

COMMIT_ATTEMPTS = 25
PAUSE_S = 0.05
"""Longest pause between two attempts, against writers that take no turns."""
MOST_FILES = 24
"""Small ones of a table, before they are written together: each merge and query opens all files."""

FILE_BYTES = 16 << 20
"""A file of a table, about: 140 000 assets. Replacing a row writes its whole file again, so a table
of many files takes a change in one place without being written anew."""

_NO_ANSWER = "Generic S3 error"
"""How Delta Lake says that a bucket failed, whatever it failed of."""
LEAST_ROOM_BYTES = 4 << 20
"""Below this a disk counts as full: more than any commit takes."""

Row = dict[str, Any]


class CatalogTables:
    """The tables below one root."""

    def __init__(
        self,
        root: str,
        *,
        storage_options: Mapping[str, str] | None = None,
        alone: Callable[[str], AbstractContextManager[object]] = nullcontext,
    ) -> None:
        """`alone` holds a name for one writer at a time, of all that share the tables."""
        self.root = root.rstrip("/")
        self.storage_options = dict(storage_options or {})
        self._alone = alone
        self._handles: dict[str, DeltaTable] | None = None

    def keep_open(self) -> None:
        """From now on read only what is new in the logs of tables: for who asks again and again.

        Not for a process that ends as an interpreter does: threads behind an open table may abort
        it then, so commands leave otherwise (see `flows.interruption.leave`).
        """
        self._handles = self._handles or {}

    def merge(self, table: str, rows: Sequence[Row]) -> None:
        """Insert rows, or replace those with the same id; all of them or none.

        Raises:
            ValueError: a row has a column the table lacks, or two rows share an id.
            ConflictError: other writers won every attempt.
            StorageError: the table cannot be written.
        """
        self._merged(
            table, rows, lambda one: one.when_matched_update_all().when_not_matched_insert_all()
        )

    def add_absent(self, table: str, rows: Sequence[Row]) -> int:
        """Insert rows whose id is not there; returns how many. Raises what `merge` raises."""
        return self._merged(table, rows, lambda one: one.when_not_matched_insert_all())

    def replace_older(self, table: str, rows: Sequence[Row], column: str) -> int:
        """Replace rows by those with a higher number in a column; returns how many were.

        None is inserted: what was deleted meanwhile stays so. Raises what `merge` raises.
        """
        newer = f"source.{column} > target.{column}"
        return self._merged(table, rows, lambda one: one.when_matched_update_all(predicate=newer))

    def replace_columns(self, table: str, rows: Sequence[Row], columns: Sequence[str]) -> int:
        """Replace some columns of rows that are there, and no others; see `replace_older`."""
        new = {name: f"source.{name}" for name in columns}
        return self._merged(table, rows, lambda one: one.when_matched_update(new))

    def delete(self, table: str, column: str, values: Sequence[str]) -> None:
        """Remove the rows with one of these values in a column; raises what `merge` raises."""
        schema = _schema(table)
        quoted = ", ".join("'{}'".format(value.replace("'", "''")) for value in values)
        if self.arrow(table, columns=[column], where={column: values}).num_rows:
            self._committed(schema, lambda: self._try_delete(schema, f"{column} IN ({quoted})"))

    def _merged(
        self, table: str, rows: Sequence[Row], rule: Callable[[TableMerger], TableMerger]
    ) -> int:
        """Merge rows by a rule in one commit; returns how many were inserted or replaced."""
        if not rows:
            return 0
        schema = _schema(table)
        source = schema.rows_as_arrow(rows)
        return self._committed(schema, lambda: self._try_merge(schema, source, rule))

    def _committed(self, schema: TableSchema, attempted: Callable[[], int | None]) -> int:
        """Attempt a commit until it wins, a bounded number of times; None is a lost attempt.

        Writers take turns. Without them nothing is lost either, but who has lost once begins
        later than the winner and goes on losing to it.
        """
        with damage_told(f"cannot write table {self._uri(schema)}"):
            self._require_room()
            with self._alone(f"table-{schema.name}"):
                for attempt in range(COMMIT_ATTEMPTS):
                    if attempt:
                        time.sleep(PAUSE_S * random.random())  # noqa: S311 - no secret
                    if (changed := attempted()) is not None:
                        return changed
        raise ConflictError(
            f"table {self._uri(schema)} had other writers in {COMMIT_ATTEMPTS} attempts"
        )

    def _require_room(self) -> None:
        """Refuse to begin a commit that the disk would not take: Delta's writer may not return."""
        folder = Path(self.root)
        if "://" in self.root or not folder.is_dir():
            return
        if shutil.disk_usage(folder).free < LEAST_ROOM_BYTES:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def rows(
        self,
        table: str,
        *,
        where: Mapping[str, Collection[str]] | None = None,
        as_of: int | datetime | None = None,
    ) -> list[Row]:
        """Rows of a table, by id, as it is or was; see `arrow`."""
        arrow = self.arrow(table, where=where, as_of=as_of)
        return arrow.sort_by(_schema(table).key).to_pylist()

    def arrow(
        self,
        table: str,
        *,
        columns: Collection[str] = (),
        where: Mapping[str, Collection[str]] | None = None,
        as_of: int | datetime | None = None,
    ) -> pa.Table:
        """A table as Arrow, with exactly the columns of its schema.

        No columns mean all; `where` takes the rows that have one of some values in any of these
        columns; `as_of` is a version or a moment, None means now.

        Raises:
            UnknownRecordError: there is no such version, or its files were vacuumed.
            StorageError: the table cannot be read.
        """
        schema = _schema(table)
        with damage_told(f"cannot read table {self._uri(schema)}"):
            found = self.delta(table, as_of=as_of)
            if found is None:
                return schema.arrow.empty_table()
            wanted = [field for field in schema.arrow if not columns or field.name in columns]
            try:
                return read_rows(found.to_pyarrow_dataset(), pa.schema(wanted), where)
            except FileNotFoundError:
                if as_of is None:
                    raise
                raise UnknownRecordError(
                    f"{table} as of {as_of} was vacuumed, expected a later version"
                ) from None

    def delta(self, table: str, *, as_of: int | datetime | None = None) -> DeltaTable | None:
        """The Delta table itself, as it is or was; None if nothing was ever written.

        Raises:
            UnknownRecordError: there is no such version.
        """
        schema = _schema(table)
        with suppress(TableNotFoundError):
            return self._current(schema) if as_of is None else self._past(schema, as_of)
        return None

    def files(self, table: str) -> list[str]:
        """The Parquet files that a table in a folder consists of; none if nothing was written."""
        schema = _schema(table)
        with damage_told(f"cannot read table {self._uri(schema)}"):
            try:
                return [unquote(uri) for uri in self._current(schema).file_uris()]
            except TableNotFoundError:
                return []

    def find(self, table: str, row_id: str) -> Row | None:
        """The row with exactly this id, or None."""
        return next(iter(self.rows(table, where={_schema(table).key: [row_id]})), None)

    def row(self, table: str, id_or_prefix: str) -> Row:
        """The one row with this id, or whose id starts with it.

        Raises:
            UnknownRecordError: none matches, or more than one.
        """
        if (exact := self.find(table, id_or_prefix)) is not None:
            return exact
        key = _schema(table).key
        ids = self.arrow(table, columns=[key])[key]
        matches = sorted(ids.filter(pc.starts_with(ids, pattern=id_or_prefix)).to_pylist())
        if len(matches) == 1 and (found := self.find(table, matches[0])) is not None:
            return found
        if len(matches) < 2:
            raise UnknownRecordError(f"no {key} {id_or_prefix!r} among {len(ids)} {table}")
        raise UnknownRecordError(f"{key} {id_or_prefix!r} is not unique: {', '.join(matches[:5])}")

    def _uri(self, schema: TableSchema) -> str:
        return f"{self.root}/{schema.name}"

    def _past(self, schema: TableSchema, as_of: int | datetime) -> DeltaTable:
        """The table as it was."""
        found = DeltaTable(self._uri(schema), storage_options=self.storage_options)
        try:
            found.load_as_version(as_of)
        except (DeltaError, ValueError, OverflowError) as error:
            why = str(error).splitlines()[0][:200]
            raise UnknownRecordError(
                f"no {schema.name} as of {as_of}, the last version is {found.version()} ({why})"
            ) from None
        return found

    def _try_delete(self, schema: TableSchema, predicate: str) -> int | None:
        """One commit; how many rows went, or None if it lost."""
        try:
            return int(self._current(schema).delete(predicate)["num_deleted_rows"] or 0)
        except CommitFailedError:
            return None

    def _try_merge(
        self, schema: TableSchema, source: pa.Table, rule: Callable[[TableMerger], TableMerger]
    ) -> int | None:
        """One commit; how many rows it inserted or replaced, or None if it lost."""
        key = schema.key
        try:
            target = self._opened(schema)
            merger = target.merge(
                source,
                predicate=f"target.{key} = source.{key}",
                source_alias="source",
                target_alias="target",
            )
            counts = rule(merger).execute()
        except CommitFailedError:
            return None
        except DeltaError as error:
            if "version already exists" in str(error).lower():  # lost the race to create it
                return None
            raise
        sizes = pa.table(target.get_add_actions()).column("size_bytes").to_pylist()
        if sum(size < FILE_BYTES // 2 for size in sizes) > MOST_FILES:
            with suppress(CommitFailedError):  # whoever won may do it
                target.optimize.compact(target_size=FILE_BYTES)
        return int(counts["num_target_rows_inserted"]) + int(counts["num_target_rows_updated"])

    def _opened(self, schema: TableSchema) -> DeltaTable:
        """The table, made if absent and given the columns that newer software added."""
        try:
            table = self._current(schema)
        except TableNotFoundError:
            DeltaTable.create(
                self._uri(schema),
                schema=schema.arrow,
                mode="ignore",
                name=schema.name,
                description=schema.description,
                configuration={"delta.targetFileSize": str(FILE_BYTES)},
                storage_options=self.storage_options,
            )
            table = self._current(schema)
        known = {field.name for field in table.schema().fields}
        if missing := [column for column in schema.columns if column.name not in known]:
            table.alter.add_columns([Field.from_arrow(column.arrow) for column in missing])
            if self._handles is not None:
                del self._handles[schema.name]
            table = self._current(schema)
        return table

    def _current(self, schema: TableSchema) -> DeltaTable:
        """The table as it is now."""
        handles = {} if self._handles is None else self._handles
        known = handles.pop(schema.name, None)
        if known is not None:
            with suppress(DeltaError):  # its folder may be another one by now
                known.update_incremental()
                handles[schema.name] = known
                return known
        found = handles[schema.name] = DeltaTable(
            self._uri(schema), storage_options=self.storage_options
        )
        return found


@contextmanager
def damage_told(doing: str) -> Iterator[None]:
    """Turn a damaged table or a bucket that does not answer into one line, as a failing disk."""
    try:
        with storage_errors(doing):
            yield
    except StorageError:
        raise
    except (DeltaError, pa.ArrowException, OSError) as error:
        if _NO_ANSWER in str(error):
            raise UnreachableError(f"{doing}: {reason_of(error)}") from None
        found = str(error).splitlines()[0][:200]
        raise StorageError(f"{doing}: it is damaged ({found})") from None


def _schema(table: str) -> TableSchema:
    try:
        return TABLES[table]
    except KeyError:
        raise UnknownRecordError(f"no table {table!r}; there are {', '.join(TABLES)}") from None
