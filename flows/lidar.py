"""What a LiDAR would measure in a finished run: judged, or written; without a server."""

from pathlib import Path
from typing import Any

from catalog.artefacts import ArtefactRef
from catalog.store import Store
from flows.parameters import view_parameters
from lidarpainter_models.evaluation.score_tables import LIDAR
from lidarpainter_models.export.simulated_sweeps import SweepRequest
from lidarpainter_models.gaussians.returns.settings import LidarConfig
from tasks.evaluation.views import load_scores
from tasks.lidar.channel import learn_lidar
from tasks.lidar.evaluate import evaluate_lidar
from tasks.lidar.render import render_sweeps
from tasks.reconstruction.publish import record_scores
from tasks.runs import FinishedRun, lineage, open_run
from tasks.specs import RunSpec


def learnt_channel(
    store: Store, finished: FinishedRun, run: RunSpec, lidar_name: str | None
) -> ArtefactRef:
    """The LiDAR channel of a run, learnt unless it is there.

    A run that was changed from another one has that one's: what was recorded is of it.
    """
    first = lineage(store, finished)[-1]
    return learn_lidar.fn(run, first.final, LidarConfig(), lidar_name).ref


def render_lidar_run(store: Store, run: str, request: SweepRequest, out: Path) -> dict[str, Any]:
    """Write the sweeps that a LiDAR would take in a finished run, into a new folder.

    Returns:
        What `render --lidar --json` prints.

    Raises:
        UnknownRecordError: there is no such run, or it did not complete.
        ConfigError: the trajectory leads too far, or something is there already.
        SceneError: the scene has no LiDAR to learn from, or no sweep is left.
    """
    return sweeps_of_run(store, open_run(store, run), request, out)


def sweeps_of_run(
    store: Store, finished: FinishedRun, request: SweepRequest, out: Path
) -> dict[str, Any]:
    """The same of a run that is open."""
    spec = view_parameters(finished).run_spec(store.address)
    channel = learnt_channel(store, finished, spec, request.lidar_name)
    made = render_sweeps(spec, finished.final, channel, request, out)
    return {
        "run_id": finished.run_id,
        "scene": finished.scene_id,
        "trajectory": request.trajectory.spec,
        **made,
    }


def evaluate_lidar_run(store: Store, run: str, *, lidar_name: str | None = None) -> dict[str, Any]:
    """Judge the simulated sweeps of a finished run, and enter every number into the catalog.

    Returns:
        `run_id`, `scene`, `protocol` and `lidar`: the figures by protocol.

    Raises:
        UnknownRecordError: there is no such run, or it did not complete.
        ConfigError: no sweep was held out.
    """
    finished = open_run(store, run)
    spec = view_parameters(finished).run_spec(store.address)
    channel = learnt_channel(store, finished, spec, lidar_name)
    made = evaluate_lidar.fn(spec, finished.final, channel, lidar_name)
    found = load_scores(store, made.ref)
    record_scores(store, finished.run_id, finished.scene_id, {LIDAR: found})
    return {
        "run_id": finished.run_id,
        "scene": finished.scene_id,
        "protocol": LIDAR,
        LIDAR: found[LIDAR],
    }
