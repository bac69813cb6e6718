"""`lidarpainter fleet report`: one page about a fleet."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from flows.cli.output import print_json, say_status
from flows.cli.shared_options import AsJson

app = typer.Typer()


@app.command("report")
def report(
    fleet: Annotated[
        str | None,
        typer.Argument(help="Name of the fleet; the one that was asked for last if absent."),
    ] = None,
    out: Annotated[Path, typer.Option(help="The page to write.")] = Path("fleet.html"),
    as_json: AsJson = False,
) -> None:
    """Write one page about a fleet: throughput, failures, cost, quality, worst scenes, planner.

    The page stands alone: nothing is loaded from elsewhere.

    Example: lidarpainter fleet report night-of-monday --out night.html
    """
    from catalog.fleets import FleetLedger
    from catalog.store import existing_store

    ledger = FleetLedger(existing_store())
    name = fleet or ledger.latest()
    ledger.rows(name)
    say_status(f"writing about {name}")
    from flows.fleet.report import fleet_page
    from lidarpainter_models.export.report import render_report
    from lidarpainter_models.storage.whole_files import write_whole

    write_whole(out, render_report(fleet_page(ledger, name)).encode())
    if as_json:
        print_json({"fleet": name, "path": str(out), "num_bytes": out.stat().st_size})
    else:
        sys.stdout.write(f"{out}\n")
