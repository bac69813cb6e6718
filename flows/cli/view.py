"""`lidarpainter view`: a run in a browser on this machine."""

import sys
import threading
import webbrowser
from typing import Annotated

import typer

from flows.cli.output import clear_status
from flows.cli.shared_options import described, named_run, parse_frames

WORDS = """
view.camera: Camera whose path is followed; the first one fitted to if absent.
port: Port to listen on, on this machine alone; a free one if absent.
lidar: Show what the log's first LiDAR would see too; what it sees is learnt first, which takes
  minutes when it was not yet.
browser: Open a browser on it, or only print its address.
"""


@described(WORDS)
def view(
    run: str,
    camera: str | None = None,
    frames: str | None = None,
    lidar: bool = False,
    port: Annotated[int | None, typer.Option(min=1, max=65535)] = None,
    browser: Annotated[bool, typer.Option("--browser/--no-browser")] = True,
) -> None:
    """Look at a finished run in a browser, live, until Ctrl-C.

    Drive it, step a lane aside or anywhere, before and after painting, with boxes, tracks, cameras
    and LiDAR, recorded or simulated; a click names an actor. Only this machine can reach it.

    Example: lidarpainter view latest
    """
    followed = parse_frames(frames)
    run_id = named_run(run)
    from catalog.store import existing_store
    from flows.cli.serve import learn
    from flows.views import view_run
    from lidarpainter_models.export.view_requests import ViewRequest
    from lidarpainter_models.geometry.trajectory_specs import parse_trajectory
    from lidarpainter_models.geometry.trajectory_words import RECORDED

    request = ViewRequest(trajectory=parse_trajectory(RECORDED), camera=camera, frames=followed)

    def opened_at(address: str) -> None:
        clear_status()
        sys.stdout.write(f"{address}\n")
        sys.stdout.flush()
        if browser:
            webbrowser.open(address)

    store = existing_store()
    if lidar:
        learn(store, (run_id,))
    view_run(
        store,
        run_id,
        request,
        has_lidar=lidar,
        port=port,
        opened_at=opened_at,
        stopped=threading.Event(),
    )
