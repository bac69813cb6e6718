"""The calls of simulators, each answered by the scenes of a pool or refused in one line."""

import time
from collections.abc import Callable, Hashable, Sequence
from concurrent.futures import CancelledError
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING

import torch

import lidarpainter_models
from lidarpainter_models.errors import LidarPainterError
from lidarpainter_models.export.simulator_bundle import rig_from_camera
from lidarpainter_models.kernels.side_by_side import side_by_side
from lidarpainter_models.serving.image_formats import encoded_within
from lidarpainter_models.serving.messages import (
    SensorRequest,
    camera_message,
    pose_message,
    read_request,
    trajectory_message,
)
from lidarpainter_models.serving.protos import Message, common_pb2, sensorsim_pb2
from lidarpainter_models.serving.refusals import Code, RequestError, invalid
from lidarpainter_models.serving.render_queue import RenderQueue
from lidarpainter_models.serving.scene_pool import ScenePool
from lidarpainter_models.serving.served_sweeps import measured_points, points_message, read_sweep
from lidarpainter_models.serving.trust import Trust, metadata
from lidarpainter_models.serving.wire import MOST_BYTES, grpc_package

if TYPE_CHECKING:
    from grpc import ServicerContext

MOST_BYTES_KEY = "lidarpainter-max-reply-bytes"
"""Metadata of a request whose reply must not be larger: images become JPEGs as good as allowed."""
MOST_ITEMS, MOST_SWEEPS = 64, 8
"""Of a batch."""
API_VERSION = {"major": 0, "minor": 0, "patch": 5}


@dataclass(frozen=True, kw_only=True)
class Told:
    """What is noted of every image that was asked for."""

    request: SensorRequest | None
    """None where the message could not be read."""
    trust: Trust
    seconds: float
    """From when the worker took it."""
    refusal: str | None
    """Why there is no image."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Made:
    data: bytes = b""
    trust: Trust = field(default_factory=Trust)
    refusal: RequestError | None = None


def answering(answer: Callable[..., Message]) -> Callable[..., Message]:
    """A call whose refusals are gRPC's status codes; whatever else fails is one line too."""

    def call(message: Message, context: "ServicerContext") -> Message:
        try:
            return answer(message, context)
        except RequestError as error:
            code: Code | str = error.code
            why = str(error)
        except CancelledError:
            code, why = "UNAVAILABLE", "the server ends"
        except LidarPainterError as error:
            code, why = "FAILED_PRECONDITION", str(error)
        except Exception as error:  # noqa: BLE001 - a client gets a line, the server goes on
            code, why = "INTERNAL", f"unexpected {type(error).__name__}: {error}".splitlines()[0]
        return context.abort(getattr(grpc_package().StatusCode, code), why)

    return call


@dataclass(frozen=True, kw_only=True, eq=False)
class SensorsimServicer:
    """All calls of the service, each by the name that is on the wire."""

    scenes: ScenePool
    queue: RenderQueue
    refuse_below: float = 0.0
    """Images that are trusted less are refused."""
    tell: Callable[[Told], None] = lambda _told: None
    """Is told of every image that was asked for."""
    shut_down_asked: Callable[[], None] | None = None
    """Ends the server when a client asks for it; None lets no client do that."""
    config: dict[str, str]
    """What the server was started with."""
    device: torch.device | None = None
    """Where scenes are drawn; None is a CPU."""
    is_painted: bool = False
    """Whether images lean on those that the same client asked for before."""

    def render_rgb(self, message: Message, context: "ServicerContext") -> Message:
        (made,) = self._made([message], context)
        if made.refusal is not None:
            raise made.refusal
        return sensorsim_pb2.RGBRenderReturn(image_bytes=made.data)

    def batch_render_rgb(self, message: Message, context: "ServicerContext") -> Message:
        found = self._made([item.request for item in message.items], context)
        reply = sensorsim_pb2.BatchRGBRenderReturn()
        for item, made in zip(message.items, found, strict=True):
            reply.items.add(
                camera_name=item.camera_name,
                result=sensorsim_pb2.RGBRenderReturn(image_bytes=made.data),
                success=made.refusal is None,
                error_message="" if made.refusal is None else str(made.refusal),
            )
        return reply

    batch_render_camera = batch_render_rgb

    def render_aggregated(self, message: Message, context: "ServicerContext") -> Message:
        if len(message.lidar_requests) > MOST_SWEEPS:
            raise invalid(f"{len(message.lidar_requests)} sweeps: expected at most {MOST_SWEEPS}")
        asks_for_sweeps_alone = message.lidar_requests and not message.rgb_requests
        found = [] if asks_for_sweeps_alone else self._made(message.rgb_requests, context)
        for made in found:
            if made.refusal is not None:
                raise made.refusal
        return sensorsim_pb2.AggregatedRenderReturn(
            rgb_returns=[sensorsim_pb2.RGBRenderReturn(image_bytes=one.data) for one in found],
            lidar_returns=[self._sweep(one, context) for one in message.lidar_requests],
        )

    def render_lidar(self, message: Message, context: "ServicerContext") -> Message:
        return self._sweep(message, context)

    def get_version(self, _message: Message, _context: "ServicerContext") -> Message:
        return common_pb2.VersionId(
            version_id=f"lidarpainter {lidarpainter_models.__version__}",
            grpc_api_version=common_pb2.VersionId.APIVersion(**API_VERSION),
        )

    def get_available_scenes(self, _message: Message, _context: "ServicerContext") -> Message:
        return common_pb2.AvailableScenesReturn(scene_ids=self.scenes.announced)

    def get_loaded_scenes(self, _message: Message, _context: "ServicerContext") -> Message:
        reply = sensorsim_pb2.LoadedScenesReturn(
            loaded_instance_capacity=len(self.scenes.announced)
        )
        for name in self.scenes.loaded():
            reply.scenes.add(scene_id=name, loaded_instance_count=1, reusable_instance_count=1)
        return reply

    def get_available_cameras(self, message: Message, _context: "ServicerContext") -> Message:
        """Every recorded camera: its lens without distortion, and where it sits in the car."""
        served, reply = self.scenes.get(message.scene_id), sensorsim_pb2.AvailableCamerasReturn()
        for name in served.recorded.camera_names:
            views = served.recorded.views_of(name)
            reply.available_cameras.add(
                intrinsics=camera_message(name, served.found(views[len(views) // 2])),
                rig_to_camera=pose_message(rig_from_camera(served.scene, served.recorded, name)),
                logical_id=name,
            )
        return reply

    def get_available_trajectories(self, message: Message, _context: "ServicerContext") -> Message:
        """The way of the car where the sweeps say that it drove, at the times of its frames."""
        served = self.scenes.get(message.scene_id)
        car = served.recorded.corrected(served.scene.cameras.path)
        reply = sensorsim_pb2.AvailableTrajectoriesReturn()
        way = trajectory_message(car.frame_timestamps_ns.tolist(), car.world_from_ego)
        reply.available_trajectories.add(trajectory=way)
        return reply

    def get_dynamic_objects(self, message: Message, _context: "ServicerContext") -> Message:
        """Every actor with its poses: those that can be moved, and those that are parked."""
        served, reply = self.scenes.get(message.scene_id), sensorsim_pb2.DynamicObjectsReturn()
        for track in (*served.scene.tracks, *served.parked.tracks.values()):
            length_m, width_m, height_m = track.size_m.tolist()
            reply.dynamic_objects.add(
                id=track.actor_id,
                semantic_class=track.category,
                trajectory=trajectory_message(track.timestamps_ns.tolist(), track.world_from_box),
                object_size=common_pb2.AABB(size_x=length_m, size_y=width_m, size_z=height_m),
            )
        return reply

    def get_available_ego_masks(self, _message: Message, _context: "ServicerContext") -> Message:
        """The cameras that show the recording car itself."""
        reply = sensorsim_pb2.AvailableEgoMasksReturn()
        for scene_id in self.scenes.announced:
            bodies = self.scenes.get(scene_id).scene.cameras.own_bodies
            for name, body in sorted(bodies.items()):
                if bool(torch.as_tensor(body).any()):
                    mask = sensorsim_pb2.EgoMaskId(camera_logical_id=name, rig_config_id=scene_id)
                    reply.ego_mask_metadata.add(ego_mask_id=mask)
        return reply

    def get_server_config(self, _message: Message, _context: "ServicerContext") -> Message:
        return sensorsim_pb2.ServerConfigReturn(server_config=self.config)

    def shut_down(self, _message: Message, _context: "ServicerContext") -> Message:
        if self.shut_down_asked is None:
            raise RequestError(
                "FAILED_PRECONDITION", "the server was started without --allow-shut-down"
            )
        self.shut_down_asked()
        return common_pb2.Empty()

    def get_external_asset_objects(self, message: Message, _context: "ServicerContext") -> Message:
        names = self.scenes.edits_of(message.scene_id).library.names
        return sensorsim_pb2.ExternalAssetObjectsReturn(track_ids=names)

    def edit_assets(self, message: Message, context: "ServicerContext") -> Message:
        edits = self.scenes.edits_of(message.scene_id)

        def edited() -> Message:
            try:
                edits.edit(message)
            except LidarPainterError as error:
                return sensorsim_pb2.EditAssetsReturn(success=False, message=str(error))
            return sensorsim_pb2.EditAssetsReturn(success=True)

        return self.queue.answer(object(), edited, context.time_remaining())

    def restore_model_parameters(self, message: Message, context: "ServicerContext") -> Message:
        edits = self.scenes.edits_of(message.scene_id)
        self.queue.answer(object(), edits.restore, context.time_remaining())
        return common_pb2.Empty()

    def _sweep(self, message: Message, context: "ServicerContext") -> Message:
        """The points of one LiDAR, as a message."""

        def measured() -> Message:
            request = read_sweep(message)
            served = self.scenes.get(request.scene_id, request)
            return points_message(measured_points(served, request))

        key = (message.SerializeToString(deterministic=True), self.scenes.num_changes())
        return self.queue.answer(key, measured, context.time_remaining())

    def _made(self, messages: Sequence[Message], context: "ServicerContext") -> list[_Made]:
        """The images of a message, drawn together; each is there or says why it is not."""
        if not 0 < len(messages) <= MOST_ITEMS:
            raise invalid(f"a batch of {len(messages)} images: expected 1 to {MOST_ITEMS}")
        client, most_bytes = context.peer() if self.is_painted else "", _most_bytes(context)
        share = most_bytes // len(messages) - 256  # of names and of the message itself
        key: Hashable = (
            tuple(each.SerializeToString(deterministic=True) for each in messages),
            most_bytes,
            client,
            self.scenes.num_changes(),
        )
        drawn = partial(self._drawn, share=share, client=client)
        found = self.queue.answer(
            key, lambda: list(side_by_side(drawn, messages, self.device)), context.time_remaining()
        )
        context.set_trailing_metadata(metadata([made.trust for made in found]))
        if sum(len(made.data) for made in found) > most_bytes:
            raise RequestError(
                "RESOURCE_EXHAUSTED",
                f"the reply is larger than {most_bytes} bytes: ask for fewer images or for JPEG, "
                f"or say {MOST_BYTES_KEY}",
            )
        return found

    def _drawn(self, message: Message, *, share: int, client: str) -> _Made:
        begun, request, made = time.perf_counter(), None, _Made()
        try:
            request = read_request(message)
            served = self.scenes.get(request.scene_id, request)
            frame = served.frame(request, client)
            made = _Made(trust=frame.trust)
            self._refuse_untrusted(frame.trust)
            data = encoded_within(frame.rgb_u8, request.encoding, share)
            made = replace(made, data=data)
        except LidarPainterError as error:
            refusal = error
            if not isinstance(refusal, RequestError):
                refusal = RequestError("FAILED_PRECONDITION", str(error))
            made = replace(made, refusal=refusal)
        seconds = time.perf_counter() - begun
        why = None if made.refusal is None else str(made.refusal)
        self.tell(Told(request=request, trust=made.trust, seconds=seconds, refusal=why))
        return made

    def _refuse_untrusted(self, trust: Trust) -> None:
        confidence = trust.confidence
        if confidence is not None and confidence < self.refuse_below:
            raise RequestError(
                "FAILED_PRECONDITION",
                f"the frame's confidence is {confidence:.2f}: expected {self.refuse_below:g} or "
                "more by --refuse-below",
            )


def _most_bytes(context: "ServicerContext") -> int:
    """How large a reply may be."""
    asked = dict(context.invocation_metadata() or ()).get(MOST_BYTES_KEY)
    if asked is None:
        return MOST_BYTES - 2**16
    text = asked.decode("ascii", "replace") if isinstance(asked, bytes) else asked
    if not text.isdecimal() or not 1000 <= int(text[:12]) <= MOST_BYTES:
        raise invalid(f"{MOST_BYTES_KEY} {text[:40]!r}: expected 1000 to {MOST_BYTES}")
    return int(text)
