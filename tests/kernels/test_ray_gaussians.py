"""What rays meet of Gaussians: worked by hand, and numba against plain torch."""

import math

import pytest
import torch

from lidarpainter_models.errors import ShapeError
from lidarpainter_models.geometry.transforms import rotation_from_quaternion
from lidarpainter_models.kernels.ray_gaussians import (
    NOTHING,
    Ellipsoids,
    RayReturns,
    Rays,
    blended_hits,
    trace_rays,
)
from lidarpainter_models.kernels.ray_gaussians.tiles import bounds_of

BACKENDS = ("cpu", "reference")
AHEAD = torch.tensor([[1.0, 0.0, 0.0]])


def solids(means, scale_m=(0.01, 1.0, 1.0), opacity=0.6, velocity=(0.0, 0.0, 0.0)):
    """Gaussians whose axes are those of the frame."""
    count = len(means)
    return Ellipsoids(
        means=torch.tensor(means).reshape(count, 3),
        axes=torch.eye(3).expand(count, 3, 3).contiguous(),
        scale_m=torch.tensor(scale_m).expand(count, 3).contiguous(),
        opacity=torch.full((count,), opacity),
        velocity_mps=torch.tensor(velocity).expand(count, 3).contiguous(),
        channels=torch.arange(1.0, count + 1)[:, None],
    )


def random_solids(count, seed, dtype=torch.float32):
    random = torch.Generator().manual_seed(seed)
    azimuth = 2 * math.pi * torch.rand(count, generator=random)
    away_m = 1 + 40 * torch.rand(count, generator=random)
    height_m = -3 + 6 * torch.rand(count, generator=random)
    rotation = rotation_from_quaternion(torch.randn(count, 4, generator=random))
    thin, wide = torch.full((count, 1), 0.02), 0.1 + torch.rand(count, 2, generator=random)
    moves = torch.rand(count, 1, generator=random) < 0.3
    columns = {
        "means": torch.stack([away_m * azimuth.cos(), away_m * azimuth.sin(), height_m], dim=1),
        "axes": rotation,
        "scale_m": torch.cat([thin, wide], dim=1),
        "opacity": torch.rand(count, generator=random),
        "velocity_mps": 8 * torch.randn(count, 3, generator=random) * moves,
        "channels": torch.rand(count, 3, generator=random),
    }
    return Ellipsoids(**{name: column.to(dtype) for name, column in columns.items()})


def random_rays(count, seed, dtype=torch.float32):
    random = torch.Generator().manual_seed(seed)
    direction = torch.randn(count, 3, generator=random) * torch.tensor([1.0, 1.0, 0.5])
    return Rays(
        origin_m=(0.1 * torch.randn(count, 3, generator=random)).to(dtype),
        direction=torch.nn.functional.normalize(direction, dim=1).to(dtype),
        after_s=(0.01 * torch.rand(count, generator=random) - 0.005).to(dtype),
    )


def one_ray(origin=(0.0, 0.0, 0.0), after_s=0.0):
    return Rays(torch.tensor([origin]), AHEAD, torch.tensor([after_s]))


@pytest.mark.parametrize("backend", BACKENDS)
def test_answers_are_blended_front_to_back(backend):
    met = trace_rays(one_ray(), solids([[8.0, 0, 0], [5.0, 0, 0]]), most_hits=3, backend=backend)
    assert met.alpha.item() == pytest.approx(0.6 + 0.4 * 0.6)
    assert met.range_m.item() == pytest.approx((0.6 * 5 + 0.24 * 8) / 0.84, rel=1e-5)
    assert met.median_m.item() == pytest.approx(5.0)
    assert met.nearest.item() == 1
    assert met.channels.item() == pytest.approx(0.6 * 2 + 0.24 * 1)
    assert met.cosine.item() == pytest.approx(0.84)
    assert met.hits.row.tolist() == [[1, 0, -1]]
    assert met.hits.response[0].tolist() == pytest.approx([1, 1, 0])
    assert met.hits.slope[0].tolist() == pytest.approx([1, 1, 0])


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_gaussian_answers_where_it_is_densest_along_the_ray(backend):
    met = trace_rays(
        one_ray((0.0, 0.3, 0.0)), solids([[5.0, 0, 0]], (0.5, 0.3, 1.0)), backend=backend
    )
    assert met.range_m.item() == pytest.approx(5.0)
    assert met.alpha.item() == pytest.approx(0.6 * math.exp(-0.5))


@pytest.mark.parametrize("backend", BACKENDS)
def test_what_moves_is_met_where_it_is_when_the_ray_is_sent(backend):
    met = trace_rays(
        one_ray(after_s=0.004), solids([[5.0, 0, 0]], velocity=(10.0, 0, 0)), backend=backend
    )
    assert met.range_m.item() == pytest.approx(5.04)


@pytest.mark.parametrize("backend", BACKENDS)
def test_what_is_behind_or_faint_is_nothing(backend):
    behind = trace_rays(one_ray(), solids([[-5.0, 0, 0]]), backend=backend)
    faint = trace_rays(one_ray(), solids([[5.0, 0, 0]], opacity=0.003), backend=backend)
    for met in (behind, faint):
        assert (met.alpha.item(), met.range_m.item(), met.nearest.item()) == (0, 0, NOTHING)
        assert met.median_m.item() == math.inf


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(
    "direction", [(-1.0, 1e-4, 0.0), (-1.0, -1e-4, 0.0), (1.0, 0.0, 0.0), (0.0, 1e-3, 1.0)]
)
def test_the_seam_and_the_pole_need_no_case_of_their_own(direction, backend):
    way = torch.nn.functional.normalize(torch.tensor([direction]), dim=1)
    mean = 4 * way[0] + torch.tensor([0.0, 0.05, 0.0])
    rays = Rays(torch.zeros(1, 3), way, torch.zeros(1))
    met = trace_rays(rays, solids(mean[None].tolist(), (0.3, 0.3, 0.3)), backend=backend)
    assert met.alpha.item() > 0.55


@pytest.mark.parametrize("count", [0, 1, 33, 700])
@pytest.mark.parametrize("seed", [0, 1])
def test_numba_meets_what_torch_meets(count, seed):
    rays, exact = random_rays(900, seed + 10), random_rays(900, seed + 10, torch.float64)
    expected = trace_rays(exact, random_solids(count, seed, torch.float64), most_hits=8)
    met = trace_rays(rays, random_solids(count, seed), most_hits=8, backend="cpu")
    assert torch.equal(met.hits.row, expected.hits.row)
    assert torch.equal(met.nearest, expected.nearest)
    # float32 against float64, at up to forty metres
    pairs = zip(met[:5], expected[:5], strict=True)
    assert all(torch.allclose(one.double(), other, atol=1e-4) for one, other in pairs)
    for one, other in zip(met.hits[1:], expected.hits[1:], strict=True):
        assert torch.allclose(one.double(), other, atol=1e-4)
    assert count < 700 or met.alpha.mean() > 0.2


def test_more_answers_than_can_wait_are_all_blended():
    crowd = [[5.0 + 0.01 * (i % 13), 0.0, 0.0] for i in range(300)]
    thick = solids(crowd, (1.0, 0.1, 0.1), opacity=0.02)
    met, expected = (trace_rays(one_ray(), thick, backend=backend) for backend in BACKENDS)
    assert met.alpha.item() == pytest.approx(expected.alpha.item(), rel=1e-4)


def test_no_rays_meet_nothing():
    met = trace_rays(random_rays(0, 0), random_solids(5, 0), most_hits=2)
    assert isinstance(met, RayReturns)
    assert met.channels.shape == (0, 3)


def test_bounds_hold_all_that_answers():
    random = torch.Generator().manual_seed(3)
    for _ in range(200):
        mean = 3 * torch.randn(3, generator=random, dtype=torch.float64)
        root = torch.randn(3, 3, generator=random, dtype=torch.float64)
        root *= torch.tensor([0.02, 0.3, 1.0], dtype=torch.float64)
        surface = torch.randn(400, 3, generator=random, dtype=torch.float64)
        surface = torch.nn.functional.normalize(surface, dim=1)
        points = mean + 2.0 * surface @ root.T
        middle, half, low, high = bounds_of(mean.numpy(), (root @ root.T).numpy(), 2.0, 0.0)
        x, y, z = points.unbind(1)
        aside = (torch.atan2(y, x) - middle + math.pi) % (2 * math.pi) - math.pi
        elevation = torch.atan2(z, torch.hypot(x, y))
        assert half >= math.pi or bool((aside.abs() <= half + 1e-9).all())
        assert bool((elevation >= low - 1e-9).all())
        assert bool((elevation <= high + 1e-9).all())


def test_blending_of_listed_answers_is_that_of_the_rays():
    gaussians, rays = random_solids(200, 5), random_rays(300, 6)
    met = trace_rays(rays, gaussians, most_hits=40)
    opacity = gaussians.opacity.requires_grad_()
    weight = blended_hits(met.hits, opacity)
    assert torch.allclose(weight.sum(dim=1), met.alpha, atol=1e-5)
    weight.sum().backward()
    assert bool((opacity.grad >= 0).all())


def test_columns_of_unequal_length_are_refused():
    with pytest.raises(ShapeError, match="as many origins as directions and times"):
        trace_rays(Rays(torch.zeros(2, 3), AHEAD, torch.zeros(1)), solids([[5.0, 0, 0]]))
