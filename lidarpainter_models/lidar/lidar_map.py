"""The LiDAR map of a log: points of many sweeps with their colours and when they were measured.

The street stands in the world, each moving actor in the frame of its box; metres.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from lidarpainter_models.devices import on_device
from lidarpainter_models.scenes.tracks import remembered

NO_FRAME = -1
"""Frame of a point that was guessed, not measured."""
_CELL_SIZES = (-6, 1)
"""Exponents of the widths of cells, 16 mm to 2 m."""
_WIDE, _HIGH = (1 << 21) - 1, (1 << 16) - 1
"""How many cells are told apart along x and y, and along z: at least 32 km and 1 km of them."""


@dataclass(frozen=True, kw_only=True, eq=False)
class MapPoints:
    """Points of the street (world frame) or of one actor (its box frame)."""

    xyz_m: Float[Tensor, "points 3"]
    """float32."""
    rgb_u8: UInt8[Tensor, "points 3"]
    """0 where the point has no colour; exposure as the first camera's."""
    has_colour: Bool[Tensor, " points"]
    """Whether an image saw the point."""
    frame_index: Int[Tensor, " points"]
    """Of the sweep it was measured in; `NO_FRAME` of a guess."""
    timestamp_ns: Int[Tensor, " points"]
    """When it was measured."""
    range_m: Float[Tensor, " points"]
    """Distance from the LiDAR that measured it: how coarsely its surface was sampled."""

    def __len__(self) -> int:
        """How many points there are."""
        return self.xyz_m.shape[0]

    @cached_property
    def reach_m(self) -> float:
        """How far the farthest point is from the origin of their frame."""
        return float(self.xyz_m.norm(dim=1).max()) if len(self) else 0.0

    def keep(self, kept: Tensor | slice) -> "MapPoints":
        """The points marked or listed; of a slice nothing is copied."""
        return type(self)(**{field.name: getattr(self, field.name)[kept] for field in fields(self)})

    def measured(self) -> "MapPoints":
        """The points that are no guess."""
        return self.keep(self.frame_index != NO_FRAME)

    def thinned(self, spacing_rad: float) -> "MapPoints":
        """One point of each cell, coloured if the cell has such, in the order of the points.

        Cells are cubes, as wide as the spacing at the range that their points were measured from,
        up to a power of two: what many sweeps measured again is kept once for each such range.
        """
        size = (self.range_m * spacing_rad).log2().ceil().clamp(*_CELL_SIZES).long()
        x, y, z = (self.xyz_m * torch.exp2(-size)[:, None]).floor().long().unbind(-1)
        cell = ((x & _WIDE) << 41) | ((y & _WIDE) << 20) | ((z & _HIGH) << 4)
        cell |= (size - _CELL_SIZES[0]) << 1
        order = (cell | ~self.has_colour).argsort(stable=True)
        is_first = torch.ones_like(self.has_colour)
        is_first[1:] = cell[order].diff() != 0
        return self.keep(order[is_first].sort().values)

    def to(self, device: torch.device) -> "MapPoints":
        """The same points on another device."""
        return on_device(self, device)

    def moved(self, world_from_box: Float[Tensor, "4 4"]) -> "MapPoints":
        """The points in another frame."""
        pose = world_from_box.to(self.xyz_m)
        return replace(self, xyz_m=self.xyz_m @ pose[:3, :3].T + pose[:3, 3])

    def to_arrays(self) -> dict[str, Tensor]:
        """Columns by name, for storage."""
        return {field.name: getattr(self, field.name).contiguous() for field in fields(self)}

    @classmethod
    def concatenate(cls, parts: Sequence["MapPoints"]) -> "MapPoints":
        """All points of several parts, in their order; none give no points."""
        if not parts:
            return cls.uncoloured(
                xyz_m=torch.zeros(0, 3),
                frame_index=torch.zeros(0, dtype=torch.int64),
                timestamp_ns=torch.zeros(0, dtype=torch.int64),
                range_m=torch.zeros(0),
            )
        columns = {
            field.name: torch.cat([getattr(part, field.name) for part in parts])
            for field in fields(cls)
        }
        return cls(**columns)

    @classmethod
    def uncoloured(
        cls,
        *,
        xyz_m: Float[Tensor, "points 3"],
        frame_index: Int[Tensor, " points"],
        timestamp_ns: Int[Tensor, " points"],
        range_m: Float[Tensor, " points"],
    ) -> "MapPoints":
        """Points that no image has been asked about yet."""
        return cls(
            xyz_m=xyz_m,
            rgb_u8=torch.zeros(xyz_m.shape, dtype=torch.uint8),
            has_colour=torch.zeros(xyz_m.shape[0], dtype=torch.bool),
            frame_index=frame_index,
            timestamp_ns=timestamp_ns,
            range_m=range_m,
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class LidarMap:
    """The points of a log."""

    street: MapPoints
    """In the world."""
    actors: dict[str, MapPoints]
    """By actor id, in the box frame, from the whole log; only moving actors with points."""
    _newest_age_ns: dict[int, int] = field(default_factory=dict, init=False, repr=False)

    def to(self, device: torch.device) -> "LidarMap":
        """The same map on another device, itself if it is there."""
        if self.street.xyz_m.device == device:
            return self
        actors = {name: points.to(device) for name, points in self.actors.items()}
        return LidarMap(street=self.street.to(device), actors=actors)

    def measured(self) -> "LidarMap":
        """The map without what was guessed."""
        actors = {name: points.measured() for name, points in self.actors.items()}
        return LidarMap(street=self.street.measured(), actors=actors)

    def thinned(self, spacing_rad: float) -> "LidarMap":
        """The map for images as coarse as that: street and actors, as `MapPoints.thinned`."""
        actors = {name: points.thinned(spacing_rad) for name, points in self.actors.items()}
        return LidarMap(street=self.street.thinned(spacing_rad), actors=actors)

    def num_street_points_near(self, place_m: Float[Tensor, "3"], radius_m: float) -> int:
        """How many points of the street are nearer than that to a place in the world."""
        xyz_m = self.street.xyz_m
        place_m = place_m.to(xyz_m)
        x_m, rows = self._street_by_x
        ends = torch.stack([place_m[0] - radius_m, place_m[0] + radius_m])
        first, last = torch.searchsorted(x_m, ends).tolist()
        near_m = xyz_m[rows[first:last]]
        return int(((near_m - place_m).norm(dim=-1) < radius_m).sum())

    @cached_property
    def _street_by_x(self) -> tuple[Float[Tensor, " points"], Int[Tensor, " points"]]:
        """The street's x in order, and the rows they are of: every painted camera asks."""
        x_m, rows = self.street.xyz_m[:, 0].sort()
        return x_m, rows.int()

    def newest_age_ns(self, timestamp_ns: int) -> int:
        """How far in time the nearest street point is; kept, as many views share a time."""

        def newest() -> int:
            age_ns = (self.street.timestamp_ns - timestamp_ns).abs()
            return int(age_ns.min()) if len(age_ns) else 0

        return remembered(self._newest_age_ns, timestamp_ns, newest)
