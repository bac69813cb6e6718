"""`lidarpainter catalog`: what the store holds."""

import json
import sys
from collections import Counter
from typing import TYPE_CHECKING, Annotated, Any

import typer

from flows.cli import upkeep
from flows.cli.output import Cell, loudness, print_json, print_pairs, print_table
from flows.cli.rows import opened_row, row_cell, told_explanation
from flows.cli.shared_options import AsJson, described, tell_run
from flows.cli.tables import heading_of

if TYPE_CHECKING:
    from datetime import datetime

app = typer.Typer(help="What the store holds.", no_args_is_help=True)
app.add_typer(upkeep.app)

SHOWN_COLUMNS = {
    "scenes": ("scene_id", "num_frames", "num_views", "num_actors", "duration_s", "num_bytes"),
    "runs": ("run_id", "scene_id", "preset", "status", "started_at", "seconds", "change"),
    "artefacts": ("artefact_id", "num_bytes", "seconds", "created_at"),
    "metrics": ("run_id", "protocol", "trajectory", "variant", "name", "value"),
    "painters": ("painter_id", "name", "num_bytes", "created_at"),
    "sequences": ("fleet", "scene_id", "state", "cause", "attempts", "seconds", "run_id"),
    "attempts": ("fleet", "scene_id", "worker", "started_at", "seconds", "cause", "reason"),
    "assets": ("asset_id", "kind", "category", "style", "dataset", "num_sightings", "score"),
    "sightings": ("asset_id", "scene_id", "run_id", "actor_id", "num_views", "sides", "score"),
}
NEWEST_FIRST = {
    "runs": "started_at",
    "artefacts": "created_at",
    "painters": "created_at",
    "attempts": "started_at",
    "assets": "created_at",
}

WORDS = """
table: Table of the catalog: scenes, runs, artefacts, metrics, painters, sequences, attempts, assets
  or sightings.
as_of: Version of the table, such as 3, or a time in UTC, such as 2026-11-22T08:00; as it is now if
  absent.
name: A scene, a run id, latest (the newest run of all), or kind/digest of an artefact; or the
  beginning of an id.
explain.name: A run id, a scene (its newest run), latest (the newest run of all), or kind/digest of
  an artefact; or the beginning of an id.
delete_record.name: A run id, latest (the newest run of all), kind/digest of an artefact, or a
  scene; or the beginning of an id.
with_dependents: Also delete what was made from it.
dry_run: Only list what would be deleted, and its size.
yes: Delete without asking.
"""


@app.command("list")
@described(WORDS)
def list_table(
    table: Annotated[str, typer.Argument()] = "runs",
    as_of: str | None = None,
    as_json: AsJson = False,
) -> None:
    """List a table of the catalog: runs, artefacts and painters from the newest on.

    As it is, or with --as-of as it was; `catalog vacuum` says how far that reaches back.
    Metrics that have no value are not listed but counted, by the reason why there is none.

    Example: lidarpainter catalog list scenes
    """
    from catalog.store import existing_store

    store = existing_store()
    past = None if as_of is None else _version_or_time(as_of)
    rows = store.rows(table) if past is None else store.tables.rows(table, as_of=past)
    if table in NEWEST_FIRST:
        rows.sort(key=lambda row: str(row[NEWEST_FIRST[table]] or ""), reverse=True)
    absent = _absent(rows) if table == "metrics" else {}
    rows = [row for row in rows if table != "metrics" or row["value"] is not None]
    if as_json:
        found = {"table": table, "store": store.name, "rows": [opened_row(row) for row in rows]}
        missing = [{"names": names, "reason": reason} for reason, names in absent.items()]
        print_json(found | ({"absent": missing} if table == "metrics" else {}))
        return
    columns = SHOWN_COLUMNS[table]
    cells = [[_listed(name, row) for name in columns] for row in rows]
    note = "\n".join(
        f"without a value: {', '.join(f'{name} ({count})' for name, count in names.items())}: "
        f"{reason}"
        for reason, names in absent.items()
    )
    headings = ["preset, painter" if name == "preset" else name for name in columns]
    print_table(f"{table} in {store.name}", headings, cells, note)


@app.command("tables")
@described(WORDS)
def describe_tables(as_json: AsJson = False) -> None:
    """Describe every table and column: type, unit and meaning, as Markdown.

    Example: lidarpainter catalog tables
    """
    from dataclasses import asdict

    from catalog.schemas import TABLES
    from catalog.sql import tables_page

    if as_json:
        print_json({"tables": [asdict(table) for table in TABLES.values()]})
    else:
        sys.stdout.write(tables_page())


def _version_or_time(text: str) -> "int | datetime":
    """What `--as-of` means; a time without a zone is UTC, as all times of the catalog."""
    from datetime import UTC, datetime

    from lidarpainter_models.errors import ConfigError

    if text.isdecimal():
        return int(text)
    try:
        found = datetime.fromisoformat(text)
    except ValueError:
        raise ConfigError(
            f"--as-of {text!r}: expected a version such as 3, or a time such as 2026-11-22T08:00"
        ) from None
    return found if found.tzinfo else found.replace(tzinfo=UTC)


@app.command("show")
@described(WORDS)
def show_record(name: str, as_json: AsJson = False) -> None:
    """Show everything known about one scene, run or artefact.

    Example: lidarpainter catalog show latest
    """
    from catalog.store import existing_store

    table, row = find_row(existing_store(), name)
    if as_json:
        print_json({"table": table, **opened_row(row)})
        return
    print_pairs(f"{table}: {name}", {column: row_cell(column, row[column]) for column in row})


@app.command("explain")
@described(WORDS)
def explain(name: str, as_json: AsJson = False) -> None:
    """Say whether a run or an artefact is up to date, or what makes it stale.

    With --verbose also all that it was made from: inputs, settings and code.

    Example: lidarpainter catalog explain latest
    """
    from catalog.artefacts import ArtefactRef
    from catalog.errors import UnknownRecordError
    from catalog.explain import Explainer
    from catalog.store import existing_store
    from tasks.stages import project_source

    store = existing_store()
    table, row = find_row(store, name)
    if table == "scenes":
        table, row = "runs", _newest_run(store, name)
    explainer = Explainer(store, project_source().code_from)
    if table == "runs":
        found = explainer.run(row)
    elif table == "artefacts":
        found = explainer.artefact(ArtefactRef.of_id(row["artefact_id"]))
    else:
        raise UnknownRecordError(f"{name!r} is in {table}, expected a run or an artefact")
    if as_json:
        print_json(found.to_dict())
        return
    lines = [found.verdict]
    if loudness() == "verbose":
        lines += told_explanation("", found, set())
    else:
        if found.newest:
            differs = ", ".join(found.newest["settings"]) or "nothing that was set"
            lines.append(f"The newest of its kind is {found.newest['name']}; differs: {differs}.")
        lines.append("--verbose shows what it was made from.")
    sys.stdout.write("\n".join(lines) + "\n")


@app.command("delete")
@described(WORDS)
def delete_record(
    name: str,
    with_dependents: bool = False,
    dry_run: bool = False,
    yes: bool = False,
    as_json: AsJson = False,
) -> None:
    """Delete a run with the artefacts no other run needs, or an artefact, or a scene.

    What an artefact or a scene was used for is named, and goes with --with-dependents only.

    Example: lidarpainter catalog delete 3f2a --dry-run
    """
    from catalog.deletion import delete, plan_deletion
    from catalog.errors import CatalogError
    from catalog.store import existing_store

    store = existing_store()
    plan = plan_deletion(store, *find_row(store, name))
    doomed = (*plan.own, *plan.dependents)
    if plan.dependents and not with_dependents and not dry_run:
        named = ", ".join(f"{one.table[:-1]} {one.row_id}" for one in plan.dependents[:5])
        raise CatalogError(
            f"{plan.own[0].row_id} is needed by {len(plan.dependents)} others ({named}): nothing "
            "was deleted, --with-dependents deletes them too"
        )
    if not dry_run and not yes and not sys.stdin.isatty():
        raise CatalogError("nobody can be asked whether to delete this, expected --yes")
    if not as_json:
        upkeep.print_doomed(f"of {store.name}", doomed)
    if not dry_run:
        if not yes and not typer.confirm("Delete this?"):
            raise CatalogError("nothing was deleted")
        delete(store, doomed)
    if as_json:
        print_json(upkeep.doomed_as_json(doomed, is_deleted=not dry_run))


def find_row(store: Any, name: str) -> tuple[str, dict[str, Any]]:  # noqa: ANN401 - imported late
    """The row with a name, wherever it stands.

    Raises:
        UnknownRecordError: no table has it.
    """
    from catalog.errors import UnknownRecordError
    from catalog.store import LATEST

    if not name:
        raise UnknownRecordError("'' names nothing, expected an id or the beginning of one")
    if name == LATEST:
        return "runs", _newest_run(store, name)
    complaints = []
    for table in ("scenes", "runs", "artefacts", "painters"):
        try:
            return table, store.row(table, name)
        except UnknownRecordError as error:
            complaints.append(str(error))
            if "not unique" in str(error):
                raise
    raise UnknownRecordError(f"nothing is called {name!r}: {'; '.join(complaints)}")


def _newest_run(store: Any, name: str) -> dict[str, Any]:  # noqa: ANN401 - imported late
    """The run that `latest` or a scene stands for, which is said on stderr."""
    row: dict[str, Any] = store.run(name)
    kind = json.loads(row["change"])["kind"] if row["change"] else None
    tell_run(name, row["run_id"], row["scene_id"], kind)
    return row


def _absent(rows: list[dict[str, Any]]) -> dict[str, Counter[str]]:
    """How often which metric has no value, by the reason."""
    found: dict[str, Counter[str]] = {}
    for row in rows:
        if row["value"] is None:
            reason = row["reason"] or "no reason given"
            found.setdefault(reason, Counter()).update([row["name"]])
    return found


def _listed(name: str, row: dict[str, Any]) -> Cell:
    """A cell of a list: a run's painter stands with its preset, a change in its words."""
    value = row[name]
    if name == "preset":
        return ", ".join(filter(None, (value, row["painter"])))
    if name == "name" and "metric_id" in row:
        return heading_of(value)
    if name != "change" or value is None:
        return row_cell(name, value)
    change = json.loads(value)
    return " ".join(filter(None, (change["kind"], change["parameters"].get("prompt"))))
