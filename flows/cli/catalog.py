"""`lidarpainter catalog`: what the store holds."""

import json
from typing import Annotated, Any

import typer

from flows.cli.output import Cell, format_bytes, print_json, print_pairs, print_table
from flows.cli.shared_options import AsJson

app = typer.Typer(help="What the store holds.", no_args_is_help=True)

SHOWN_COLUMNS = {
    "scenes": ("scene_id", "num_frames", "num_views", "num_actors", "duration_s", "num_bytes"),
    "runs": ("run_id", "scene_id", "preset", "painter", "status", "seconds", "num_gaussians"),
    "artefacts": ("artefact_id", "num_bytes", "seconds", "created_at"),
    "metrics": ("run_id", "protocol", "trajectory", "variant", "name", "value"),
    "painters": ("painter_id", "name", "num_bytes", "created_at"),
}
JSON_COLUMNS = ("parameters", "stage_seconds", "result", "inputs", "config", "summary", "record")
"""Columns that hold JSON text: shown as what they hold."""
LONGEST_JSON = 120
"""Characters of such a column in a table."""


@app.command("list")
def list_table(
    table: Annotated[
        str, typer.Argument(help="scenes, runs, artefacts, metrics or painters.")
    ] = "runs",
    as_json: AsJson = False,
) -> None:
    """List a table of the catalog."""
    from catalog.store import open_store

    store = open_store()
    rows = store.tables.rows(table)
    if as_json:
        print_json({"table": table, "store": str(store.root), "rows": [_open(row) for row in rows]})
        return
    columns = SHOWN_COLUMNS[table]
    cells = [[_cell(name, row[name]) for name in columns] for row in rows]
    print_table(f"{table} in {store.root}", columns, cells)


@app.command("show")
def show_record(
    name: Annotated[
        str, typer.Argument(help="A scene id, a run id or `latest`, or kind/digest; or a prefix.")
    ],
    as_json: AsJson = False,
) -> None:
    """Show everything known about one scene, run or artefact."""
    from catalog.store import open_store

    table, row = _find(open_store(), name)
    if as_json:
        print_json({"table": table, **_open(row)})
        return
    print_pairs(f"{table}: {name}", {column: _cell(column, row[column]) for column in row})


def _find(store: Any, name: str) -> tuple[str, dict[str, Any]]:  # noqa: ANN401 - imported late
    """The row with a name, wherever it stands.

    Raises:
        UnknownRecordError: no table has it.
    """
    from catalog.errors import UnknownRecordError
    from catalog.store import LATEST

    if name == LATEST:
        return "runs", store.run(name)
    complaints = []
    for table in ("scenes", "runs", "artefacts", "painters"):
        try:
            return table, store.tables.row(table, name)
        except UnknownRecordError as error:
            complaints.append(str(error))
            if "not unique" in str(error):
                raise
    raise UnknownRecordError(f"nothing is called {name!r}: {'; '.join(complaints)}")


def _open(row: dict[str, Any]) -> dict[str, Any]:
    """A row with times as text and JSON columns as what they hold."""
    opened = {}
    for name, value in row.items():
        if value is not None and name in JSON_COLUMNS:
            value = json.loads(value)
        opened[name] = value.isoformat() if hasattr(value, "isoformat") else value
    return opened


def _cell(name: str, value: Any) -> Cell:  # noqa: ANN401 - any value of a table
    if value is None or isinstance(value, (bool, float, int)):
        return format_bytes(value) if value is not None and name.endswith("bytes") else value
    if isinstance(value, list):
        return ", ".join(value)
    if hasattr(value, "isoformat"):
        return value.isoformat(timespec="seconds")
    is_long = name in JSON_COLUMNS and len(value) > LONGEST_JSON
    return f"{value[:LONGEST_JSON]}... (--json shows all)" if is_long else str(value)
