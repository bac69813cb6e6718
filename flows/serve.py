"""Serve finished runs to driving simulators: from runs of the store to a server that answers."""

import csv
import threading
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from catalog.store import Store
from flows.lidar import learnt_channel
from flows.views import envelope_of, viewed_run
from lidarpainter_models.devices import chosen_device
from lidarpainter_models.errors import WriteError
from lidarpainter_models.export.view_requests import ViewRequest
from lidarpainter_models.geometry.trajectory_specs import parse_trajectory
from lidarpainter_models.geometry.trajectory_words import RECORDED
from lidarpainter_models.serving.http_routes import http_server
from lidarpainter_models.serving.render_queue import RenderQueue
from lidarpainter_models.serving.scene_pool import LoadedScene, ScenePool
from lidarpainter_models.serving.server import grpc_server
from lidarpainter_models.serving.servicer import SensorsimServicer, Told
from tasks.runs import FinishedRun, open_run
from tasks.serving.load import ServedAs, load_served

COLUMNS = (
    "scene",
    "camera",
    "start_us",
    "end_us",
    "x_m",
    "y_m",
    "z_m",
    "confidence",
    "predicted_db",
    "envelope_distance_m",
    "seconds",
    "refusal",
)


@dataclass(frozen=True, kw_only=True)
class ServeRequest:
    """What is served, and how."""

    runs: tuple[str, ...]
    """Ids of finished runs."""
    host: str = "127.0.0.1"
    port: int = 8080
    """Of gRPC."""
    http_port: int | None = None
    """Of NeuroNCAP's routes, which show the first run; None leaves them out."""
    how: ServedAs = field(default_factory=ServedAs)
    has_lidar: bool = False
    """Whether sweeps are answered; what the LiDAR of each log sees is learnt when it is loaded."""
    most_bytes: int = 4_000_000_000
    """Of scenes in memory."""
    most_waiting: int = 32
    limit_s: float = 60.0
    """Of one request."""
    refuse_below: float = 0.0
    """Images of less confidence are refused."""
    log: Path | None = None
    """Table of all images and how far each can be trusted."""
    allows_shut_down: bool = False


def serve_runs(
    store: Store,
    request: ServeRequest,
    *,
    opened_at: Callable[[str, str | None], None],
    stopped: threading.Event,
) -> None:
    """Serve until stopped; tells the addresses of gRPC and of HTTP when they are there.

    Raises:
        ConfigError: a port is in use, or a run cannot be painted.
        MissingPackageError: gRPC is not installed.
        WriteError: the log cannot be written.
    """
    finished = [open_run(store, run) for run in request.runs]
    pool = _pool(store, finished, request)
    queue = RenderQueue(request.most_waiting, request.limit_s)
    with ExitStack() as stack:
        tell = stack.enter_context(_log(request.log))
        servicer = SensorsimServicer(
            scenes=pool,
            queue=queue,
            refuse_below=request.refuse_below,
            tell=tell,
            shut_down_asked=stopped.set if request.allows_shut_down else None,
            config=_config(request),
            device=chosen_device(request.how.device),
            is_painted=request.how.is_painted,
        )
        address = None
        if request.http_port is not None:
            shown = partial(pool.get, pool.announced[0])
            port = stack.enter_context(
                http_server(shown, queue, host=request.host, port=request.http_port)
            )
            address = f"http://{request.host}:{port}"
        port = stack.enter_context(grpc_server(servicer, host=request.host, port=request.port))
        opened_at(f"{request.host}:{port}", address)
        stopped.wait()


def _pool(store: Store, finished: Sequence[FinishedRun], request: ServeRequest) -> ScenePool:
    """The runs by their ids, and by their scenes where only one of them shows it."""
    by_id = {run.run_id: run for run in finished}
    counts = Counter(run.scene_id for run in by_id.values())
    names = {run.run_id: run.run_id for run in by_id.values()}
    names |= {run.scene_id: run.run_id for run in by_id.values() if counts[run.scene_id] == 1}
    scenes = [name for name in names if name not in by_id]
    return ScenePool(
        runs=names,
        announced=(*scenes, *by_id),
        load=lambda run_id: _load(store, by_id[run_id], request),
        most_bytes=request.most_bytes,
    )


def learn_lidars(store: Store, runs: Sequence[str]) -> None:
    """Learn what the first LiDAR of each run's log sees, where that is not known yet.

    Raises:
        SceneError: a scene has no LiDAR.
    """
    for run in runs:
        learnt_channel(store, open_run(store, run))


def _load(store: Store, run: FinishedRun, request: ServeRequest) -> LoadedScene:
    viewed = viewed_run(
        store,
        run,
        ViewRequest(
            trajectory=parse_trajectory(RECORDED),
            is_painted=request.how.is_painted,
            painter=request.how.painter,
        ),
    )
    return load_served(
        viewed,
        envelope_of(store, run),
        request.how,
        lidar=learnt_channel(store, run) if request.has_lidar else None,
        name=run.run_id,
    )


def _config(request: ServeRequest) -> dict[str, str]:
    return {
        "confidence": str(request.how.is_measured).lower(),
        "painted": str(request.how.is_painted).lower(),
        "parked_apart": str(request.how.is_parked_apart).lower(),
        "placeholders": str(request.how.has_placeholders).lower(),
        "memory_bytes": str(request.most_bytes),
        "queue": str(request.most_waiting),
        "time_limit_s": f"{request.limit_s:g}",
        "refuse_below": f"{request.refuse_below:g}",
        "smaller_resolution": "scales",
        "world": "x forward, y left, z up at the first pose of the recording; metres",
    }


@contextmanager
def _log(path: Path | None) -> Iterator[Callable[[Told], None]]:
    """What writes a row for every image; nothing without a path."""
    if path is None:
        yield lambda _told: None
        return
    try:
        file = path.open("w", encoding="utf-8", newline="", buffering=1)
    except OSError as error:
        raise WriteError(f"{path}: {error.strerror}") from None
    lock = threading.Lock()
    with file:
        table = csv.writer(file)
        table.writerow(COLUMNS)

        def tell(told: Told) -> None:
            with lock:
                if not file.closed:
                    table.writerow(_row(told))

        yield tell


def _row(told: Told) -> list[object]:
    request = told.request
    asked: list[object] = [""] * 7
    if request is not None:
        place = request.world_from_middle[:3, 3].tolist()
        asked = [request.scene_id, request.camera_name, request.start_us, request.end_us, *place]
    return [*asked, *told.trust.words(), f"{told.seconds:.4f}", told.refusal or ""]
