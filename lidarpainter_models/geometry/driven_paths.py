"""The way a body went, the ego vehicle or an actor, and where it is farther along.

World: x forward, y left, z up. Body: x forward, y left, z up, wherever its origin is; metres.
"""

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lidarpainter_models.geometry.trajectories import road_directions
from lidarpainter_models.geometry.transforms import interpolate_rigid, invert_rigid


@dataclass(frozen=True, eq=False, kw_only=True)
class DrivenPath:
    """Poses of one body in order of time; one that stands still has its heading for a road."""

    timestamps_ns: Int[Tensor, " times"]
    world_from_body: Float[Tensor, "times 4 4"]
    """float64."""

    def __len__(self) -> int:
        return len(self.timestamps_ns)

    @cached_property
    def directions(self) -> Float[Tensor, "times 3"]:
        """Driving direction in the ground plane at every pose."""
        return road_directions(self.world_from_body)

    @cached_property
    def travelled_m(self) -> Float[Tensor, " times"]:
        """Way gone since the first pose, over the ground."""
        steps_m = (self.world_from_body[1:, :2, 3] - self.world_from_body[:-1, :2, 3]).norm(dim=1)
        return torch.cat([steps_m.new_zeros(1), steps_m.cumsum(0)])

    @cached_property
    def speed_mps(self) -> Float[Tensor, " times"]:
        """Speed over the ground, between the neighbours of every pose."""
        if len(self) < 2:
            return torch.zeros(len(self), dtype=torch.float64)
        seconds = (self.timestamps_ns - self.timestamps_ns[0]).double() * 1e-9
        way = self.world_from_body[:, :2, 3]
        rates = torch.gradient(way, spacing=(seconds,), dim=0)[0]
        return rates.norm(dim=1)

    def at(self, times_ns: Int[Tensor, " queries"]) -> "DrivenPath":
        """The poses at other times; beyond its ends the end pose holds."""
        inside_ns = times_ns.clamp(int(self.timestamps_ns[0]), int(self.timestamps_ns[-1]))
        before, after = _neighbours(self.timestamps_ns, inside_ns)
        span_ns = (self.timestamps_ns[after] - self.timestamps_ns[before]).clamp(min=1)
        poses = interpolate_rigid(
            self.world_from_body[before],
            self.world_from_body[after],
            (inside_ns - self.timestamps_ns[before]).double() / span_ns,
        )
        return DrivenPath(timestamps_ns=times_ns, world_from_body=poses)

    def driven_on(self, times_ns: Int[Tensor, " queries"]) -> "DrivenPath":
        """The poses at other times; beyond its ends the body goes straight on as fast as there."""
        last = len(self) - 1
        ends = torch.where(times_ns < self.timestamps_ns[0], 0, last)
        inside_ns = times_ns.clamp(int(self.timestamps_ns[0]), int(self.timestamps_ns[-1]))
        ahead_m = (times_ns - inside_ns).double() * 1e-9 * self.speed_mps[ends]
        poses = self.moved_along(ends, ahead_m) @ self.at(times_ns).world_from_body
        return DrivenPath(timestamps_ns=times_ns, world_from_body=poses)

    def beyond_m(self, rows: Int[Tensor, " steps"], ahead_m: Float[Tensor, " steps"]) -> float:
        """How far out of the path's ends the farthest of some steps ahead or back leads."""
        wanted_m = self.travelled_m[rows] + ahead_m
        return float(torch.maximum(wanted_m - self.travelled_m[-1], -wanted_m).amax().clamp(min=0))

    def moved_along(
        self, rows: Int[Tensor, " steps"], ahead_m: Float[Tensor, " steps"]
    ) -> Float[Tensor, "steps 4 4"]:
        """`world_from_world` that carries some poses along the path, straight past its ends.

        Where the path turns on the way, what is carried turns with it.
        """
        wanted_m = self.travelled_m[rows] + ahead_m
        inside_m = wanted_m.clamp(0, float(self.travelled_m[-1]))
        before, after = _neighbours(self.travelled_m, inside_m)
        span_m = self.travelled_m[after] - self.travelled_m[before]
        fraction = torch.where(span_m > 0, (inside_m - self.travelled_m[before]) / span_m, 0)
        poses = interpolate_rigid(
            self.world_from_body[before], self.world_from_body[after], fraction
        )
        # where the car stood, several poses share a place: a step of nothing changes nothing
        start = self.world_from_body[rows]
        poses = torch.where((ahead_m == 0)[:, None, None], start, poses)
        ends = torch.where(wanted_m < inside_m, before, after)
        poses[:, :3, 3] += (wanted_m - inside_m)[:, None] * self.directions[ends]
        return poses @ invert_rigid(start)

    def height_near(self, xy_m: Float[Tensor, "places 2"]) -> Float[Tensor, " places"]:
        """Height of the body's origin where the path comes nearest to each place."""
        nearest = torch.cdist(xy_m, self.world_from_body[:, :2, 3]).argmin(dim=1)
        return self.world_from_body[nearest, 2, 3]


def _neighbours(ascending: Tensor, wanted: Tensor) -> tuple[Tensor, Tensor]:
    """Rows of a table before and after each wanted value, which lies inside the table."""
    last = len(ascending) - 1
    after = torch.searchsorted(ascending, wanted).clamp(min=min(1, last), max=last)
    return (after - 1).clamp(min=0), after
