"""`lidarpainter serve`: runs as the renderer that driving simulators call."""

import sys
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from flows.cli.output import clear_status
from flows.cli.shared_options import check_painter, described, named_run, parse_bytes, parse_seconds
from flows.interruption import ends_as_meant, starts_anew
from lidarpainter_models.devices import check_device
from lidarpainter_models.errors import ConfigError

if TYPE_CHECKING:
    from catalog.store import Store
    from flows.serve import ServeRequest

WORDS = """
runs: Runs to serve, each by its id or the beginning of it, a scene such as pandaset/002 (its newest
  run), or latest. Clients ask for the scene, or for the id where several runs show it.
host: Address to listen on; 0.0.0.0 lets other machines in, and anybody on them.
serve.port: Port of gRPC; 0 takes a free one.
http_port: Port of NeuroNCAP's routes, which show the first run; without it there are none.
paint: Paint every image, in agreement with the one that the same client asked of the camera before.
serve.painter: Painter of the images, which it paints without --paint too; the run's own if absent.
placeholder: Show an actor of the asset library for one that a scene does not have; else the request
  is refused.
parked_apart: Let clients move and leave out parked cars too, which else are part of the street.
lidar: Answer LiDAR sweeps too; what the LiDAR of each log sees is learnt first, which takes minutes
  when it was not yet.
memory: How much scenes in memory may take together, such as 4GB; the one that was asked for longest
  ago leaves.
queue: How many requests may wait at a time; more are refused.
serve.time_limit: How long a request may take, waiting included, such as 60s.
trust: Measure how far each image can be trusted, which takes longer than to draw it, or leave it
  out.
refuse_below: Confidence from 0 to 1 below which an image is refused.
log: CSV file that gets a row for every image: what was asked for, and how far it can be trusted.
allow_shut_down: Let clients end the server.
"""


@described(WORDS)
def serve(  # noqa: PLR0913 - the options of a command
    runs: Annotated[list[str], typer.Argument()],
    port: Annotated[int, typer.Option(min=0, max=65535)] = 8080,
    host: str = "127.0.0.1",
    http_port: Annotated[int | None, typer.Option(min=0, max=65535)] = None,
    paint: bool = False,
    painter: str | None = None,
    placeholder: bool = False,
    parked_apart: bool = False,
    lidar: bool = False,
    device: str = "auto",
    memory: str = "4GB",
    queue: Annotated[int, typer.Option(min=1, max=1000)] = 32,
    time_limit: str = "60s",
    trust: Annotated[bool, typer.Option("--trust/--no-trust")] = True,
    refuse_below: Annotated[float, typer.Option(min=0, max=1)] = 0.0,
    log: Path | None = None,
    allow_shut_down: bool = False,
) -> None:
    """Serve finished runs to driving simulators over gRPC, until Ctrl-C.

    It answers the calls of AlpaSim, NuRec and CARLA (SensorsimService), and those of NeuroNCAP.

    Example: lidarpainter serve latest --log trust.csv
    """
    most_bytes, limit_s = parse_bytes(memory), parse_seconds(time_limit)
    check_device(device)
    if refuse_below and not trust:
        raise ConfigError("--refuse-below needs the confidence that --no-trust leaves out")
    run_ids = tuple(dict.fromkeys(named_run(run) for run in runs))
    check_painter(painter)
    from flows.serve import ServeRequest
    from tasks.serving.load import ServedAs

    start(
        ServeRequest(
            runs=run_ids,
            host=host,
            port=port,
            http_port=http_port,
            how=ServedAs(
                device=device,
                is_painted=paint or painter is not None,
                painter=painter,
                is_measured=trust,
                is_parked_apart=parked_apart,
                has_placeholders=placeholder,
            ),
            has_lidar=lidar,
            most_bytes=most_bytes,
            most_waiting=queue,
            limit_s=limit_s,
            refuse_below=refuse_below,
            log=log,
            allows_shut_down=allow_shut_down,
        )
    )


def start(request: "ServeRequest") -> None:
    """Learn what is to be learnt, then answer until a signal comes."""
    from catalog.store import existing_store
    from flows.serve import serve_runs

    starts_anew("the server")
    store = existing_store()
    if request.has_lidar:
        learn(store, request.runs)
    serve_runs(store, request, opened_at=opened_at, stopped=threading.Event())


def learn(store: "Store", runs: Sequence[str]) -> None:
    """Learn what the LiDAR of each run's log sees, where that is not known yet, and say how far."""
    from flows.cli.progress import shown_progress
    from flows.serve import learn_lidars

    with shown_progress():
        learn_lidars(store, runs)


def opened_at(address: str, http_address: str | None) -> None:
    """Print where the server can be reached."""
    ends_as_meant()
    clear_status()
    for one in (address, http_address):
        if one is not None:
            sys.stdout.write(f"{one}\n")
    sys.stdout.flush()
