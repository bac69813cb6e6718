"""`lidarpainter fleet`: many sequences from one manifest."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from flows.cli.output import print_json, print_result, print_table, say_status, tell
from flows.cli.shared_options import AsJson, described
from lidarpainter_models.errors import ConfigError

if TYPE_CHECKING:
    from catalog.fleets import FleetLedger
    from flows.fleet.manifest import Manifest

NOT_OVER = 2
TOLD_APART_BY = ("configuration", "cameras", "fit_seed")
"""Shown of sequences where not all of a fleet have the same."""
MOST_WORKERS = 150
"""Beyond 200 flow runs that wait, Prefect's queues starve (its issue 19403)."""

app = typer.Typer(help="Many sequences from one manifest.", no_args_is_help=True)

WORDS = """
manifest: TOML file that says which sequences are wanted and how, described in docs/fleet.md.
workers: Number of sequences made at once, each in a process of its own.
threads: Number of threads of each worker.
deploys: Let workers of a Prefect work pool make the sequences, in place of this command.
cron: With --deploy: when the manifest is looked at, in UTC, such as '0 3 * * *'; once now if
  absent.
pool: With --deploy: name of the work pool, which is made if it is not there.
fleet: Name of the fleet; if absent, the one that was asked for last.
work.fleet: Name of the fleet, as its manifest has it.
failed: Show only what failed or was set aside, and why.
metrics: File, such as fleet.prom, that figures are also written to in the text format of
  Prometheus.
scene: Only this scene, as dataset/sequence, even if it was set aside. May be repeated.
out: HTML file that the page is written to.
"""


@app.command("run")
@described(WORDS)
def run(  # noqa: PLR0913 - the options of a command
    manifest: Path,
    workers: Annotated[int, typer.Option(min=1, max=MOST_WORKERS)] = 1,
    threads: Annotated[int, typer.Option(min=1)] = 1,
    accept_stale: bool = False,
    deploys: Annotated[bool, typer.Option("--deploy")] = False,
    cron: str | None = None,
    pool: str | None = None,
    as_json: AsJson = False,
) -> None:
    """Make every sequence that a manifest asks for; what is done stays done.

    Run it again after whatever has ended it: it goes on.

    Example: lidarpainter fleet run night.toml --workers 2
    """
    from flows.fleet.manifest import read_manifest

    asked = read_manifest(manifest)
    if deploys:
        parameters: dict[str, Any] = {
            "manifest": str(manifest.absolute()),
            "workers": workers,
            "accept_stale": accept_stale,
        }
        say_status(f"deploying {asked.name}")
        from catalog.store import open_store
        from flows.fleet.deployed import POOL, deploy

        parameters["store"] = open_store().name
        made = deploy(asked.name, parameters, pool=pool or POOL, cron=cron, threads=threads)
        print_result(f"fleet {asked.name}, deployed", made, as_json=as_json)
        return
    if cron is not None or pool is not None:
        raise ConfigError(f"{'--pool' if cron is None else '--cron'} needs --deploy")
    folder = manifest.absolute().parent
    _run_here(asked, folder, workers, threads, accept_stale=accept_stale, as_json=as_json)


@app.command("status")
@described(WORDS)
def status(
    fleet: Annotated[str | None, typer.Argument()] = None,
    failed: bool = False,
    metrics: Path | None = None,
    as_json: AsJson = False,
) -> None:
    """Show where every sequence of a fleet stands.

    Example: lidarpainter fleet status --failed
    """
    from flows.fleet.status import fleet_status

    ledger, name = _named(fleet)
    if metrics is not None:
        from flows.fleet.metrics_file import write_metrics

        write_metrics(ledger, name, metrics)
    found = fleet_status(ledger, name)
    if failed:
        amiss = [one for one in found["sequences"] if one["state"] in ("failed", "set-aside")]
        found = {**found, "sequences": amiss}
    _show(found, as_json=as_json)


@app.command("retry")
@described(WORDS)
def retry(
    fleet: Annotated[str | None, typer.Argument()] = None,
    scene: list[str] | None = None,
    as_json: AsJson = False,
) -> None:
    """Let what failed wait for another attempt; `fleet run` makes it.

    Example: lidarpainter fleet retry --scene pandaset/002
    """
    ledger, name = _named(fleet)
    _show_scenes(name, "waiting", ledger.retry(name, scene or ()), as_json=as_json)


@app.command("cancel")
@described(WORDS)
def cancel(fleet: Annotated[str | None, typer.Argument()] = None, as_json: AsJson = False) -> None:
    """Let nothing more of a fleet begin, and end what is running; what is done stays.

    Workers on any machine end within seconds. `fleet run` goes on later.

    Example: lidarpainter fleet cancel
    """
    ledger, name = _named(fleet)
    _show_scenes(name, "cancelled", ledger.cancel(name), as_json=as_json)


@app.command("work")
@described(WORDS)
def work(fleet: str) -> None:
    """Work on a fleet that was asked for, beside all others who do; `fleet run` starts these.

    Example: lidarpainter fleet work night-of-monday
    """
    ledger, _ = _named(fleet)
    ledger.rows(fleet)
    from flows.fleet.work import make_sequence
    from flows.fleet.worker import EventLog, Worker
    from tasks.progress import listening

    log = EventLog(fleet, sys.stderr.write)
    with listening(log):
        Worker(ledger=ledger, fleet=fleet, work=make_sequence, say=log).run()


@app.command("report")
@described(WORDS)
def report(
    fleet: Annotated[str | None, typer.Argument()] = None,
    out: Path = Path("fleet.html"),
    as_json: AsJson = False,
) -> None:
    """Write one page about a fleet: throughput, failures, cost, quality, worst scenes, forecast.

    The page stands alone: nothing is loaded from elsewhere.

    Example: lidarpainter fleet report night-of-monday --out night.html
    """
    ledger, name = _named(fleet)
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


def _run_here(
    asked: "Manifest",
    folder: Path,
    workers: int,
    threads: int,
    *,
    accept_stale: bool,
    as_json: bool,
) -> None:
    """Make a fleet with workers of this machine."""
    say_status(f"looking for the sequences of {asked.name}")
    from catalog.fleets import FleetLedger
    from catalog.store import open_store
    from flows.fleet.asked_sequences import wishes
    from flows.fleet.local_workers import run_workers, starter
    from flows.fleet.status import counts_of, fleet_status, is_over

    wanted = wishes(asked, folder)
    store = open_store()
    store.make()
    ledger = FleetLedger(store)
    for line in [*ledger.reconcile(), *_closed(ledger)]:
        tell(line)
    ledger.ask(wanted, accept_stale=accept_stale)
    counts = counts_of(ledger.rows(asked.name))
    if still := counts["waiting"] + counts["running"]:
        start = starter(store.address, asked.name, threads)
        run_workers(ledger, asked.name, start, min(workers, still), tell)
    status = fleet_status(ledger, asked.name)
    _show(status, as_json=as_json)
    if not is_over(status):
        raise typer.Exit(NOT_OVER)


def _closed(ledger: "FleetLedger") -> list[str]:
    """Lines about flow runs that nobody works on, where Prefect is configured."""
    from prefect.settings import PREFECT_API_URL

    from flows.fleet.flow_runs import ApiLostError, close_lost_runs

    if not PREFECT_API_URL.value():
        return []
    try:
        return close_lost_runs(ledger)
    except ApiLostError as error:  # workers wait until it answers
        return [str(error)]


def _named(fleet: str | None) -> "tuple[FleetLedger, str]":
    """The ledger, and the fleet that is meant: the one asked for last if none is named."""
    from catalog.fleets import FleetLedger
    from catalog.store import existing_store

    ledger = FleetLedger(existing_store())
    return ledger, fleet or ledger.latest()


def _show(status: dict[str, Any], *, as_json: bool) -> None:
    if as_json:
        print_json(status)
        return
    rows = status["sequences"]
    apart = [name for name in TOLD_APART_BY if len({str(one[name]) for one in rows}) > 1]
    columns = ["scene", *apart, "state", "seconds", "attempts", "run_id", "reason"]
    cells = [[_in_words(one[name]) for name in columns] for one in rows]
    counts = ", ".join(f"{count} {state}" for state, count in status["counts"].items())
    error = status["forecast_error"]
    notes = [
        counts,
        *([f"held back: {status['held_back']}"] if status["held_back"] else []),
        *([] if error is None else [f"the forecast was off by {error:.0%} (median)"]),
    ]
    num_text_columns = 2 + len(apart)
    print_table(
        f"fleet {status['fleet']}",
        columns,
        cells,
        "\n".join(notes),
        num_text_columns=num_text_columns,
    )


def _in_words(value: Any) -> Any:  # noqa: ANN401 - any cell
    return ", ".join(value) if isinstance(value, list) else value


def _show_scenes(fleet: str, state: str, scenes: list[str], *, as_json: bool) -> None:
    if as_json:
        print_json({"fleet": fleet, "scenes": scenes})
    else:
        print_table(f"fleet {fleet}, {state}", ["scene"], [[scene] for scene in scenes])
