"""Metrics against answers worked out by hand."""

import math

import pytest
import torch

from lidarpainter_models.errors import ShapeError
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.metrics.depth import score_depth, visible_points
from lidarpainter_models.metrics.images import (
    apply_affine_colour,
    fit_affine_colour,
    pooled_psnr,
    score_image,
)


def flat_camera() -> Camera:
    return Camera.centred(torch.eye(4, dtype=torch.float64), 10.0, width_px=32, height_px=32)


def test_known_error_gives_known_psnr():
    truth = torch.zeros(16, 16, 3)
    score = score_image(truth + 0.1, truth)
    assert score.psnr_db == pytest.approx(20.0, abs=1e-4)
    assert score.masked_pixels == 0


def test_equal_images_have_infinite_psnr_and_unit_ssim():
    image = torch.rand(32, 32, 3, generator=torch.Generator().manual_seed(1))
    score = score_image(image, image)
    assert math.isinf(score.psnr_db)
    assert score.ssim == pytest.approx(1.0, abs=1e-5)


def test_mask_restricts_and_pools():
    truth = torch.zeros(10, 10, 3)
    image = truth.clone()
    image[:5] = 0.1
    mask = torch.zeros(10, 10, dtype=torch.bool)
    mask[:5] = True
    assert pooled_psnr([score_image(image, truth, mask)]) == pytest.approx(20.0, abs=1e-4)
    assert pooled_psnr([score_image(image, truth, torch.zeros_like(mask))]) is None
    both = [score_image(image, truth, mask), score_image(truth, truth, mask)]
    assert pooled_psnr(both) == pytest.approx(10 * math.log10(1 / 0.005), abs=1e-3)


def test_affine_colour_is_recovered():
    generator = torch.Generator().manual_seed(2)
    source = torch.rand(500, 3, generator=generator)
    affine = torch.tensor([[0.8, 0.1, 0, 0.02], [0, 0.9, 0.05, 0.01], [0.1, 0, 0.7, 0.03]])
    fitted = fit_affine_colour(source, apply_affine_colour(source, affine))
    assert torch.allclose(fitted, affine, atol=1e-5)


def test_too_few_pixels_fit_no_colour():
    with pytest.raises(ShapeError, match="at least"):
        fit_affine_colour(torch.rand(5, 3), torch.rand(5, 3))


def test_hidden_point_does_not_count():
    points = torch.tensor([[0.05, 0.05, 5.0], [0.1, 0.1, 10.0]])
    _, depth_m = visible_points(flat_camera(), points)
    assert depth_m.tolist() == [5.0]


def test_depth_inliers_stop_at_five_percent():
    points = torch.tensor([[-5.0, 0.5, 10.0], [0.5, 0.5, 10.0], [5.0, 0.5, 10.0]])
    rendered = torch.zeros(32, 32)
    rendered[:, :14] = 10.4  # within 5 %
    rendered[:, 14:20] = 10.6  # outside
    score = score_depth(rendered, flat_camera(), points)  # the third point falls into a hole
    assert (score.inliers, score.points) == (1, 3)
