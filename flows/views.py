"""Show a finished run: along a trajectory, painted or styled, or in a browser; without a server."""

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

from catalog.store import Store
from flows.lidar import learnt_channel
from flows.parameters import view_parameters
from lidarpainter_models.errors import ConfigError
from lidarpainter_models.evaluation.anchoring import calibration_of
from lidarpainter_models.evaluation.score_tables import ENVELOPE
from lidarpainter_models.export.styled_views import StyleRequest
from lidarpainter_models.export.view_requests import RECORDING, UNPAINTED, ViewRequest
from lidarpainter_models.observations.image_shrinking import require_recorded_width
from tasks.opened import open_scene
from tasks.runs import FinishedRun, is_of_its_scene, lineage, open_run
from tasks.specs import FittedRef
from tasks.views.drive import SHOWN, view_live
from tasks.views.render import ViewedRun, render, stylize

BEFORE_PAINTING = "before painting"
"""What the viewer calls the scene of a run after its first fit."""


def render_run(store: Store, run: str, request: ViewRequest, out: Path) -> dict[str, Any]:
    """Render a finished run where nobody drove, into a folder.

    Returns:
        What `render --json` prints.

    Raises:
        ConfigError: see `viewed_run`, or the path leads into a wall.
        SceneError: the scene has no such camera, or no frame is left.
    """
    finished = open_run(store, run)
    viewed = viewed_run(store, finished, request)
    made = render(viewed, request, out)
    return {
        "run_id": finished.run_id,
        "scene": finished.scene_id,
        "trajectory": request.trajectory.spec,
        "painter": viewed.run.painter if request.is_painted else None,
        "prompt": request.prompt,
        "previous": request.sequence.previous,
        **made,
    }


def stylize_run(
    store: Store, run: str, request: ViewRequest, style: StyleRequest, out: Path
) -> dict[str, Any]:
    """Show a finished run in another weather or at night, and how well its edges are kept.

    Returns:
        What `stylize --json` prints.

    Raises:
        ConfigError: see `viewed_run`, or what is asked for cannot be put in a style.
    """
    finished = open_run(store, run)
    made = stylize(viewed_run(store, finished, request), request, style, out)
    return {
        "run_id": finished.run_id,
        "scene": finished.scene_id,
        "prompt": style.mix.text,
        "trajectory": request.trajectory.spec,
        **made,
    }


def viewed_run(store: Store, finished: FinishedRun, request: ViewRequest) -> ViewedRun:
    """A finished run as the stages that show it are given it.

    Raises:
        ConfigError: images wider than recorded, or a run beside that shows another scene.
    """
    parameters = view_parameters(finished)
    if request.width_px is not None:
        views = open_scene(store, finished.scene_id).views
        require_recorded_width(request.width_px, views, "--width")
    return ViewedRun(
        run=parameters.run_spec(store.address, painter=request.painter),
        fitted=finished.final,
        observation=parameters.observation,
        conditions=parameters.conditions,
        calibration=calibration_of(envelope_of(store, finished)),
        beside=_beside(store, finished, request.beside),
    )


def envelope_of(store: Store, finished: FinishedRun) -> dict[str, Any] | None:
    """How far a run can be trusted, or the nearest that it was changed from; None if unasked."""
    envelopes = (run.result.get(ENVELOPE) for run in lineage(store, finished))
    return next((found for found in envelopes if found), None)


def _beside(store: Store, finished: FinishedRun, beside: str | None) -> FittedRef | None:
    """The scene of another run that is shown to the left."""
    if beside in (None, RECORDING, UNPAINTED):
        return None
    other = open_run(store, beside)
    if other.scene_id != finished.scene_id:
        raise ConfigError(
            f"--beside {beside}: shows {other.scene_id}, expected a run of {finished.scene_id}"
        )
    return other.final


def view_run(
    store: Store,
    run: str,
    request: ViewRequest,
    *,
    has_lidar: bool = False,
    port: int | None,
    opened_at: Callable[[str], None],
    stopped: threading.Event,
) -> None:
    """Show a run in a browser on this machine until stopped; see `tasks.views.drive.view_live`.

    With `has_lidar` it can show what the log's first LiDAR would see.
    """
    finished = open_run(store, run)
    viewed = viewed_run(store, finished, request)
    scenes = {SHOWN: finished.final} | _other_scenes(store, finished)
    lidar = learnt_channel(store, finished) if has_lidar else None
    view_live(viewed, request, scenes, lidar=lidar, port=port, opened_at=opened_at, stopped=stopped)


def _other_scenes(store: Store, finished: FinishedRun) -> dict[str, FittedRef]:
    """The run before painting, and the runs that were derived from it."""
    scenes = {}
    if finished.unpainted != finished.final:
        scenes[BEFORE_PAINTING] = finished.unpainted
    for row in store.rows("runs"):
        is_derived = row["derived_from"] == finished.run_id and row["status"] == "complete"
        if is_derived and is_of_its_scene(store, row):
            derived = open_run(store, row["run_id"])
            kind = derived.change["kind"] if derived.change else "derived"
            scenes[f"{kind} {derived.run_id[:8]}"] = derived.final
    return scenes
