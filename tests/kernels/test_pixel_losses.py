import math
from importlib import import_module

import pytest
import torch
from splat_drawing import TRITON, home_of

from lidarpainter_models.kernels.gaussian_raster import SplatImage
from lidarpainter_models.kernels.pixel_losses import (
    OPEN,
    SKY,
    SOLID,
    PixelFacts,
    PixelRules,
    pixel_terms,
)
from lidarpainter_models.kernels.pixel_losses.reference import (
    clear_sky_loss,
    composed,
    depth_loss,
    looks_like_sky,
)

HEIGHT_PX, WIDTH_PX = 13, 17
RULES = PixelRules(sky_tolerance=0.3, depth_tolerance=0.05, min_transmittance=0.2)
LEAVES = ("rgb", "depth_m", "alpha", "sky_rgb")
EPS = torch.finfo(torch.float32).eps
EXPOSURE = torch.tensor([[1.3, 0.1, -0.1, 0.02], [0.05, 1.2, 0.0, -0.03], [0.0, -0.2, 0.8, 0.1]])


def random_case(seed=0):
    generator = torch.Generator().manual_seed(seed)

    def random(*size):
        return torch.rand(HEIGHT_PX, WIDTH_PX, *size, generator=generator)

    alpha = random()
    alpha[0, :4] = torch.tensor([0.0, 1.0, 5e-5, 1 - 5e-5])
    leaves = [random(3), 20 * random(), alpha, random(3)]
    facts = PixelFacts(
        rgb=random(3),
        kind=(4 * random()).to(torch.uint8),
        lidar_depth_m=torch.where(random() > 0.5, 20 * random() + 1, 0.0),
    )
    return [leaf.requires_grad_(True) for leaf in leaves], facts


def image_of(rgb, depth_m, alpha):
    return SplatImage(
        rgb=rgb,
        depth_m=depth_m,
        alpha=alpha,
        features=rgb[..., :0],
        visible=torch.zeros(0, dtype=torch.bool),
    )


def terms_and_gradients(backend, dtype):
    home = home_of(backend)
    leaves, facts = random_case()
    leaves = [leaf.detach().to(home, dtype).requires_grad_(True) for leaf in leaves]
    facts = PixelFacts(
        rgb=facts.rgb.to(home, dtype),
        kind=facts.kind.to(home),
        lidar_depth_m=facts.lidar_depth_m.to(home, dtype),
    )
    rgb, depth_m, alpha, sky_rgb = leaves
    exposure = EXPOSURE.to(home, dtype, copy=True).requires_grad_(True)
    image = image_of(rgb, depth_m, alpha)
    terms = pixel_terms(image, sky_rgb, facts, RULES, exposure=exposure, backend=backend)
    weight = torch.linspace(-1, 1, terms.shown.numel(), dtype=dtype)
    weight = weight.view(terms.shown.shape).to(home)
    ((terms.shown * weight).sum() + 3 * terms.sky + 5 * terms.depth).backward()
    found = {"shown": terms.shown, "sky": terms.sky, "depth": terms.depth}
    found |= {name: leaf.grad for name, leaf in zip(LEAVES, leaves, strict=True)}
    found["exposure"] = exposure.grad
    return {name: value.detach().cpu().double() for name, value in found.items()}


@pytest.mark.parametrize("backend", ["cpu", TRITON])
def test_fast_terms_and_gradients_are_those_of_plain_torch_in_double(backend):
    fast, truth = (
        terms_and_gradients(backend, torch.float32),
        terms_and_gradients("reference", torch.float64),
    )
    for name, expected in truth.items():
        # a dozen operations a pixel, on numbers as large as the largest beside it
        most = 16 * EPS * torch.maximum(expected.abs(), expected.abs().mean())
        assert bool(((fast[name] - expected).abs() <= most).all()), name


@pytest.mark.parametrize("backend", [TRITON])
def test_blocks_of_pixels_add_up(backend, monkeypatch):
    whole = terms_and_gradients(backend, torch.float32)
    module = import_module("lidarpainter_models.kernels.pixel_losses.triton")
    monkeypatch.setattr(module, "PIXELS_AT_ONCE", 32)
    monkeypatch.setattr(module, "SUMS_AT_ONCE", 4)
    found, again = (terms_and_gradients(backend, torch.float32) for _ in range(2))
    for name, value in found.items():
        torch.testing.assert_close(value, whole[name], rtol=1e-6, atol=1e-6)
        assert torch.equal(value, again[name]), name


@pytest.mark.parametrize("backend", ["cpu", TRITON])
def test_strided_images_give_the_same_as_their_copies(backend):
    home = home_of(backend)
    (rgb, depth_m, alpha, sky_rgb), facts = random_case()
    values = [value.detach().to(home) for value in (rgb, depth_m, alpha, sky_rgb, facts.rgb)]
    spread = [torch.stack([value, value * 0], dim=1)[:, 0] for value in values]
    assert not any(value.is_contiguous() for value in spread)
    kind, lidar_depth_m = facts.kind.to(home), facts.lidar_depth_m.to(home)
    shown = []
    for *drawn, sky, target in (values, spread):
        known = PixelFacts(rgb=target, kind=kind, lidar_depth_m=lidar_depth_m)
        shown.append(pixel_terms(image_of(*drawn), sky, known, RULES, backend=backend))
    assert torch.equal(shown[0].shown, shown[1].shown)
    assert torch.equal(shown[0].sky, shown[1].sky)
    assert torch.equal(shown[0].depth, shown[1].depth)


def test_without_an_exposure_colours_are_shown_as_they_are():
    (rgb, depth_m, alpha, sky_rgb), facts = random_case()
    shown = pixel_terms(image_of(rgb, depth_m, alpha), sky_rgb, facts, RULES).shown
    assert torch.equal(shown, rgb + (1 - alpha)[..., None] * sky_rgb)


def test_sky_term_by_hand():
    alpha = torch.tensor([[0.5, 0.5, 0.9]])
    sky = torch.tensor([[True, False, False]])
    solid = torch.tensor([[False, True, False]])
    assert abs(float(clear_sky_loss(alpha, sky, solid)) - 2 * math.log(2) / 3) < 1e-6


def test_depth_term_by_hand():
    accumulated = torch.tensor([[5.5, 7.0, 1.0]])
    alpha = torch.tensor([[0.5, 1.0, 0.1]])
    lidar_m = torch.tensor([[10.0, 0.0, 10.0]])  # the second has none, the third is mostly clear
    # expected depth 11 against 10: relative error 0.1, twice the tolerance
    expected = math.log(3)
    assert abs(float(depth_loss(accumulated, alpha, lidar_m, tolerance=0.05)) - expected) < 1e-5


def test_only_open_pixels_can_look_like_sky():
    rgb = torch.full((1, 3, 3), 0.5)
    sky_rgb = torch.tensor([[[0.52] * 3, [0.52] * 3, [0.7] * 3]])
    kind = torch.tensor([[OPEN, SOLID, OPEN]])
    found = looks_like_sky(rgb, sky_rgb, kind == OPEN, tolerance=0.05)
    assert found.tolist() == [[True, False, False]]


@pytest.mark.parametrize("backend", ["cpu", "reference", TRITON])
def test_open_pixels_are_held_against_the_sky_as_the_camera_shows_it(backend):
    clear = torch.zeros(HEIGHT_PX, WIDTH_PX, device=home_of(backend))
    black = clear[..., None].expand(-1, -1, 3)
    sky_rgb = black + 0.4
    facts = PixelFacts(
        rgb=black + 0.8,  # twice the sky: a camera that is twice as bright
        kind=torch.full_like(clear, OPEN, dtype=torch.uint8),
        lidar_depth_m=clear,
    )
    image = image_of(black, clear, clear + 0.5)
    exposures = {1.0: 0.0, 2.0: math.log(2)}
    for gain, expected in exposures.items():
        exposure = gain * torch.eye(3, 4).to(clear)
        terms = pixel_terms(image, sky_rgb, facts, RULES, exposure=exposure, backend=backend)
        assert float(terms.sky) == pytest.approx(expected)


@pytest.mark.parametrize("backend", ["cpu", TRITON])
def test_image_without_returns_has_no_depth_term(backend):
    home = home_of(backend)
    leaves, facts = random_case()
    rgb, depth_m, alpha, sky_rgb = (leaf.detach().to(home).requires_grad_() for leaf in leaves)
    blind = PixelFacts(
        rgb=facts.rgb.to(home),
        kind=torch.full_like(facts.kind, SKY, device=home),
        lidar_depth_m=torch.zeros_like(facts.lidar_depth_m, device=home),
    )
    terms = pixel_terms(image_of(rgb, depth_m, alpha), sky_rgb, blind, RULES, backend=backend)
    (terms.depth + terms.shown.sum()).backward()
    assert float(terms.depth.detach()) == 0
    assert float(depth_m.grad.abs().sum()) == 0


def test_opaque_pixels_send_no_gradient_to_the_sky():
    alpha = torch.tensor([[0.0, 0.5, 0.79, 0.81, 1.0]])
    sky_rgb = torch.rand(1, 5, 3, requires_grad=True)
    splat = image_of(torch.zeros(1, 5, 3), torch.zeros(1, 5), alpha)
    composed(splat, sky_rgb, 0.2).sum().backward()
    expected = torch.tensor([[1.0, 0.5, 0.21, 0.0, 0.0]])
    assert torch.allclose(sky_rgb.grad, expected[..., None].expand(1, 5, 3), atol=1e-6)
