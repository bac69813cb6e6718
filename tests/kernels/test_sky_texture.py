"""Sky look-ups: the numba version against plain torch, and plain torch against what is known."""

import math

import pytest
import torch
from gaussian_world import turned_camera

from lidarpainter_models.errors import BackendError, ShapeError
from lidarpainter_models.kernels.sky_texture import (
    SkyLayout,
    TexelMoments,
    reference,
    sample_sky,
    scatter_gradient,
    sky_rays,
    step_texels,
)

EPS = torch.finfo(torch.float32).eps


def full_turn(columns=64, rows=16):
    return SkyLayout(
        azimuth_left_rad=math.pi,
        elevation_top_rad=math.pi / 2,
        texel_rad=2 * math.pi / columns,
        columns=columns,
        rows=rows,
    )


def random_texture(layout, seed=0):
    return torch.rand(layout.rows, layout.columns, 3, generator=torch.Generator().manual_seed(seed))


def random_gradient(camera, seed=1):
    generator = torch.Generator().manual_seed(seed)
    gradient = torch.randn(camera.height_px, camera.width_px, 3, generator=generator)
    weight = torch.rand(camera.height_px, camera.width_px, generator=generator)
    return gradient, torch.where(weight > 0.5, weight, 0.0)


@pytest.mark.parametrize("yaw_rad", [0.0, 1.0, 3.1, -2.5])
def test_fast_rays_and_samples_agree_with_plain_torch(yaw_rad):
    layout, camera = full_turn(), turned_camera(yaw_rad)
    texture = random_texture(layout)
    fast, plain = (sky_rays(camera, layout, backend=name) for name in ("cpu", "reference"))
    # the arc tangent polynomial is good to 2e-6 rad; a turn of float32 in texels on top
    most = 2e-6 / layout.texel_rad + 4 * EPS * layout.columns
    apart = (fast.places - plain.places).abs()
    apart[..., 0] = torch.minimum(apart[..., 0], layout.columns - apart[..., 0])
    assert float(apart.max()) <= most
    # a colour changes by at most 1 from texel to texel, along both axes
    rgb = sample_sky(texture, fast, layout, backend="cpu")
    assert float((rgb - reference.sample(texture, plain, layout)).abs().max()) <= 2 * most + 8 * EPS
    # from the same places only the places, as shares of the texture, and the blend are rounded
    most = (8 + 2 * layout.columns) * EPS
    assert float((rgb - reference.sample(texture, fast, layout)).abs().max()) <= most


def test_pixels_that_are_not_wanted_are_black():
    layout, camera = full_turn(), turned_camera(0.3)
    wanted = torch.zeros(camera.height_px, camera.width_px, dtype=torch.bool)
    wanted[3:9, 5:20] = True
    for backend in ("cpu", "reference"):
        rays = sky_rays(camera, layout, wanted, backend=backend)
        rgb = sample_sky(torch.ones(16, 64, 3), rays, layout, backend=backend)
        assert torch.allclose(rgb, wanted[..., None].expand_as(rgb).float(), atol=8 * EPS, rtol=0)


def test_fast_scatter_is_that_of_plain_torch_and_the_transpose_of_sampling():
    layout, camera = full_turn(), turned_camera(0.4)
    gradient, weight = random_gradient(camera)
    rays = sky_rays(camera, layout)
    fast = scatter_gradient(gradient, weight, rays, layout, backend="cpu")
    exact = scatter_gradient(gradient.double(), weight.double(), rays, layout)
    counts = (weight > 0).double()
    most = scatter_gradient(gradient.double().abs(), counts, rays, layout)
    terms = camera.height_px * camera.width_px
    for actual, expected, added in zip(fast, exact, most, strict=True):
        # a sum of n numbers is off by n roundings of the sum of their absolute values
        bound = EPS * (4 + min(terms, 200)) * added + 1e-12
        assert bool(((actual - expected).abs() <= bound).all())
    texture = random_texture(layout).double().requires_grad_(True)
    seen = reference.sample(texture, rays, layout)
    (seen * gradient * (weight > 0)[..., None]).sum().backward()
    assert torch.allclose(exact[0], texture.grad, rtol=1e-9, atol=1e-9)


def test_fast_adam_agrees_with_plain_torch_in_double():
    layout, camera = full_turn(), turned_camera(0.0)
    rays = sky_rays(camera, layout)
    textures = [torch.full((16, 64, 3), 0.5, dtype=kind) for kind in (torch.float32, torch.float64)]
    states = [
        TexelMoments(
            first=torch.zeros_like(texture),
            second=torch.zeros_like(texture),
            visits=torch.zeros(16, 64, dtype=torch.int32),
        )
        for texture in textures
    ]
    for seed in range(3):
        gradient, weight = scatter_gradient(*random_gradient(camera, seed), rays, layout)
        for texture, moments in zip(textures, states, strict=True):
            kind = texture.dtype
            step_texels(texture, moments, gradient.to(kind), weight.to(kind), 0.01)
    # a step is 0.01 times a ratio of moments of size 1; colours of size 1 are rounded each time
    assert float((textures[0] - textures[1]).abs().max()) <= 3 * (EPS + 0.01 * 64 * EPS)
    assert torch.equal(states[0].visits, states[1].visits)
    assert float((textures[1] - 0.5).abs().max()) > 0.01


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
    with pytest.raises(BackendError, match="float32"):
        sample_sky(random_texture(layout).double(), rays, layout, backend="cpu")
