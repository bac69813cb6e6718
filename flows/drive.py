"""Drive a policy through a finished run, its cameras asked for over gRPC as a simulator does."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from catalog.store import Store
from flows.serve import ServeRequest, serve_runs
from flows.views import envelope_of, viewed_run
from lidarpainter_models.errors import ConfigError, LidarPainterError
from lidarpainter_models.export.videos import video_file
from lidarpainter_models.export.view_requests import ViewRequest
from lidarpainter_models.geometry.trajectory_specs import parse_trajectory
from lidarpainter_models.geometry.trajectory_words import RECORDED
from lidarpainter_models.scenes.driving_scene import driven_road
from lidarpainter_models.serving.closed_loop import STEP_S, ClosedLoop, Moment, num_moments
from lidarpainter_models.serving.drive_film import film_image, shown_cameras
from lidarpainter_models.serving.policies import policy_named
from lidarpainter_models.serving.sensor_client import CALL_S, connected
from tasks.exports.simulator import driven_street
from tasks.progress import listener
from tasks.runs import FinishedRun, open_run

STAGE = "drive"
FILM_FILE = "drive.mp4"
LEAST_S = 2 * STEP_S
START_S = 60.0
"""How long a server of one's own may take to be there."""


@dataclass(frozen=True, kw_only=True)
class DriveRequest:
    """Who drives, how long, and who renders."""

    policy: str
    """Name of a built-in policy, or path of a Python file."""
    against: str | None = None
    """HOST:PORT of a renderer; None starts a server of one's own."""
    start_s: float = 0.0
    """When the drive begins, since the first image of the log."""
    seconds: float | None = None
    """None drives until the log ends."""
    lane_change_m: float = 0.0
    width_px: int = 480
    """Of the images that are asked for."""


def drive_run(store: Store, run: str, request: DriveRequest, out: Path) -> dict[str, Any]:
    """Drive, and write a film into a folder.

    Returns:
        What `drive --json` prints.

    Raises:
        ConfigError: no such policy, one that fails, or longer than the log.
        DataError: the renderer is not there or refuses.
        SceneError: the log does not show the ground.
    """
    policy, finished = policy_named(request.policy), open_run(store, run)
    listener().started(STAGE)
    viewed = viewed_run(store, finished, ViewRequest(trajectory=parse_trajectory(RECORDED)))
    street = driven_street(viewed.run, finished.final, envelope_of(store, finished))
    loop = ClosedLoop(
        surroundings=street.surroundings,
        path=driven_road(street.recorded),
        moving=street.scene.actors.recorded_tracks,
        parked=[track for track in street.recorded.tracks if not track.is_moving],
        lane_change_m=request.lane_change_m,
    )
    times_ns = [view.timestamp_ns for view in street.recorded.views]
    start_ns = max(int(loop.path.timestamps_ns[0]), min(times_ns)) + round(request.start_s * 1e9)
    end_ns = max(times_ns)
    seconds = _seconds(request, (end_ns - start_ns) * 1e-9)
    moments: list[Moment] = []
    with (
        _renderer(store, finished, request) as address,
        connected(
            address, (finished.run_id, finished.scene_id), width_px=request.width_px
        ) as client,
        video_file(out / FILM_FILE, 1 / STEP_S) as film,
    ):
        names, shown = tuple(client.cameras), shown_cameras(client.rig_from_camera)
        driven = loop.drive(
            policy,
            lambda rig, time_us, actors: client.frames(names, rig, time_us, actors),
            start_ns=start_ns,
            seconds=seconds,
        )
        for moment in driven:
            film.add(film_image(moment, shown))
            moments.append(replace(moment, frames=_without_images(moment)))
            listener().advanced(STAGE, len(moments), num_moments(seconds), "")
    return {
        "run_id": finished.run_id,
        "scene": finished.scene_id,
        "policy": request.policy,
        "renderer": request.against or "own server",
        "cameras": ", ".join(names),
        **loop.judged(moments),
        "lanes_assumed": bool(street.surroundings.road.lane.assumed),
        "film": str(out / FILM_FILE),
    }


def _seconds(request: DriveRequest, longest_s: float) -> float:
    """How long is driven."""
    if longest_s < LEAST_S:
        raise ConfigError(
            f"--start {request.start_s:g}: expected {LEAST_S:g} s before the log ends"
        )
    if request.seconds is None:
        return STEP_S * int(longest_s / STEP_S + 1e-6)
    if not LEAST_S <= request.seconds <= longest_s + 1e-6:
        raise ConfigError(
            f"--seconds {request.seconds:g}: expected {LEAST_S:g} to {longest_s:.1f}, as long as "
            "the log is"
        )
    return request.seconds


@contextmanager
def _renderer(store: Store, finished: FinishedRun, request: DriveRequest) -> Iterator[str]:
    """The address of a renderer: one that is there, or a server in a thread of its own."""
    if request.against is not None:
        yield request.against
        return
    stopped, is_there = threading.Event(), threading.Event()
    found: list[str] = []
    failed: list[LidarPainterError] = []

    def opened_at(address: str, _http: str | None) -> None:
        found.append(address)
        is_there.set()

    def serve() -> None:
        served = ServeRequest(runs=(finished.run_id,), port=0, limit_s=CALL_S)
        try:
            serve_runs(store, served, opened_at=opened_at, stopped=stopped)
        except LidarPainterError as error:
            failed.append(error)
        finally:
            is_there.set()

    thread = threading.Thread(target=serve, name="renderer", daemon=True)
    thread.start()
    try:
        is_there.wait(START_S)
        if failed:
            raise failed[0]
        if not found:
            raise ConfigError(f"the server is not there after {START_S:g} s")
        yield found[0]
    finally:
        stopped.set()
        thread.join(START_S)


def _without_images(moment: Moment) -> dict[str, Any]:
    """How far the frames of a moment can be trusted; a drive's images do not fit into memory."""
    return {name: replace(frame, rgb_u8=frame.rgb_u8[:0]) for name, frame in moment.frames.items()}
