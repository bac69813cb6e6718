"""What a LiDAR would measure in a finished run: judged, or written; without a server."""

import json
import math
from pathlib import Path
from typing import Any

from catalog.artefacts import ArtefactRef
from catalog.store import Store
from flows.parameters import view_parameters
from lidarpainter_models.evaluation.score_tables import LIDAR
from lidarpainter_models.export.simulated_sweeps import SweepRequest
from lidarpainter_models.gaussians.lidar_returns.settings import LidarConfig
from lidarpainter_models.lidar.firings import mounted_lidar
from lidarpainter_models.lidar.sensors import PRESETS, LidarSensor
from lidarpainter_models.storage.whole_files import write_whole
from tasks.evaluation.views import load_scores
from tasks.exports.sweeps import render_sweeps
from tasks.lidar.channel import learn_lidar, lidar_of
from tasks.lidar.evaluate import evaluate_lidar
from tasks.opened import open_scene
from tasks.reconstruction.publish import record_scores
from tasks.runs import FinishedRun, lineage, open_run


def learnt_channel(
    store: Store, finished: FinishedRun, lidar_name: str | None = None
) -> ArtefactRef:
    """The channel of a LiDAR of a run, of the first one unless named, learnt unless it is there.

    A run that was changed from another one has that one's: what was recorded is of it.

    Raises:
        SceneError: the scene has no such LiDAR.
    """
    run = view_parameters(finished).run_spec(store.address)
    first = lineage(store, finished)[-1]
    return learn_lidar.fn(run, first.final, LidarConfig(), lidar_name).ref


def sweeps_of_run(
    store: Store, finished: FinishedRun, request: SweepRequest, out: Path
) -> dict[str, Any]:
    """Write the sweeps that a LiDAR would take in a finished run, into a new folder.

    Returns:
        What `render --lidar --json` prints.

    Raises:
        ConfigError: the trajectory leads too far, or something is there already.
        SceneError: the scene has no LiDAR to learn from, or no sweep is left.
    """
    spec = view_parameters(finished).run_spec(store.address)
    channel = learnt_channel(store, finished, request.lidar_name)
    made = render_sweeps(spec, finished.final, channel, request, out)
    return {
        "run_id": finished.run_id,
        "scene": finished.scene_id,
        "trajectory": request.trajectory.spec,
        **made,
    }


def evaluate_lidar_run(store: Store, run: str) -> dict[str, Any]:
    """Judge the simulated sweeps of a finished run, and enter every number into the catalog.

    Returns:
        `run_id`, `scene`, `protocol` and `lidar`: the figures by protocol.

    Raises:
        UnknownRecordError: there is no such run, or it did not complete.
        ConfigError: no sweep was held out.
    """
    finished = open_run(store, run)
    spec = view_parameters(finished).run_spec(store.address)
    made = evaluate_lidar.fn(spec, finished.final, learnt_channel(store, finished))
    found = load_scores(store, made.ref)
    record_scores(store, finished.run_id, finished.scene_id, {LIDAR: found})
    return {
        "run_id": finished.run_id,
        "scene": finished.scene_id,
        "protocol": LIDAR,
        LIDAR: found[LIDAR],
    }


def sensor_of_scene(
    store: Store, scene_id: str, lidar_name: str | None, out: Path | None
) -> dict[str, Any]:
    """Estimate the sensor of a scene's LiDAR from its sweeps; nothing is taken from a data sheet.

    Returns:
        `sensor` (its name), `num_beams`, `elevation_deg` from the highest beam to the lowest,
        `steps`, `turn_s`, `lean_deg`, `tells_lost`, and `nearest_preset` with the largest
        difference of its elevations where one has as many beams.

    Raises:
        SceneError: there is no such scene or LiDAR, or its sweeps do not tell its beams.
        WriteError: the disk refuses.
    """
    scene = open_scene(store, scene_id)
    lidar = mounted_lidar(scene, lidar_of(scene, lidar_name), knows_sheets=False)
    sensor = lidar.sensor
    if out is not None:
        write_whole(out, (json.dumps(sensor.to_record(), indent=1) + "\n").encode("utf-8"))
    up = lidar.lidar_from_sensor[:3, 2]
    return {
        "sensor": sensor.name,
        "num_beams": sensor.num_beams,
        "elevation_deg": list(sensor.elevation_deg),
        "steps": sensor.steps,
        "turn_s": sensor.turn_s,
        "lean_deg": [round(math.degrees(math.asin(float(one))), 3) for one in up[:2]],
        "tells_lost": lidar.tells_lost,
        **_nearest_preset(sensor),
        **({} if out is None else {"path": str(out)}),
    }


def _nearest_preset(sensor: LidarSensor) -> dict[str, Any]:
    """The preset of as many beams whose elevations differ least, and by how much at most."""
    apart = {
        name: max(
            abs(one - other)
            for one, other in zip(sensor.elevation_deg, known.elevation_deg, strict=True)
        )
        for name, known in PRESETS.items()
        if known.num_beams == sensor.num_beams
    }
    if not apart:
        return {"nearest_preset": None}
    name = min(apart, key=lambda one: apart[one])
    return {"nearest_preset": name, "most_apart_deg": round(apart[name], 3)}
