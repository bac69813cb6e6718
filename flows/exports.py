"""Write a finished run in the formats of other programs; queries without a server."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, get_args

from catalog.store import Store
from flows.browsing import drive_request
from flows.parameters import view_parameters
from flows.views import PathRequest, render_request
from lidarpainter_models.errors import ConfigError
from lidarpainter_models.geometry.trajectory_specs import parse_trajectory
from lidarpainter_models.geometry.trajectory_words import RECORDED
from tasks.exports.dataset import DatasetFormat, DatasetRequest, export_dataset
from tasks.exports.scene import SceneFormat, SceneRequest, export_scene
from tasks.exports.sweeps import SweepFormat, export_sweeps
from tasks.exports.views import export_images, export_video
from tasks.opened import open_scene
from tasks.runs import FinishedRun, lineage, open_run
from tasks.specs import RunSpec
from tasks.views.drive import write_page
from tasks.views.files import ViewKinds

SCENE_FORMATS: tuple[SceneFormat, ...] = get_args(SceneFormat)
DATASET_FORMATS: tuple[DatasetFormat, ...] = get_args(DatasetFormat)
SWEEP_FORMATS: tuple[SweepFormat, ...] = get_args(SweepFormat)
VIEW_FORMATS = ("video", "depth", "semantics")
PAGE_FORMAT = "page"
FORMATS = (*SCENE_FORMATS, *DATASET_FORMATS, *VIEW_FORMATS, PAGE_FORMAT, *SWEEP_FORMATS)


@dataclass(frozen=True, kw_only=True)
class ExportRequest:
    """What of a run is written; formats read what concerns them."""

    format: str
    """One of `FORMATS`."""
    scene: SceneRequest | None
    """Of the formats that hold a scene, else None."""
    path: PathRequest
    """Which run; for images, films and data sets also where to look from."""
    fps: float | None
    """Of a film; None takes the recording's."""


def export_request(
    wanted: str, scene: Mapping[str, Any], path: PathRequest, fps: float | None
) -> ExportRequest:
    """Put a request together.

    `scene` holds the fields of a `SceneRequest` that were asked for, but its format.

    Raises:
        ConfigError: no such format or version, or an option that the format has no use for.
    """
    if wanted not in FORMATS:
        raise ConfigError(f"no format {wanted!r}, expected one of {', '.join(FORMATS)}")
    is_scene = wanted in SCENE_FORMATS
    fields: dict[str, Any] = {**scene, "format": wanted if is_scene else SCENE_FORMATS[0]}
    asked = SceneRequest(**fields)
    given = _given(asked, path, fps)
    if unused := [name for name in given if name not in _options_of(wanted)]:
        raise ConfigError(f"{unused[0]} has no use for --format {wanted}")
    return ExportRequest(format=wanted, scene=asked if is_scene else None, path=path, fps=fps)


def _given(scene: SceneRequest, path: PathRequest, fps: float | None) -> list[str]:
    """The options that say something else than nothing."""
    said = {
        "--time": scene.time_s > 0 or scene.frame is not None,
        "--actors": scene.actors is not None,
        "--per-actor": scene.is_per_actor,
        "--sky": scene.with_sky,
        "--spz-version": scene.spz_version != SceneRequest.spz_version,
        "--trajectory": not path.trajectory.is_recorded,
        "--camera": path.camera is not None,
        "--frames": path.frames is not None,
        "--width": path.width_px is not None,
        "--postpaint": path.is_painted,
        "--fps": fps is not None,
        "--beside": path.beside is not None,
    }
    return [name for name, is_given in said.items() if is_given]


def _options_of(wanted: str) -> tuple[str, ...]:
    """The options that a format reads."""
    if wanted in SCENE_FORMATS:
        own = {"ply": "--per-actor", "spz": "--spz-version"}.get(wanted, "")
        return ("--time", "--actors", "--sky", own)
    if wanted in SWEEP_FORMATS:
        return ("--frames",)
    views = ("--trajectory", "--camera", "--frames", "--width")
    if wanted in DATASET_FORMATS:
        return (*views, "--postpaint")
    if wanted == PAGE_FORMAT:
        return (*views, "--postpaint", "--beside")  # refused with a reason of its own
    return (*views, "--postpaint", "--fps", "--beside") if wanted == "video" else views


def export_run(store: Store, request: ExportRequest, out: Path) -> dict[str, Any]:
    """Write a run in one format.

    Raises:
        ConfigError: see `export_request`, or what was recorded is asked of a run that was changed.
    """
    finished = open_run(store, request.path.run)
    if request.format in (*DATASET_FORMATS, *SWEEP_FORMATS):
        _refuse_changed(store, finished, request.format)
    run = view_parameters(finished).run_spec(store.address, painter=request.path.painter)
    made = _export(store, request, finished, run, out)
    return {
        "run_id": finished.run_id,
        "scene": finished.scene_id,
        "format": request.format,
        **made,
    }


def _refuse_changed(store: Store, finished: FinishedRun, wanted: str) -> None:
    """Refuse what was recorded where the run shows something else."""
    if finished.change is not None:
        first = lineage(store, finished)[-1]
        raise ConfigError(
            f"--format {wanted} holds what was recorded, and run {finished.run_id} was changed "
            f"({finished.change['kind']}): export {first.derived_from or first.run_id}, "
            "which it was derived from"
        )


def _export(
    store: Store, request: ExportRequest, finished: FinishedRun, run: RunSpec, out: Path
) -> dict[str, Any]:
    if request.format == PAGE_FORMAT:
        return write_page.fn(run, drive_request(store, finished, request.path), out)
    if request.scene is not None:
        return export_scene.fn(run, finished.final, request.scene, out)
    for sweep_format in SWEEP_FORMATS:
        if request.format == sweep_format:
            return export_sweeps.fn(run, sweep_format, request.path.frames, out)
    for dataset_format in DATASET_FORMATS:
        if request.format == dataset_format:
            wanted = _dataset_request(store, request, finished, dataset_format)
            return export_dataset.fn(run, finished.final, wanted, out)
    kinds = ViewKinds(
        images=False,
        depth=request.format == "depth",
        semantics=request.format == "semantics",
        video=request.format == "video",
        fps=request.fps,
    )
    view = render_request(store, finished, request.path, kinds)
    task = export_video if kinds.video else export_images
    return task.fn(run, finished.final, view, out)


def _dataset_request(
    store: Store, request: ExportRequest, finished: FinishedRun, dataset_format: DatasetFormat
) -> DatasetRequest:
    """Recorded images at their own width, views beside at that of the fit, unless one is given."""
    path = request.path
    recorded = replace(path, trajectory=parse_trajectory(RECORDED), is_painted=False, painter=None)
    if path.width_px is None:
        recorded = replace(recorded, width_px=_widest_px(store, finished))
    beside = None
    if not path.trajectory.is_recorded or path.is_painted:
        beside = render_request(store, finished, path, ViewKinds())
    return DatasetRequest(
        format=dataset_format,
        recorded=render_request(store, finished, recorded, ViewKinds()),
        beside=beside,
    )


def _widest_px(store: Store, finished: FinishedRun) -> int:
    """Of the images that the scene's cameras recorded."""
    return max(view.camera.width_px for view in open_scene(store, finished.scene_id).views)
