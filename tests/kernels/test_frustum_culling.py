"""Blocks in view: fast versions mark what plain torch marks, and all what by hand is seen."""

import pytest
import torch
from gaussian_world import camera_at
from splat_drawing import TRITON, home_of

from lidarpainter_models.errors import ShapeError
from lidarpainter_models.geometry.transforms import invert_rigid, rigid_from_tangent
from lidarpainter_models.kernels.frustum_culling import Blocks, mark_seen, refresh_bounds

BACKENDS = ["cpu", "reference", TRITON]


def seeded(count, interpreted):
    """Backends and seeds; Triton's interpreter takes a second for a world."""
    by_numba = [pytest.param("cpu", seed) for seed in range(count)]
    seeds = range(interpreted)
    return by_numba + [pytest.param("triton", seed, marks=TRITON.marks) for seed in seeds]


def on_home(blocks, backend):
    """The blocks on the device that a backend runs on."""
    return Blocks._make(tensor.to(home_of(backend)) for tensor in blocks)


def refreshed(blocks, means, log_scale, is_stale, backend, reach_sigmas=3.5):
    """Blocks with bounds by a backend, on the CPU."""
    moved = on_home(blocks, backend)
    given = (each.to(home_of(backend)) for each in (means, log_scale, is_stale))
    refresh_bounds(moved, *given, reach_sigmas=reach_sigmas, backend=backend)
    return on_home(moved, "cpu")


def marked(blocks, views, backend, **options):
    """Who is seen according to a backend, on the CPU."""
    is_seen = torch.zeros(len(blocks.order), dtype=torch.bool, device=home_of(backend))
    mark_seen(on_home(blocks, backend), views, is_seen, backend=backend, **options)
    return is_seen.cpu()


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
    return refreshed(blocks, means, log_scale, is_stale, backend)


def bodies_before(camera, seed):
    twist = torch.randn(6, generator=torch.Generator().manual_seed(seed)).double()
    camera_from_world = invert_rigid(camera.world_from_camera)
    return torch.stack([camera_from_world, camera_from_world @ rigid_from_tangent(twist)])


@pytest.mark.parametrize(("backend", "seed"), seeded(4, 1))
def test_fast_bounds_are_those_of_plain_torch(backend, seed):
    fast, plain = (bounded(seed, name) for name in (backend, "reference"))
    assert torch.equal(fast.low, plain.low)
    assert torch.equal(fast.high, plain.high)
    # one exponential in double
    assert torch.allclose(fast.reach, plain.reach, rtol=1e-14, atol=0)


@pytest.mark.parametrize(("backend", "seed"), seeded(8, 2))
@pytest.mark.parametrize("actor_slack_m", [0.0, 2.0])
def test_fast_marks_are_those_of_plain_torch(backend, seed, actor_slack_m):
    blocks, camera = bounded(seed, "cpu"), camera_at(0.0)
    views = [(camera, bodies_before(camera, seed))]
    marks = [
        marked(blocks, views, name, actor_slack_m=actor_slack_m) for name in (backend, "reference")
    ]
    assert torch.equal(*marks)  # a selection; no block lies within rounding of a plane
    assert 0 < int(marks[0].sum()) < 600


@pytest.mark.parametrize("backend", BACKENDS)
def test_what_any_view_shows_is_marked(backend):
    blocks, views = bounded(3, "cpu"), []
    for place, x_m in enumerate((0.0, -40.0, 15.0)):
        camera = camera_at(x_m, width_px=64 + 16 * place)
        views.append((camera, bodies_before(camera, place)))
    alone = [marked(blocks, [view], "reference") for view in views]
    together = marked(blocks, views, backend)
    assert torch.equal(together, alone[0] | alone[1] | alone[2])
    assert int(together.sum()) > max(int(each.sum()) for each in alone)
    assert not marked(blocks, [], backend).any()


@pytest.mark.parametrize("backend", BACKENDS)
def test_blocks_of_any_size_are_bounded_and_marked_whole(backend):
    """More and fewer than are looked at together; the fourth has none, the fifth none finite."""
    sizes = torch.tensor([1, 128, 129, 0, 2])
    block_of_row = torch.arange(5).repeat_interleave(sizes)
    means = torch.rand(len(block_of_row), 3, generator=torch.Generator().manual_seed(0))
    means += torch.tensor([10.0, 0.0, 1.0])
    log_scale = torch.full_like(means, -3.0)
    log_scale[-2, 1], log_scale[-1, 2] = torch.nan, torch.inf
    is_stale, body = torch.ones(5, dtype=torch.bool), torch.zeros(5, dtype=torch.int32)
    blocks = refreshed(blocks_of(block_of_row, body), means, log_scale, is_stale, backend)
    for block in range(3):
        own = means[block_of_row == block].double()
        assert torch.equal(blocks.low[block], own.amin(dim=0))
        assert torch.equal(blocks.high[block], own.amax(dim=0))
    assert bool((blocks.low[3:] == torch.inf).all())
    assert bool((blocks.high[3:] == -torch.inf).all())
    assert blocks.reach[3:].tolist() == [0.0, 0.0]
    camera = camera_at(0.0)
    seen = marked(blocks, [(camera, bodies_before(camera, 0)[:1])], backend)
    assert torch.equal(seen, block_of_row < 3)


@pytest.mark.parametrize("backend", BACKENDS)
def test_without_blocks_nothing_is_done(backend):
    blocks = blocks_of(torch.zeros(0, dtype=torch.int64), torch.zeros(0, dtype=torch.int32))
    nothing, camera = torch.zeros(0, 3), camera_at(0.0)
    blocks = refreshed(blocks, nothing, nothing, torch.zeros(0, dtype=torch.bool), backend)
    assert len(marked(blocks, [(camera, bodies_before(camera, 0))], backend)) == 0


@pytest.mark.parametrize("backend", BACKENDS)
def test_one_gaussian_by_hand(backend):
    """The camera looks along x from 1 m up; half its image is 1 / 1.6 of the distance wide."""
    camera = camera_at(0.0)
    body = torch.zeros(1, dtype=torch.int32)
    for y_m, expected in ((0.0, True), (-6.0, True), (-7.5, False)):
        blocks = blocks_of(torch.zeros(1, dtype=torch.int64), body)
        means, log_scale = torch.tensor([[10.0, y_m, 1.0]]), torch.full((1, 3), 0.05).log()
        blocks = refreshed(blocks, means, log_scale, torch.tensor([True]), backend, 3.33)
        is_seen = marked(blocks, [(camera, bodies_before(camera, 0)[:1])], backend)
        assert bool(is_seen[0]) == expected, y_m


@pytest.mark.parametrize("backend", BACKENDS)
def test_only_stale_blocks_are_bounded_again(backend):
    blocks, means, log_scale = random_world(0)
    is_stale = torch.zeros(len(blocks.body), dtype=torch.bool)
    is_stale[3] = True
    blocks = refreshed(blocks, means, log_scale, is_stale, backend)
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
        mark_seen(blocks, [(camera_at(0.0), torch.eye(4)[None])], torch.zeros(2, dtype=torch.bool))
    views = [(camera_at(0.0), torch.eye(4).expand(count, 4, 4)) for count in (1, 2)]
    with pytest.raises(ShapeError, match="same bodies"):
        mark_seen(blocks, views, torch.zeros(600, dtype=torch.bool))


@pytest.mark.parametrize("backend", [TRITON])
def test_flags_that_lie_apart_are_marked_too(backend):
    blocks, camera = bounded(0, "cpu"), camera_at(0.0)
    views = [(camera, bodies_before(camera, 0))]
    flags = torch.zeros(len(blocks.order), 2, dtype=torch.bool, device=home_of(backend))
    mark_seen(on_home(blocks, backend), views, flags[:, 0], backend=backend)
    assert torch.equal(flags[:, 0].cpu(), marked(blocks, views, "cpu"))
    assert not flags[:, 1].any()
