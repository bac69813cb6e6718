"""Run a flow from a command: with a Prefect server, and progress on stderr."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from catalog.store import Store
from flows.cli.output import say_status
from flows.cli.progress import shown_progress
from flows.server import prefect_server

if TYPE_CHECKING:
    from flows.parameters import ReconstructParameters


def run_reconstruction(parameters: "ReconstructParameters", store: Store) -> dict[str, Any]:
    """Reconstruct one scene of the store; what is known already is not asked of a server."""
    from flows.recall import recalled

    if (known := recalled(parameters, store.root)) is not None:
        return known
    from flows.reconstruct import check_inputs, reconstruct

    check_inputs(parameters, store.root)  # before a server is started for nothing
    with _running(store):
        return reconstruct(parameters, store.root)


def run_demo(
    parameters: "ReconstructParameters", seed: int, store: Store, first_image: Path
) -> dict[str, Any]:
    """Make the street of a seed in the store and reconstruct it."""
    from flows.demo import demo, demo_street

    with _running(store):
        return demo(demo_street(seed), parameters, store.root, first_image)


@contextmanager
def _running(store: Store) -> Iterator[None]:
    store.make()
    say_status("starting Prefect's server")
    with prefect_server(store.root / "logs" / "prefect.log"), shown_progress():
        yield
