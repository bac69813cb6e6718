"""Write a finished run in the formats of other programs; queries without a server."""

from dataclasses import replace
from pathlib import Path
from typing import Any

from catalog.store import Store
from flows.lidar import sweeps_of_run
from flows.views import envelope_of, viewed_run
from lidarpainter_models.errors import ConfigError
from lidarpainter_models.export.formats import ExportFormat, export_format
from lidarpainter_models.export.simulated_sweeps import SweepRequest
from lidarpainter_models.export.view_requests import ViewKinds, ViewRequest
from tasks.exports.dataset import export_dataset, export_log
from tasks.exports.scene import SceneRequest, export_images, export_scene, export_video
from tasks.exports.simulator import export_bundle
from tasks.exports.sweeps import export_sweeps
from tasks.opened import open_scene
from tasks.runs import FinishedRun, lineage, open_run
from tasks.views.drive import write_page
from tasks.views.render import ViewedRun


def export_run(
    store: Store,
    run: str,
    wanted: str,
    request: ViewRequest,
    out: Path,
    *,
    scene: SceneRequest | None = None,
) -> dict[str, Any]:
    """Write a run in one format, by its name, to a file or a new folder.

    The request says where to look from, for images, films and data sets; `scene` what a format that
    holds the scene takes of it: None takes all, at its beginning. A format of logs takes a scene's
    name too, with a run or without.

    Returns:
        What `export --json` prints.

    Raises:
        ConfigError: no such format, or what was recorded is asked of a run that was changed.
    """
    row = export_format(wanted)
    if row.kind == "log" and run in store.scene_ids():
        made = export_log(open_scene(store, run), row, request.frames, out)
        return {"run_id": None, "scene": run, "format": row.name, **made}
    finished = open_run(store, run)
    if row.holds_recorded and finished.change is not None:
        first = lineage(store, finished)[-1]
        raise ConfigError(
            f"--format {row.name} holds what was recorded, and run {finished.run_id} was changed "
            f"({finished.change['kind']}): export {first.derived_from or first.run_id}, "
            "which it was derived from"
        )
    if row.kind == "page" and (request.is_painted or request.beside is not None):
        raise ConfigError(
            "a browser shows the scene itself: --postpaint and --beside are not for it"
        )
    if row.kind == "log":
        made = export_log(open_scene(store, finished.scene_id), row, request.frames, out)
    else:
        made = _export(store, finished, row, request, scene or SceneRequest(), out)
    return {"run_id": finished.run_id, "scene": finished.scene_id, "format": row.name, **made}


def _export(
    store: Store,
    finished: FinishedRun,
    row: ExportFormat,
    request: ViewRequest,
    scene: SceneRequest,
    out: Path,
) -> dict[str, Any]:
    """Hand a format to the stage that writes its kind."""
    viewed = viewed_run(store, finished, request)
    match row.kind:
        case "scene":
            return export_scene(viewed.run, finished.final, row, scene, out)
        case "sweeps":
            return export_sweeps(viewed.run, row, request.frames, out)
        case "simulated":
            wanted = SweepRequest(
                trajectory=request.trajectory, frames=request.frames, file_format="parquet"
            )
            return sweeps_of_run(store, finished, wanted, out)
        case "dataset":
            return export_dataset(viewed, request, row, out)
        case "page":
            return write_page(viewed, request, out)
        case "bundle":
            return export_bundle(viewed.run, finished, envelope_of(store, finished), row, out)
        case _:
            return _export_views(viewed, row, request, out)


def _export_views(
    viewed: ViewedRun, row: ExportFormat, request: ViewRequest, out: Path
) -> dict[str, Any]:
    """Write images or a film of the kind that a format is named by."""
    kinds = ViewKinds(
        images=False,
        depth=row.name == "depth",
        semantics=row.name == "semantics",
        video=row.name == "video",
        fps=request.kinds.fps,
    )
    task = export_video if kinds.video else export_images
    return task(viewed, replace(request, kinds=kinds), out)
