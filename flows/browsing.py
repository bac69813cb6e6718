"""Look at a finished run in a browser; a query without a Prefect server."""

import threading
from collections.abc import Callable
from dataclasses import replace

from catalog.store import Store
from flows.parameters import view_parameters
from flows.views import PathRequest, render_request
from lidarpainter_models.errors import ConfigError
from tasks.runs import FinishedRun, is_of_its_scene, open_run
from tasks.specs import FittedRef
from tasks.views.drive import DriveRequest, view_live
from tasks.views.files import ViewKinds

FINAL, UNPAINTED = "painted", "before painting"


def view_run(
    store: Store,
    path: PathRequest,
    *,
    port: int | None,
    opened_at: Callable[[str], None],
    stopped: threading.Event,
) -> None:
    """Show a run in a browser on this machine until stopped.

    Without a `port` a free one is taken; `opened_at` is told the address.
    """
    finished = open_run(store, path.run)
    run = view_parameters(finished).run_spec(store.address)
    request = drive_request(store, finished, path)
    request = replace(request, scenes=request.scenes | _other_scenes(store, finished))
    view_live(run, request, port=port, opened_at=opened_at, stopped=stopped)


def drive_request(store: Store, finished: FinishedRun, path: PathRequest) -> DriveRequest:
    """A run as it is shown in a browser.

    Raises:
        ConfigError: images are to be painted or to stand beside others.
    """
    if path.is_painted or path.beside is not None:
        raise ConfigError(
            "a browser shows the scene itself: --postpaint and --beside are not for it"
        )
    view = render_request(store, finished, path, ViewKinds())
    return DriveRequest(view=view, scenes={FINAL: finished.final})


def _other_scenes(store: Store, finished: FinishedRun) -> dict[str, FittedRef]:
    """The run before painting, and the runs that were derived from it."""
    scenes = {}
    if finished.unpainted != finished.final:
        scenes[UNPAINTED] = finished.unpainted
    for row in store.rows("runs"):
        is_derived = row["derived_from"] == finished.run_id and row["status"] == "complete"
        if is_derived and is_of_its_scene(store, row):
            derived = open_run(store, row["run_id"])
            kind = derived.change["kind"] if derived.change else "derived"
            scenes[f"{kind} {derived.run_id[:8]}"] = derived.final
    return scenes
