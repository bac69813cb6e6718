"""Write LiDAR sweeps: those that a run's scene has recorded, or that a LiDAR would take in it."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from catalog.artefacts import ArtefactRef
from lidarpainter_models.errors import SceneError
from lidarpainter_models.export.formats import ExportFormat
from lidarpainter_models.export.lidar_files import WrittenSweep, write_sweep
from lidarpainter_models.export.simulated_sweeps import SweepRequest, simulated_sweeps
from tasks.exports.places import STAGE, new_folder
from tasks.json_files import write_json
from tasks.lidar.channel import corrected_scene, lidar_of, load_channel, mounted
from tasks.opened import opened
from tasks.progress import listener
from tasks.specs import FittedRef, RunSpec
from tasks.stored import load_scene

RENDER = "render"
"""The stage of sweeps that nobody recorded."""
INDEX_FILE = "sweeps.json"
FILE_FORMATS = {"lidar": "pcd", "lidar-bin": "pcd.bin"}
"""Files of the sweeps, by the format of the export."""


def export_sweeps(
    run: RunSpec, row: ExportFormat, frames: slice | None, out: Path
) -> dict[str, Any]:
    """Write a file for every recorded sweep, as `render_sweeps` does for simulated ones.

    Raises:
        SceneError: no sweep is left.
        ConfigError: something is there already.
        WriteError: the disk refuses; nothing is left half-written.
    """
    scene = opened(run).scene
    wanted = set(scene.frame_indices[frames or slice(None)])
    sweeps = [sweep for sweep in scene.sweeps if sweep.frame_index in wanted]
    if not sweeps:
        raise SceneError(f"{scene.path.name}: no LiDAR sweep is left to export")
    made = (WrittenSweep(sweep=sweep, points=scene.read_sweep(sweep)) for sweep in sweeps)
    return _write_sweeps(
        made, out, stage=STAGE, total=len(sweeps), file_format=FILE_FORMATS[row.name]
    )


def render_sweeps(
    run: RunSpec, fitted: FittedRef, channel: ArtefactRef, request: SweepRequest, out: Path
) -> dict[str, Any]:
    """Write a file for every simulated sweep, and `sweeps.json` with when and where it is taken.

    Raises:
        SceneError: no sweep is left.
        ConfigError: something is there already, or the trajectory leads too far.
        WriteError: the disk refuses; nothing is left half-written.
    """
    this = opened(run)
    scene = load_scene(this.store, fitted.gaussians)
    lidar = mounted(this, scene, lidar_of(this.scene, request.lidar_name))
    sensor = request.sensor or lidar.sensor
    log = corrected_scene(this, scene)
    returns = load_channel(this.store, channel)
    made = _write_sweeps(
        simulated_sweeps(request, log, scene, returns, lidar),
        out,
        stage=RENDER,
        total=len(log.frame_indices[request.frames or slice(None)]),
        file_format=request.file_format,
        about={"simulated": True, "sensor": sensor.to_record()},
    )
    return {"sensor": sensor.name, **made}


def _write_sweeps(
    made: Iterable[WrittenSweep],
    out: Path,
    *,
    stage: str,
    total: int,
    file_format: str,
    about: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Write a file for every sweep, and `sweeps.json` with when and where it was taken.

    `about` is what that file says of all of them; `stage` and `total` are what listeners are told.
    """
    listener().started(stage)
    rows: list[dict[str, Any]] = []
    with new_folder(out) as folder:
        for done, written in enumerate(made, start=1):
            sweep = written.sweep
            name = f"{sweep.lidar_name}/{sweep.frame_index:04d}.{file_format}"
            write_sweep(folder / name, written, file_format)
            rows.append(
                {
                    "file": name,
                    "lidar": sweep.lidar_name,
                    "frame_index": sweep.frame_index,
                    "timestamp_ns": sweep.timestamp_ns,
                    "world_from_lidar": sweep.world_from_lidar.reshape(-1).tolist(),
                    "num_points": sweep.num_points,
                }
            )
            listener().advanced(stage, done, total, "")
        write_json(folder / INDEX_FILE, {**(about or {}), "sweeps": rows})
    num_points = sum(row["num_points"] for row in rows)
    return {"path": str(out), "num_sweeps": len(rows), "num_points": num_points}
