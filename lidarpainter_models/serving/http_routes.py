"""NeuroNCAP's closed loop over HTTP, as neurad-studio answers it.

Camera poses are OpenCV's (x right, y down, z forward), actor poses the centres of boxes; times are
microseconds. Nothing rolls. Actors stand where the client last put them; those that it left out are
gone. The routes know one scene, which is loaded when it is first asked for.
"""

import base64
import io
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Annotated, Any, Literal

import torch
from pydantic import BaseModel, Field
from torch import Tensor

from lidarpainter_models.errors import LidarPainterError
from lidarpainter_models.geometry.transforms import interpolate_rigid_track, is_rigid
from lidarpainter_models.serving.image_formats import Encoding, encoded
from lidarpainter_models.serving.lens_models import SensorCamera
from lidarpainter_models.serving.messages import SensorRequest
from lidarpainter_models.serving.refusals import RequestError, invalid
from lidarpainter_models.serving.render_queue import RenderQueue
from lidarpainter_models.serving.renderer import Frame, ServedScene
from lidarpainter_models.serving.trust import metadata
from lidarpainter_models.serving.wire import listening

if TYPE_CHECKING:
    from fastapi import FastAPI

END_S = 1.0
"""How long the server may take to end."""
MOST_ACTORS, MOST_POSES = 1000, 10_000
STATUS = {"NOT_FOUND": 404, "OUT_OF_RANGE": 416, "RESOURCE_EXHAUSTED": 429, "UNAVAILABLE": 503}
"""HTTP's for codes of refusals; 422 for all others."""
Matrix = Annotated[
    list[Annotated[list[float], Field(min_length=4, max_length=4)]],
    Field(min_length=4, max_length=4),
]


class ActorMessage(BaseModel):
    """One actor's poses at times."""

    uuid: str
    poses: Annotated[list[Matrix], Field(max_length=MOST_POSES)]
    timestamps: Annotated[list[int], Field(max_length=MOST_POSES)]
    dims: Annotated[list[float], Field(max_length=3)] = []


class ScaleMessage(BaseModel):
    """How much larger than recorded an actor is drawn."""

    uuid: str
    scale: Annotated[float, Field(gt=0.05, lt=20)]


class ImageMessage(BaseModel):
    """One image that is asked for."""

    pose: Matrix
    timestamp: Annotated[int, Field(ge=0, lt=2**53)]
    camera_name: str
    image_format: Literal["raw", "png", "jpg", "jpeg"] = "raw"


@dataclass(eq=False, kw_only=True)
class HttpScene:
    """The scene of the routes, and where its actors are by now."""

    scene: Callable[[], ServedScene]
    queue: RenderQueue
    _scales: dict[str, float] = field(default_factory=dict, init=False)
    _lock: threading.RLock = field(default_factory=threading.RLock, init=False)

    @property
    def served(self) -> ServedScene:
        """The scene, with its actors as large as the client has them."""
        with self._lock:
            return self._served

    @cached_property
    def _served(self) -> ServedScene:
        return self.scene()

    @cached_property
    def _actors(self) -> dict[str, tuple[Tensor, Tensor]]:
        """Times (microseconds) and poses by id; at first as recorded."""
        tracks = self.served.scene.tracks
        return {one.actor_id: (one.timestamps_ns // 1000, one.world_from_box) for one in tracks}

    def start_us(self) -> int:
        """When the recording begins."""
        return int(self.served.recorded.frame_timestamps_ns[0]) // 1000

    def actors(self) -> list[dict[str, Any]]:
        """Where actors are, as the client asks for it."""
        sizes = {track.actor_id: track.size_m.tolist() for track in self.served.scene.tracks}
        with self._lock:
            return [
                {
                    "uuid": name,
                    "poses": poses.tolist(),
                    "timestamps": times_us.tolist(),
                    "dims": sizes[name],
                }
                for name, (times_us, poses) in self._actors.items()
            ]

    def update(self, actors: list[ActorMessage]) -> None:
        """Put the actors where the client has them.

        Raises:
            RequestError: INVALID_ARGUMENT: a stranger, or poses that are none.
        """
        for actor in actors:
            self._body_of(actor.uuid)
        found = {actor.uuid: _track_of(actor) for actor in actors}
        with self._lock:
            self._actors = found

    def scale(self, message: ScaleMessage) -> None:
        """Draw an actor larger or smaller than it was recorded.

        Raises:
            RequestError: INVALID_ARGUMENT: the scene has no such actor.
        """
        body = self._body_of(message.uuid)
        with self._lock:
            scene = self.served.scene
            change = message.scale / self._scales.get(message.uuid, 1.0)
            self._scales[message.uuid] = message.scale
            factor = torch.where(scene.gaussians.body_index == body, change, 1.0)[:, None]
            larger = replace(
                scene.gaussians,
                means=scene.gaussians.means * factor,
                log_scale=scene.gaussians.log_scale + factor.log(),
            )
            self._served = self._served.showing(scene.with_gaussians(larger))

    def _body_of(self, name: str) -> int:
        """Which body of the scene an actor is."""
        for body, track in enumerate(self.served.scene.actors.recorded_tracks, start=1):
            if track.actor_id == name:
                return body
        raise invalid(f"actor {name!r}: the scene has no such actor")

    def frame(self, message: ImageMessage) -> Frame:
        """The image that a client asks for, at the size of the fit.

        Raises:
            RequestError: no such camera, a time outside of the scene, or a pose that is none.
        """
        served, request = self.served, self._request(message)
        key = ("http", id(served), message.model_dump_json(), id(self._actors))
        return self.queue.answer(key, lambda: served.frame(request, "http"))

    def _request(self, message: ImageMessage) -> SensorRequest:
        served, pose = self.served, _rigid(message.pose, "pose")
        if message.camera_name not in served.recorded.camera_names:
            raise RequestError(
                "NOT_FOUND",
                f"no camera {message.camera_name!r}, expected one of "
                f"{', '.join(served.recorded.camera_names)}",
            )
        view = served.recorded.views_of(message.camera_name)[0]
        time_us = message.timestamp
        with self._lock:
            ids = [n for n, (times, _) in self._actors.items() if _is_there(times, time_us)]
            poses = [interpolate_rigid_track(*self._actors[name], time_us) for name in ids]
        placed = torch.stack([*poses, pose])[:-1]
        return SensorRequest(
            scene_id=served.scene_id,
            camera_name=message.camera_name,
            camera=SensorCamera.of_pinhole(view.camera.no_wider(served.observation.width_px)),
            start_us=time_us,
            end_us=time_us,
            world_from_sensor=torch.stack([pose, pose]),
            actor_ids=tuple(ids),
            world_from_actors=torch.stack([placed, placed], dim=1),
            encoding=Encoding(),
        )


def _is_there(times_us: Tensor, time_us: int) -> bool:
    """As recorded tracks are: from half a frame before the first pose to half a one after."""
    return bool(times_us[0] - 60_000 <= time_us <= times_us[-1] + 60_000)


def _track_of(actor: ActorMessage) -> tuple[Tensor, Tensor]:
    times_us = torch.tensor(actor.timestamps, dtype=torch.int64)
    is_rising = bool((times_us.diff() > 0).all())
    if not is_rising or not 0 < len(times_us) == len(actor.poses):
        raise invalid(f"actor {actor.uuid!r}: expected as many poses as rising timestamps")
    poses = [_rigid(pose, f"actor {actor.uuid!r}") for pose in actor.poses]
    return times_us, torch.stack(poses)


def _rigid(rows: list[list[float]], what: str) -> Tensor:
    pose = torch.tensor(rows, dtype=torch.float64)
    if not bool(is_rigid(pose)) or float(pose[:3, 3].abs().max()) > 1e6:
        raise invalid(f"{what}: expected a rigid 4x4 pose in metres")
    return pose


def http_app(scene: HttpScene) -> "FastAPI":
    """The routes of a scene."""
    from fastapi import FastAPI, Request, Response
    from fastapi.responses import JSONResponse

    app = FastAPI(title="LidarPainter for NeuroNCAP", openapi_url=None)

    @app.exception_handler(LidarPainterError)
    def refused(_request: Request, error: LidarPainterError) -> JSONResponse:
        code = getattr(error, "code", "FAILED_PRECONDITION")
        return JSONResponse({"detail": str(error)}, STATUS.get(code, 422))

    app.get("/alive")(lambda: True)
    app.get("/start_time")(scene.start_us)
    app.get("/get_actors")(scene.actors)

    @app.post("/update_actors")
    def update_actors(actors: Annotated[list[ActorMessage], Field(max_length=MOST_ACTORS)]) -> None:
        scene.update(actors)

    @app.post("/set_actor_scale")
    def set_actor_scale(message: ScaleMessage) -> None:
        scene.scale(message)

    @app.post("/render_image")
    def render_image(message: ImageMessage) -> Response:
        frame = scene.frame(message)
        headers = dict(metadata([frame.trust]))
        if message.image_format == "raw":  # a saved uint8 tensor (height, width, 3) in base64
            file = io.BytesIO()
            torch.save(torch.from_numpy(frame.rgb_u8), file)
            data = base64.b64encode(file.getvalue())
            return Response(data, media_type="text/plain", headers=headers)
        kind, ending = ("png", ".png") if message.image_format == "png" else ("jpeg", ".jpg")
        data = encoded(frame.rgb_u8, Encoding(ending))
        return Response(data, media_type=f"image/{kind}", headers=headers)

    return app


@contextmanager
def http_server(
    scene: Callable[[], ServedScene], queue: RenderQueue, *, host: str, port: int
) -> Iterator[int]:
    """Serve as long as the block runs; gives the port, which 0 leaves to the system.

    Raises:
        ConfigError: the port cannot be had.
    """
    import uvicorn

    socket = listening(host, port)
    app = http_app(HttpScene(scene=scene, queue=queue))
    config = uvicorn.Config(app, log_level="critical", lifespan="off", timeout_graceful_shutdown=0)
    server = uvicorn.Server(config)
    sockets = {"sockets": [socket]}
    thread = threading.Thread(target=server.run, kwargs=sockets, name="http", daemon=True)
    thread.start()
    try:
        yield socket.getsockname()[1]
    finally:
        server.should_exit = True
        thread.join(END_S)
        socket.close()
