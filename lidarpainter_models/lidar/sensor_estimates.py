"""What the sweeps of a log tell of their sensor: how it leans, where its beams look, its steps.

Frames as in `lidar.sensors`; metres.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, product

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.ndimage import gaussian_filter1d
from torch import Tensor

from lidarpainter_models.errors import SceneError
from lidarpainter_models.geometry.driven_paths import DrivenPath
from lidarpainter_models.geometry.transforms import invert_rigid, rotation_from_vector
from lidarpainter_models.lidar.sensors import MOST_BEAMS, LidarSensor
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.records import Sweep

LEANS_RAD = np.radians(2.75)
"""No sensor is taken to lean by more."""
SHARPNESS_DEG = (0.4, 0.2, 0.1, 0.05, 0.025)
"""Lines of elevations are looked for ever more finely."""
NEAR_M = 12.0
"""By points so near it is told where the sensor is: of farther ones a centimetre is nothing."""
PLACED_M = (0.02, 0.01, 0.005, 0.0025)
"""How far its place is looked for from the last guess, again and again."""
SURER = 1.02
"""A place is another one where the lines of near points are so much sharper from there, and those
of all points no less sharp."""
MOST_TRIED = 40_000
LINE_DEG, LEAST_SHARE = 0.02, 0.1
"""Elevations are counted in steps of so much; a beam has so much of the points of the median."""
MOST_BETWEEN = 0.35
"""Beams are told apart where the least between two of them is no more than this of a usual one."""
LEAST_BEAM_POINTS = 20
AWAY_DEG = 0.75
"""A point that lies so many times the distance of two beams from all of them is of none."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SeenPoints:
    """Points of a sweep as its sensor saw them, each at its own time."""

    points_m: Float[np.ndarray, "points 3"]
    time_ns: Int[np.ndarray, " points"]
    ring: Int[np.ndarray, " points"]
    intensity: Float[np.ndarray, " points"]
    is_first: Bool[np.ndarray, " points"]
    """Whether a point is the first return of its ray."""

    def select(self, rows: np.ndarray) -> "SeenPoints":
        """Some of the points."""
        return SeenPoints(**{name: column[rows] for name, column in vars(self).items()})

    @property
    def azimuth_deg(self) -> Float[np.ndarray, " points"]:
        """Counter-clockwise from ahead."""
        return np.degrees(np.arctan2(self.points_m[:, 1], self.points_m[:, 0]))

    @property
    def elevation_deg(self) -> Float[np.ndarray, " points"]:
        """Above the sensor's own horizon."""
        range_m = np.maximum(np.linalg.norm(self.points_m, axis=1), 1e-6)
        return np.degrees(np.arcsin(np.clip(self.points_m[:, 2] / range_m, -1, 1)))


def points_seen(
    scene: DrivingScene, sweep: Sweep, path: DrivenPath, lidar_from_sensor: Tensor
) -> SeenPoints:
    """The points of a sweep, each from where its sensor was at its time."""
    points, times_ns = scene.read_sweep(sweep), scene.measured_ns(sweep)
    different, places = torch.unique(times_ns, return_inverse=True)
    poses = path.driven_on(different).world_from_body @ lidar_from_sensor
    sensor_from_world = invert_rigid(poses)[places]
    turned = (sensor_from_world[:, :3, :3] @ points.xyz_m.double()[:, :, None])[..., 0]
    return SeenPoints(
        points_m=(turned + sensor_from_world[:, :3, 3]).numpy(),
        time_ns=times_ns.numpy(),
        ring=points.ring.numpy().astype(np.int64),
        intensity=points.intensity.numpy(),
        is_first=(points.return_index == 0).numpy(),
    )


def sensor_seat(seen_m: Sequence[Float[np.ndarray, "_ 3"]]) -> Float[np.ndarray, "4 4"]:
    """The pose `lidar_from_sensor` from which elevations fall onto the sharpest lines.

    Sharpness is the sum of squared counts of elevations. How the sensor leans is climbed from
    coarse counts, which reach far, to fine ones; then where its beams meet, a few centimetres
    from where a log has it: a centimetre is 0.15 degrees of a beam that meets the road at 4 m.
    """
    all_m = np.concatenate(seen_m)
    near_m = all_m[np.linalg.norm(all_m, axis=1) < NEAR_M]
    far, near = (one[:: max(1, len(one) // MOST_TRIED)] for one in (all_m, near_m))

    def sharpness(seat: np.ndarray, width_deg: float, points_m: np.ndarray) -> float:
        away_m = points_m - seat[2:]
        up = np.array([seat[0], seat[1], 1.0]) / math.hypot(seat[0], seat[1], 1.0)
        sine = (away_m @ up) / np.maximum(np.linalg.norm(away_m, axis=1), 1e-6)
        place = (np.degrees(np.arcsin(np.clip(sine, -1, 1))) + 90) / width_deg
        lower = place.astype(int)  # each counts in two bins, so that none has an edge
        last = int(lower.max()) + 2
        counts = np.bincount(lower, 1 - place + lower, last)
        counts += np.bincount(lower + 1, place - lower, last)
        return float(np.square(counts).sum() / max(len(place), 1))

    def climbed(
        seat: np.ndarray, axes: Sequence[int], steps: np.ndarray, points_m: np.ndarray
    ) -> np.ndarray:
        tried = [seat + one for one in _grid(axes, steps)]
        return max(tried, key=lambda one: sharpness(one, width_deg, points_m))

    seat, reach, finest = np.zeros(5), LEANS_RAD, SHARPNESS_DEG[-1]
    for width_deg in SHARPNESS_DEG:
        steps = np.linspace(-reach, reach, 23 if reach == LEANS_RAD else 9)
        seat = climbed(seat, (0, 1), steps, far)
        reach = max(2 * (steps[1] - steps[0]), np.radians(width_deg) / 4)
    seat = max((np.zeros(5), seat), key=lambda one: sharpness(one, finest, far))
    leant = seat
    for reach_m in PLACED_M:
        for axes in ((4,), (2,), (3,)):
            seat = climbed(seat, axes, np.linspace(-reach_m, reach_m, 9), near)
        seat = climbed(seat, (0, 1), np.linspace(-reach_m, reach_m, 5) / 10, far)
    is_surer = sharpness(seat, finest, near) > SURER * sharpness(leant, finest, near)
    if not is_surer or sharpness(seat, finest, far) < sharpness(leant, finest, far):
        seat = leant
    found = np.eye(4)
    lean = torch.tensor([-seat[1], seat[0], 0.0], dtype=torch.float64)
    found[:3, :3], found[:3, 3] = rotation_from_vector(lean).numpy(), seat[2:]
    return found


def _grid(axes: Sequence[int], steps: np.ndarray) -> Iterator[Float[np.ndarray, "5"]]:
    """Changes of a seat (lean ahead and left, place) along some axes, no change first."""
    for values in sorted(product(steps, repeat=len(axes)), key=lambda one: np.square(one).sum()):
        change = np.zeros(5)
        change[list(axes)] = values
        yield change


def beam_elevations(seen: Sequence[SeenPoints]) -> tuple[Float[np.ndarray, " beams"], bool]:
    """Elevations of the beams of some sweeps, and whether they are told apart."""
    elevation = np.concatenate([one.elevation_deg for one in seen])
    ring = np.concatenate([one.ring for one in seen])
    if (ring >= 0).all():
        numbers = np.unique(ring)
        middles = [np.median(elevation[ring == number]) for number in numbers]
        return np.array(middles), True
    return _lines(elevation)


def estimated_sensor(
    name: str,
    seen: Sequence[SeenPoints],
    beams_deg: Float[np.ndarray, " beams"],
    scene: DrivingScene,
) -> LidarSensor:
    """A sensor from some of its sweeps.

    Raises:
        SceneError: their elevations do not lie on lines.
    """
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
    return replace(draft, steps=_steps(seen[0], beams_of(seen[0], draft), draft))


def _lines(
    elevation_deg: Float[np.ndarray, " points"],
) -> tuple[Float[np.ndarray, " beams"], bool]:
    """Elevations that many points share, each the median of its own, and whether few lie between.

    A point is of the nearest line, unless it lies farther from it than half of the least gap.
    """
    bins = ((elevation_deg + 90) / LINE_DEG).astype(int)
    counts = np.bincount(bins, minlength=int(180 / LINE_DEG) + 2)  # none at either end is a line
    smooth = gaussian_filter1d(counts.astype(float), 1.5)
    is_peak = np.zeros(len(smooth), dtype=bool)
    is_peak[1:-1] = (smooth[1:-1] >= smooth[:-2]) & (smooth[1:-1] > smooth[2:])
    heights = smooth[is_peak & (smooth > smooth.max() / 10)]
    usual = np.median(heights) if len(heights) else np.inf
    peaks = np.flatnonzero(is_peak & (smooth >= LEAST_SHARE * usual))
    between = [smooth[one:other].min() for one, other in pairwise(peaks)]
    valley = np.median(between) if between else 0.0
    lines_deg = (peaks + 0.5) * LINE_DEG - 90
    reach_deg = np.diff(lines_deg).min() / 2 if len(lines_deg) > 1 else np.inf
    ascending = np.sort(elevation_deg)
    starts, ends = (np.searchsorted(ascending, lines_deg + side * reach_deg) for side in (-1, 1))
    middles = [np.median(ascending[one:other]) for one, other in zip(starts, ends, strict=True)]
    return np.array(middles), bool(valley <= MOST_BETWEEN * usual)


def _turns_left(seen: SeenPoints) -> bool:
    """Whether azimuths grow with time; to the right where times do not tell."""
    order = np.argsort(seen.time_ns, kind="stable")
    azimuth = seen.azimuth_deg[order]
    turned = np.remainder(np.diff(azimuth[:: max(1, len(azimuth) // 500)]) + 180, 360) - 180
    return bool(np.ptp(seen.time_ns) > 0 and np.median(turned) > 0)


def _steps(seen: SeenPoints, beam: Int[np.ndarray, " points"], sensor: LidarSensor) -> int:
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


def beams_of(seen: SeenPoints, sensor: LidarSensor) -> Int[np.ndarray, " points"]:
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
