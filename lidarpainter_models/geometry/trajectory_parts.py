"""What trajectories are made of: steps off a path, and whole paths in its place.

World: x forward, y left, z up. Offsets count in the road frame: along the path, left of it, up.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lidarpainter_models.geometry.driven_paths import DrivenPath
from lidarpainter_models.geometry.trajectory_words import ConstantStep, PathWords, Step
from lidarpainter_models.geometry.transforms import rigid_from_rotation, rotation_about_up
from lidarpainter_models.geometry.waypoints import Waypoints

FOLLOW_BEHIND_M = 10.0
"""From the middle of the actor that is followed to the body that follows it."""
ORBIT_RADIUS_M = 8.0
ORBIT_HEIGHT_M = 3.0
"""Above the middle of the actor that is circled once in a log."""
SLOW_MPS = 1.0
"""Below this speed a lane change no longer turns the body: it would stand across the road."""
UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)

PathOf = Callable[[str], DrivenPath]
"""The path of an actor by its name."""


class Moments(NamedTuple):
    """When a path is followed, and at which of its poses."""

    rows: Int[Tensor, " moments"]
    """Of the path that gives the road."""
    seconds: Float[Tensor, " moments"]
    """Since the log began."""
    progress: Float[Tensor, " moments"]
    """0 at the first moment that is followed, 1 at the last."""
    log_s: float
    """Length of the log."""


class Offsets(NamedTuple):
    """Steps off a path, at every moment."""

    along_m: Float[Tensor, " moments"]
    lateral_m: Float[Tensor, " moments"]
    up_m: Float[Tensor, " moments"]
    yaw_rad: Float[Tensor, " moments"]

    @classmethod
    def none(cls, count: int) -> "Offsets":
        """On the path."""
        return cls(*torch.zeros(4, count, dtype=torch.float64))

    def plus(self, other: "Offsets") -> "Offsets":
        """Both steps."""
        return Offsets(*(mine + theirs for mine, theirs in zip(self, other, strict=True)))


def offsets_of(step: Step, moments: Moments, road: DrivenPath) -> Offsets:
    """A step at every moment; in a lane change with times the heading follows the path."""
    if isinstance(step, ConstantStep):
        steps = (step.along_m, step.lateral_m, step.up_m, step.yaw_rad)
        return Offsets(*(torch.full_like(moments.seconds, one) for one in steps))
    found = Offsets.none(len(moments.seconds))
    if step.start_s is None:
        share, _ = _smooth_step(moments.progress)
        return found._replace(lateral_m=step.width_m * share)
    share, rate = _smooth_step((moments.seconds - step.start_s) / step.duration_s)
    sideways_mps = step.width_m * rate / step.duration_s
    speed_mps = road.speed_mps[moments.rows]
    yaw_rad = torch.atan2(sideways_mps, speed_mps)
    moves = speed_mps > SLOW_MPS
    return found._replace(lateral_m=step.width_m * share, yaw_rad=torch.where(moves, yaw_rad, 0.0))


def other_poses(
    path: PathWords, waypoints: Waypoints | None, moments: Moments, own: DrivenPath, path_of: PathOf
) -> Float[Tensor, "moments 4 4"]:
    """Where a body is that follows another path than the recorded one, `own`.

    `waypoints` is what the path's file says.
    """
    if waypoints is not None:
        return _along_waypoints(waypoints, moments, own)
    if path.actor is None:
        places = own.world_from_body[moments.rows, :3, 3] + path.height_m * UP
        return _looking(-UP, own.directions[moments.rows], places)
    other = path_of(path.actor).at(own.timestamps_ns[moments.rows])
    centres = other.world_from_body[:, :3, 3]
    if not path.looks:
        places = centres - FOLLOW_BEHIND_M * other.directions
        places[:, 2] = own.height_near(places[:, :2])
        return headed(places, torch.atan2(*other.directions[:, [1, 0]].unbind(1)))
    angle = 2 * math.pi * moments.progress + math.pi
    circle = torch.stack([angle.cos(), angle.sin(), torch.zeros_like(angle)], dim=1)
    away = ORBIT_RADIUS_M * circle + ORBIT_HEIGHT_M * UP
    toward = torch.nn.functional.normalize(-away, dim=1)
    return _looking(toward, UP.expand_as(toward), centres + away)


def headed(
    places: Float[Tensor, "moments 3"], yaw_rad: Float[Tensor, " moments"]
) -> Float[Tensor, "moments 4 4"]:
    """Level poses at some places with some headings."""
    return rigid_from_rotation(rotation_about_up(yaw_rad), places)


def _along_waypoints(
    waypoints: Waypoints, moments: Moments, own: DrivenPath
) -> Float[Tensor, "moments 4 4"]:
    columns = waypoints.columns_at(moments.seconds, moments.log_s)
    xy_m = torch.stack([columns["x_m"], columns["y_m"]], dim=1)
    z_m = columns["z_m"] if "z_m" in columns else own.height_near(xy_m)
    places = torch.cat([xy_m, z_m[:, None]], dim=1)
    if "yaw_rad" in columns:
        return headed(places, columns["yaw_rad"])
    # the way to the next place gives the heading, also where the body stands at an end of it
    ways = waypoints.columns_at(moments.seconds + 0.1, moments.log_s)
    back = waypoints.columns_at(moments.seconds - 0.1, moments.log_s)
    away = torch.stack([ways[name] - back[name] for name in ("x_m", "y_m")], dim=1)
    known = (away.norm(dim=1) > 1e-6).nonzero()[:, 0]
    if len(known):
        nearest = (torch.arange(len(away))[:, None] - known).abs().argmin(dim=1)
        away = away[known[nearest]]
    else:
        away = own.directions[moments.rows, :2]
    return headed(places, torch.atan2(away[:, 1], away[:, 0]))


def _looking(
    forward: Float[Tensor, "*moments 3"],
    up: Float[Tensor, "moments 3"],
    places: Float[Tensor, "moments 3"],
) -> Float[Tensor, "moments 4 4"]:
    """Poses that look forward, turned until up is as far up as it can be."""
    forward = forward.expand_as(up)
    left = torch.nn.functional.normalize(torch.linalg.cross(up, forward), dim=1)
    axes = torch.stack([forward, left, torch.linalg.cross(forward, left)], dim=2)
    return rigid_from_rotation(axes, places)


def _smooth_step(
    progress: Float[Tensor, " moments"],
) -> tuple[Float[Tensor, " moments"], Float[Tensor, " moments"]]:
    """From 0 to 1, and its rate of change."""
    share = progress.clamp(0, 1)
    rate = 30 * share**2 * (1 - share) ** 2
    return share**3 * (10 - 15 * share + 6 * share**2), rate
