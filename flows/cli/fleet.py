"""`lidarpainter fleet`: many sequences from one manifest."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from flows.cli import fleet_report
from flows.cli.output import complain, loudness, print_json, print_table, say_status
from flows.cli.shared_options import AsJson

if TYPE_CHECKING:
    from catalog.fleets import FleetLedger

NOT_OVER = 2
Fleet = Annotated[
    str | None, typer.Argument(help="Name of the fleet; the one that was asked for last if absent.")
]

app = typer.Typer(help="Many sequences from one manifest.", no_args_is_help=True)
app.add_typer(fleet_report.app)


@app.command("run")
def run(
    manifest: Annotated[Path, typer.Argument(help="TOML file, see docs/fleet.md.")],
    workers: Annotated[
        int, typer.Option(min=1, help="Sequences at once, each in a process of its own.")
    ] = 1,
    threads: Annotated[int, typer.Option(min=1, help="Of each worker.")] = 1,
    accept_stale: Annotated[
        bool, typer.Option("--accept-stale", help="Leave what older code has done as it is.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Make every sequence that a manifest asks for; what is done stays done.

    Run it again after whatever has ended it: it goes on.

    Example: lidarpainter fleet run night.toml --workers 2
    """
    from flows.fleet.manifest import read_manifest

    asked = read_manifest(manifest)
    say_status(f"looking for the sequences of {asked.name}")
    from catalog.fleets import FleetLedger
    from catalog.store import open_store
    from flows.fleet.asked import wishes
    from flows.fleet.local_workers import run_workers, starter
    from flows.fleet.status import counts_of, fleet_status, is_over

    wanted = wishes(asked, manifest.absolute().parent)
    store = open_store()
    store.make()
    ledger = FleetLedger(store)
    for line in ledger.reconcile():
        _tell(line)
    ledger.ask(wanted, accept_stale=accept_stale)
    counts = counts_of(ledger.rows(asked.name))
    if still := counts["waiting"] + counts["running"]:
        start = starter(store.address, asked.name, threads)
        run_workers(ledger, asked.name, start, min(workers, still), _tell)
    status = fleet_status(ledger, asked.name)
    _show(status, as_json=as_json)
    if not is_over(status):
        raise typer.Exit(NOT_OVER)


@app.command("status")
def status(
    fleet: Fleet = None,
    failed: Annotated[
        bool, typer.Option("--failed", help="Only what failed or was set aside, and why.")
    ] = False,
    metrics: Annotated[
        Path | None,
        typer.Option(help="Also write this file, X.prom, in the text format of Prometheus."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Show where every sequence of a fleet stands.

    Example: lidarpainter fleet status --failed
    """
    from flows.fleet.status import fleet_status

    ledger = _ledger()
    name = fleet or ledger.latest()
    if metrics is not None:
        from flows.fleet.metrics_file import write_metrics

        write_metrics(ledger, name, metrics)
    found = fleet_status(ledger, name)
    if failed:
        amiss = [one for one in found["sequences"] if one["state"] in ("failed", "set-aside")]
        found = {**found, "sequences": amiss}
    _show(found, as_json=as_json)


@app.command("retry")
def retry(
    fleet: Fleet = None,
    scene: Annotated[
        list[str] | None,
        typer.Option(help="Only this scene, though it was set aside. May be repeated."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Let what failed wait for another attempt; `fleet run` makes it.

    Example: lidarpainter fleet retry --scene pandaset/002
    """
    ledger = _ledger()
    name = fleet or ledger.latest()
    _show_scenes(name, "waiting", ledger.retry(name, scene or ()), as_json=as_json)


@app.command("cancel")
def cancel(fleet: Fleet = None, as_json: AsJson = False) -> None:
    """Let nothing more of a fleet begin, and end what is running; what is done stays.

    Workers on any machine end within seconds. `fleet run` goes on later.

    Example: lidarpainter fleet cancel
    """
    ledger = _ledger()
    name = fleet or ledger.latest()
    _show_scenes(name, "cancelled", ledger.cancel(name), as_json=as_json)


@app.command("work")
def work(fleet: Annotated[str, typer.Argument(help="Name of the fleet.")]) -> None:
    """Work on a fleet that was asked for, beside all others who do; `fleet run` starts these.

    Example: lidarpainter fleet work night-of-monday
    """
    ledger = _ledger()
    ledger.rows(fleet)
    from flows.fleet.event_log import EventLog
    from flows.fleet.work import make_sequence
    from flows.fleet.worker import Worker
    from tasks.progress import listening

    log = EventLog(fleet, sys.stderr.write)
    with listening(log):
        Worker(ledger=ledger, fleet=fleet, work=make_sequence, say=log).run()


def _ledger() -> "FleetLedger":
    from catalog.fleets import FleetLedger
    from catalog.store import existing_store

    return FleetLedger(existing_store())


def _show(status: dict[str, Any], *, as_json: bool) -> None:
    if as_json:
        print_json(status)
        return
    columns = ("scene", "state", "seconds", "attempts", "run_id", "reason")
    cells = [[one[name] for name in columns] for one in status["sequences"]]
    counts = ", ".join(f"{count} {state}" for state, count in status["counts"].items())
    error = status["planner_error"]
    notes = [
        counts,
        *([f"held back: {status['held_back']}"] if status["held_back"] else []),
        *([] if error is None else [f"the planner was off by {error:.0%} (median)"]),
    ]
    print_table(f"fleet {status['fleet']}", columns, cells, "\n".join(notes), num_text_columns=2)


def _show_scenes(fleet: str, state: str, scenes: list[str], *, as_json: bool) -> None:
    if as_json:
        print_json({"fleet": fleet, "scenes": scenes})
    else:
        print_table(f"fleet {fleet}, {state}", ["scene"], [[scene] for scene in scenes])


def _tell(line: str) -> None:
    if loudness() != "quiet":
        complain(line)
