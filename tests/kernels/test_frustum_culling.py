"""Blocks in view: the numba version marks what plain torch marks, and both what by hand is seen."""

import pytest
import torch
from gaussian_world import camera_at

from lidarpainter_models.errors import ShapeError
from lidarpainter_models.geometry.transforms import invert_rigid, rigid_from_tangent
from lidarpainter_models.kernels.frustum_culling import Blocks, mark_seen, refresh_bounds

BACKENDS = ["cpu", "reference"]


def blocks_of(block_of_row, body):
    order = torch.argsort(block_of_row, stable=True)
    count = len(body)
    first = torch.searchsorted(block_of_row[order], torch.arange(count + 1))
    low, high = torch.full((2, count, 3), 99.0, dtype=torch.float64)
    reach = torch.zeros(count, dtype=torch.float64)
    return Blocks(order=order, first=first, body=body, low=low, high=high, reach=reach)


def random_world(seed, *, count=600, num_blocks=90):
    """Gaussians around their block's place, all about; some blocks belong to an actor."""
    generator = torch.Generator().manual_seed(seed)
    block_of_row = torch.arange(count) % num_blocks
    place_m = 30.0 * torch.randn(num_blocks, 3, generator=generator)
    means = place_m[block_of_row] + torch.randn(count, 3, generator=generator)
    log_scale = torch.randn(count, 3, generator=generator) - 2.0
    means[7], log_scale[8, 1] = torch.nan, torch.inf
    body = (torch.arange(num_blocks) % 5 == 0).to(torch.int32)
    return blocks_of(block_of_row, body), means, log_scale


def bounded(seed, backend):
    blocks, means, log_scale = random_world(seed)
    is_stale = torch.ones(len(blocks.body), dtype=torch.bool)
    refresh_bounds(blocks, means, log_scale, is_stale, reach_sigmas=3.5, backend=backend)
    return blocks


def bodies_before(camera, seed):
    twist = torch.randn(6, generator=torch.Generator().manual_seed(seed)).double()
    camera_from_world = invert_rigid(camera.world_from_camera)
    return torch.stack([camera_from_world, camera_from_world @ rigid_from_tangent(twist)])


@pytest.mark.parametrize("seed", range(4))
def test_fast_bounds_are_those_of_plain_torch(seed):
    fast, plain = (bounded(seed, backend) for backend in BACKENDS)
    assert torch.equal(fast.low, plain.low)
    assert torch.equal(fast.high, plain.high)
    # one exponential in double
    assert torch.allclose(fast.reach, plain.reach, rtol=1e-14, atol=0)


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("actor_slack", [(0.0, 0.0), (2.0, 0.1)])
def test_fast_marks_are_those_of_plain_torch(seed, actor_slack):
    blocks, camera = bounded(seed, "cpu"), camera_at(0.0)
    marks = []
    for backend in BACKENDS:
        is_seen = torch.zeros(600, dtype=torch.bool)
        bodies = bodies_before(camera, seed)
        mark_seen(blocks, camera, bodies, is_seen, actor_slack=actor_slack, backend=backend)
        marks.append(is_seen)
    assert torch.equal(*marks)  # a selection; no block lies within rounding of a plane
    assert 0 < int(marks[0].sum()) < 600


@pytest.mark.parametrize("backend", BACKENDS)
def test_one_gaussian_by_hand(backend):
    """The camera looks along x from 1 m up; half its image is 1 / 1.6 of the distance wide."""
    camera = camera_at(0.0)
    body = torch.zeros(1, dtype=torch.int32)
    for y_m, expected in ((0.0, True), (-6.0, True), (-7.5, False)):
        blocks = blocks_of(torch.zeros(1, dtype=torch.int64), body)
        means, log_scale = torch.tensor([[10.0, y_m, 1.0]]), torch.full((1, 3), 0.05).log()
        refresh_bounds(
            blocks, means, log_scale, torch.tensor([True]), reach_sigmas=3.33, backend=backend
        )
        is_seen = torch.tensor([False])
        mark_seen(blocks, camera, bodies_before(camera, 0)[:1], is_seen, backend=backend)
        assert bool(is_seen[0]) == expected, y_m


@pytest.mark.parametrize("backend", BACKENDS)
def test_only_stale_blocks_are_bounded_again(backend):
    blocks, means, log_scale = random_world(0)
    is_stale = torch.zeros(len(blocks.body), dtype=torch.bool)
    is_stale[3] = True
    refresh_bounds(blocks, means, log_scale, is_stale, reach_sigmas=3.5, backend=backend)
    assert bool((blocks.low[~is_stale] == 99.0).all())
    assert bool((blocks.low[3] < blocks.high[3]).all())


def test_what_does_not_belong_together_is_refused():
    blocks, means, log_scale = random_world(0)
    everything = torch.ones(len(blocks.body), dtype=torch.bool)
    with pytest.raises(ShapeError, match="600 Gaussians"):
        refresh_bounds(blocks, means[:3], log_scale[:3], everything, reach_sigmas=3.0)
    with pytest.raises(ShapeError, match="as many flags"):
        refresh_bounds(blocks, means, log_scale, everything[:2], reach_sigmas=3.0)
    with pytest.raises(ShapeError, match="as many flags"):
        mark_seen(blocks, camera_at(0.0), torch.eye(4)[None], torch.zeros(2, dtype=torch.bool))
