"""How people and animals move within their boxes: a lattice of offsets over time.

A box is filled with a coarse lattice; its nodes are moved by offsets that a fit finds for each of
its times, cubic in between (Catmull and Rom, 1974; knots need not be even). A Gaussian goes where
the eight nodes around its centre take it (free-form deformation, Sederberg and Parry, 1986); axes
and colours stay. Box frame: x along the length, y left, z up, metres.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lidarpainter_models.devices import on_device
from lidarpainter_models.gaussians.model.seen_gaussians import AnyGaussians

Nodes = tuple[int, int, int]
"""How many there are along x, y and z; in a list of them z counts fastest."""


def lattice_values(
    values: Float[Tensor, "lattices nodes channels"],
    lattice: Int[Tensor, " places"],
    along: Float[Tensor, "places 3"],
    nodes: Nodes,
) -> Float[Tensor, "places channels"]:
    """What lattices have at places: linear between the eight nodes around each.

    `along` is the part of the box that lies before a place, by axis; beyond 0 to 1 the border is
    taken. Differentiable in values and places.
    """
    device = along.device
    last = torch.tensor([count - 1 for count in nodes]).to(device, non_blocking=True)
    stride = torch.tensor([nodes[1] * nodes[2], nodes[2], 1]).to(device, non_blocking=True)
    bit = torch.tensor([2, 1, 0]).to(device, non_blocking=True)
    place = along * last
    place = place.clamp(torch.zeros_like(place), last.to(place).expand_as(place))
    low = torch.minimum(place.detach().floor().long(), last - 1)
    share = (place - low)[:, None]
    corner = torch.arange(8, device=device)[:, None] >> bit & 1
    node = ((low[:, None] + corner) * stride).sum(dim=-1)
    x, y, z = torch.where(corner > 0, share, 1 - share).unbind(-1)
    return ((x * y * z)[..., None] * values[lattice[:, None], node]).sum(dim=1)


NODES = (3, 3, 5)
"""Along a box's length, width and height: legs part, arms swing, the head follows."""
REACH_M = 0.5
"""A fit that asks which bodies are in view takes limbs to reach so far from where they rest."""
REST = 0.1
"""How much a node's own way counts beside what parts it from a neighbour."""
NUM_NODES = NODES[0] * NODES[1] * NODES[2]


@dataclass(frozen=True, eq=False, kw_only=True)
class Bending:
    """The lattices of those actors that bend; all else is rigid."""

    bodies: Int[Tensor, " bent"]
    """Their body indices, ascending."""
    size_m: Float[Tensor, "bent 3"]
    """Length, width and height of their boxes."""
    knots_ns: Int[Tensor, " knots"]
    """Ascending; on the CPU."""
    offset_m: Float[Tensor, "knots bent nodes 3"]
    """Where each node is taken; changed in place by a fit."""

    @classmethod
    def none(
        cls,
        bodies: Sequence[int] = (),
        sizes_m: Sequence[Float[Tensor, "3"]] = (),
        knots_ns: Int[Tensor, " knots"] | None = None,
    ) -> "Bending":
        """Lattices at rest, in boxes of these sizes; by default none."""
        times_ns = torch.zeros(0, dtype=torch.int64) if knots_ns is None else knots_ns
        return cls(
            bodies=torch.tensor(bodies, dtype=torch.int64),
            size_m=torch.stack([torch.zeros(3), *sizes_m]).float()[1:],
            knots_ns=times_ns,
            offset_m=torch.zeros(len(times_ns), len(bodies), NUM_NODES, 3),
        )

    def to(self, device: torch.device) -> "Bending":
        """The same on another device, but for the times."""
        return on_device(self, device, stays=("knots_ns",))

    def strain(self, timestamp_ns: int) -> Float[Tensor, ""]:
        """How far nodes are taken at a time, and how differently their neighbours; square metres.

        Sums over nodes, differentiable.
        """
        offset_m = self.offset_at(timestamp_ns)
        lattice = offset_m.unflatten(1, NODES)
        bends = [torch.diff(lattice, dim=axis).square().sum() for axis in (1, 2, 3)]
        return torch.stack([REST * offset_m.square().sum(), *bends]).sum()

    def rigid(self, body: int) -> "Bending":
        """The same, but one body does not bend."""
        kept = self.bodies != body
        return replace(
            self,
            bodies=self.bodies[kept],
            size_m=self.size_m[kept],
            offset_m=self.offset_m[:, kept],
        )

    def without(self, body: int) -> "Bending":
        """The same once a body has gone; those after it move up."""
        rest = self.rigid(body)
        return replace(rest, bodies=rest.bodies - (rest.bodies > body).long())

    def weights_at(self, timestamp_ns: int) -> tuple[slice, list[float]]:
        """Which knots say how the nodes stand at a time, and how much each of them counts."""
        before, after, _ = knots_around(self.knots_ns, timestamp_ns)
        if before == after:
            return slice(after, after + 1), [1.0]
        first, past = max(after - 2, 0), min(after + 2, len(self.knots_ns))
        times_s = (self.knots_ns[first:past] - self.knots_ns[after]).double() * 1e-9
        now_s = (timestamp_ns - int(self.knots_ns[after])) * 1e-9
        return slice(first, past), _cubic_weights(times_s.tolist(), after - first, now_s)

    def offset_at(self, timestamp_ns: int) -> Float[Tensor, "bent nodes 3"]:
        """Where the nodes are taken at a time; differentiable."""
        near, weights = self.weights_at(timestamp_ns)
        known = zip(weights, self.offset_m[near], strict=True)
        return torch.stack([weight * offset_m for weight, offset_m in known]).sum(dim=0)

    def reach_m(self, timestamp_ns: int) -> float:
        """The farthest that any node is taken at a time."""
        if not len(self.bodies):
            return 0.0
        return float(self.offset_at(timestamp_ns).norm(dim=-1).amax())

    def bent(self, gaussians: AnyGaussians, timestamp_ns: int) -> AnyGaussians:
        """The Gaussians where they are at a time; differentiable in centres and offsets."""
        if not len(self.bodies):
            return gaussians
        body = gaussians.body_index.long()
        rows = torch.isin(body, self.bodies).nonzero()[:, 0]
        if not len(rows):
            return gaussians
        lattice = torch.searchsorted(self.bodies, body[rows])
        along = gaussians.means[rows] / self.size_m[lattice] + 0.5
        moved = lattice_values(self.offset_at(timestamp_ns), lattice, along, NODES)
        return replace(gaussians, means=gaussians.means.index_add(0, rows, moved))


def knots_around(knots_ns: Int[Tensor, " knots"], timestamp_ns: int) -> tuple[int, int, float]:
    """The knots before and after a time, and the weight of the later one.

    Up to the first knot and past the last one both are the knot at that end.
    """
    after, last = int(torch.searchsorted(knots_ns, timestamp_ns)), len(knots_ns) - 1
    if after == 0 or after > last:
        end = min(after, last)
        return end, end, 0.0
    start_ns, end_ns = knots_ns[after - 1 : after + 1].tolist()
    return after - 1, after, (timestamp_ns - start_ns) / (end_ns - start_ns)


def _cubic_weights(times_s: Sequence[float], after: int, now_s: float) -> list[float]:
    """Weights of the knots around an interval: its cubic has the slopes of their neighbours."""
    before, last = after - 1, len(times_s) - 1
    span_s = times_s[after] - times_s[before]
    u = (now_s - times_s[before]) / span_s
    weights = [0.0] * len(times_s)
    weights[before] += 1 - u * u * (3 - 2 * u)
    weights[after] += u * u * (3 - 2 * u)
    for knot, slope in ((before, u * (1 - u) ** 2), (after, u * u * (u - 1))):
        left, right = max(knot - 1, 0), min(knot + 1, last)
        per_knot = slope * span_s / (times_s[right] - times_s[left])
        weights[right] += per_knot
        weights[left] -= per_knot
    return weights
