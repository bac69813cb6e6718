"""Recorded sweeps as the sensor fired them: every ray with where and when it began, met or not.

A log keeps what came back, as points of the world with their own times. Each is seen again from
where the sensor was at its time: its elevation tells the beam and its azimuth the step, and the
steps of a beam that hold no point are rays that nothing sent back (neurad-studio judges its ray
drop so). Where a log does not say how its sensor leans or where its beams look, that is what makes
the elevations of its sweeps fall onto the fewest lines.

Frames as in `lidar.sensors`; poses are those of the log, corrected or not. Metres.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.ndimage import gaussian_filter1d
from torch import Tensor

from lidarpainter_models.errors import SceneError
from lidarpainter_models.geometry.driven_paths import DrivenPath
from lidarpainter_models.geometry.transforms import (
    invert_rigid,
    rotation_from_vector,
)
from lidarpainter_models.lidar.sensors import MOST_BEAMS, LidarSensor, preset_of
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.records import Sweep

LEANS_RAD = np.radians(2.75)
"""No sensor is taken to lean by more."""
SHARPNESS_DEG = (0.4, 0.2, 0.1, 0.05, 0.025)
"""Lines of elevations are looked for ever more finely."""
MOST_TRIED = 40_000
LINE_DEG, LEAST_SHARE = 0.02, 0.1
"""Elevations are counted in steps of so much; a beam has so much of the points of the median."""
LEAST_BEAM_POINTS = 20
AWAY_DEG = 0.75
"""A point that lies so many times the distance of two beams from all of them is of none."""


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


@dataclass(frozen=True, kw_only=True, eq=False)
class MountedLidar:
    """A sensor of a log: its beams, how it leans, and the way it went."""

    name: str
    """What the log calls it."""
    sensor: LidarSensor
    lidar_from_sensor: Float[Tensor, "4 4"]
    """Turn of the sensor in the frame that the log calls its LiDAR's; float64."""
    path: DrivenPath
    """`world_from_lidar` at the times of its sweeps."""

    def world_from_sensor(self, times_ns: Int[Tensor, " times"]) -> Float[Tensor, "times 4 4"]:
        """Where the sensor was; the motion goes on before the first sweep and after the last."""
        return self.path.driven_on(times_ns).world_from_body @ self.lidar_from_sensor

    def rays(self, timestamp_ns: int) -> SweepRays:
        """All rays of a sweep around a time, which nothing has sent back."""
        directions, after_s, beam = self.sensor.sweep()
        times_ns = timestamp_ns + (after_s * 1e9).round().long()
        columns_ns = times_ns[:: self.sensor.num_beams]
        poses = self.world_from_sensor(columns_ns)
        poses = poses.repeat_interleave(self.sensor.num_beams, dim=0)
        return _unanswered(poses, directions, times_ns, beam)


def mounted_lidar(
    scene: DrivingScene, lidar_name: str, frames: Sequence[int] | None = None
) -> MountedLidar:
    """What is known of a LiDAR of a scene, the rest estimated from sweeps of some frames.

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
    seen = [_seen_by(scene, sweep, path, torch.eye(4, dtype=torch.float64)) for sweep in looked_at]
    turn = _upright([one.points_m for one in seen])
    seen = [replace(one, points_m=one.points_m @ turn) for one in seen]  # by the transpose
    lidar_from_sensor = torch.eye(4, dtype=torch.float64)
    lidar_from_sensor[:3, :3] = torch.from_numpy(turn)
    sensor = preset_of(lidar_name) or _estimated(lidar_name, seen, scene)
    return MountedLidar(
        name=lidar_name, sensor=sensor, lidar_from_sensor=lidar_from_sensor, path=path
    )


def recorded_rays(scene: DrivingScene, sweep: Sweep, lidar: MountedLidar) -> SweepRays:
    """The rays of a recorded sweep: those that came back as measured, then those that did not."""
    seen = _seen_by(scene, sweep, lidar.path, lidar.lidar_from_sensor)
    sensor, range_m = lidar.sensor, np.linalg.norm(seen.points_m, axis=1)
    kept = np.flatnonzero(
        (range_m >= sensor.min_range_m) & (range_m <= sensor.max_range_m) & seen.is_first
    )
    seen, range_m = seen.select(kept), range_m[kept]
    beam = _beams(seen, sensor)
    world_from_sensor = lidar.world_from_sensor(torch.from_numpy(seen.time_ns))
    direction = torch.from_numpy(seen.points_m / range_m[:, None])
    rows = torch.arange(len(range_m))
    returned = _unanswered(
        world_from_sensor, direction, torch.from_numpy(seen.time_ns), torch.from_numpy(beam)
    )
    returned = replace(
        returned,
        range_m=torch.from_numpy(range_m),
        intensity=torch.from_numpy(seen.intensity)[rows].float(),
        is_returned=torch.ones(len(range_m), dtype=torch.bool),
    )
    missing = _missing(seen, beam, sensor)
    absent = _unanswered(
        lidar.world_from_sensor(torch.from_numpy(missing.time_ns)),
        torch.from_numpy(sensor.directions(missing.beam, missing.head_deg)),
        torch.from_numpy(missing.time_ns),
        torch.from_numpy(missing.beam),
    )
    pairs = ((getattr(returned, name), getattr(absent, name)) for name in vars(returned))
    return SweepRays(**dict(zip(vars(returned), map(torch.cat, pairs), strict=True)))


def _unanswered(
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


@dataclass(frozen=True, kw_only=True, eq=False)
class _Seen:
    """Points of a sweep as its sensor saw them, each at its own time."""

    points_m: Float[np.ndarray, "points 3"]
    time_ns: Int[np.ndarray, " points"]
    ring: Int[np.ndarray, " points"]
    intensity: Float[np.ndarray, " points"]
    is_first: Bool[np.ndarray, " points"]
    """Whether a point is the first return of its ray."""

    def select(self, rows: np.ndarray) -> "_Seen":
        return _Seen(**{name: column[rows] for name, column in vars(self).items()})

    @property
    def azimuth_deg(self) -> Float[np.ndarray, " points"]:
        return np.degrees(np.arctan2(self.points_m[:, 1], self.points_m[:, 0]))

    @property
    def elevation_deg(self) -> Float[np.ndarray, " points"]:
        return _elevation_deg(self.points_m)


def _elevation_deg(points_m: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, " points"]:
    range_m = np.maximum(np.linalg.norm(points_m, axis=1), 1e-6)
    return np.degrees(np.arcsin(np.clip(points_m[:, 2] / range_m, -1, 1)))


def _seen_by(
    scene: DrivingScene, sweep: Sweep, path: DrivenPath, lidar_from_sensor: Tensor
) -> _Seen:
    points, times_ns = scene.read_sweep(sweep), scene.measured_ns(sweep)
    different, places = torch.unique(times_ns, return_inverse=True)
    poses = path.driven_on(different).world_from_body @ lidar_from_sensor
    sensor_from_world = invert_rigid(poses)[places]
    xyz_m = points.xyz_m.double()
    turned = (sensor_from_world[:, :3, :3] @ xyz_m[:, :, None])[..., 0] + sensor_from_world[
        :, :3, 3
    ]
    return _Seen(
        points_m=turned.numpy(),
        time_ns=times_ns.numpy(),
        ring=points.ring.numpy().astype(np.int64),
        intensity=points.intensity.numpy(),
        is_first=(points.return_index == 0).numpy(),
    )


def _upright(seen_m: Sequence[Float[np.ndarray, "_ 3"]]) -> Float[np.ndarray, "3 3"]:
    """The turn `lidar_from_sensor` under which elevations fall onto the sharpest lines.

    Sharpness is the sum of squared counts of elevations; it is climbed from coarse counts, which
    reach far, to fine ones.
    """
    points_m = np.concatenate(seen_m)
    points_m = points_m[:: max(1, len(points_m) // MOST_TRIED)]
    points_m = points_m / np.maximum(np.linalg.norm(points_m, axis=1, keepdims=True), 1e-6)

    def sharpness(lean: np.ndarray, width_deg: float) -> float:
        up = np.array([lean[0], lean[1], 1.0])
        elevation = np.degrees(np.arcsin(np.clip(points_m @ (up / np.linalg.norm(up)), -1, 1)))
        counts = np.bincount(((elevation + 90) / width_deg).astype(int))
        return float(np.square(counts, dtype=float).sum() / len(elevation))

    lean, reach = np.zeros(2), LEANS_RAD
    for width_deg in SHARPNESS_DEG:
        steps = np.linspace(-reach, reach, 23 if reach == LEANS_RAD else 9)
        tried = [lean + np.array([a, b]) for a in steps for b in steps]
        lean = max(tried, key=lambda one: sharpness(one, width_deg))
        reach = max(2 * (steps[1] - steps[0]), np.radians(width_deg) / 4)
    level = max((np.zeros(2), lean), key=lambda one: sharpness(one, SHARPNESS_DEG[-1]))
    turned = rotation_from_vector(torch.tensor([-level[1], level[0], 0.0], dtype=torch.float64))
    found: Float[np.ndarray, "3 3"] = turned.numpy()
    return found


def _estimated(name: str, seen: Sequence[_Seen], scene: DrivingScene) -> LidarSensor:
    """A sensor from some of its sweeps.

    Raises:
        SceneError: their elevations do not lie on lines.
    """
    elevation = np.concatenate([one.elevation_deg for one in seen])
    ring = np.concatenate([one.ring for one in seen])
    if (ring >= 0).all():
        numbers = np.unique(ring)
        beams_deg = np.array([np.median(elevation[ring == number]) for number in numbers])
    else:
        beams_deg = _lines(elevation)
    if not 1 <= len(beams_deg) <= MOST_BEAMS:
        raise SceneError(
            f"{scene.path.name}: {len(beams_deg)} beams make up the sweeps of {name!r}, expected 1 "
            f"to {MOST_BEAMS}"
        )
    beams_deg = np.sort(beams_deg)[::-1]
    duration_ns = max(float(np.ptp(one.time_ns)) for one in seen)
    range_m = np.concatenate([np.linalg.norm(one.points_m, axis=1) for one in seen])
    draft = LidarSensor(
        name=name[:80],
        elevation_deg=tuple(beams_deg.round(4).tolist()),
        steps=1800,
        turn_s=min(duration_ns * 1e-9, 1.0),
        turns_left=_turns_left(seen[0]),
        min_range_m=float(max(np.quantile(range_m, 1e-4) * 0.9, 0.05)),
        max_range_m=float(min(range_m.max() * 1.05 + 1.0, 1000.0)),
    )
    return replace(draft, steps=_steps(seen[0], _beams(seen[0], draft), draft))


def _lines(elevation_deg: Float[np.ndarray, " points"]) -> Float[np.ndarray, " beams"]:
    """Elevations that many points share."""
    counts = np.bincount(((elevation_deg + 90) / LINE_DEG).astype(int), minlength=8).astype(float)
    smooth = gaussian_filter1d(counts, 1.5)
    is_peak = np.zeros(len(smooth), dtype=bool)
    is_peak[1:-1] = (smooth[1:-1] >= smooth[:-2]) & (smooth[1:-1] > smooth[2:])
    usual = np.median(smooth[is_peak & (smooth > smooth.max() / 10)])
    peaks = np.flatnonzero(is_peak & (smooth >= LEAST_SHARE * usual))
    found: Float[np.ndarray, " beams"] = (peaks + 0.5) * LINE_DEG - 90
    return found


def _turns_left(seen: _Seen) -> bool:
    """Whether azimuths grow with time; to the right where times do not tell."""
    order = np.argsort(seen.time_ns, kind="stable")
    azimuth = seen.azimuth_deg[order]
    turned = np.remainder(np.diff(azimuth[:: max(1, len(azimuth) // 500)]) + 180, 360) - 180
    return bool(np.ptp(seen.time_ns) > 0 and np.median(turned) > 0)


def _steps(seen: _Seen, beam: Int[np.ndarray, " points"], sensor: LidarSensor) -> int:
    """How many steps a turn has, by how far apart a beam's neighbours are."""
    gaps = []
    for one in range(sensor.num_beams):
        azimuth = np.sort(seen.azimuth_deg[beam == one])
        if len(azimuth) >= LEAST_BEAM_POINTS:
            gaps.append(np.diff(azimuth))
    if not gaps:
        return sensor.steps
    apart = np.concatenate(gaps)
    apart = apart[(apart > 0.02) & (apart < 2.0)]
    return int(np.clip(round(360 / float(np.median(apart))), 90, 8192)) if len(apart) else 1800


def _beams(seen: _Seen, sensor: LidarSensor) -> Int[np.ndarray, " points"]:
    """The beam of each point: by its ring where the log tells it, else by its elevation."""
    beams_deg = np.array(sensor.elevation_deg)
    rings = np.unique(seen.ring)
    if len(rings) == sensor.num_beams and rings[0] == 0 and rings[-1] == len(rings) - 1:
        middle = [np.median(seen.elevation_deg[seen.ring == ring]) for ring in rings]
        rank = np.empty(len(rings), dtype=np.int64)
        rank[np.argsort(middle)] = np.argsort(beams_deg)
        return rank[seen.ring]
    ascending = np.argsort(beams_deg)
    sorted_deg = beams_deg[ascending]
    between = (sorted_deg[1:] + sorted_deg[:-1]) / 2
    place = np.searchsorted(between, seen.elevation_deg)
    apart = np.abs(seen.elevation_deg - sorted_deg[place])
    gap = np.gradient(sorted_deg) if len(sorted_deg) > 1 else np.array([np.inf])
    return np.where(apart <= AWAY_DEG * gap[place], ascending[place], -1)


@dataclass(frozen=True, eq=False)
class _Missing:
    """Firings that nothing came back of."""

    beam: Int[np.ndarray, " rays"]
    head_deg: Float[np.ndarray, " rays"]
    time_ns: Int[np.ndarray, " rays"]


def _missing(seen: _Seen, beam: np.ndarray, sensor: LidarSensor) -> _Missing:
    """The steps of each beam that hold no point.

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
    time_ns = _step_times(step, seen.time_ns[known], sensor)[empty_step]
    return _Missing(beam=empty_beam, head_deg=empty_head, time_ns=time_ns)


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
    found: np.ndarray = np.interp(steps, known, means).astype(np.int64) + time_ns.min()
    return found
