"""One sweep of a Pandar64, 115,200 rays, through a street of 60,000 Gaussians."""

from unittest.mock import patch

import numba
import numpy as np
import torch
from bench_machine import best_cpu_s
from bench_records import Figure

from lidarpainter_models.kernels.ray_gaussians import (
    LEFT_OVER,
    Ellipsoids,
    Rays,
    cpu,
    trace_rays,
)
from lidarpainter_models.kernels.ray_gaussians.tiles import TURN_RAD
from lidarpainter_models.lidar.firings import fired_rays
from lidarpainter_models.lidar.sensors import PRESETS

NUM_GAUSSIANS, PIECES, SPEED_MPS = 60_000, 10, 14.0
LISTED = 64
TEST_FLOPS, ANSWER_FLOPS, BLEND_FLOPS, BOUND_FLOPS = 7, 74, 50, 250
"""Of asking whether a Gaussian's bounds hold a ray, of its answer to one that they hold, of
blending that, and of the bounds of one Gaussian in one piece of time; counted in the plain code."""


def ray_figures(machine, repeats, *, num_gaussians=NUM_GAUSSIANS, keep_every=1):
    """CPU time of a sweep on one thread, against the arithmetic that finds and blends answers.

    Needed are, for each ray, the tests of its tile's Gaussians up to where it is stopped, and the
    answers of those whose bounds hold it. The floor is what these take at the machine's peak.
    """
    numba.set_num_threads(1)
    street, pieces = street_of_surfels(num_gaussians), sweep_pieces(keep_every)

    def sweep():
        return [trace_rays(rays, street, backend="cpu") for rays in pieces]

    taken_s = best_cpu_s(sweep, repeats)
    counts = zip(*(work_of(rays, street) for rays in pieces), strict=True)
    tests, answers, blended = map(sum, counts)
    flops = TEST_FLOPS * tests + ANSWER_FLOPS * answers + BLEND_FLOPS * blended
    flops += BOUND_FLOPS * num_gaussians
    num_rays = sum(len(rays.after_s) for rays in pieces)
    return [
        Figure(name="ray_gaussians.tests", value=tests / num_rays, unit="a ray"),
        Figure(name="ray_gaussians.answers", value=answers / num_rays, unit="a ray"),
        Figure(name="ray_gaussians.blended", value=blended / num_rays, unit="a ray"),
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


def work_of(rays, street):
    """How many bounds have to be tested, answers computed, and answers blended."""
    met = trace_rays(rays, street, most_hits=LISTED, backend="cpu")
    with patch.object(cpu, "_follow") as follow:
        trace_rays(rays, street, backend="cpu")
    (_, tile_of, starts, lists, *_), (*_, azimuth, elevation), _, limits, _ = follow.call_args.args
    bounds, near_m = limits
    is_stopped = met.alpha >= 1 - 2 * LEFT_OVER
    end_m = torch.where(is_stopped, met.hits.range_m.amax(dim=1), torch.inf).numpy()
    found = looked_at((tile_of, starts, lists), azimuth, elevation, bounds, near_m, end_m)
    return (*found, int((met.hits.row >= 0).sum()))


@numba.njit
def looked_at(tiles, azimuth, elevation, bounds, near_m, end_m):
    """Tests of bounds before each ray's end, and how many of them hold it."""
    tile_of, starts, lists = tiles
    tests, held = 0, 0
    for ray in range(len(tile_of)):
        tile = tile_of[ray]
        for g in lists[starts[tile] : starts[tile + 1]]:
            if near_m[g] > end_m[ray]:
                break
            aside = azimuth[ray] - bounds[g, 0]
            aside -= TURN_RAD * np.floor(aside / TURN_RAD + 0.5)
            is_held = abs(aside) <= bounds[g, 1] or bounds[g, 1] >= np.pi
            is_held &= bounds[g, 2] <= elevation[ray] <= bounds[g, 3]
            tests, held = tests + 1, held + is_held
    return tests, held


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
    sensor = PRESETS["pandar64"]
    step_ns = torch.from_numpy((sensor.shares - 0.5) * sensor.turn_s * 1e9).long()
    rays = fired_rays(sensor, torch.eye(4).double().expand(sensor.steps, 4, 4), step_ns)
    pieces = []
    for rows in torch.arange(len(rays))[::keep_every].chunk(PIECES):
        own_s = (1e-9 * (rays.time_ns[rows] - rays.time_ns[rows].double().mean())).float()
        origin_m = own_s[:, None] * torch.tensor([SPEED_MPS, 0.0, 0.0])
        pieces.append(Rays(origin_m, rays.direction[rows].float(), own_s))
    return pieces
