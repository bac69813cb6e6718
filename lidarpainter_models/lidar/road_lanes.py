"""The road that was driven as lanes beside a line, by its markings in the LiDAR points.

World frame, z up, metres. Road coordinates are (s, d): metres along the smoothed path of the
recording car and to its left. Markings along the road fill a histogram over d: where they show on a
good part of its length there is a line, solid or broken, and two lines a lane's width apart enclose
a lane. Who drives against us tells which lanes do. Where no marking tells a lane its width is
assumed, and said to be.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.ndimage import gaussian_filter1d
from scipy.signal import find_peaks
from scipy.spatial import cKDTree

from lidarpainter_models.geometry.driven_paths import DrivenPath
from lidarpainter_models.lidar.ground_surface import GroundSurface
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.tracks import ActorTrack

STEP_M = 0.5
"""Between samples of the road's line."""
SMOOTH_M = 2.0
"""Deviation of the Gaussian that takes the jitter of poses off the line."""
MOST_BEYOND_M = 40.0
"""The line goes straight on past both ends of the path so far, while there is ground."""
ASSUMED_LANE_M = 3.5
NARROWEST_M, WIDEST_M = 2.5, 4.6
"""Of a lane between two lines; what is wider is two lanes with no line between, or none."""
MOST_ASIDE_M, BIN_M = 12.0, 0.1
BEYOND_SEEN_M = 10.0
"""Markings count so far past the ends of the path: farther on the road may turn."""
LEAST_SHARE, SOLID_SHARE = 0.12, 0.6
"""Of the length of the road on which a line shows: a broken one shows on a quarter of it."""
LEAST_BRIGHT = 3.0
"""Paint returns more than the road does, by so many deviations of the road at its range."""
RANGE_BIN_M, MOST_RANGE_M = 3.0, 30.0
ON_ROAD_M = 0.05
"""Paint is flat: what is higher above the ground or deeper below it is none."""

KERB_M = 0.06
"""What rises or falls by more within two bins is no road to drive on, but a kerb."""

Mark = Literal["solid", "broken", "none"]


@dataclass(frozen=True, eq=False, kw_only=True)
class RoadLine:
    """Samples of the line that the recording car drove, straight on past its ends."""

    xy_m: Float[np.ndarray, "samples 2"]
    from_m: float
    """s of the first sample; s = 0 is where the recording begins."""

    @cached_property
    def s_m(self) -> Float[np.ndarray, " samples"]:
        """Metres along the line."""
        steps = np.linalg.norm(np.diff(self.xy_m, axis=0), axis=1)
        return np.concatenate([[0.0], np.cumsum(steps)]) + self.from_m

    @cached_property
    def ahead(self) -> Float[np.ndarray, "samples 2"]:
        """Unit direction at every sample."""
        tangent = np.gradient(self.xy_m, axis=0)
        return tangent / np.linalg.norm(tangent, axis=1, keepdims=True)

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(self.xy_m)

    def place(
        self, s_m: Float[np.ndarray, "*#places"], d_m: Float[np.ndarray, "*#places"] | float
    ) -> Float[np.ndarray, "... 2"]:
        """World x and y of road coordinates."""
        x, y, u, v = (np.interp(s_m, self.s_m, column) for column in (*self.xy_m.T, *self.ahead.T))
        norm = np.hypot(u, v)
        return np.stack([x - d_m * v / norm, y + d_m * u / norm], axis=-1)

    def coordinates(self, xy_m: Float[np.ndarray, "places 2"]) -> Float[np.ndarray, "places 2"]:
        """Road coordinates (s, d) of places in the world."""
        _, nearest = self._tree.query(xy_m)
        offset, ahead = xy_m - self.xy_m[nearest], self.ahead[nearest]
        s_m = self.s_m[nearest] + (offset * ahead).sum(axis=1)
        return np.stack([s_m, ahead[:, 0] * offset[:, 1] - ahead[:, 1] * offset[:, 0]], axis=1)


@dataclass(frozen=True, slots=True, kw_only=True)
class Lane:
    """A lane, all along the road."""

    right_d_m: float
    left_d_m: float
    right_mark: Mark = "none"
    left_mark: Mark = "none"
    is_forward: bool = True
    """Whether it is driven in the direction of the recording car."""
    is_driving: bool = True
    """Whether it is a lane, or only ground beside one that may be driven on."""
    assumed: str = ""
    """What of it no marking tells; empty where markings tell all."""

    @property
    def middle_d_m(self) -> float:
        """Where its middle is, to the left of the line."""
        return (self.left_d_m + self.right_d_m) / 2


@dataclass(frozen=True, eq=False, kw_only=True)
class Road:
    """The driven road."""

    line: RoadLine
    lanes: tuple[Lane, ...]
    """From right to left, each beginning where the one before ends."""
    own: int
    """Which of them was driven."""

    @property
    def lane(self) -> Lane:
        """The lane that was driven."""
        return self.lanes[self.own]

    def holds(self, xy_m: Float[np.ndarray, "places 2"]) -> Bool[np.ndarray, " places"]:
        """Which places lie on a lane or on ground beside it that may be driven on."""
        s_m, d_m = self.line.coordinates(xy_m).T
        is_beside = (d_m >= self.lanes[0].right_d_m) & (d_m <= self.lanes[-1].left_d_m)
        return is_beside & (s_m >= self.line.s_m[0]) & (s_m <= self.line.s_m[-1])


def driven_line(path: DrivenPath, ground: GroundSurface) -> RoadLine:
    """The line of a path, smoothed, straight on as long as there is ground beside it."""
    driven = path.world_from_body[:, :2, 3].numpy()
    travelled_m = path.travelled_m.numpy()
    length_m, ahead = float(travelled_m[-1]), path.directions.numpy()[:, :2]
    moved = np.concatenate([[True], np.diff(travelled_m) > 1e-6])
    s_m = np.arange(0, max(length_m, STEP_M) + STEP_M / 2, STEP_M)
    xy_m = np.stack([np.interp(s_m, travelled_m[moved], axis[moved]) for axis in driven.T], axis=1)
    xy_m += np.maximum(s_m - length_m, 0)[:, None] * ahead[-1]
    spare = round(4 * SMOOTH_M / STEP_M)  # a filter bends the ends, which are cut off again
    beyond = np.arange(1, MOST_BEYOND_M / STEP_M + spare + 1)[:, None] * STEP_M
    before, after = xy_m[0] - beyond[::-1] * ahead[0], xy_m[-1] + beyond * ahead[-1]
    samples = np.concatenate([before, xy_m, after])
    smooth = gaussian_filter1d(samples, SMOOTH_M / STEP_M, axis=0, mode="nearest")
    start, end = len(before), len(before) + len(xy_m)
    first = start - _num_on_ground(smooth[start - 1 : spare - 1 : -1], ahead[0], ground)
    last = end + _num_on_ground(smooth[end : len(smooth) - spare], ahead[-1], ground)
    return RoadLine(xy_m=smooth[first:last], from_m=(first - start) * STEP_M)


def _num_on_ground(
    xy_m: Float[np.ndarray, "samples 2"], ahead: Float[np.ndarray, "2"], ground: GroundSurface
) -> int:
    """How many samples come before the first where most of a lane's width has no ground."""
    across = np.linspace(-1.5, 1.5, 7)[:, None, None] * np.array([-ahead[1], ahead[0]])
    is_known = np.isfinite(ground.at(xy_m + across)).mean(axis=0) >= 0.5
    return len(xy_m) if is_known.all() else int(is_known.argmin())


def marking_points(
    scene: DrivingScene, frames: Collection[int], ground: GroundSurface
) -> Float[np.ndarray, "points 2"]:
    """World x and y of points on lane markings.

    Those that the dataset calls so, or else returns from the road that are brighter than it.
    """
    named = [
        number
        for number, name in scene.semantic_classes.items()
        if "lane" in name.lower() and "mark" in name.lower()
    ]
    wanted, found = set(frames), [np.zeros((0, 2))]
    for frame in scene.swept_frames if named else ():
        classes = scene.read_semantics(frame) if frame in wanted else None
        if classes is not None:
            is_marked = torch.isin(classes, torch.tensor(named))
            found.append(scene.read_positions(frame)[is_marked, :2].double().numpy())
    if len(found) > 1:
        return np.concatenate(found)
    for sweep in scene.sweeps:  # two LiDARs see the same paint with different strength
        if sweep.frame_index in wanted:
            points = scene.read_sweep(sweep)
            xyz_m = points.xyz_m.double().numpy()
            range_m = np.linalg.norm(xyz_m - sweep.world_from_lidar[:3, 3].numpy(), axis=1)
            on_road = np.abs(xyz_m[:, 2] - ground.at(xyz_m[:, :2])) < ON_ROAD_M
            bright = _is_bright(points.intensity.numpy()[on_road], range_m[on_road])
            found.append(xyz_m[on_road][bright, :2])
    return np.concatenate(found)


def _is_bright(
    intensity: Float[np.ndarray, " points"], range_m: Float[np.ndarray, " points"]
) -> Bool[np.ndarray, " points"]:
    """Which returns are brighter than those of the road at their range."""
    is_bright = np.zeros(len(intensity), bool)
    ring = (range_m / RANGE_BIN_M).astype(int)
    for one in range(int(MOST_RANGE_M / RANGE_BIN_M)):
        rows = np.flatnonzero(ring == one)
        if len(rows) > 20:
            middle = np.median(intensity[rows])
            deviation = 1.4826 * np.median(np.abs(intensity[rows] - middle))
            is_bright[rows] = intensity[rows] > middle + LEAST_BRIGHT * max(deviation, 1e-6)
    return is_bright


def driven_road_lanes(
    line: RoadLine,
    markings_m: Float[np.ndarray, "points 2"],
    ground: GroundSurface,
    tracks: Sequence[ActorTrack],
    *,
    path_length_m: float,
    trusted_m: tuple[float, float],
) -> Road:
    """Find the lanes of the driven road.

    Args:
        line: the line that was driven.
        markings_m: world x and y of points on lane markings.
        ground: what is level with the lane may be driven on too, where no marking tells a lane.
        tracks: who drives there, and in which direction.
        path_length_m: how long the recorded path is.
        trusted_m: how far to the left and to the right of it the scene is trusted.
    """
    lines = _lines(line.coordinates(markings_m), path_length_m)
    right = max((d for d in lines if -WIDEST_M < d < -0.6), default=None)
    left = min((d for d in lines if 0.6 < d < WIDEST_M), default=None)
    if left is None and right is None:
        return _assumed_road(line, ground, trusted_m)
    assumed = "one edge has no marking: 3.5 m wide"
    if left is None or (right is not None and left - right > WIDEST_M and -right < left):
        first = right or 0.0
        last = first + ASSUMED_LANE_M
    elif right is None or left - right > WIDEST_M:
        first, last = left - ASSUMED_LANE_M, left
    else:
        first, last, assumed = right, left, ""
    edges = [first, last]
    for d in sorted(d for d in lines if d > last):
        edges += [d] if NARROWEST_M <= d - edges[-1] <= WIDEST_M else []
    for d in sorted((d for d in lines if d < first), reverse=True):
        edges = [d, *edges] if NARROWEST_M <= edges[0] - d <= WIDEST_M else edges
    own = edges.index(first)
    against = _against(line, tracks)
    lanes: list[Lane] = []
    for number, (low, high) in enumerate(pairwise(edges)):
        votes = [is_against for d, is_against in against if low < d < high]
        is_behind_solid = number > own and (lines.get(low) == "solid" or not lanes[-1].is_forward)
        is_forward = number <= own or not (np.mean(votes) > 0.5 if votes else is_behind_solid)
        said = assumed if number == own else "" if votes else "nobody showed its direction"
        lanes.append(
            Lane(
                right_d_m=low,
                left_d_m=high,
                right_mark=lines.get(low, "none"),
                left_mark=lines.get(high, "none"),
                is_forward=is_forward,
                assumed=said,
            )
        )
    return Road(line=line, lanes=tuple(lanes), own=own)


def _lines(markings_sd: Float[np.ndarray, "points 2"], path_length_m: float) -> dict[float, Mark]:
    """The lines along the road, by how far to the left they are."""
    s_m, d_m = markings_sd.T
    low_m, high_m = -BEYOND_SEEN_M, path_length_m + BEYOND_SEEN_M
    used = (s_m > low_m) & (s_m < high_m) & (np.abs(d_m) < MOST_ASIDE_M)
    shape = (int((high_m - low_m) / STEP_M) + 1, int(2 * MOST_ASIDE_M / BIN_M) + 1)
    seen = np.zeros(shape, bool)
    along = ((s_m[used] - low_m) / STEP_M).astype(int)
    seen[along, ((d_m[used] + MOST_ASIDE_M) / BIN_M).astype(int)] = True
    beside = seen.copy()  # a line is as wide as a bin, and may lie on the edge of two
    beside[:, 1:] |= seen[:, :-1]
    share = gaussian_filter1d(beside.mean(axis=0), 1.0)
    peaks, _ = find_peaks(share, height=LEAST_SHARE, distance=round(1.0 / BIN_M))
    return {
        round(float(peak * BIN_M - MOST_ASIDE_M), 2): (
            "solid" if share[peak] > SOLID_SHARE else "broken"
        )
        for peak in peaks
    }


def _against(line: RoadLine, tracks: Sequence[ActorTrack]) -> list[tuple[float, bool]]:
    """Of everybody who drives along the road: d, and whether against our direction."""
    found = []
    for track in tracks:
        xy_m = track.world_from_box[:, :2, 3].numpy()
        way = xy_m[-1] - xy_m[0]
        if track.is_moving and np.linalg.norm(way) > 5.0:
            sd = line.coordinates(xy_m)
            along = sd[-1, 0] - sd[0, 0]
            if abs(along) > 0.9 * np.linalg.norm(way):
                found.append((float(np.median(sd[:, 1])), bool(along < 0)))
    return found


def _assumed_road(line: RoadLine, ground: GroundSurface, trusted_m: tuple[float, float]) -> Road:
    """One lane of usual width, and beside it the level ground on which the scene is trusted."""
    half = ASSUMED_LANE_M / 2
    aside = np.arange(half, MOST_ASIDE_M, BIN_M)
    lanes = [Lane(right_d_m=-half, left_d_m=half, assumed="no marking: 3.5 m wide")]
    for side, reach_m in zip((1, -1), trusted_m, strict=True):
        places = line.place(line.s_m[:, None], side * aside[None])
        rise_m = ground.at(places) - ground.at(line.place(line.s_m, 0.0))[:, None]
        profile_m = np.median(np.nan_to_num(rise_m, nan=np.inf), axis=0)
        with np.errstate(invalid="ignore"):  # unknown beside unknown
            is_level = np.append(np.abs(profile_m[2:] - profile_m[:-2]) < KERB_M, [False, False])
        free = int(is_level.argmin())
        edge = half + min(free * BIN_M, reach_m)
        if edge - half > 0.3:
            ends = (half, edge) if side > 0 else (-edge, -half)
            beside = Lane(
                right_d_m=ends[0],
                left_d_m=ends[1],
                is_driving=False,
                assumed="level ground on which the scene is trusted",
            )
            lanes = [*lanes, beside] if side > 0 else [beside, *lanes]
    own = next(row for row, lane in enumerate(lanes) if lane.is_driving)
    return Road(line=line, lanes=tuple(lanes), own=own)
