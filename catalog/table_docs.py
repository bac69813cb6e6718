"""The page about the tables of the catalog, made from their one dictionary (`schemas`)."""

from collections.abc import Iterator

from catalog.schemas import TABLES, TableSchema

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
