"""What requests ask for, checked, and poses and lenses as messages.

Everything here comes from outside: sizes, numbers and lists are bounded before they are used, and
what makes no sense is refused in one line that names the field.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.geometry.transforms import (
    interpolate_rigid,
    quaternion_from_rotation,
    rigid_from_rotation,
    rotation_from_quaternion,
)
from lidarpainter_models.serving.camera_messages import checked_size, sensor_camera
from lidarpainter_models.serving.image_formats import Encoding, encoding_of
from lidarpainter_models.serving.lens_models import SensorCamera
from lidarpainter_models.serving.protos import Message, common_pb2, sensorsim_pb2
from lidarpainter_models.serving.refusals import invalid

MOST_ACTORS = 4096
"""Of one request."""
FARTHEST_M = 1e6
"""From the origin of the scene; float32 has centimetres there."""
LENGTH_TOLERANCE = 0.01
"""By which a quaternion may depart from unit length."""
MOST_SEARCHED = 2**21
"""Pixels through a distorted pinhole or behind a windshield: 1920 x 1080 is within, and seconds."""
LONGEST_S = 1.0
"""Of a readout."""
_ACROSS = {
    sensorsim_pb2.UNKNOWN: (0.0, 0.0),
    sensorsim_pb2.GLOBAL: (0.0, 0.0),
    sensorsim_pb2.ROLLING_TOP_TO_BOTTOM: (0.0, 1.0),
    sensorsim_pb2.ROLLING_BOTTOM_TO_TOP: (0.0, -1.0),
    sensorsim_pb2.ROLLING_LEFT_TO_RIGHT: (1.0, 0.0),
    sensorsim_pb2.ROLLING_RIGHT_TO_LEFT: (-1.0, 0.0),
}
"""By shutter: how much later the right end and the lower end are read, in readouts."""


@dataclass(frozen=True, kw_only=True, eq=False)
class TimedRequest:
    """What is asked of a sensor for a span of time: where it is then, and who else is where."""

    scene_id: str
    start_us: int
    end_us: int
    """When the sensor begins to see and when it ends."""
    world_from_sensor: Float[Tensor, "2 4 4"]
    """At the start and at the end."""
    actor_ids: tuple[str, ...] = ()
    """Who is there; nobody else is."""
    world_from_actors: Float[Tensor, "actors 2 4 4"]
    """Their boxes at the start and at the end."""

    @property
    def middle_ns(self) -> int:
        """The middle of the span; an instant [t, t + 1) us is t."""
        is_instant = self.end_us - self.start_us <= 1
        return self.start_us * 1000 if is_instant else (self.start_us + self.end_us) * 500

    @property
    def readout_s(self) -> float:
        """How long what is there moves while the sensor sees it."""
        return (self.end_us - self.start_us) * 1e-6


@dataclass(frozen=True, kw_only=True, eq=False)
class SensorRequest(TimedRequest):
    """One image that is asked for, between the opening and the closing of its shutter."""

    camera_name: str
    """Whose exposure and own body it gets; may be a name that the scene does not know."""
    camera: SensorCamera
    """At the size that is asked for."""
    across: tuple[float, float] = (0.0, 0.0)
    """How much later the right end and the lower end are read, in readouts: 0, 1 or -1."""
    own_body_of: str | None = None
    """Camera whose view of the recording car is laid over the image."""
    encoding: Encoding

    @property
    def readout_s(self) -> float:
        """How long the shutter rolls; 0 where it does not."""
        return (self.end_us - self.start_us) * 1e-6 if any(self.across) else 0.0

    @property
    def across_s(self) -> tuple[float, float]:
        """How much later the right end and the lower end of the image are read."""
        return self.across[0] * self.readout_s, self.across[1] * self.readout_s

    @property
    def world_from_middle(self) -> Float[Tensor, "4 4"]:
        """Where the sensor is in the middle of the readout."""
        return middle_of(self.world_from_sensor[None])[0]


def middle_of(pairs: Float[Tensor, "bodies 2 4 4"]) -> Float[Tensor, "bodies 4 4"]:
    """Poses half way from the start to the end; exactly those where nothing moves."""
    start, end = pairs.unbind(1)
    half = interpolate_rigid(start, end, torch.full(pairs.shape[:1], 0.5, dtype=pairs.dtype))
    stands = (start == end).all(-1).all(-1)
    return torch.where(stands[:, None, None], start, half)


def read_request(message: Message) -> SensorRequest:
    """What an `RGBRenderRequest` asks for.

    Raises:
        RequestError: INVALID_ARGUMENT, with the field that makes no sense.
    """
    spec = message.camera_intrinsics
    width_px, height_px = checked_size(message, spec)
    if spec.shutter_type not in _ACROSS:
        raise invalid(f"shutter_type {spec.shutter_type}: expected 0 to {len(_ACROSS) - 1}")
    camera = sensor_camera(spec).resized(width_px, height_px)
    if camera.is_searched and width_px * height_px > MOST_SEARCHED:
        raise invalid(
            f"the request has {width_px} x {height_px} px through a lens whose rays are searched "
            f"for: expected at most {MOST_SEARCHED} px"
        )
    own_body_of = None
    if message.insert_ego_mask:
        own_body_of = message.ego_mask_id.camera_logical_id or spec.logical_id
    return SensorRequest(
        **read_timed(message),
        camera_name=spec.logical_id,
        camera=camera,
        across=_ACROSS[spec.shutter_type],
        own_body_of=own_body_of,
        encoding=encoding_of(message.image_format, message.image_quality),
    )


def read_timed(message: Message) -> dict[str, Any]:
    """What every request says of its span of time: the fields of a `TimedRequest`.

    Raises:
        RequestError: INVALID_ARGUMENT, with the field that makes no sense.
    """
    start_us, end_us = message.frame_start_us, message.frame_end_us
    if end_us < start_us:
        raise invalid(f"frame_end_us {end_us} lies before frame_start_us {start_us}")
    if end_us - start_us > LONGEST_S * 1e6 or end_us >= 2**53:
        raise invalid(
            f"frame_start_us {start_us} to frame_end_us {end_us}: expected a span of at most "
            f"{LONGEST_S:g} s"
        )
    if len(message.dynamic_objects) > MOST_ACTORS:
        raise invalid(
            f"{len(message.dynamic_objects)} dynamic_objects: expected at most {MOST_ACTORS}"
        )
    ids = tuple(one.track_id for one in message.dynamic_objects)
    pairs = [(f"dynamic object {one.track_id!r}", one.pose_pair) for one in message.dynamic_objects]
    poses = _poses([("sensor_pose", message.sensor_pose), *pairs])
    if len(set(ids)) < len(ids):
        twice = next(name for index, name in enumerate(ids) if name in ids[:index])
        raise invalid(f"dynamic object {twice!r} is there twice")
    return {
        "scene_id": message.scene_id,
        "start_us": start_us,
        "end_us": end_us,
        "world_from_sensor": poses[0],
        "actor_ids": ids,
        "world_from_actors": poses[1:],
    }


def _poses(pairs: Sequence[tuple[str, Message]]) -> Float[Tensor, "pairs 2 4 4"]:
    """Pairs of poses (`PosePair`); one without an end stays where it starts."""
    ends = []
    for what, pair in pairs:
        if not pair.HasField("start_pose"):
            raise invalid(f"{what} has no start_pose")
        end = pair.end_pose if pair.HasField("end_pose") else pair.start_pose
        ends += [(what, pair.start_pose), (what, end)]
    return _checked_poses(ends).unflatten(0, (len(pairs), 2))


def track_poses(
    trajectory: Message, what: str
) -> tuple[Int[Tensor, " times"], Float[Tensor, "times 4 4"]]:
    """Times (nanoseconds) and poses of a `Trajectory`.

    Raises:
        RequestError: INVALID_ARGUMENT: it has none, too many, or its times do not ascend.
    """
    times_us = [one.timestamp_us for one in trajectory.poses[: MOST_ACTORS + 1]]
    is_rising = all(first < second for first, second in pairwise(times_us))
    if not 0 < len(times_us) <= MOST_ACTORS or not is_rising or times_us[-1] >= 2**53:
        raise invalid(f"{what}: expected a way of 1 to {MOST_ACTORS} poses at ascending times")
    poses = _checked_poses([(what, one.pose) for one in trajectory.poses])
    return torch.tensor(times_us) * 1000, poses


def _checked_poses(named: Sequence[tuple[str, Message]]) -> Float[Tensor, "poses 4 4"]:
    found = torch.tensor([_numbers(pose) for _, pose in named], dtype=torch.float64)
    lengths = found[:, 3:].norm(dim=-1)
    is_good = found.isfinite().all(-1) & ((lengths - 1).abs() <= LENGTH_TOLERANCE)
    is_good &= (found[:, :3].abs() <= FARTHEST_M).all(-1)
    if not bool(is_good.all()):
        row = int((~is_good).nonzero()[0])
        shown = ", ".join(f"{number:g}" for number in found[row].tolist())
        raise invalid(
            f"{named[row][0]} has a pose (x, y, z; w, x, y, z) of {shown}: expected metres within "
            f"{FARTHEST_M:g} and a unit quaternion"
        )
    return rigid_from_rotation(rotation_from_quaternion(found[:, 3:]), found[:, :3])


def _numbers(pose: Message) -> list[float]:
    vec, quat = pose.vec, pose.quat
    return [vec.x, vec.y, vec.z, quat.w, quat.x, quat.y, quat.z]


def matrix_of(pose: Message) -> Float[Tensor, "4 4"]:
    """The transform (float64) that a pose's message says; `pose_message` the other way round."""
    numbers = torch.tensor(_numbers(pose), dtype=torch.float64)
    return rigid_from_rotation(rotation_from_quaternion(numbers[3:]), numbers[:3])


def pose_message(world_from_body: Float[Tensor, "4 4"]) -> Message:
    """A pose as a message; float32 there."""
    x, y, z = world_from_body[:3, 3].tolist()
    w, i, j, k = quaternion_from_rotation(world_from_body[:3, :3]).tolist()
    return common_pb2.Pose(
        vec=common_pb2.Vec3(x=x, y=y, z=z), quat=common_pb2.Quat(w=w, x=i, y=j, z=k)
    )


def trajectory_message(
    timestamps_ns: Sequence[int], world_from_body: Float[Tensor, "times 4 4"]
) -> Message:
    """Poses at times as a message."""
    return common_pb2.Trajectory(
        poses=[
            common_pb2.PoseAtTime(pose=pose_message(pose), timestamp_us=int(time_ns) // 1000)
            for time_ns, pose in zip(timestamps_ns, world_from_body, strict=True)
        ]
    )


def camera_message(name: str, camera: Camera) -> Message:
    """The lens of a camera as a message."""
    return sensorsim_pb2.CameraSpec(
        logical_id=name,
        resolution_w=camera.width_px,
        resolution_h=camera.height_px,
        shutter_type=getattr(sensorsim_pb2, camera.shutter_name),
        opencv_pinhole_param=sensorsim_pb2.OpenCVPinholeCameraParam(
            principal_point_x=camera.cx_px,
            principal_point_y=camera.cy_px,
            focal_length_x=camera.fx_px,
            focal_length_y=camera.fy_px,
        ),
    )
