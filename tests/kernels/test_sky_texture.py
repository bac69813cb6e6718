"""Sky look-ups: the fast versions against plain torch, and plain torch against what is known."""

import math

import pytest
import torch
from gaussian_world import turned_camera
from splat_drawing import TRITON, home_of

from lidarpainter_models.errors import BackendError, ShapeError
from lidarpainter_models.kernels.sky_texture import (
    SkyLayout,
    SkyRays,
    TexelMoments,
    reference,
    sample_sky,
    scatter_gradient,
    sky_rays,
    step_texels,
)

EPS = torch.finfo(torch.float32).eps
FAST = ["cpu", TRITON]


def full_turn(columns=64, rows=16):
    return SkyLayout(
        azimuth_left_rad=math.pi,
        elevation_top_rad=math.pi / 2,
        texel_rad=2 * math.pi / columns,
        columns=columns,
        rows=rows,
    )


def crop(columns=23, rows=9):
    """Ahead and a little above, with sides that do not meet."""
    return SkyLayout(
        azimuth_left_rad=0.4, elevation_top_rad=0.3, texel_rad=0.04, columns=columns, rows=rows
    )


def rays_of(camera, layout, backend, wanted=None):
    """Rays by a backend, on the CPU."""
    if wanted is None:
        wanted = torch.ones(camera.height_px, camera.width_px, dtype=torch.bool)
    rays = sky_rays(camera, layout, wanted.to(home_of(backend)), backend=backend)
    return SkyRays(places=rays.places.cpu(), wanted=wanted)


def on_home(rays, backend):
    home = home_of(backend)
    return SkyRays(places=rays.places.to(home), wanted=rays.wanted.to(home))


def sampled(texture, rays, layout, backend):
    moved = on_home(rays, backend)
    return sample_sky(texture.to(home_of(backend)), moved, layout, backend=backend).cpu()


def scattered(gradient, weight, rays, layout, backend):
    """Texel gradients and weights by a backend, on the CPU."""
    given = (gradient.to(home_of(backend)), weight.to(home_of(backend)), on_home(rays, backend))
    return [each.cpu() for each in scatter_gradient(*given, layout, backend=backend)]


def random_texture(layout, seed=0):
    return torch.rand(layout.rows, layout.columns, 3, generator=torch.Generator().manual_seed(seed))


def random_gradient(camera, seed=1):
    generator = torch.Generator().manual_seed(seed)
    gradient = torch.randn(camera.height_px, camera.width_px, 3, generator=generator)
    weight = torch.rand(camera.height_px, camera.width_px, generator=generator)
    return gradient, torch.where(weight > 0.5, weight, 0.0)


@pytest.mark.parametrize("backend", FAST)
@pytest.mark.parametrize("yaw_rad", [0.0, 1.0, 3.1, -2.5])
def test_fast_rays_and_samples_agree_with_plain_torch(yaw_rad, backend):
    layout, camera = full_turn(), turned_camera(yaw_rad)
    texture = random_texture(layout)
    fast, plain = (rays_of(camera, layout, name) for name in (backend, "reference"))
    # the arc tangent polynomial is good to 2e-6 rad; a turn of float32 in texels on top
    most = 2e-6 / layout.texel_rad + 4 * EPS * layout.columns
    apart = (fast.places - plain.places).abs()
    apart[..., 0] = torch.minimum(apart[..., 0], layout.columns - apart[..., 0])
    assert float(apart.max()) <= most
    # a colour changes by at most 1 from texel to texel, along both axes
    rgb = sampled(texture, fast, layout, backend)
    assert float((rgb - reference.sample(texture, plain, layout)).abs().max()) <= 2 * most + 8 * EPS
    # from the same places only the places, as shares of the texture, and the blend are rounded
    most = (8 + 2 * layout.columns) * EPS
    assert float((rgb - reference.sample(texture, fast, layout)).abs().max()) <= most


@pytest.mark.parametrize("backend", FAST)
def test_directions_outside_a_crop_go_to_its_nearer_edge(backend):
    layout, texture = crop(), random_texture(crop())
    for yaw_rad in (0.0, 1.5, math.pi):
        rays, plain = (
            rays_of(turned_camera(yaw_rad), layout, name) for name in (backend, "reference")
        )
        most = 2e-6 / layout.texel_rad + 4 * EPS * 2 * math.pi / layout.texel_rad
        assert float((rays.places - plain.places).abs().max()) <= most
        expected = reference.sample(texture.double(), rays, layout)
        rgb = sampled(texture, rays, layout, backend)
        # far from the crop a place of size 80 is rounded before it is put to the edge
        assert float((rgb - expected).abs().max()) <= 100 * EPS


@pytest.mark.parametrize("backend", ["reference", *FAST])
def test_pixels_that_are_not_wanted_are_black(backend):
    layout, camera = full_turn(), turned_camera(0.3)
    wanted = torch.zeros(camera.height_px, camera.width_px, dtype=torch.bool)
    wanted[3:9, 5:20] = True
    rays = rays_of(camera, layout, backend, wanted)
    rgb = sampled(torch.ones(16, 64, 3), rays, layout, backend)
    assert torch.allclose(rgb, wanted[..., None].expand_as(rgb).float(), atol=8 * EPS, rtol=0)


@pytest.mark.parametrize("backend", FAST)
@pytest.mark.parametrize("layout", [full_turn(), crop()], ids=["full turn", "crop"])
def test_fast_scatter_is_that_of_plain_torch(layout, backend):
    camera = turned_camera(0.4)
    gradient, weight = random_gradient(camera)
    rays = rays_of(camera, layout, "cpu")
    fast = scattered(gradient, weight, rays, layout, backend)
    exact = scatter_gradient(gradient.double(), weight.double(), rays, layout)
    counts = (weight > 0).double()
    most = scatter_gradient(gradient.double().abs(), counts, rays, layout)
    # a share is the place's distance from its texel, and places are counted from the edge
    shares = layout.columns / 16
    terms = camera.height_px * camera.width_px
    for actual, expected, added in zip(fast, exact, most, strict=True):
        # a sum of n numbers is off by n roundings of the sum of their absolute values
        bound = EPS * (4 + shares + min(terms, 200)) * added + 1e-12
        assert bool(((actual - expected).abs() <= bound).all())


def test_plain_scatter_is_the_transpose_of_sampling():
    layout, camera = full_turn(), turned_camera(0.4)
    gradient, weight = random_gradient(camera)
    rays = sky_rays(camera, layout)
    exact = scatter_gradient(gradient.double(), weight.double(), rays, layout)
    texture = random_texture(layout).double().requires_grad_(True)
    seen = reference.sample(texture, rays, layout)
    (seen * gradient * (weight > 0)[..., None]).sum().backward()
    assert torch.allclose(exact[0], texture.grad, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("backend", FAST)
def test_what_is_tiny_or_huge_is_scattered_as_well(backend):
    """As its neighbours are of another size, each texel needs a scale of its own."""
    layout, camera = full_turn(), turned_camera(0.4)
    gradient, weight = random_gradient(camera)
    size = 10.0 ** torch.linspace(-30, 30, camera.width_px)[None, :, None]
    rays = rays_of(camera, layout, "cpu")
    found, _ = scattered(gradient * size, weight, rays, layout, backend)
    exact, _ = scatter_gradient((gradient * size).double(), weight.double(), rays, layout)
    most, _ = scatter_gradient((gradient * size).double().abs(), weight.double(), rays, layout)
    assert bool(((found - exact).abs() <= 200 * EPS * most).all())


@pytest.mark.parametrize("backend", FAST)
def test_a_gradient_that_is_not_a_number_stays_on_its_texels(backend):
    layout, camera = full_turn(), turned_camera(0.4)
    gradient, weight = random_gradient(camera)
    gradient[7, 9], weight[7, 9] = torch.nan, 1.0
    rays = rays_of(camera, layout, "cpu")
    found, found_weight = scattered(gradient, weight, rays, layout, backend)
    assert 0 < int(found.isnan().any(dim=-1).sum()) <= 4
    assert bool(found_weight.isfinite().all())


@pytest.mark.parametrize("backend", FAST)
def test_equal_gradients_scatter_to_equal_bits(backend):
    layout, camera = full_turn(8, 4), turned_camera(0.4)
    rays = rays_of(camera, layout, "cpu")
    runs = [scattered(*random_gradient(camera), rays, layout, backend) for _ in range(2)]
    assert all(torch.equal(*each) for each in zip(*runs, strict=True))


@pytest.mark.parametrize("backend", FAST)
def test_no_pixels_leave_no_trace(backend):
    layout = crop(3, 2)
    rays = SkyRays(places=torch.zeros(0, 5, 2), wanted=torch.zeros(0, 5, dtype=torch.bool))
    assert sampled(random_texture(layout), rays, layout, backend).shape == (0, 5, 3)
    found = scattered(torch.zeros(0, 5, 3), torch.zeros(0, 5), rays, layout, backend)
    assert [each.shape for each in found] == [(2, 3, 3), (2, 3)]
    assert not any(each.any() for each in found)


@pytest.mark.parametrize("backend", [TRITON])
def test_strides_do_not_matter(backend):
    layout, camera = crop(), turned_camera(0.1)
    texture, (gradient, weight) = random_texture(layout), random_gradient(camera)
    rays = rays_of(camera, layout, "cpu")
    strided = SkyRays(places=rays.places.mT.contiguous().mT, wanted=rays.wanted.T.contiguous().T)
    apart = texture.permute(2, 0, 1).contiguous().permute(1, 2, 0)
    expected = sampled(texture, rays, layout, backend)
    assert torch.equal(sampled(apart, strided, layout, backend), expected)
    expected = scattered(gradient, weight, rays, layout, backend)
    given = (gradient.permute(2, 0, 1).contiguous().permute(1, 2, 0), weight.T.contiguous().T)
    found = scattered(*given, strided, layout, backend)
    assert all(torch.equal(*each) for each in zip(found, expected, strict=True))
    stepped = [optimised(kept, *expected, backend, steps=1)[0] for kept in (texture, apart)]
    assert torch.equal(*stepped)


def optimised(texture, gradient, weight, backend, steps):
    """The texture after some steps of Adam from nothing, and the visits of its texels, on CPU."""
    home, kind = home_of(backend), texture.dtype
    texture = texture.to(home, copy=True)
    moments = TexelMoments(
        first=torch.zeros_like(texture),
        second=torch.zeros_like(texture),
        visits=torch.zeros(texture.shape[:2], dtype=torch.int32, device=home),
    )
    gradient, weight = gradient.to(home, kind), weight.to(home, kind)
    for step in range(steps):
        given = (gradient.roll(step, 1), weight.roll(step, 1))
        step_texels(texture, moments, *given, 0.01, backend=backend)
    return texture.cpu(), moments.visits.cpu()


@pytest.mark.parametrize("backend", FAST)
def test_fast_adam_agrees_with_plain_torch_in_double(backend):
    layout, camera = full_turn(), turned_camera(0.0)
    rays = rays_of(camera, layout, "cpu")
    found = scattered(*random_gradient(camera), rays, layout, "cpu")
    start = torch.full((16, 64, 3), 0.5)
    fast, visits = optimised(start, *found, backend, steps=3)
    plain, plain_visits = optimised(start.double(), *found, "reference", steps=3)
    # a step is 0.01 times a ratio of moments of size 1; colours of size 1 are rounded each time
    assert float((fast - plain).abs().max()) <= 3 * (EPS + 0.01 * 64 * EPS)
    assert torch.equal(visits, plain_visits)
    assert int(visits.min()) == 0
    assert float((plain - 0.5).abs().max()) > 0.01


def test_left_of_the_image_is_left_in_the_texture():
    layout = full_turn()
    places = sky_rays(turned_camera(0.0), layout, backend="reference").places
    assert bool((places[:, 1:, 0] > places[:, :-1, 0]).all())
    assert bool((places[1:, :, 1] > places[:-1, :, 1]).all())


def test_looking_back_meets_no_seam():
    layout, camera = full_turn(), turned_camera(math.pi)
    columns = torch.arange(layout.columns).float()
    smooth = (2 * math.pi * (columns + 0.5) / layout.columns).cos()[None, :, None] * 0.5 + 0.5
    texture = smooth.expand(layout.rows, layout.columns, 3).contiguous()
    row = sample_sky(texture, sky_rays(camera, layout), layout)[20, :, 0]
    assert float((row[1:] - row[:-1]).abs().max()) < 0.02


def test_what_does_not_belong_together_is_refused():
    layout, camera = full_turn(), turned_camera(0.0)
    rays = sky_rays(camera, layout)
    with pytest.raises(ShapeError, match="wanted pixels"):
        sky_rays(camera, layout, torch.ones(2, 2, dtype=torch.bool))
    with pytest.raises(ShapeError, match="another shape"):
        sample_sky(torch.zeros(3, 3, 3), rays, layout)
    with pytest.raises(ShapeError, match="gradient and a weight"):
        scatter_gradient(torch.zeros(2, 2, 3), torch.zeros(2, 2), rays, layout)


@pytest.mark.parametrize("backend", FAST)
def test_other_numbers_than_float32_are_refused(backend):
    layout = full_turn()
    rays = rays_of(turned_camera(0.0), layout, backend)
    with pytest.raises(BackendError, match="float32"):
        sampled(random_texture(layout).double(), rays, layout, backend)
