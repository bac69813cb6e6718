"""LiDAR sweeps that simulators ask for: the rays of a sensor between two poses, and what returns.

The sensor's frame is x ahead, y left, z up. It turns once in the span of a request, as it moves
from the first pose to the second; points are told in its frame at the end.
"""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.geometry.transforms import (
    interpolate_rigid,
    invert_rigid,
    transform_points,
)
from lidarpainter_models.lidar.firings import SweepRays, fired_rays
from lidarpainter_models.lidar.sensors import PRESETS, LidarSensor
from lidarpainter_models.serving.messages import TimedRequest, read_timed
from lidarpainter_models.serving.placed_actors import placed_actors
from lidarpainter_models.serving.protos import Message, sensorsim_pb2
from lidarpainter_models.serving.refusals import RequestError, invalid
from lidarpainter_models.serving.renderer import ServedScene

SENSORS = {sensorsim_pb2.PANDAR128: PRESETS["pandar128"], sensorsim_pb2.AT128: PRESETS["at128"]}
"""By the numbers of `LidarDeviceType`."""
LIKELY_LOST = 0.5
"""Chance from which on a ray is lost, unless the request says another."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SweepRequest(TimedRequest):
    """One sweep that is asked for."""

    sensor: LidarSensor
    most_lost: float = LIKELY_LOST
    """Rays that are lost with a higher chance do not return."""
    least_opaque: float = 0.0
    """Rays that the scene stops less of do not return."""
    farthest_m: float

    def rays(self) -> SweepRays:
        """The rays of one turn, evenly over the span."""
        share, span_ns = torch.from_numpy(self.sensor.shares), (self.end_us - self.start_us) * 1000
        start, end = (one.expand(len(share), 4, 4) for one in self.world_from_sensor)
        step_ns = self.start_us * 1000 + (share * span_ns).round().long()
        return fired_rays(self.sensor, interpolate_rigid(start, end, share), step_ns)


@dataclass(frozen=True, kw_only=True, eq=False)
class MeasuredPoints:
    """What a LiDAR would measure, point by point."""

    xyz_m: Float[Tensor, "points 3"]
    """In the sensor's frame at the end of the sweep; float32."""
    intensity: Float[Tensor, " points"]
    """0 to 1, of what the log's own LiDAR reports of its brightest surface."""


def read_sweep(message: Message) -> SweepRequest:
    """What a `LidarRenderRequest` asks for.

    Raises:
        RequestError: INVALID_ARGUMENT, with the field that makes no sense.
    """
    kind = message.lidar_config.lidar_type
    if kind not in SENSORS:
        raise invalid(f"lidar_type {kind}: expected 0 (PANDAR128) or 1 (AT128)")
    sensor, wanted = SENSORS[kind], message.render_filter
    limits: dict[str, Any] = {}
    if wanted.HasField("raydrop_threshold"):
        limits["most_lost"] = _share(wanted.raydrop_threshold, "raydrop_threshold")
    if wanted.HasField("opacity_threshold"):
        limits["least_opaque"] = _share(wanted.opacity_threshold, "opacity_threshold")
    farthest_m = sensor.max_range_m
    if wanted.enable_distance_filter:
        threshold_m = wanted.distance_filter_threshold
        if not 0 < threshold_m < float("inf"):
            raise invalid(f"distance_filter_threshold {threshold_m:g}: expected positive metres")
        farthest_m = min(farthest_m, threshold_m)
    return SweepRequest(**read_timed(message), **limits, sensor=sensor, farthest_m=farthest_m)


def _share(value: float, name: str) -> float:
    if not 0 <= value <= 1:
        raise invalid(f"{name} {value:g}: expected 0 to 1")
    return float(value)


def measured_points(served: ServedScene, request: SweepRequest) -> MeasuredPoints:
    """What a LiDAR would measure of a scene whose actors stand where a request has them.

    Raises:
        RequestError: FAILED_PRECONDITION: nobody learnt what a LiDAR sees of the scene;
            OUT_OF_RANGE: the scene knows nothing of that time; INVALID_ARGUMENT: it has no such
            actor, or one that cannot be moved.
    """
    if served.returns is None:
        raise RequestError("FAILED_PRECONDITION", "the server was started without --lidar")
    served.refuse_other_times(request)
    scene, own = served.scene, served.scene.actors
    actors = placed_actors(own, served.parked, request, request.middle_ns)
    if actors is not own:
        scene = scene.with_actors(actors)
    rays = request.rays()
    met = served.returns.simulated(scene, rays)
    returns = (met.alpha > 0) & (met.lost <= request.most_lost)
    returns &= met.alpha >= request.least_opaque
    returns &= (met.range_m >= request.sensor.min_range_m) & (met.range_m <= request.farthest_m)
    back = returns.nonzero()[:, 0]
    world = rays.origin_m[back] + met.range_m[back, None].double() * rays.direction[back]
    sensor_from_world = invert_rigid(request.world_from_sensor[1])
    return MeasuredPoints(
        xyz_m=transform_points(sensor_from_world, world).float(),
        intensity=(met.intensity[back] / served.returns.full_intensity).clamp(0, 1).float(),
    )


def points_message(points: MeasuredPoints) -> Message:
    """Points as a message: as numbers, and as bytes (float32, lowest byte first) alike."""
    xyz_m, intensity = points.xyz_m.contiguous().numpy(), points.intensity.numpy()
    return sensorsim_pb2.LidarRenderReturn(
        point_xyzs=xyz_m.reshape(-1),
        point_intensities=intensity,
        num_points=len(xyz_m),
        point_xyzs_buffer=xyz_m.astype("<f4").tobytes(),
        point_intensities_buffer=intensity.astype("<f4").tobytes(),
    )
