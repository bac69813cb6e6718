"""Write the sweeps that a LiDAR would take in a finished run."""

from pathlib import Path
from typing import Any

from catalog.artefacts import ArtefactRef
from lidarpainter_models.export.formats import SWEEP_ENDINGS
from lidarpainter_models.export.simulated_sweeps import SweepRequest, simulated_sweeps, write_sweep
from tasks.exports.places import new_folder
from tasks.exports.sweeps import INDEX_FILE, sweep_record
from tasks.json_files import write_json
from tasks.lidar.channel import corrected_scene, lidar_of, load_channel, mounted
from tasks.opened import opened
from tasks.progress import listener
from tasks.specs import FittedRef, RunSpec
from tasks.stored import load_scene

STAGE = "render"


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
    made = simulated_sweeps(request, log, scene, load_channel(this.store, channel), lidar)
    total = len(log.frame_indices[request.frames or slice(None)])
    listener().started(STAGE)
    rows = []
    with new_folder(out) as folder:
        for done, written in enumerate(made, start=1):
            ending = SWEEP_ENDINGS[request.file_format]
            name = f"{sensor.name}/{written.sweep.frame_index:04d}{ending}"
            write_sweep(folder / name, written, request.file_format)
            rows.append(sweep_record(name, written.sweep))
            listener().advanced(STAGE, done, total, "")
        about = {"simulated": True, "sensor": sensor.to_record(), "sweeps": rows}
        write_json(folder / INDEX_FILE, about)
    return {
        "path": str(out),
        "sensor": sensor.name,
        "num_sweeps": len(rows),
        "num_points": sum(row["num_points"] for row in rows),
    }
