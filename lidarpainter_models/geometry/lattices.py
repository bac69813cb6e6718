"""Lattices that fill boxes evenly: values at their nodes, looked up anywhere in between."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

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
