"""`lidarpainter catalog gc`, `compact`, `vacuum`, `verify`, `export`, `import`: keeping a store."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from flows.cli.output import Cell, format_bytes, print_json, print_pairs, print_table, say_status
from flows.cli.shared_options import AsJson

DAMAGED = 1
MOST_LISTED = 200
"""Rows of a table on the terminal; --json has all."""

app = typer.Typer()

Days = Annotated[
    float,
    typer.Option(min=0.0, max=36500.0, help="How long ago counts as recent; 0.5 is half a day."),
]
ForReal = Annotated[bool, typer.Option("--delete", help="Do it; else only list what would go.")]


@app.command("gc")
def collect(days: Days = 30.0, for_real: ForReal = False, as_json: AsJson = False) -> None:
    """List, or delete, what nothing recent needs: no run, no fleet, no asset, no work.

    Runs of the last days stay, runs of wanted sequences and of assets, trained painters, all that
    these were made from, and whatever somebody works on.

    Example: lidarpainter catalog gc --days 30 --delete
    """
    from datetime import UTC, datetime, timedelta

    from catalog.collection import plan_collection
    from catalog.deletion import delete
    from catalog.store import existing_store

    store = existing_store()
    doomed = plan_collection(store, datetime.now(UTC) - timedelta(days=days))
    if for_real:
        delete(store, doomed)
    num_bytes = sum(one.num_bytes for one in doomed)
    if as_json:
        going = [{"table": one.table, "id": one.row_id, "bytes": one.num_bytes} for one in doomed]
        print_json({"is_deleted": for_real, "num_bytes": num_bytes, "rows": going})
        return
    largest = sorted(doomed, key=lambda one: -one.num_bytes)[:MOST_LISTED]
    rows: list[list[Cell]] = [
        [one.table[:-1], one.row_id, format_bytes(one.num_bytes)] for one in largest
    ]
    left = len(doomed) - len(largest)
    notes = [f"and {left} smaller ones"] if left else []
    if doomed and not for_real:
        notes.append("nothing was deleted: --delete does")
    what = "deleted from" if for_real else "not needed in"
    title = f"{format_bytes(num_bytes)} {what} {store.name}"
    print_table(title, ["what", "name", "size"], rows, "\n".join(notes), num_text_columns=2)


@app.command("compact")
def compact_tables(as_json: AsJson = False) -> None:
    """Write the many small files of each table together: reading them gets faster.

    Old versions stay readable until `vacuum`.

    Example: lidarpainter catalog compact
    """
    from dataclasses import asdict

    from catalog.store import existing_store
    from catalog.table_upkeep import compact

    store = existing_store()
    done = compact(store.tables)
    if as_json:
        print_json({"store": store.name, "tables": [asdict(one) for one in done]})
    else:
        rows: list[list[Cell]] = [
            [one.table, one.version, one.files_before, one.files_after] for one in done
        ]
        columns = ["table", "version", "files before", "files after"]
        print_table(f"tables of {store.name}", columns, rows)


@app.command("vacuum")
def vacuum_tables(days: Days = 30.0, for_real: ForReal = False, as_json: AsJson = False) -> None:
    """Delete the files of tables that only versions older than some days need.

    `catalog list TABLE --as-of` reaches back so far and no further then.

    Example: lidarpainter catalog vacuum --days 30 --delete
    """
    from datetime import timedelta

    from catalog.store import existing_store
    from catalog.table_upkeep import vacuum

    store = existing_store()
    found = vacuum(store.tables, timedelta(days=days), dry_run=not for_real)
    counts = {table: len(files) for table, files in found.items()}
    if as_json:
        print_json({"is_deleted": for_real, "num_files": counts})
    else:
        note = "" if for_real else "nothing was deleted: --delete does"
        what = "deleted from" if for_real else "not needed in"
        print_pairs(f"files {what} tables of {store.name}", counts, note)


@app.command("verify")
def verify_store(as_json: AsJson = False) -> None:
    """Read every byte of the store and name what is not as it was written; then exit with 1.

    Example: lidarpainter catalog verify
    """
    from catalog.store import existing_store
    from catalog.verification import verify
    from lidarpainter_models.errors import SceneError
    from lidarpainter_models.scenes.stored import StoredScene

    def scene_damage(folder: Path) -> str | None:
        try:
            StoredScene(folder).verify_content()
        except SceneError as error:
            return str(error)
        return None

    store = existing_store()
    say_status(f"reading {store.name}")
    checked = list(verify(store, scene_damage))
    damaged = [one for one in checked if one.damage]
    if as_json:
        found = [{"name": one.name, "damage": one.damage} for one in damaged]
        print_json({"store": store.name, "num_checked": len(checked), "damaged": found})
    elif damaged:
        rows = [[one.name, one.damage] for one in damaged]
        title = f"damaged in {store.name}, of {len(checked)}"
        print_table(title, ["what", "damage"], rows, num_text_columns=2)
    else:
        sys.stdout.write(f"all {len(checked)} in {store.name} are as they were written\n")
    if damaged:
        raise typer.Exit(DAMAGED)


@app.command("export")
def export_selection(
    selection: Annotated[
        list[str], typer.Argument(help="Run ids or `latest`, scene ids, kind/digest; or prefixes.")
    ],
    out: Annotated[Path, typer.Option(help="The tar to write.")],
    as_json: AsJson = False,
) -> None:
    """Write runs with all that they need, or scenes, or artefacts, into one tar.

    Example: lidarpainter catalog export latest --out night.tar
    """
    from catalog.archives import select, write_archive
    from catalog.store import existing_store
    from flows.cli.catalog import find_row

    store = existing_store()
    chosen = select(store, [find_row(store, name) for name in selection])
    num_bytes = write_archive(store, chosen, out)
    counts = {table: len(rows) for table, rows in chosen.rows.items() if rows}
    if as_json:
        print_json({"path": str(out), "num_bytes": num_bytes, "rows": counts})
    else:
        print_pairs(f"{format_bytes(num_bytes)} in {out}", counts)


@app.command("import")
def import_selection(
    archive: Annotated[Path, typer.Argument(help="A tar that `catalog export` wrote.")],
    as_json: AsJson = False,
) -> None:
    """Take what `catalog export` wrote into this store; what is there already stays.

    Example: lidarpainter catalog import night.tar
    """
    from catalog.imports import import_archive
    from catalog.store import open_store

    store = open_store()
    counts = import_archive(store, archive)
    if as_json:
        print_json({"store": store.name, "new_rows": counts})
    else:
        print_pairs(f"new in {store.name}", counts)
