"""Run a flow from a command: a store, a Prefect server, progress, quiet threads."""

from typing import Any

from catalog.store import open_store
from flows.cli.progress import shown_progress
from flows.parameters import ReconstructParameters
from flows.reconstruct import reconstruct
from flows.server import prefect_server


def run_reconstruction(parameters: ReconstructParameters) -> dict[str, Any]:
    """Reconstruct one scene of the store, drawing progress on stderr."""
    store = open_store()
    with prefect_server(store.root / "logs" / "prefect.log"), shown_progress():
        return reconstruct(parameters, store.root)
