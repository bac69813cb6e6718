"""`lidarpainter catalog` commands that keep a store: what is stale, what it cost, what may go."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from flows.cli.output import Cell, format_bytes, print_json, print_pairs, print_table, say_status
from flows.cli.shared_options import AsJson, described

if TYPE_CHECKING:
    from catalog.deletion import Doomed

DAMAGED = 1
MOST_LISTED = 200
"""Rows of a table on the terminal; --json has all."""

Days = Annotated[float, typer.Option(min=0.0, max=36500.0)]
ForReal = Annotated[bool, typer.Option("--delete")]

app = typer.Typer()

WORDS = """
days: Number of days that count as recent; 0.5 is half a day.
for_real: Delete it; otherwise what would be deleted is only listed.
selection: What is taken along: run ids, latest (the newest run of all), scenes, or kind/digest of
  artefacts; or the beginnings of ids.
out: The tar file to write.
archive: A tar file that `catalog export` wrote.
"""


@app.command("gc")
@described(WORDS)
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
    if as_json:
        print_json(doomed_as_json(doomed, is_deleted=for_real))
    else:
        what, note = _fate(for_real=for_real)
        print_doomed(f"{what} {store.name}", doomed, note if doomed else "")


def _fate(*, for_real: bool) -> tuple[str, str]:
    """What became of what is listed, and a note."""
    if for_real:
        return "deleted from", ""
    return "not needed in", "nothing was deleted: --delete does"


def doomed_as_json(doomed: "Sequence[Doomed]", *, is_deleted: bool) -> dict[str, Any]:
    """What goes out of a store, as commands that delete print it with `--json`."""
    rows = [{"table": one.table, "id": one.row_id, "bytes": one.num_bytes} for one in doomed]
    num_bytes = sum(one.num_bytes for one in doomed)
    return {"is_deleted": is_deleted, "num_bytes": num_bytes, "rows": rows}


def print_doomed(what: str, doomed: "Sequence[Doomed]", note: str = "") -> None:
    """A table of what goes out of a store, the largest first."""
    largest = sorted(doomed, key=lambda one: -one.num_bytes)[:MOST_LISTED]
    left = len(doomed) - len(largest)
    notes = "\n".join(filter(None, [f"and {left} smaller ones" if left else "", note]))
    rows = [[one.table[:-1], one.row_id, format_bytes(one.num_bytes)] for one in largest]
    title = f"{format_bytes(sum(one.num_bytes for one in doomed))} {what}"
    print_table(title, ["what", "name", "size"], rows, notes, num_text_columns=2)


@app.command("compact")
@described(WORDS)
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
@described(WORDS)
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
        what, note = _fate(for_real=for_real)
        print_pairs(f"files {what} tables of {store.name}", counts, note)


@app.command("verify")
@described(WORDS)
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
@described(WORDS)
def export_selection(
    selection: list[str], out: Annotated[Path, typer.Option()], as_json: AsJson = False
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
@described(WORDS)
def import_selection(archive: Path, as_json: AsJson = False) -> None:
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


@app.command("stale")
@described(WORDS)
def stale(as_json: AsJson = False) -> None:
    """Show which runs today's code would make otherwise, why, and what redoing them takes.

    Of the runs of one scene with the same parameters the newest counts. Seconds are those of the
    stages concerned when they were computed; what several runs share counts once in the total.

    Example: lidarpainter catalog stale
    """
    from dataclasses import asdict

    from catalog.questions import stale_runs
    from catalog.store import existing_store
    from tasks.stages import project_source

    store = existing_store()
    found = stale_runs(store, project_source().code_from)
    once = {name: cost for one in found for name, cost in one.artefacts.items()}
    total = {
        name: sum(cost[name] for cost in once.values())
        for name in ("seconds", "cpu_seconds", "num_bytes")
    }
    scenes = len({one.scene_id for one in found})
    if as_json:
        print_json({"scenes": scenes, "total": total, "runs": [asdict(one) for one in found]})
        return
    columns = ["scene", "run", "stages", "changed", "s", "CPU s"]
    rows: list[list[Cell]] = [
        [
            one.scene_id,
            one.run_id,
            ", ".join(sorted({name.partition("/")[0] for name in one.artefacts})),
            ", ".join(one.changed),
            one.total("seconds"),
            one.total("cpu_seconds"),
        ]
        for one in found
    ]
    note = (
        f"{scenes} scenes; to redo them took {total['seconds']:.0f} s, "
        f"{total['cpu_seconds']:.0f} s of CPU, and {format_bytes(total['num_bytes'])}"
    )
    print_table(f"stale in {store.name}", columns, rows, note, num_text_columns=4)


@app.command("cost")
@described(WORDS)
def cost(scene: str, as_json: AsJson = False) -> None:
    """Show what a scene has cost: attempts of fleets by cause, and stages as computed.

    Money follows from money_per_hour in the table `budget` of the fleet's manifest.

    Example: lidarpainter catalog cost pandaset/002
    """
    from catalog.questions import cost_of
    from catalog.store import existing_store

    found = cost_of(existing_store(), scene)
    if as_json:
        print_json(found)
        return
    columns = ["what", "how many", "s", "CPU s", "size", "most memory", "money"]
    rows = [_row(f"attempts: {cause}", one) for cause, one in found["by_cause"].items()]
    rows += [_row("all attempts", found["attempts"])] if rows else []
    rows += [_row(f"stage: {kind}", one) for kind, one in found["stages"].items()]
    rows += [_row(f"all stages of {found['runs']} runs", found["stages_total"])]
    print_table(f"cost of {scene}", columns, rows)


def _row(name: str, spent: dict[str, Any]) -> list[Cell]:
    memory, money = spent.get("peak_memory_bytes"), spent.get("money")
    return [
        name,
        spent.get("attempts"),
        spent["seconds"],
        spent["cpu_seconds"],
        format_bytes(spent["num_bytes"]),
        format_bytes(memory) if memory else None,
        money,
    ]
