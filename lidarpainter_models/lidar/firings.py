"""Recorded sweeps as the sensor fired them: every ray with where and when it began, met or not.

A log keeps what came back, as points of the world with their own times. Each is seen again from
where the sensor was at its time: its elevation tells the beam and its azimuth the step, and the
steps of a beam that hold no point are rays that nothing sent back (neurad-studio judges its ray
drop so). What a log does not say of its sensor is estimated (`sensor_estimates`).

Frames as in `lidar.sensors`; poses are those of the log, corrected or not. Metres.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lidarpainter_models.errors import SceneError
from lidarpainter_models.geometry.driven_paths import DrivenPath
from lidarpainter_models.lidar.sensor_estimates import (
    LEAST_BEAM_POINTS,
    SeenPoints,
    beam_elevations,
    beams_of,
    estimated_sensor,
    points_seen,
    sensor_seat,
)
from lidarpainter_models.lidar.sensors import LidarSensor, preset_of
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.records import Sweep


@dataclass(frozen=True, kw_only=True, eq=False)
class SweepRays:
    """The rays of one sweep."""

    origin_m: Float[Tensor, "rays 3"]
    """Where each began; world, float64."""
    direction: Float[Tensor, "rays 3"]
    """Unit vectors; world, float64."""
    time_ns: Int[Tensor, " rays"]
    beam: Int[Tensor, " rays"]
    """-1 where unknown."""
    range_m: Float[Tensor, " rays"]
    """What was measured; 0 where nothing came back."""
    intensity: Float[Tensor, " rays"]
    """As the sensor states it; 0 where nothing came back."""
    is_returned: Bool[Tensor, " rays"]

    def __len__(self) -> int:
        return len(self.range_m)

    def select(self, rows: Tensor) -> "SweepRays":
        """Some of the rays."""
        return SweepRays(**{name: column[rows] for name, column in vars(self).items()})

    @classmethod
    def joined(cls, parts: Sequence["SweepRays"]) -> "SweepRays":
        """The rays of several parts, one after the other."""
        columns = ([getattr(part, name) for part in parts] for name in vars(parts[0]))
        return cls(**dict(zip(vars(parts[0]), map(torch.cat, columns), strict=True)))


@dataclass(frozen=True, kw_only=True, eq=False)
class MountedLidar:
    """A sensor of a log: its beams, how it leans, and the way it went."""

    name: str
    """What the log calls it."""
    sensor: LidarSensor
    lidar_from_sensor: Float[Tensor, "4 4"]
    """Where the sensor sits in the frame that the log calls its LiDAR's; float64."""
    path: DrivenPath
    """`world_from_lidar` at the times of its sweeps."""
    tells_lost: bool = True
    """Whether its sweeps say which rays nothing has come back of: their beams are told apart."""

    def world_from_sensor(self, times_ns: Int[Tensor, " times"]) -> Float[Tensor, "times 4 4"]:
        """Where the sensor was; the motion goes on before the first sweep and after the last."""
        return self.path.driven_on(times_ns).world_from_body @ self.lidar_from_sensor

    def rays(self, timestamp_ns: int) -> SweepRays:
        """All rays of a sweep around a time, which nothing has sent back."""
        turn_ns = round(self.sensor.turn_s * 1e9)
        after_ns = (torch.from_numpy(self.sensor.shares - 0.5) * turn_ns).round().long()
        step_ns = timestamp_ns + after_ns
        return fired_rays(self.sensor, self.world_from_sensor(step_ns), step_ns)


def mounted_lidar(
    scene: DrivingScene,
    lidar_name: str,
    frames: Sequence[int] | None = None,
    *,
    knows_sheets: bool = True,
) -> MountedLidar:
    """What is known of a LiDAR of a scene, the rest estimated from sweeps of some frames.

    With `knows_sheets` a LiDAR that is called as a preset has the beams of its data sheet.

    Raises:
        SceneError: there is no such LiDAR, or its sweeps do not tell its beams.
    """
    sweeps = [sweep for sweep in scene.sweeps if sweep.lidar_name == lidar_name]
    if not sweeps:
        names = ", ".join(scene.lidar_names) or "none"
        raise SceneError(f"{scene.path.name}: no LiDAR {lidar_name!r}, it has {names}")
    path = DrivenPath(
        timestamps_ns=torch.tensor([sweep.timestamp_ns for sweep in sweeps]),
        world_from_body=torch.stack([sweep.world_from_lidar.double() for sweep in sweeps]),
    )
    usable = [sweep for sweep in sweeps if frames is None or sweep.frame_index in set(frames)]
    looked_at = (usable or sweeps)[:: max(1, len(usable or sweeps) // 3)][:3]
    seen = [
        points_seen(scene, sweep, path, torch.eye(4, dtype=torch.float64)) for sweep in looked_at
    ]
    seat = sensor_seat([one.points_m for one in seen])
    turn, place_m = seat[:3, :3], seat[:3, 3]
    seen = [replace(one, points_m=(one.points_m - place_m) @ turn) for one in seen]  # transposed
    sensor, are_apart = preset_of(lidar_name) if knows_sheets else None, True
    if sensor is None:
        beams_deg, are_apart = beam_elevations(seen)
        sensor = estimated_sensor(lidar_name, seen, beams_deg, scene)
    has_second = any(not one.is_first.all() for one in seen)
    return MountedLidar(
        name=lidar_name,
        sensor=replace(sensor, returns=2 if has_second else 1),
        lidar_from_sensor=torch.from_numpy(seat),
        path=path,
        tells_lost=are_apart,
    )


def recorded_rays(scene: DrivingScene, sweep: Sweep, lidar: MountedLidar) -> SweepRays:
    """The rays of a recorded sweep: those that came back as measured, then those that did not."""
    seen = points_seen(scene, sweep, lidar.path, lidar.lidar_from_sensor)
    sensor, range_m = lidar.sensor, np.linalg.norm(seen.points_m, axis=1)
    kept = np.flatnonzero(
        (range_m >= sensor.min_range_m) & (range_m <= sensor.max_range_m) & seen.is_first
    )
    seen, range_m = seen.select(kept), range_m[kept]
    beam = beams_of(seen, sensor)
    world_from_sensor = lidar.world_from_sensor(torch.from_numpy(seen.time_ns))
    direction = torch.from_numpy(seen.points_m / range_m[:, None])
    returned = unanswered_rays(
        world_from_sensor, direction, torch.from_numpy(seen.time_ns), torch.from_numpy(beam)
    )
    returned = replace(
        returned,
        range_m=torch.from_numpy(range_m),
        intensity=torch.from_numpy(seen.intensity).float(),
        is_returned=torch.ones(len(range_m), dtype=torch.bool),
    )
    if not lidar.tells_lost:
        return returned
    lost_beam, head_deg, time_ns = _missing(seen, beam, sensor)
    absent = unanswered_rays(
        lidar.world_from_sensor(torch.from_numpy(time_ns)),
        torch.from_numpy(sensor.directions(lost_beam, head_deg)),
        torch.from_numpy(time_ns),
        torch.from_numpy(lost_beam),
    )
    return SweepRays.joined([returned, absent])


def fired_rays(
    sensor: LidarSensor,
    world_from_sensor: Float[Tensor, "steps 4 4"],
    step_ns: Int[Tensor, " steps"],
) -> SweepRays:
    """All rays of a sweep, step after step, by where the sensor was at each step and when."""
    step = torch.arange(sensor.steps).repeat_interleave(sensor.num_beams)
    beam = torch.arange(sensor.num_beams).repeat(sensor.steps)
    head_deg = sensor.head_azimuth_deg(step.numpy())
    directions = torch.from_numpy(sensor.directions(beam.numpy(), head_deg))
    return unanswered_rays(world_from_sensor[step], directions, step_ns[step], beam)


def unanswered_rays(
    world_from_sensor: Tensor, directions: Tensor, times_ns: Tensor, beam: Tensor
) -> SweepRays:
    """Rays of the sensor's frame in the world; nothing came back."""
    nothing = torch.zeros(len(times_ns), dtype=torch.float64)
    return SweepRays(
        origin_m=world_from_sensor[:, :3, 3],
        direction=(world_from_sensor[:, :3, :3] @ directions[:, :, None])[..., 0],
        time_ns=times_ns,
        beam=beam.long(),
        range_m=nothing,
        intensity=nothing.float(),
        is_returned=torch.zeros(len(times_ns), dtype=torch.bool),
    )


def _missing(
    seen: SeenPoints, beam: np.ndarray, sensor: LidarSensor
) -> tuple[Int[np.ndarray, " rays"], Float[np.ndarray, " rays"], Int[np.ndarray, " rays"]]:
    """Beam, azimuth of the head and time of the steps of each beam that hold no point.

    Steps are counted from where most points say that they begin; their times go with azimuth.
    """
    known = beam >= 0
    head_deg = seen.azimuth_deg[known] - sensor.beam_offsets_deg[beam[known]]
    first, last = sensor.azimuths_deg
    turned = (head_deg - first if sensor.turns_left else last - head_deg) / sensor.step_deg
    begins = np.angle(np.exp(2j * np.pi * turned).mean()) / (2 * np.pi) if len(turned) else 0.0
    whole = last - first >= 360
    step = np.rint(turned - begins).astype(np.int64)
    step = step % sensor.steps if whole else np.clip(step, 0, sensor.steps - 1)
    is_met = np.zeros((sensor.steps, sensor.num_beams), dtype=bool)
    is_met[step, beam[known]] = True
    # a beam that the log leaves out altogether (or that the car hides) tells nothing
    is_met[:, is_met.sum(axis=0) < LEAST_BEAM_POINTS] = True
    empty_step, empty_beam = np.nonzero(~is_met)
    turn_deg = (empty_step + begins) * sensor.step_deg
    empty_head = first + turn_deg if sensor.turns_left else last - turn_deg
    return empty_beam, empty_head, _step_times(step, seen.time_ns[known], sensor)[empty_step]


def _step_times(step: np.ndarray, time_ns: np.ndarray, sensor: LidarSensor) -> np.ndarray:
    """When each step was fired, from the times of those that came back."""
    if not len(step) or np.ptp(time_ns) == 0:
        middle = int(time_ns[0]) if len(step) else 0
        return np.full(sensor.steps, middle, dtype=np.int64)
    order = np.argsort(step, kind="stable")
    known, starts = np.unique(step[order], return_index=True)
    sums = np.add.reduceat((time_ns[order] - time_ns.min()).astype(float), starts)
    means = sums / np.diff([*starts, len(order)])
    steps = np.arange(sensor.steps)
    return np.interp(steps, known, means).astype(np.int64) + time_ns.min()
