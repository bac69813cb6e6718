import math

import numba
import pytest
import torch

from lidarpainter_models.errors import BackendError, ShapeError
from lidarpainter_models.kernels.ssim import l1_ssim_loss, ssim, ssim_map
from lidarpainter_models.kernels.ssim.reference import window_weights

# float32 against float64: rounding of the windowed sums; the reference in float32 reaches 2e-5
GRADIENT_TOLERANCE = 1e-5
# where the image is flat a variance of 1e-7 is lost in rounding and stands beside c2 = 9e-4
MAP_TOLERANCE = 1e-4
SIZES = [(1, 1), (1, 40), (11, 3), (23, 64), (65, 97)]


def image(height, width, seed):
    """Smooth patches with a saturated and a black band: flat places are the hard ones."""
    generator = torch.Generator().manual_seed(seed)
    coarse = torch.rand(1, 3, 2 + height // 8, 2 + width // 8, generator=generator)
    fine = torch.nn.functional.interpolate(coarse, (height, width), mode="bilinear")
    rgb = fine[0].permute(1, 2, 0).contiguous()
    rgb[: height // 4] = 1.0
    rgb[height - height // 5 :] = 0.0
    return rgb


def noisy_pair(height, width, noise=0.05):
    target = image(height, width, seed=1)
    generator = torch.Generator().manual_seed(2)
    return (target + noise * torch.randn(target.shape, generator=generator)).clamp(0, 1), target


def gradient_of(function, rendered, *args, **settings):
    leaf = rendered.clone().requires_grad_()
    value = function(leaf, *args, **settings)
    value.backward()
    return value.detach(), leaf.grad


def relative_error(actual, expected):
    return float((actual.double() - expected).norm() / expected.norm())


@pytest.mark.parametrize("backend", ["reference", "cpu"])
def test_a_image_is_fully_similar_to_itself(backend):
    rgb = image(20, 31, seed=0)
    similarity = ssim_map(rgb, rgb, backend=backend)
    torch.testing.assert_close(similarity, torch.ones_like(rgb), atol=1e-4, rtol=0)
    assert float(ssim(rgb, rgb, backend=backend)) == pytest.approx(1, abs=1e-5)


def test_window_is_the_normalised_gaussian_of_the_paper():
    weights = window_weights()
    assert len(weights) == 11
    assert math.isclose(sum(weights), 1)
    assert weights[4] / weights[5] == pytest.approx(math.exp(-1 / (2 * 1.5**2)))


@pytest.mark.parametrize("backend", ["reference", "cpu"])
def test_flat_images_differ_only_in_luminance(backend):
    first, second = torch.full((31, 31, 3), 0.8), torch.full((31, 31, 3), 0.4)
    expected = (2 * 0.8 * 0.4 + 1e-4) / (0.8**2 + 0.4**2 + 1e-4)
    centre = ssim_map(first, second, backend=backend)[15, 15, 0]
    assert float(centre) == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize("backend", ["reference", "cpu"])
def test_a_single_pixel_sees_only_zeros_around_it(backend):
    weight = window_weights()[5] ** 2
    first, second = 0.5, 0.25
    mean_1, mean_2 = weight * first, weight * second
    variance_1, variance_2 = weight * first**2 - mean_1**2, weight * second**2 - mean_2**2
    covariance = weight * first * second - mean_1 * mean_2
    expected = (2 * mean_1 * mean_2 + 1e-4) / (mean_1**2 + mean_2**2 + 1e-4)
    expected *= (2 * covariance + 9e-4) / (variance_1 + variance_2 + 9e-4)
    actual = ssim(torch.full((1, 1, 3), first), torch.full((1, 1, 3), second), backend=backend)
    assert float(actual) == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize(("height", "width"), SIZES)
def test_fast_map_and_its_gradient_match_float64(height, width):
    rendered, target = noisy_pair(height, width)
    expected = ssim_map(rendered.double(), target.double(), backend="reference")
    torch.testing.assert_close(
        ssim_map(rendered, target, backend="cpu").double(), expected, atol=MAP_TOLERANCE, rtol=0
    )
    _, law = gradient_of(ssim, rendered.double(), target.double(), backend="reference")
    _, fast = gradient_of(ssim, rendered, target, backend="cpu")
    assert relative_error(fast, law) <= GRADIENT_TOLERANCE


@pytest.mark.parametrize("noise", [0.3, 0.01])
@pytest.mark.parametrize(("height", "width"), SIZES)
@pytest.mark.parametrize("is_weighted", [False, True])
def test_fast_loss_and_its_gradient_match_float64(height, width, is_weighted, noise):
    rendered, target = noisy_pair(height, width, noise)
    weight = None
    if is_weighted:
        weight = torch.rand(height, width, generator=torch.Generator().manual_seed(3)) - 0.3
        weight = weight.clamp(min=0)
        weight[0, 0] = 1.0
    double = None if weight is None else weight.double()
    law, law_gradient = gradient_of(
        l1_ssim_loss, rendered.double(), target.double(), pixel_weight=double, backend="reference"
    )
    fast, fast_gradient = gradient_of(
        l1_ssim_loss, rendered, target, pixel_weight=weight, backend="cpu"
    )
    assert float(fast) == pytest.approx(float(law), rel=1e-5, abs=1e-7)
    assert relative_error(fast_gradient, law_gradient) <= GRADIENT_TOLERANCE


def test_the_reference_gradient_is_the_slope_of_the_reference():
    rendered, target = (rgb.double() for rgb in noisy_pair(6, 7, noise=0.3))
    rendered.requires_grad_()
    assert torch.autograd.gradcheck(
        lambda rgb: ssim(rgb, target, backend="reference"), (rendered,), fast_mode=True
    )


def test_loss_is_a_mean_over_all_pixels_of_weighted_errors():
    rendered, target = noisy_pair(24, 24)
    full = l1_ssim_loss(rendered, target)
    half = l1_ssim_loss(rendered, target, pixel_weight=torch.full((24, 24), 0.5))
    assert float(half) == pytest.approx(float(full) / 2, rel=1e-6)
    expected = (rendered - target).abs().mean() + 0.2 * (1 - ssim(rendered, target))
    assert float(full) == pytest.approx(float(expected), rel=1e-6)
    assert float(l1_ssim_loss(rendered, target, pixel_weight=torch.zeros(24, 24))) == 0


@pytest.mark.parametrize("backend", ["reference", "cpu"])
def test_an_untrusted_pixel_has_no_influence(backend):
    rendered, target = noisy_pair(24, 30)
    weight = torch.ones(24, 30)
    weight[8:12, 10:20] = 0
    loss, gradient = gradient_of(
        l1_ssim_loss, rendered, target, pixel_weight=weight, backend=backend
    )
    changed = rendered.clone()
    changed[8:12, 10:20] = 0.9
    assert float(loss) == float(l1_ssim_loss(changed, target, pixel_weight=weight, backend=backend))
    assert not gradient[8:12, 10:20].any()
    assert gradient[6, 9].any()


def test_one_and_two_threads_give_the_same_bits():
    rendered, target = noisy_pair(61, 83)
    threads = numba.get_num_threads()
    try:
        results = []
        for num_threads in (1, min(2, numba.config.NUMBA_NUM_THREADS)):
            numba.set_num_threads(num_threads)
            results.append(gradient_of(l1_ssim_loss, rendered, target, backend="cpu"))
    finally:
        numba.set_num_threads(threads)
    assert torch.equal(results[0][0], results[1][0])
    assert torch.equal(results[0][1], results[1][1])


def test_a_strided_image_gives_the_same_as_its_copy():
    rendered, target = noisy_pair(20, 34)
    strided = rendered.permute(2, 0, 1).contiguous().permute(1, 2, 0)
    assert not strided.is_contiguous()
    assert torch.equal(ssim_map(strided, target), ssim_map(rendered, target))


def test_upstream_gradients_scale_the_loss_gradient():
    rendered, target = noisy_pair(20, 20)
    _, plain = gradient_of(l1_ssim_loss, rendered, target)
    _, scaled = gradient_of(lambda rgb, other: 3 * l1_ssim_loss(rgb, other), rendered, target)
    torch.testing.assert_close(scaled, 3 * plain)


def test_auto_takes_the_reference_for_float64_and_the_numba_door_refuses_it():
    rendered, target = (rgb.double() for rgb in noisy_pair(12, 12))
    assert ssim(rendered, target).dtype == torch.float64
    with pytest.raises(BackendError, match="float32"):
        ssim(rendered, target, backend="cpu")


def test_images_that_do_not_fit_are_refused():
    with pytest.raises(ShapeError, match="one size"):
        ssim(torch.zeros(4, 5, 3), torch.zeros(5, 4, 3))
    with pytest.raises(ShapeError, match="one weight per pixel"):
        l1_ssim_loss(torch.zeros(4, 5, 3), torch.zeros(4, 5, 3), pixel_weight=torch.ones(5, 4))
