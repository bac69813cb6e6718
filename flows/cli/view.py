"""`lidarpainter view`: a run in a browser on this machine."""

import sys
import threading
import webbrowser
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from flows.cli.output import clear_status
from flows.cli.shared_options import described, named_run, parse_frames, refuse_unused
from flows.interruption import ends_as_meant

WORDS = """
view.run: Which run, as elsewhere; with --label the scene whose boxes are mended.
label: Show the boxes of a scene over its sweeps and images, and merge, split, delete and rename
  actors by click.
edits: File that every edit of --label is written to at once; where it is there already, its edits
  hold. label-edits.json if absent. `label SCENE --edits FILE` writes the scene so changed.
view.camera: Camera whose path is followed; the first one fitted to if absent.
port: Port to listen on, on this machine alone; a free one if absent.
lidar: Show what the log's first LiDAR would see too; what it sees is learnt first, which takes
  minutes when it was not yet.
browser: Open a browser on it, or only print its address.
"""


@described(WORDS)
def view(  # noqa: PLR0913 - the options of a command
    run: str,
    camera: str | None = None,
    frames: str | None = None,
    lidar: bool = False,
    port: Annotated[int | None, typer.Option(min=1, max=65535)] = None,
    label: bool = False,
    edits: Path | None = None,
    browser: Annotated[bool, typer.Option("--browser/--no-browser")] = True,
) -> None:
    """Look at a finished run in a browser, live, until Ctrl-C.

    Drive it, step a lane aside or anywhere, before and after painting, with boxes, tracks, cameras
    and LiDAR, recorded or simulated; a click names an actor. Only this machine can reach it.

    Example: lidarpainter view latest

    Mend boxes that `label` found: lidarpainter view mcap/drive-labelled --label --edits edits.json
    """

    def opened_at(address: str) -> None:
        ends_as_meant()
        clear_status()
        sys.stdout.write(f"{address}\n")
        sys.stdout.flush()
        if browser:
            webbrowser.open(address)

    if label:
        given = {"--camera": camera is not None, "--frames": frames is not None, "--lidar": lidar}
        refuse_unused("--label", given)
        _label(run, edits or Path("label-edits.json"), port, opened_at)
        return
    refuse_unused("view of a run", {"--edits": edits is not None})
    followed = parse_frames(frames)
    run_id = named_run(run)
    from catalog.store import existing_store
    from flows.cli.serve import learn
    from flows.views import view_run
    from lidarpainter_models.export.view_requests import ViewRequest
    from lidarpainter_models.geometry.trajectory_specs import parse_trajectory
    from lidarpainter_models.geometry.trajectory_words import RECORDED

    request = ViewRequest(trajectory=parse_trajectory(RECORDED), camera=camera, frames=followed)
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


def _label(scene: str, edits: Path, port: int | None, opened_at: Callable[[str], None]) -> None:
    """Show the boxes of a scene until Ctrl-C."""
    from catalog.store import existing_store
    from tasks.ingest.label import label_by_hand

    store = existing_store()
    label_by_hand(store, scene, edits, port=port, opened_at=opened_at, stopped=threading.Event())
