import math

import torch

from lidarpainter_models.gaussians.fitting.pixel_terms import (
    OPEN,
    SKY,
    SOLID,
    PixelFacts,
    clear_sky_loss,
    depth_loss,
    looks_like_sky,
    pixel_terms,
    pixel_terms_reference,
)
from lidarpainter_models.kernels.gaussian_raster import SplatImage

HEIGHT_PX, WIDTH_PX = 13, 17
SETTINGS = {"sky_tolerance": 0.3, "depth_tolerance": 0.05, "least_clear": 0.2}


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
        features=torch.zeros(HEIGHT_PX, WIDTH_PX, 0),
        visible=torch.zeros(0, dtype=torch.bool),
        radius_px=torch.zeros(0),
    )


def test_fast_terms_and_gradients_are_those_of_plain_torch():
    found = []
    for terms_of in (pixel_terms, pixel_terms_reference):
        (rgb, depth_m, alpha, sky_rgb), facts = random_case()
        terms = terms_of(image_of(rgb, depth_m, alpha), sky_rgb, facts, **SETTINGS)
        weight = torch.linspace(-1, 1, terms.shown.numel()).view_as(terms.shown)
        ((terms.shown * weight).sum() + 3 * terms.sky + 5 * terms.depth).backward()
        found.append(
            [terms.shown, terms.sky, terms.depth, rgb.grad, depth_m.grad, alpha.grad, sky_rgb.grad]
        )
    for fast, plain in zip(*found, strict=True):
        # float32 sums in another order
        assert torch.allclose(fast, plain, rtol=1e-4, atol=1e-5)


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


def test_image_without_returns_has_no_depth_term():
    (rgb, depth_m, alpha, sky_rgb), facts = random_case()
    blind = PixelFacts(
        rgb=facts.rgb,
        kind=torch.full_like(facts.kind, SKY),
        lidar_depth_m=torch.zeros_like(facts.lidar_depth_m),
    )
    terms = pixel_terms(image_of(rgb, depth_m, alpha), sky_rgb, blind, **SETTINGS)
    (terms.depth + terms.shown.sum()).backward()
    assert float(terms.depth.detach()) == 0
    assert float(depth_m.grad.abs().sum()) == 0
