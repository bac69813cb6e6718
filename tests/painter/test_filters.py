"""Blurs, filled holes and pyramids of images."""

import pytest
import torch
import torch.nn.functional as F  # noqa: N812 - the name everyone knows

from lidarpainter_models.painter.filters import blur, fill_push_pull, masked_blur


@pytest.mark.parametrize("sigma_px", [1.5, 3.0])
def test_a_blur_is_the_convolution_with_its_kernel(sigma_px):
    image = torch.rand(2, 3, 17, 30, generator=torch.Generator().manual_seed(2))
    radius_px = round(2.5 * sigma_px)
    offsets = torch.arange(-radius_px, radius_px + 1).float()
    kernel = torch.exp(-0.5 * (offsets / sigma_px) ** 2)
    kernel = torch.outer(kernel, kernel) / kernel.sum() ** 2
    padded = F.pad(image, (radius_px,) * 4, mode="replicate")
    expected = F.conv2d(padded, kernel.expand(3, 1, -1, -1), groups=3)
    torch.testing.assert_close(blur(image, sigma_px=sigma_px), expected, rtol=0, atol=1e-6)


def test_filling_keeps_known_pixels_and_reaches_everywhere():
    image = torch.zeros(1, 3, 13, 21)
    known = torch.zeros(1, 1, 13, 21)
    image[0, :, 2, 3], known[0, 0, 2, 3] = 0.75, 1
    filled = fill_push_pull(image, known)
    torch.testing.assert_close(filled, torch.full_like(filled, 0.75))
    assert float(fill_push_pull(image, torch.zeros_like(known)).abs().max()) == 0


def test_filling_a_full_image_changes_nothing():
    image = torch.rand(2, 3, 9, 11, generator=torch.Generator().manual_seed(0))
    filled = fill_push_pull(image, torch.ones(2, 1, 9, 11))
    torch.testing.assert_close(filled, image)


def test_blur_keeps_constants_and_masked_blur_ignores_the_unknown():
    constant = torch.full((1, 3, 9, 9), 0.3)
    torch.testing.assert_close(blur(constant), constant)
    valid = torch.ones(1, 1, 9, 9)
    valid[..., 4:] = 0
    spoiled = torch.where(valid > 0, constant, 1.0)
    torch.testing.assert_close(masked_blur(spoiled, valid)[..., :4], constant[..., :4])
