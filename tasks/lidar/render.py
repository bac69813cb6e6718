"""Write the sweeps that a LiDAR would take in a finished run."""

from pathlib import Path
from typing import Any

from catalog.artefacts import ArtefactRef
from lidarpainter_models.export.simulated_sweeps import SweepRequest, simulated_sweeps
from tasks.exports.sweeps import write_sweeps
from tasks.lidar.channel import corrected_scene, lidar_of, load_channel, mounted
from tasks.opened import opened
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
    returns = load_channel(this.store, channel)
    made = write_sweeps(
        simulated_sweeps(request, log, scene, returns, lidar),
        out,
        stage=STAGE,
        total=len(log.frame_indices[request.frames or slice(None)]),
        file_format=request.file_format,
        about={"simulated": True, "sensor": sensor.to_record()},
    )
    return {"sensor": sensor.name, **made}
