"""The cameras of a car, asked for over gRPC as a simulator asks for them.

It talks to our server as to anybody's: cameras and their seats come from the renderer, poses and
actors from the simulation, and how far a frame can be trusted from trailing metadata, where a
renderer has such. World frame of the scene, metres; images are RGB bytes.
"""

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from torch import Tensor

from lidarpainter_models.errors import DataError
from lidarpainter_models.scenes.image_bytes import decode_image
from lidarpainter_models.serving.messages import LENGTH_TOLERANCE, matrix_of, pose_message
from lidarpainter_models.serving.protos import Message, common_pb2, sensorsim_pb2
from lidarpainter_models.serving.trust import KEYS
from lidarpainter_models.serving.wire import MOST_BYTES, client, grpc_package

MOST_CAMERAS, MOST_PX = 64, 100_000
CONNECT_S, CALL_S = 20.0, 300.0
"""How long a renderer may take to be there, and to answer: the first image loads the scene."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SeenFrame:
    """One image and how far it can be trusted."""

    rgb_u8: UInt8[np.ndarray, "height width 3"]
    confidence: float | None
    """None where the renderer does not say."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SensorClient:
    """The cameras that a renderer has for a scene."""

    calls: Any
    scene_id: str
    cameras: Mapping[str, Any]
    """Lens (`CameraSpec`) by logical id."""
    rig_from_camera: Mapping[str, Float[Tensor, "4 4"]]
    width_px: int
    """Images are scaled to it; a renderer keeps the aspect."""

    def frames(
        self,
        names: tuple[str, ...],
        world_from_rig: Float[Tensor, "4 4"],
        timestamp_us: int,
        world_from_actors: Mapping[str, Float[Tensor, "4 4"]],
    ) -> dict[str, SeenFrame]:
        """What some cameras see at an instant, all in one call.

        Raises:
            DataError: the renderer refuses, or answers with what is no image.
        """
        actors = [
            sensorsim_pb2.DynamicObject(
                track_id=name, pose_pair=sensorsim_pb2.PosePair(start_pose=pose, end_pose=pose)
            )
            for name, pose in ((one, pose_message(at)) for one, at in world_from_actors.items())
        ]
        items = []
        for name in names:
            pose = pose_message(world_from_rig @ self.rig_from_camera[name])
            spec = self.cameras[name]
            width_px = min(self.width_px, spec.resolution_w)
            request = sensorsim_pb2.RGBRenderRequest(
                scene_id=self.scene_id,
                resolution_w=width_px,
                resolution_h=max(round(spec.resolution_h * width_px / spec.resolution_w), 1),
                camera_intrinsics=spec,
                frame_start_us=timestamp_us,
                frame_end_us=timestamp_us + 1,
                sensor_pose=sensorsim_pb2.PosePair(start_pose=pose, end_pose=pose),
                dynamic_objects=actors,
                image_format=sensorsim_pb2.PNG,
            )
            items.append(sensorsim_pb2.BatchRGBRenderRequestItem(camera_name=name, request=request))
        batch = sensorsim_pb2.BatchRGBRenderRequest(items=items)
        with _one_line(self.scene_id):
            reply, call = self.calls.batch_render_rgb.with_call(batch, timeout=CALL_S)
        said = dict(call.trailing_metadata() or ()).get(KEYS[0], "").split(",")
        confidences = [_number(word) for word in said] if len(said) == len(names) else []
        found = {
            item.camera_name: SeenFrame(
                rgb_u8=_decoded(item), confidence=confidences[row] if confidences else None
            )
            for row, item in enumerate(reply.items)
        }
        if set(found) != set(names):
            raise DataError(f"{self.scene_id}: {len(found)} images of {len(names)} that were asked")
        return found


@contextmanager
def connected(address: str, wanted: tuple[str, ...], *, width_px: int) -> Iterator[SensorClient]:
    """The cameras of a scene at a renderer.

    Args:
        address: HOST:PORT.
        wanted: names that the scene may have there; the first that is there is taken.
        width_px: how wide images shall be.

    Raises:
        DataError: nobody answers there, or without such a scene or without cameras.
        MissingPackageError: gRPC is not installed.
    """
    grpc = grpc_package()
    size = [(f"grpc.max_{way}_message_length", MOST_BYTES) for way in ("send", "receive")]
    with grpc.insecure_channel(address, options=size) as channel:
        calls = client(channel)
        with _one_line(address):
            known = calls.get_available_scenes(
                common_pb2.Empty(), timeout=CONNECT_S, wait_for_ready=True
            ).scene_ids
            scene_id = next((one for one in wanted if one in known), None)
            if scene_id is None:
                there = ", ".join(list(known)[:10]) or "none"
                raise DataError(f"{address} has no scene {wanted[0]}, it has {there}")
            asked = sensorsim_pb2.AvailableCamerasRequest(scene_id=scene_id)
            found = calls.get_available_cameras(asked, timeout=CALL_S).available_cameras
        if not 0 < len(found) <= MOST_CAMERAS:
            raise DataError(
                f"{address} has {len(found)} cameras for {scene_id}, expected 1 to {MOST_CAMERAS}"
            )
        yield SensorClient(
            calls=calls,
            scene_id=scene_id,
            cameras={one.logical_id: one.intrinsics for one in found},
            rig_from_camera={one.logical_id: _seat(one) for one in found},
            width_px=width_px,
        )


@contextmanager
def _one_line(place: str) -> Iterator[None]:
    """Turn what gRPC says of a failed call into one line."""
    grpc = grpc_package()
    try:
        yield
    except grpc.RpcError as error:
        code, said = error.code().name, " ".join((error.details() or "").split())
        raise DataError(f"{place}: {code}: {said[:300]}") from None


def _seat(camera: Message) -> Float[Tensor, "4 4"]:
    """Where a camera sits in the car; the renderer may be anybody's."""
    quat, spec = camera.rig_to_camera.quat, camera.intrinsics
    length = math.hypot(quat.w, quat.x, quat.y, quat.z)
    seat = matrix_of(camera.rig_to_camera)
    is_told = abs(length - 1) < LENGTH_TOLERANCE and bool(seat.isfinite().all())
    if not is_told or not 0 < min(spec.resolution_w, spec.resolution_h) <= MOST_PX:
        raise DataError(f"camera {camera.logical_id[:80]!r}: no seat in the car, or no size")
    return seat


def _decoded(item: Message) -> UInt8[np.ndarray, "height width 3"]:
    if not item.success:
        raise DataError(f"camera {item.camera_name}: {item.error_message[:300]}")
    image = decode_image(item.result.image_bytes)
    if image is None:
        raise DataError(f"camera {item.camera_name}: the answer is no image that can be decoded")
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def _number(word: str) -> float | None:
    try:
        return float(word)
    except ValueError:
        return None
