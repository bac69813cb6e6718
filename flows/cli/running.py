"""Run a flow from a command: with a Prefect server, and progress on stderr."""

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from catalog.store import Store
from flows.cli.output import say_status
from flows.cli.progress import shown_progress
from flows.cli.stage_times import PlannedStage, expected_seconds
from flows.server import prefect_server

if TYPE_CHECKING:
    from flows.parameters import ReconstructParameters


def run_reconstruction(parameters: "ReconstructParameters", store: Store) -> dict[str, Any]:
    """Reconstruct one scene of the store; what is known already is not asked of a server."""
    from flows.recall import recalled

    if (known := recalled(parameters, store.address)) is not None:
        return known
    from flows.reconstruct import check_inputs, reconstruct

    check_inputs(parameters, store.address)  # before a server is started for nothing
    with _running(store, parameters):
        return reconstruct(parameters, store.address)


def run_demo(
    parameters: "ReconstructParameters", seed: int, store: Store, first_image: Path
) -> dict[str, Any]:
    """Make the street of a seed in the store and reconstruct it."""
    from flows.demo import demo, demo_street

    with _running(store, parameters):
        return demo(demo_street(seed), parameters, store.address, first_image)


@contextmanager
def _running(store: Store, parameters: "ReconstructParameters") -> Iterator[None]:
    store.make()
    expected = _expected(store, parameters)
    say_status("starting Prefect's server")
    with prefect_server(store.root / "logs" / "prefect.log"), shown_progress(expected):
        yield


def _expected(store: Store, parameters: "ReconstructParameters") -> dict[str, float] | None:
    """Seconds of the run's stages by past runs of the store; None where none tells."""
    scenes = {row["scene_id"]: row for row in store.rows("scenes")}

    def num_views(scene_id: str, cameras: Sequence[str] | None) -> float:
        row = scenes.get(scene_id)
        return row["num_views"] * len(cameras or row["cameras"]) / len(row["cameras"]) if row else 0

    past = []
    for row in store.rows("runs"):
        cameras = json.loads(row["parameters"] or "{}").get("train_cameras")
        past.append({**row, "num_views": num_views(row["scene_id"], cameras)})
    views = num_views(parameters.scene, parameters.train_cameras)
    if not views:  # the scene is not drawn yet
        return None
    stages = [
        PlannedStage(name=name, amount=steps or views, has_steps=steps is not None)
        for name, steps in parameters.stages.items()
    ]
    return expected_seconds(stages, parameters.preset, past)
