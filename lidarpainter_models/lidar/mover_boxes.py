"""From what is seen of a thing that moves to its box: a size that lasts, a place in each frame.

A LiDAR sees the near faces only. The box is as long, wide and high as was ever seen (of a car that
shows its tail alone as cars are), points the way it goes, and stands behind the faces that are
seen. Places are smoothed forth and back (Rauch, Tung and Striebel, 1965).
World: z up. Box frame: x along the length, y left, z up, origin at the centre; metres, seconds.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.geometry.transforms import rigid_from_rotation, rotation_about_up
from lidarpainter_models.lidar.mover_tracks import FIRST_SPEED_MPS, middle, moved_on
from lidarpainter_models.lidar.moving_points import Clump

LEAST_FRAMES, LEAST_WAY_M, LEAST_SPEED_MPS = 5, 1.0, 0.5
LEAST_STRAIGHT, MOST_JITTER_M = 0.6, 0.6
"""Of a way, its ends' distance over its length; and how far clumps lie from it (RMS)."""
LEAST_TALL_M, MOST_HANGING_M = 0.5, 1.0
"""Of what is seen, from its lowest point to its highest; less is a lone ring at the edge of what
stands; and of its lowest point over the ground."""
HEADING_MPS = 0.7
"""Who goes slower points where it pointed when it went faster."""
ROUNDS = 3
END_SEEN, SIDE_SEEN = 0.35, 0.35
"""Sine of the angle under which a face is seen from which on it shows its width."""
CAR_M, PERSON_M, CYCLE_M = (4.5, 1.85, 1.5), (0.7, 0.7, 1.7), (1.8, 0.7, 1.6)
SLOW_M, NARROW_M = 1.25, 1.05
"""People are shorter, seen from above; people and cycles narrower."""
WALK_MPS, RIDE_MPS = 3.5, 9.0
"""Who is faster does not walk; nor ride a bicycle."""
OUTER = (2.0, 98.0)
"""Percentiles of points that make a face: mirrors and stray points stand out of it."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Mover:
    """Something that moves, boxed in every frame in which it was seen."""

    clumps: tuple[Clump, ...]
    category: str
    size_m: Float[np.ndarray, "3"]
    """Length, width, height."""
    world_from_box: Float[Tensor, "times 4 4"]
    """At the times of the clumps, float64."""
    velocity_mps: Float[np.ndarray, "times 2"]
    score: float
    """From 0 to 1: seen throughout, along an even way that is long enough."""

    @property
    def places_m(self) -> Float[np.ndarray, "times 2"]:
        """Centres, seen from above."""
        return np.asarray(self.world_from_box[:, :2, 3].numpy())

    @property
    def times_s(self) -> Float[np.ndarray, " times"]:
        """When each box holds."""
        return np.array([clump.time_ns for clump in self.clumps]) * 1e-9


def boxed(clumps: Sequence[Clump]) -> Mover | None:
    """The boxes of a track; None where it does not move, or moves as nothing does."""
    if len(clumps) < LEAST_FRAMES or not _stands(clumps):
        return None
    times_s = np.array([clump.time_ns for clump in clumps]) * 1e-9
    seen_m = np.array([middle(clump) for clump in clumps])
    sigma_m = np.full(len(clumps), 0.4)
    places_m, velocity = smoothed(times_s, seen_m, sigma_m)
    for _ in range(ROUNDS):
        yaw = _headings(velocity, places_m)
        views = [_FaceView.of(*one) for one in zip(clumps, yaw.tolist(), strict=True)]
        category, size_m = _shape(views, _speed(velocity))
        standing = [view.centre(size_m) for view in views]
        seen_m = np.array([place_m for place_m, _ in standing])
        sigma_m = np.array([sigma for _, sigma in standing])
        places_m, velocity = smoothed(times_s, seen_m, sigma_m)
    score = _score(times_s, places_m, seen_m)
    if score is None:
        return None
    ground_m, _ = smoothed(
        times_s, np.array([[one.ground_m] * 2 for one in clumps]), np.full(len(clumps), 0.1)
    )
    centres_m = np.column_stack([places_m, ground_m[:, 0] + size_m[2] / 2])
    turn = rotation_about_up(torch.from_numpy(_headings(velocity, places_m)))
    return Mover(
        clumps=tuple(clumps),
        category=category,
        size_m=size_m,
        world_from_box=rigid_from_rotation(turn, torch.from_numpy(centres_m)),
        velocity_mps=velocity,
        score=score,
    )


def _stands(clumps: Sequence[Clump]) -> bool:
    """Whether what is seen is tall enough and reaches down towards the ground."""
    tall_m = np.percentile([np.ptp(clump.points_m[:, 2]) for clump in clumps], 80)
    hangs_m = np.median([clump.points_m[:, 2].min() - clump.ground_m for clump in clumps])
    return bool(tall_m >= LEAST_TALL_M and hangs_m <= MOST_HANGING_M)


def smoothed(
    times_s: Float[np.ndarray, " times"],
    seen_m: Float[np.ndarray, "times 2"],
    sigma_m: Float[np.ndarray, " times"],
) -> tuple[Float[np.ndarray, "times 2"], Float[np.ndarray, "times 2"]]:
    """Places and velocities of an even motion through places that are seen with some deviation."""
    state = np.stack([seen_m[0], np.zeros(2)])
    covariance = np.diag([sigma_m[0] ** 2, FIRST_SPEED_MPS**2])
    kept, expected = [(state, covariance)], []
    for step_s, place_m, sigma in zip(np.diff(times_s), seen_m[1:], sigma_m[1:], strict=True):
        state, covariance = moved_on(state, covariance, step_s)
        expected.append((state, covariance))
        gain = covariance[:, 0] / (covariance[0, 0] + sigma**2)
        state = state + gain[:, None] * (place_m - state[0])
        covariance = covariance - np.outer(gain, covariance[0])
        kept.append((state, covariance))
    found = [kept[-1]]
    steps = zip(kept[-2::-1], expected[::-1], np.diff(times_s)[::-1], strict=True)
    for (state, covariance), (ahead, ahead_covariance), step_s in steps:
        step = np.array([[1.0, step_s], [0.0, 1.0]])
        back = covariance @ step.T @ np.linalg.inv(ahead_covariance)
        later, later_covariance = found[-1]
        state = state + back @ (later - ahead)
        covariance = covariance + back @ (later_covariance - ahead_covariance) @ back.T
        found.append((state, covariance))
    states = np.array([state for state, _ in found[::-1]])
    return states[:, 0], states[:, 1]


def _headings(
    velocity: Float[np.ndarray, "times 2"], places_m: Float[np.ndarray, "times 2"]
) -> Float[np.ndarray, " times"]:
    """Yaw in every frame: where it goes, or went when it went faster."""
    fast = np.flatnonzero(np.linalg.norm(velocity, axis=1) >= HEADING_MPS)
    if not len(fast):
        way_m = places_m[-1] - places_m[0]
        return np.full(len(velocity), np.arctan2(way_m[1], way_m[0]))
    rows = np.arange(len(velocity))
    nearest = fast[np.abs(rows[:, None] - fast).argmin(axis=1)]
    return np.asarray(np.arctan2(velocity[nearest, 1], velocity[nearest, 0]))


def _speed(velocity: Float[np.ndarray, "times 2"]) -> float:
    return float(np.percentile(np.linalg.norm(velocity, axis=1), 80))


@dataclass(frozen=True, kw_only=True, eq=False)
class _FaceView:
    """What of a thing is seen in one frame, along and across its heading."""

    axes: Float[np.ndarray, "2 2"]
    """World from heading, seen from above."""
    low_m: Float[np.ndarray, "2"]
    high_m: Float[np.ndarray, "2"]
    """Faces along the heading and to its left."""
    eye_m: Float[np.ndarray, "2"]
    """Where the LiDAR is, along the same axes."""
    height_m: float
    """Of what is seen, over the ground."""
    num_points: int

    @classmethod
    def of(cls, clump: Clump, yaw: float) -> "_FaceView":
        """Look at a clump along a heading."""
        axes = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
        low_m, high_m = np.percentile(clump.points_m[:, :2] @ axes, OUTER, axis=0)
        top_m = float(np.percentile(clump.points_m[:, 2], OUTER[1]))
        return cls(
            axes=axes,
            low_m=low_m,
            high_m=high_m,
            eye_m=clump.origin_m[:2] @ axes,
            height_m=top_m - clump.ground_m,
            num_points=len(clump.points_m),
        )

    @property
    def extent_m(self) -> Float[np.ndarray, "2"]:
        """Length and width of what is seen."""
        return self.high_m - self.low_m

    @property
    def slant(self) -> Float[np.ndarray, "2"]:
        """Cosines of the direction to the eye, along and across."""
        away_m = self.eye_m - (self.low_m + self.high_m) / 2
        return np.abs(away_m) / max(float(np.linalg.norm(away_m)), 1e-6)

    def centre(self, size_m: Float[np.ndarray, "3"]) -> tuple[Float[np.ndarray, "2"], float]:
        """Where the box stands in the world, seen from above, and how far off that may be."""
        half_m, centre_m, unsure_m = size_m[:2] / 2, np.zeros(2), 0.0
        for axis in (0, 1):
            least, most = sorted(
                (self.high_m[axis] - half_m[axis], self.low_m[axis] + half_m[axis])
            )
            seen = (self.low_m[axis] + self.high_m[axis]) / 2
            if self.eye_m[axis] < seen - half_m[axis]:
                centre_m[axis] = self.low_m[axis] + half_m[axis]
            elif self.eye_m[axis] > seen + half_m[axis]:
                centre_m[axis] = self.high_m[axis] - half_m[axis]
            else:  # beside it, either end may be hidden
                centre_m[axis] = (least + most) / 2
                unsure_m = max(unsure_m, (most - least) / 2)
        few_m = 0.5 / np.sqrt(max(self.num_points, 1))
        return self.axes @ centre_m, 0.08 + few_m + unsure_m


def _shape(views: Sequence[_FaceView], speed_mps: float) -> tuple[str, Float[np.ndarray, "3"]]:
    """Category and size of who is seen so."""
    extents_m = np.array([view.extent_m for view in views])
    slants = np.array([view.slant for view in views])
    longest_m, widest_m = np.percentile(extents_m, 90, axis=0)
    height_m = float(np.percentile([view.height_m for view in views], 90))
    if longest_m < SLOW_M and widest_m < NARROW_M and speed_mps < WALK_MPS:
        size_m = np.maximum([longest_m, widest_m, height_m], [0.5, 0.5, 1.4])
        return "pedestrian", size_m
    if longest_m < 2.4 and widest_m < NARROW_M and speed_mps < RIDE_MPS:
        return "bicycle", np.maximum([longest_m, widest_m, height_m], [1.6, 0.6, 1.4])
    shows_side, shows_end = slants[:, 1] >= SIDE_SEEN, slants[:, 0] >= END_SEEN
    length_m = _size(extents_m[:, 0], shows_side, CAR_M[0], least_m=3.6)
    width_m = min(_size(extents_m[:, 1], shows_end, CAR_M[1], least_m=1.6), 2.7)
    category = "car"
    if height_m > 2.4 or length_m > 6.5:
        category = "bus" if length_m > 9.5 else "truck"
    return category, np.array([length_m, width_m, max(height_m, 1.35)])


def _size(
    extents_m: Float[np.ndarray, " times"], shows: np.ndarray, usual_m: float, *, least_m: float
) -> float:
    """As large as it was ever seen, where that tells its size; else as is usual."""
    if shows.sum() < 2:
        return max(float(np.percentile(extents_m, 90)), usual_m)
    return max(float(np.percentile(extents_m[shows], 90)), least_m)


def _score(
    times_s: np.ndarray, places_m: Float[np.ndarray, "times 2"], seen_m: np.ndarray
) -> float | None:
    """How sure it is that something moves; None where it does not."""
    steps_m = np.linalg.norm(np.diff(places_m, axis=0), axis=1)
    way_m = float(np.linalg.norm(places_m - places_m[0], axis=1).max())
    jitter_m = float(np.sqrt(((seen_m - places_m) ** 2).sum(axis=1).mean()))
    seconds = float(times_s[-1] - times_s[0])
    if way_m < LEAST_WAY_M or way_m / seconds < LEAST_SPEED_MPS:
        return None
    straight = way_m / max(float(steps_m.sum()), 1e-6)
    if straight < LEAST_STRAIGHT or jitter_m > MOST_JITTER_M or way_m < 3 * jitter_m:
        return None
    usual_s = float(np.median(np.diff(times_s)))
    seen = min(1.0, len(times_s) * usual_s / (seconds + usual_s))
    return round(seen * min(1.0, way_m / 3.0) / (1 + (jitter_m / 0.4) ** 2), 3)
