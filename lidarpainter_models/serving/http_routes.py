"""NeuroNCAP's closed loop over HTTP, as neurad-studio answers it.

Camera poses are OpenCV's (x right, y down, z forward), actor poses the centres of boxes; times are
microseconds. Nothing rolls. Actors stand where the client last put them; those that it left out are
gone. The routes know one scene.
"""

import base64
import io
from dataclasses import dataclass, field, replace
from threading import Lock
from typing import TYPE_CHECKING, Annotated, Any, Literal

import torch
from pydantic import BaseModel, ConfigDict, Field
from torch import Tensor

from lidarpainter_models.errors import LidarPainterError
from lidarpainter_models.geometry.transforms import interpolate_rigid_track, is_rigid
from lidarpainter_models.serving.image_formats import Encoding, encoded
from lidarpainter_models.serving.messages import SensorRequest
from lidarpainter_models.serving.refusals import RequestError, invalid
from lidarpainter_models.serving.render_queue import RenderQueue
from lidarpainter_models.serving.renderer import Frame, ServedScene
from lidarpainter_models.serving.sensor_cameras import PinholeLens, SensorCamera
from lidarpainter_models.serving.trust import metadata

if TYPE_CHECKING:
    from fastapi import FastAPI

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

    model_config = ConfigDict(extra="ignore")
    pose: Matrix
    timestamp: Annotated[int, Field(ge=0, lt=2**53)]
    camera_name: str
    image_format: Literal["raw", "png", "jpg", "jpeg"] = "raw"


@dataclass(eq=False, kw_only=True)
class HttpScene:
    """The scene of the routes, and where its actors are by now."""

    served: ServedScene
    queue: RenderQueue
    _scales: dict[str, float] = field(default_factory=dict, init=False)
    _actors: dict[str, tuple[Tensor, Tensor]] = field(default_factory=dict, init=False)
    _lock: Lock = field(default_factory=Lock, init=False)

    def __post_init__(self) -> None:
        """Everybody is where it was recorded."""
        for track in self.served.scene.tracks:
            self._actors[track.actor_id] = (track.timestamps_ns // 1000, track.world_from_box)

    def actors(self) -> list[dict[str, Any]]:
        """Where actors are, as the client asks for it."""
        sizes = {track.actor_id: track.size_m.tolist() for track in self.served.scene.tracks}
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
        known = {track.actor_id for track in self.served.scene.tracks}
        found = {}
        for actor in actors:
            if actor.uuid not in known:
                raise invalid(f"actor {actor.uuid!r}: the scene has no such actor")
            found[actor.uuid] = _track_of(actor)
        with self._lock:
            self._actors = found

    def scale(self, message: ScaleMessage) -> None:
        """Draw an actor larger or smaller than it was recorded.

        Raises:
            RequestError: INVALID_ARGUMENT: the scene has no such actor.
        """
        scene = self.served.scene
        bodies = {t.actor_id: body for body, t in enumerate(scene.actors.recorded_tracks, start=1)}
        if message.uuid not in bodies:
            raise invalid(f"actor {message.uuid!r}: the scene has no such actor")
        with self._lock:
            change = message.scale / self._scales.get(message.uuid, 1.0)
            self._scales[message.uuid] = message.scale
            rows = scene.gaussians.body_index == bodies[message.uuid]
            factor = torch.where(rows, change, 1.0).to(scene.device)[:, None]
            larger = replace(
                scene.gaussians,
                means=scene.gaussians.means * factor,
                log_scale=scene.gaussians.log_scale + factor.log(),
            )
            builder = self.served.builder.showing(
                scene.with_gaussians(larger), self.served.builder.boxes
            )
            self.served = replace(self.served, builder=builder)

    def frame(self, message: ImageMessage) -> Frame:
        """The image that a client asks for, at the size of the fit.

        Raises:
            RequestError: no such camera, a time outside of the scene, or a pose that is none.
        """
        request = self._request(message)
        key = ("http", id(self.served), message.model_dump_json(), id(self._actors))
        served = self.served
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
        lens = view.camera.no_wider(served.observation.width_px)
        time_us = message.timestamp
        with self._lock:
            ids = [n for n, (times, _) in self._actors.items() if _is_there(times, time_us)]
            poses = [interpolate_rigid_track(*self._actors[name], time_us) for name in ids]
        placed = torch.stack([*poses, pose])[:-1]
        return SensorRequest(
            scene_id=served.scene_id,
            camera_name=message.camera_name,
            camera=SensorCamera(
                lens=PinholeLens(),
                pixels_per_unit=(lens.fx_px, 0.0, 0.0, lens.fy_px),
                middle_px=(lens.cx_px, lens.cy_px),
                width_px=lens.width_px,
                height_px=lens.height_px,
            ),
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


def raw_bytes(frame: Frame) -> bytes:
    """An image as neurad-studio sends it: a saved uint8 tensor (height, width, 3) in base64."""
    file = io.BytesIO()
    torch.save(torch.from_numpy(frame.rgb_u8), file)
    return base64.b64encode(file.getvalue())


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
    first_ns = int(scene.served.recorded.frame_timestamps_ns[0])
    app.get("/start_time")(lambda: first_ns // 1000)
    app.get("/get_actors")(scene.actors)

    @app.post("/update_actors")
    def update_actors(
        actors: Annotated[list[ActorMessage], Field(max_length=MOST_ACTORS)],
    ) -> None:
        scene.update(actors)

    @app.post("/set_actor_scale")
    def set_actor_scale(message: ScaleMessage) -> None:
        scene.scale(message)

    @app.post("/render_image")
    def render_image(message: ImageMessage) -> Response:
        frame = scene.frame(message)
        headers = dict(metadata([frame.trust]))
        if message.image_format == "raw":
            return Response(raw_bytes(frame), media_type="text/plain", headers=headers)
        kind, ending = ("png", ".png") if message.image_format == "png" else ("jpeg", ".jpg")
        data = encoded(frame.rgb_u8, Encoding(ending))
        return Response(data, media_type=f"image/{kind}", headers=headers)

    return app
