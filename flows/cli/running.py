"""Run a reconstruction from a command: with a Prefect server, and progress on stderr."""

import json
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from catalog.store import Store
from flows.cli.output import say_status
from flows.cli.progress import shown_progress
from flows.server import prefect_server
from flows.time_prediction import expected_seconds
from tasks.progress import ProgressListener

if TYPE_CHECKING:
    from flows.parameters import ReconstructParameters

SERVER = "starting Prefect's server, which orders and records the stages (a few seconds)"


def run_reconstruction(
    parameters: "ReconstructParameters", store: Store, *, is_watched: bool = False
) -> dict[str, Any]:
    """Reconstruct one scene of the store; what is known already is not asked of a server.

    Where it `is_watched`, its fits are shown in a browser while they run.
    """
    from flows.recall import recalled

    if (known := recalled(parameters, store.address)) is not None:
        return known
    from flows.reconstruct import check_inputs, reconstruct_flow

    check_inputs(parameters, store.address)  # before a server is started for nothing
    scene = next((r for r in store.rows("scenes") if r["scene_id"] == parameters.scene), None)
    num_views = _num_views(scene, parameters.train_cameras), _num_views(scene, None)
    with _running(store, parameters, *num_views) as listener, ExitStack() as stack:
        if is_watched:
            from lidarpainter_models.viewing.watching import watching

            listener.watch, address = stack.enter_context(watching(label=parameters.scene))
            sys.stderr.write(f"{address} shows the fits of this run while they run\n")
        return reconstruct_flow(parameters, store.address)


def run_demo(
    parameters: "ReconstructParameters", seed: int, store: Store, first_image: Path
) -> dict[str, Any]:
    """Make the street of a seed in the store and reconstruct it."""
    from flows.demo import demo, demo_street

    street = demo_street(seed)
    num_views = street.num_frames * len(street.cameras)
    with _running(store, parameters, num_views, num_views):
        return demo(street, parameters, store.address, first_image)


@contextmanager
def _running(
    store: Store, parameters: "ReconstructParameters", num_views: float, num_recorded: float
) -> Iterator[ProgressListener]:
    """Start a server, and show the stages of a run of so many views, of all that are recorded."""
    store.make()
    scenes = {row["scene_id"]: row for row in store.rows("scenes")}
    past = []
    for row in store.rows("runs"):
        scene = scenes.get(row["scene_id"])
        counts = {
            "num_views": _num_views(scene, _cameras(row)),
            "num_recorded": _num_views(scene, None),
        }
        past.append(row | counts)
    expected, is_told = expected_seconds(parameters, num_views, past, num_recorded)
    say_status(SERVER)
    log = store.root / "logs" / "prefect.log"
    with prefect_server(log), shown_progress(expected, is_told_by_past=is_told) as listener:
        yield listener


def _cameras(row: dict[str, Any]) -> Sequence[str] | None:
    """The cameras that a run was given; None where it took all."""
    return json.loads(row["parameters"] or "{}").get("train_cameras")


def _num_views(row: dict[str, Any] | None, cameras: Sequence[str] | None) -> float:
    """How many images some cameras of a scene have taken, by its row; 0 without one."""
    return row["num_views"] * len(cameras or row["cameras"]) / len(row["cameras"]) if row else 0.0
