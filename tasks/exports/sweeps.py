"""Write the recorded LiDAR sweeps of a run's scene."""

from pathlib import Path
from typing import Any

from lidarpainter_models.errors import SceneError
from lidarpainter_models.export.formats import ExportFormat
from lidarpainter_models.scenes.records import Sweep
from tasks.exports.places import new_folder
from tasks.json_files import write_json
from tasks.opened import opened
from tasks.progress import listener
from tasks.specs import RunSpec

STAGE = "export"
INDEX_FILE = "sweeps.json"
ENDINGS = {"lidar": ".pcd", "lidar-bin": ".pcd.bin"}
"""How the file of a sweep ends."""


def export_sweeps(
    run: RunSpec, row: ExportFormat, frames: slice | None, out: Path
) -> dict[str, Any]:
    """Write a file for every sweep, and `sweeps.json` with when and where it was taken.

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
    write, ending = row.load_writer(), ENDINGS[row.name]
    listener().started(STAGE)
    rows = []
    with new_folder(out) as folder:
        for done, sweep in enumerate(sweeps, start=1):
            name = f"{sweep.lidar_name}/{sweep.frame_index:04d}{ending}"
            write(folder / name, sweep, scene.read_sweep(sweep))
            rows.append(sweep_record(name, sweep))
            listener().advanced(STAGE, done, len(sweeps), "")
        write_json(folder / INDEX_FILE, {"sweeps": rows})
    num_points = sum(sweep.num_points for sweep in sweeps)
    return {"path": str(out), "num_sweeps": len(sweeps), "num_points": num_points}


def sweep_record(name: str, sweep: Sweep) -> dict[str, Any]:
    """What the list of sweeps says of one: its file, when it was taken and where."""
    return {
        "file": name,
        "lidar": sweep.lidar_name,
        "frame_index": sweep.frame_index,
        "timestamp_ns": sweep.timestamp_ns,
        "world_from_lidar": sweep.world_from_lidar.reshape(-1).tolist(),
        "num_points": sweep.num_points,
    }
