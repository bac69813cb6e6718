"""SQL over the catalog's tables, by DuckDB: read-only, and bounded in time, memory and rows.

DuckDB reads the Parquet files that a table's Delta log names, so it reads the columns and the
groups of rows that a question needs and no others. Arrow's dataset could not: merges store text as
`string_view`, for which Arrow's filters have no kernels (pyarrow 26). Tables in a bucket are read
whole by Arrow, and only those that the question names.

Whatever is asked can read those files and nothing else: no other file, no network, no extension.
"""

import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import chain
from typing import Any

from catalog.errors import CatalogError, StorageError
from catalog.schemas import TABLES, ColumnType, TableSchema
from catalog.tables import CatalogTables, Row

HEAD = """# Tables of the catalog

Delta Lake tables below `STORE/tables/`, each merged on its first column. Times are UTC, JSON is
canonical (sorted keys, no spaces). This page is what `lidarpainter catalog tables` prints, from the
dictionary in `catalog/schemas.py`, which says too what becomes of tables that older or newer
software wrote.

`lidarpainter catalog list TABLE --as-of VERSION|TIME` shows a table as it was. DuckDB, polars and
Spark read the same files; from Python, `deltalake.DeltaTable("STORE/tables/runs").to_pandas()`.
"""


def tables_page() -> str:
    """All tables, one section each, as Markdown."""
    return "\n".join([HEAD, *(line for table in TABLES.values() for line in _section(table))])


def _section(table: TableSchema) -> Iterator[str]:
    yield f"## {table.name}\n"
    yield f"{table.description}\n"
    yield "| column | type | unit | meaning |"
    yield "|---|---|---|---|"
    for column in table.columns:
        yield f"| `{column.name}` | {column.type} | {column.unit} | {column.description} |"
    yield ""


LONGEST_S = 60.0
MOST_MEMORY = "1GB"
MOST_ROWS = 100_000
"""Rows of an answer at most; those beyond are cut off, and that is said."""

_TYPES: dict[ColumnType, str] = {
    "text": "VARCHAR",
    "integer": "BIGINT",
    "number": "DOUBLE",
    "flag": "BOOLEAN",
    "time": "TIMESTAMPTZ",
    "texts": "VARCHAR[]",
}
_BOUNDS: dict[str, str | bool | int | float | list[str]] = {
    "threads": 1,
    "memory_limit": MOST_MEMORY,
    "temp_directory": "",
    "autoinstall_known_extensions": False,
    "autoload_known_extensions": False,
    "allow_community_extensions": False,
    "python_enable_replacements": False,
}


@dataclass(frozen=True, kw_only=True)
class Answer:
    """What a question gave."""

    columns: tuple[str, ...]
    rows: list[Row]
    is_cut: bool
    """Whether there were more rows than were asked for."""


class CatalogSql:
    """The tables as they are now: one connection, for one question or several."""

    def __init__(self, tables: CatalogTables) -> None:
        import duckdb  # 0.3 s, which no other command needs to wait for

        self._tables = tables
        self._connection = duckdb.connect(":memory:", config=_BOUNDS)
        self._waiting = set(TABLES) if "://" in tables.root else set()
        """Tables in a bucket that no question has named yet."""
        files = {name: tables.files(name) for name in TABLES.keys() - self._waiting}
        self._connection.execute("SET allowed_paths = $1", [list(chain(*files.values()))])
        self._connection.execute("SET TimeZone = 'UTC'")
        self._connection.execute("SET enable_external_access = false")
        for name, found in files.items():
            self._show(TABLES[name], found)
        self._connection.execute("SET lock_configuration = true")

    def ask(
        self, sql: str, parameters: Mapping[str, Any] | None = None, *, most_rows: int = MOST_ROWS
    ) -> Answer:
        """Answer one SELECT.

        `parameters` are the values of its `$name`s.

        Raises:
            CatalogError: it is no such statement, or it takes more than it may.
            StorageError: a table cannot be read.
        """
        import duckdb

        timer = threading.Timer(LONGEST_S, self._connection.interrupt)
        timer.daemon = True
        timer.start()
        try:
            self._check(sql)
            asked = self._connection.sql(sql, params=parameters)
            found = asked.limit(most_rows + 1).to_arrow_table()
        except duckdb.InterruptException:
            raise CatalogError(f"the query took more than {LONGEST_S:.0f} s") from None
        except duckdb.OutOfMemoryException:
            raise CatalogError(f"the query took more than {MOST_MEMORY} of memory") from None
        except (duckdb.Error, ValueError) as error:
            reason = " ".join(str(error).split("\n\n")[0].split())
            raise CatalogError(f"the query cannot be answered: {reason[:300]}") from None
        finally:
            timer.cancel()
        return Answer(
            columns=tuple(found.column_names),
            rows=found.slice(0, most_rows).to_pylist(),
            is_cut=found.num_rows > most_rows,
        )

    def _check(self, sql: str) -> None:
        """Refuse everything but one SELECT; take in the tables that it names."""
        import duckdb

        statements = self._connection.extract_statements(sql)
        if len(statements) != 1 or statements[0].type != duckdb.StatementType.SELECT:
            raise CatalogError("a query is one SELECT over the tables of the catalog")
        with suppress(duckdb.Error):  # not every SELECT can be asked for its tables: DESCRIBE
            named = {name.lower() for name in self._connection.get_table_names(sql)}
            for name in named & self._waiting:
                self._connection.register(name, self._tables.arrow(name))
                self._waiting.remove(name)

    def _show(self, schema: TableSchema, files: Sequence[str]) -> None:
        """Give a table its name; columns that its files lack are null."""
        import duckdb

        if not files:
            self._connection.register(schema.name, schema.arrow.empty_table())
            return
        try:
            stored = self._connection.read_parquet(list(files), union_by_name=True)
        except duckdb.Error as error:
            reason = str(error).splitlines()[0][:200]
            raise StorageError(
                f"cannot read table {schema.name}: it is damaged ({reason})"
            ) from None
        known = set(stored.columns)
        columns = [
            f'"{column.name}"'
            if column.name in known
            else f'NULL::{_TYPES[column.type]} AS "{column.name}"'
            for column in schema.columns
        ]
        stored.project(", ".join(columns)).create_view(schema.name)
