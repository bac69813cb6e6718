"""Lamps that go on and off: brake lamps and indicators of actors, signals of the street.

A lamp is a small upright box in its body's frame, filled with a lattice that says what being on
adds to the colours of the Gaussians in it, and how much it is on over time. Body 0 is the street
(world frame), body `i` the i-th actor (its box frame); metres. A Gaussian's own colour is that of
the lamp off.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lidarpainter_models.devices import on_device
from lidarpainter_models.gaussians.model.bending import knots_around, lattice_values
from lidarpainter_models.gaussians.model.gaussian_set import SH_CONSTANT, GaussianSet
from lidarpainter_models.gaussians.model.seen_gaussians import AnyGaussians

NODES = (5, 5, 5)
NUM_NODES = NODES[0] * NODES[1] * NODES[2]


@dataclass(frozen=True, eq=False, kw_only=True)
class Blinking:
    """All lamps that go on and off."""

    bodies: Int[Tensor, " lamps"]
    """Which body each lamp is part of."""
    centre_m: Float[Tensor, "lamps 3"]
    size_m: Float[Tensor, "lamps 3"]
    """Sides of its box, in the frame of its body."""
    lit_rgb: Float[Tensor, "lamps nodes 3"]
    """What being on adds to the colour at each node."""
    knots_ns: Int[Tensor, " knots"]
    """Ascending; on the CPU."""
    is_lit: Float[Tensor, "knots lamps"]
    """How much each is on, 0 to 1, linear in time between knots; on the CPU."""

    @classmethod
    def dark(
        cls,
        bodies: Int[Tensor, " lamps"],
        centre_m: Float[Tensor, "lamps 3"],
        size_m: Float[Tensor, "lamps 3"],
    ) -> "Blinking":
        """Lamps in these boxes of which nothing else is known."""
        return cls(
            bodies=bodies,
            centre_m=centre_m,
            size_m=size_m,
            lit_rgb=centre_m.new_zeros(len(bodies), NUM_NODES, 3),
            knots_ns=torch.zeros(1, dtype=torch.int64),
            is_lit=torch.zeros(1, len(bodies)),
        )

    @classmethod
    def none(cls) -> "Blinking":
        """No lamps."""
        return cls.dark(torch.zeros(0, dtype=torch.int64), torch.zeros(0, 3), torch.zeros(0, 3))

    def __len__(self) -> int:
        return len(self.bodies)

    def in_words(self, actor_ids: Sequence[str]) -> list[str]:
        """Where lamps go on and off, as a sentence; none without lamps."""
        counts = Counter(self.bodies.tolist())
        of_bodies = [
            f"{counts[body]} of {name}"
            for body, name in enumerate(["the street", *actor_ids])
            if counts[body]
        ]
        if not of_bodies:
            return []
        return [f"Lamps go on and off ({', '.join(of_bodies)}): shown on when they were."]

    def to(self, device: torch.device) -> "Blinking":
        """The same on another device, but for what changes over time."""
        return on_device(self, device, stays=("knots_ns", "is_lit"))

    def kept(self, chosen: Bool[Tensor, " lamps"]) -> "Blinking":
        """Some of the lamps."""
        return replace(
            self,
            bodies=self.bodies[chosen],
            centre_m=self.centre_m[chosen],
            size_m=self.size_m[chosen],
            lit_rgb=self.lit_rgb[chosen],
            is_lit=self.is_lit[:, chosen.cpu()],
        )

    def of_others(self, body: int) -> "Blinking":
        """The lamps of all bodies but one."""
        return self.kept(self.bodies != body)

    def without(self, body: int) -> "Blinking":
        """The same once a body has gone; those after it move up."""
        rest = self.of_others(body)
        return replace(rest, bodies=rest.bodies - (rest.bodies > body).long())

    def lit_at(self, timestamp_ns: int) -> Float[Tensor, " lamps"]:
        """How much each lamp is on at a time; before and after all knots as at the nearest."""
        before, after, weight = knots_around(self.knots_ns, timestamp_ns)
        return (1 - weight) * self.is_lit[before] + weight * self.is_lit[after]

    def lit(self, gaussians: AnyGaussians, timestamp_ns: int) -> AnyGaussians:
        """The Gaussians in the light of their own lamps at a time; differentiable in colours."""
        return self._lit_by(gaussians, self.lit_at(timestamp_ns))

    def lit_on_average(self, gaussians: AnyGaussians) -> AnyGaussians:
        """The Gaussians as lit in the mean of all knots: for what has no time."""
        return self._lit_by(gaussians, self.is_lit.mean(dim=0))

    def _lit_by(self, gaussians: AnyGaussians, strength: Float[Tensor, " lamps"]) -> AnyGaussians:
        lamps = (strength > 0).nonzero()[:, 0]
        if not len(lamps):
            return gaussians
        device, means = self.bodies.device, gaussians.means.detach()
        lamps = lamps.to(device, non_blocking=True)
        rows, lamp = self.inside(means, gaussians.body_index, lamps)
        if not len(rows):
            return gaussians
        share = strength.to(device, non_blocking=True)[lamp, None]
        added = share * self.colours(self.lit_rgb, means[rows], lamp)
        return with_added_colour(gaussians, rows, added)

    def inside(
        self,
        means: Float[Tensor, "gaussians 3"],
        body_index: Int[Tensor, " gaussians"],
        lamps: Int[Tensor, " chosen"],
    ) -> tuple[Int[Tensor, " rows"], Int[Tensor, " rows"]]:
        """Rows of the Gaussians in the boxes of the chosen lamps, and in which; once for each."""
        low = (self.centre_m - self.size_m / 2)[lamps]
        high = (self.centre_m + self.size_m / 2)[lamps]
        may_be = torch.ones_like(body_index, dtype=torch.bool)
        for axis in (0, 1):  # few Gaussians are left to be compared with every lamp
            may_be &= _in_any(means[:, axis].contiguous(), low[:, axis], high[:, axis])
        rows = may_be.nonzero()[:, 0]
        place = means[rows, None]
        is_inside = ((place >= low) & (place <= high)).all(dim=-1)
        is_inside &= body_index[rows, None] == self.bodies[lamps]
        which, lamp = is_inside.nonzero().unbind(1)
        return rows[which], lamps[lamp]

    def colours(
        self,
        at_nodes: Float[Tensor, "lamps nodes channels"],
        means: Float[Tensor, "rows 3"],
        lamp: Int[Tensor, " rows"],
    ) -> Float[Tensor, "rows channels"]:
        """What lattices like those of the lamps have where Gaussians are."""
        along = (means - self.centre_m[lamp]) / self.size_m[lamp] + 0.5
        return lattice_values(at_nodes, lamp, along, NODES)


def with_added_colour(
    gaussians: AnyGaussians, rows: Int[Tensor, " rows"], rgb: Float[Tensor, "rows 3"]
) -> AnyGaussians:
    """The Gaussians with more colour in some rows, whatever they are seen from."""
    name = "sh_dc" if isinstance(gaussians, GaussianSet) else "sh"
    harmonics: Tensor = getattr(gaussians, name)
    more = harmonics.new_zeros(len(rows), *harmonics.shape[1:])
    more[:, 0] = rgb / SH_CONSTANT
    return replace(gaussians, **{name: harmonics.index_add(0, rows, more)})


def _in_any(
    value: Float[Tensor, " values"], low: Float[Tensor, " ranges"], high: Float[Tensor, " ranges"]
) -> Bool[Tensor, " values"]:
    """Whether each value lies in at least one range."""
    low, order = low.sort()
    furthest = torch.cummax(high[order], dim=0).values if len(low) else high
    before = torch.searchsorted(low, value, right=True)
    return (before > 0) & (value <= torch.cat([low.new_zeros(1), furthest])[before])
