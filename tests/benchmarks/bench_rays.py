"""One sweep of a Pandar64, 115,200 rays, through a street of 60,000 Gaussians."""

import numba
import torch
from bench_machine import best_cpu_s
from bench_records import Figure

from lidarpainter_models.kernels.ray_gaussians import Ellipsoids, Rays, trace_rays
from lidarpainter_models.lidar.sensors import PRESETS

NUM_GAUSSIANS, PIECES, SPEED_MPS = 60_000, 10, 14.0
LISTED = 64
ANSWER_FLOPS, BOUND_FLOPS = 90, 250
"""Of one answer with its blending, and of the bounds of one Gaussian in one piece of time."""


def ray_figures(machine, repeats, *, num_gaussians=NUM_GAUSSIANS, keep_every=1):
    """CPU time of a sweep on one thread, against the arithmetic of the answers it blends."""
    numba.set_num_threads(1)
    street, pieces = street_of_surfels(num_gaussians), sweep_pieces(keep_every)

    def sweep():
        return [trace_rays(rays, street, backend="cpu") for rays in pieces]

    taken_s = best_cpu_s(sweep, repeats)
    listed = [trace_rays(rays, street, most_hits=LISTED, backend="cpu") for rays in pieces]
    answers = sum(int((one.hits.row >= 0).sum()) for one in listed)
    flops = ANSWER_FLOPS * answers + BOUND_FLOPS * num_gaussians
    num_rays = sum(len(rays.after_s) for rays in pieces)
    return [
        Figure(
            name="ray_gaussians.sweep",
            value=1e3 * taken_s,
            unit="ms",
            floor=1e3 * flops / machine.flops,
        ),
        Figure(
            name="ray_gaussians.rays",
            value=1e-6 * num_rays / taken_s,
            unit="Mrays/s",
            better="higher",
        ),
    ]


def street_of_surfels(count):
    """A road and walls to both sides, in discs as far apart as beams are."""
    random = torch.Generator().manual_seed(0)

    def uniform(low, high):
        return low + (high - low) * torch.rand(count, generator=random)

    along = torch.sign(uniform(-1, 1)) * 60 * uniform(0.02, 1) ** 1.5
    is_road = uniform(0, 1) < 0.5
    side = torch.sign(uniform(-1, 1)) * uniform(9.9, 10.1)
    across = torch.where(is_road, uniform(-10, 10), side)
    height = torch.where(is_road, uniform(-1.92, -1.88), uniform(-1.9, 6))
    across_road, across_wall = torch.tensor([2, 1, 0]), torch.tensor([1, 0, 2])
    axes = torch.eye(3)[torch.where(is_road[:, None], across_road, across_wall)]
    sigma_m = 0.006 * torch.stack([along, across, height]).norm(dim=0) + 0.03
    return Ellipsoids(
        means=torch.stack([along, across, height], dim=1),
        axes=axes.contiguous(),
        scale_m=torch.stack([0.05 * sigma_m, sigma_m, sigma_m], dim=1),
        opacity=uniform(0.5, 0.95),
        velocity_mps=torch.zeros(count, 3),
        channels=torch.rand(count, 2, generator=random),
    )


def sweep_pieces(keep_every):
    """A sweep in pieces of ten milliseconds, taken at 50 km/h."""
    directions, after_s, _ = map(torch.from_numpy, PRESETS["pandar64"].sweep())
    pieces = []
    for rows in torch.arange(len(after_s))[::keep_every].chunk(PIECES):
        own_s = (after_s[rows] - after_s[rows].mean()).float()
        origin_m = own_s[:, None] * torch.tensor([SPEED_MPS, 0.0, 0.0])
        pieces.append(Rays(origin_m, directions[rows].float(), own_s))
    return pieces
