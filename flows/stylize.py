"""One finished run in another weather or at night."""

from pathlib import Path
from typing import Any

from prefect import flow

from catalog.store import open_store
from flows.parameters import view_parameters
from lidarpainter_models.geometry.trajectory_specs import parse_trajectory
from tasks.runs import open_run
from tasks.views.render import RenderRequest
from tasks.views.stylize import StylizeRequest, stylize


@flow(name="stylize")
def stylize_run(
    run: str, prompt: str, out: Path, trajectory: str = "recorded", store: str | None = None
) -> dict[str, Any]:
    """Write styled renders of a run.

    Args:
        run: its id, a unique prefix of one, or `latest`.
        prompt: `clear`, `foggy`, `night` or `rain`.
        out: folder for the images.
        trajectory: where the camera goes, as for `render`.
        store: folder of the store; by default what `LIDARPAINTER_STORE` says on the worker.
    """
    opened = open_store(store)
    finished = open_run(opened, run)
    parameters = view_parameters(finished)
    view = RenderRequest(
        trajectory=parse_trajectory(trajectory),
        observation=parameters.observation,
        conditions=parameters.conditions,
    )
    return stylize(opened.root, finished, StylizeRequest(prompt=prompt, view=view), out)
