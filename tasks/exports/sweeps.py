"""Write LiDAR sweeps: those that a run's scene has recorded, or any others."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from lidarpainter_models.errors import SceneError
from lidarpainter_models.export.formats import ExportFormat
from lidarpainter_models.export.lidar_files import WrittenSweep, write_sweep
from tasks.exports.places import new_folder
from tasks.json_files import write_json
from tasks.opened import opened
from tasks.progress import listener
from tasks.specs import RunSpec

STAGE = "export"
INDEX_FILE = "sweeps.json"
FILE_FORMATS = {"lidar": "pcd", "lidar-bin": "pcd.bin"}
"""Files of the sweeps, by the format of the export."""


def export_sweeps(
    run: RunSpec, row: ExportFormat, frames: slice | None, out: Path
) -> dict[str, Any]:
    """Write the recorded sweeps of a run's scene, see `write_sweeps`.

    Raises:
        SceneError: no sweep is left.
    """
    scene = opened(run).scene
    wanted = set(scene.frame_indices[frames or slice(None)])
    sweeps = [sweep for sweep in scene.sweeps if sweep.frame_index in wanted]
    if not sweeps:
        raise SceneError(f"{scene.path.name}: no LiDAR sweep is left to export")
    made = (WrittenSweep(sweep=sweep, points=scene.read_sweep(sweep)) for sweep in sweeps)
    return write_sweeps(
        made, out, stage=STAGE, total=len(sweeps), file_format=FILE_FORMATS[row.name]
    )


def write_sweeps(
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

    Raises:
        ConfigError: something is there already.
        WriteError: the disk refuses; nothing is left half-written.
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
