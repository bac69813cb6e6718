"""`lidarpainter catalog`: what the store holds."""

import json
import sys
from collections.abc import Iterator
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
    from catalog.store import existing_store

    store = existing_store()
    rows = store.rows(table)
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
    from catalog.store import existing_store

    table, row = _find(existing_store(), name)
    if as_json:
        print_json({"table": table, **_open(row)})
        return
    print_pairs(f"{table}: {name}", {column: _cell(column, row[column]) for column in row})


@app.command("explain")
def explain(
    name: Annotated[str, typer.Argument(help="A run id or `latest`, or kind/digest; or a prefix.")],
    as_json: AsJson = False,
) -> None:
    """Show what a run or an artefact was made from, and what makes it stale."""
    from catalog.artefacts import ArtefactRef
    from catalog.errors import UnknownRecordError
    from catalog.explain import Explainer
    from catalog.store import existing_store
    from tasks.stages import project_source

    store = existing_store()
    table, row = _find(store, name)
    explainer = Explainer(store, project_source().code_from)
    if table == "runs":
        found = explainer.run(row)
    elif table == "artefacts":
        found = explainer.artefact(ArtefactRef.of_id(row["artefact_id"]))
    else:
        raise UnknownRecordError(f"{name!r} is in {table}, expected a run or an artefact")
    if as_json:
        print_json(found.to_dict())
    else:
        sys.stdout.write("\n".join(_tree("", found, set())) + "\n")


def _tree(part: str, found: Any, shown: set[str], depth: int = 0) -> Iterator[str]:  # noqa: ANN401
    """An explanation as indented lines; what was explained above is only named."""
    indent = "  " * depth
    state = f"STALE: {'; '.join(found.stale)}" if found.stale else ""
    again = "see above" if found.name in shown and found.facts else ""
    title = f"{part}: {found.name}" if part else found.name
    yield indent + "  ".join(text for text in (title, state, again) if text)
    if again:
        return
    shown.add(found.name)
    for fact, value in found.facts.items():
        if value:
            yield f"{indent}  {fact}: {_short(value)}"
    for what, value in (found.newest or {}).items():
        yield f"{indent}  newest {what}: {_short(value)}"
    for name, made in found.inputs.items():
        yield from _tree("" if name == made.name else name, made, shown, depth + 1)


def _short(value: Any) -> str:  # noqa: ANN401 - any JSON value
    text = value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
    return f"{text[:LONGEST_JSON]}... (--json shows all)" if len(text) > LONGEST_JSON else text


def _find(store: Any, name: str) -> tuple[str, dict[str, Any]]:  # noqa: ANN401 - imported late
    """The row with a name, wherever it stands.

    Raises:
        UnknownRecordError: no table has it.
    """
    from catalog.errors import UnknownRecordError
    from catalog.store import LATEST

    if not name:
        raise UnknownRecordError("'' names nothing, expected an id or the beginning of one")
    if name == LATEST:
        return "runs", store.run(name)
    complaints = []
    for table in ("scenes", "runs", "artefacts", "painters"):
        try:
            return table, store.row(table, name)
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
