import math
from importlib import import_module

import numba
import pytest
import torch
from splat_drawing import TRITON, WITHOUT_TRITON, home_of

from lidarpainter_models.errors import BackendError, ShapeError
from lidarpainter_models.kernels.ssim import l1_ssim_loss, ssim_map
from lidarpainter_models.kernels.ssim.reference import window_weights

# float32 against float64: rounding of the windowed sums; the reference in float32 reaches 2e-5
GRADIENT_TOLERANCE = 1e-5
# where the image is flat a variance of 1e-7 is lost in rounding and stands beside c2 = 9e-4
MAP_TOLERANCE = 1e-4
SIZES = [(1, 1), (1, 40), (11, 3), (23, 64), (65, 97)]
BACKENDS = ["reference", "cpu", TRITON]
FAST = [pytest.param("cpu", size, id=f"cpu-{size}") for size in SIZES]
FAST += [pytest.param("triton", size, marks=TRITON.marks) for size in [(1, 1), (11, 3), (7, 30)]]
"""Numpy interprets Triton, slowly."""


@pytest.fixture(autouse=True)
def _large_tiles(monkeypatch):
    """What is interpreted costs by the number of tiles; `test_tiles_meet` has those of a GPU."""
    if WITHOUT_TRITON is None and home_of("triton").type == "cpu":
        module = import_module("lidarpainter_models.kernels.ssim.triton")
        monkeypatch.setattr(module, "COLUMNS_AT_ONCE", 512)
        monkeypatch.setattr(module, "ROWS_AT_ONCE", 64)


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


def at_home(function, *images, backend="auto", pixel_weight=None, **settings):
    """What a backend gives on its device; the answer comes back."""
    home = home_of(backend)
    if pixel_weight is not None:
        settings["pixel_weight"] = pixel_weight.to(home)
    return function(*(image.to(home) for image in images), backend=backend, **settings).cpu()


def gradient_of(function, rendered, target, **settings):
    leaf = rendered.clone().requires_grad_()
    value = at_home(function, leaf, target, **settings)
    value.backward()
    return value.detach(), leaf.grad


def relative_error(actual, expected):
    return float((actual.double() - expected).norm() / expected.norm())


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_image_is_fully_similar_to_itself(backend):
    rgb = image(20, 31, seed=0)
    similarity = at_home(ssim_map, rgb, rgb, backend=backend)
    torch.testing.assert_close(similarity, torch.ones_like(rgb), atol=1e-4, rtol=0)
    assert float(similarity.mean()) == pytest.approx(1, abs=1e-5)


def test_window_is_the_normalised_gaussian_of_the_paper():
    weights = window_weights()
    assert len(weights) == 11
    assert math.isclose(sum(weights), 1)
    assert weights[4] / weights[5] == pytest.approx(math.exp(-1 / (2 * 1.5**2)))


@pytest.mark.parametrize("backend", BACKENDS)
def test_flat_images_differ_only_in_luminance(backend):
    first, second = torch.full((31, 31, 3), 0.8), torch.full((31, 31, 3), 0.4)
    expected = (2 * 0.8 * 0.4 + 1e-4) / (0.8**2 + 0.4**2 + 1e-4)
    centre = at_home(ssim_map, first, second, backend=backend)[15, 15, 0]
    assert float(centre) == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_single_pixel_sees_only_zeros_around_it(backend):
    weight = window_weights()[5] ** 2
    first, second = 0.5, 0.25
    mean_1, mean_2 = weight * first, weight * second
    variance_1, variance_2 = weight * first**2 - mean_1**2, weight * second**2 - mean_2**2
    covariance = weight * first * second - mean_1 * mean_2
    expected = (2 * mean_1 * mean_2 + 1e-4) / (mean_1**2 + mean_2**2 + 1e-4)
    expected *= (2 * covariance + 9e-4) / (variance_1 + variance_2 + 9e-4)
    images = [torch.full((1, 1, 3), value) for value in (first, second)]
    actual = at_home(ssim_map, *images, backend=backend).mean()
    assert float(actual) == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize(("backend", "size"), FAST)
def test_fast_map_and_its_gradient_match_float64(backend, size):
    rendered, target = noisy_pair(*size)
    upstream = torch.linspace(-1, 2, rendered.numel(), dtype=torch.float64).view_as(rendered)
    expected = ssim_map(rendered.double(), target.double(), backend="reference")
    found = at_home(ssim_map, rendered, target, backend=backend)
    torch.testing.assert_close(found.double(), expected, atol=MAP_TOLERANCE, rtol=0)

    def weighted(first, second, backend):
        return (ssim_map(first, second, backend=backend) * upstream.to(first)).sum()

    _, law = gradient_of(weighted, rendered.double(), target.double(), backend="reference")
    _, fast = gradient_of(weighted, rendered, target, backend=backend)
    assert relative_error(fast, law) <= GRADIENT_TOLERANCE


def assert_loss_matches_float64(backend, size, noise, *, is_weighted):
    rendered, target = noisy_pair(*size, noise)
    weight = None
    if is_weighted:
        weight = torch.rand(*size, generator=torch.Generator().manual_seed(3)) - 0.3
        weight = weight.clamp(min=0)
        weight[0, 0] = 1.0
    double = None if weight is None else weight.double()
    law, law_gradient = gradient_of(
        l1_ssim_loss, rendered.double(), target.double(), pixel_weight=double, backend="reference"
    )
    fast, fast_gradient = gradient_of(
        l1_ssim_loss, rendered, target, pixel_weight=weight, backend=backend
    )
    assert float(fast) == pytest.approx(float(law), rel=1e-5, abs=1e-7)
    assert relative_error(fast_gradient, law_gradient) <= GRADIENT_TOLERANCE


@pytest.mark.parametrize("noise", [0.3, 0.01])
@pytest.mark.parametrize(("backend", "size"), FAST)
@pytest.mark.parametrize("is_weighted", [False, True])
def test_fast_loss_and_its_gradient_match_float64(backend, size, is_weighted, noise):
    assert_loss_matches_float64(backend, size, noise, is_weighted=is_weighted)


@pytest.mark.parametrize("backend", [TRITON])
def test_tiles_meet(backend, monkeypatch):
    module = import_module("lidarpainter_models.kernels.ssim.triton")
    monkeypatch.setattr(module, "COLUMNS_AT_ONCE", 32)
    monkeypatch.setattr(module, "ROWS_AT_ONCE", 4)
    assert_loss_matches_float64(backend, (6, 13), 0.1, is_weighted=True)


@pytest.mark.parametrize("backend", [TRITON])
def test_equal_input_gives_equal_bits(backend):
    rendered, target = noisy_pair(5, 9)
    first, again = (gradient_of(l1_ssim_loss, rendered, target, backend=backend) for _ in range(2))
    assert torch.equal(first[0], again[0])
    assert torch.equal(first[1], again[1])


@pytest.mark.parametrize("backend", ["cpu", TRITON])
def test_an_image_of_no_pixels_has_an_empty_map(backend):
    for size in ((0, 5, 3), (5, 0, 3)):
        assert at_home(ssim_map, *torch.zeros(2, *size), backend=backend).shape == size


def test_the_reference_gradient_is_the_slope_of_the_reference():
    rendered, target = (rgb.double() for rgb in noisy_pair(6, 7, noise=0.3))
    rendered.requires_grad_()
    assert torch.autograd.gradcheck(
        lambda rgb: ssim_map(rgb, target, backend="reference"), (rendered,), fast_mode=True
    )


def test_loss_is_a_mean_over_all_pixels_of_weighted_errors():
    rendered, target = noisy_pair(24, 24)
    full = l1_ssim_loss(rendered, target)
    half = l1_ssim_loss(rendered, target, pixel_weight=torch.full((24, 24), 0.5))
    assert float(half) == pytest.approx(float(full) / 2, rel=1e-6)
    expected = (rendered - target).abs().mean() + 0.2 * (1 - ssim_map(rendered, target).mean())
    assert float(full) == pytest.approx(float(expected), rel=1e-6)
    assert float(l1_ssim_loss(rendered, target, pixel_weight=torch.zeros(24, 24))) == 0


@pytest.mark.parametrize("backend", BACKENDS)
def test_an_untrusted_pixel_has_no_influence(backend):
    rendered, target = noisy_pair(14, 30)
    weight = torch.ones(14, 30)
    weight[8:12, 10:20] = 0
    loss, gradient = gradient_of(
        l1_ssim_loss, rendered, target, pixel_weight=weight, backend=backend
    )
    changed = rendered.clone()
    changed[8:12, 10:20] = 0.9
    same = at_home(l1_ssim_loss, changed, target, pixel_weight=weight, backend=backend)
    assert float(loss) == float(same)
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


@pytest.mark.parametrize("backend", ["cpu", TRITON])
def test_a_strided_image_gives_the_same_as_its_copy(backend):
    rendered, target = noisy_pair(6, 34)
    strided = rendered.permute(2, 0, 1).contiguous().permute(1, 2, 0)
    assert not strided.is_contiguous()
    found, expected = (at_home(ssim_map, x, target, backend=backend) for x in (strided, rendered))
    assert torch.equal(found, expected)


@pytest.mark.parametrize("backend", ["cpu", TRITON])
def test_upstream_gradients_scale_the_loss_gradient(backend):
    def tripled(*images, **settings):
        return 3 * l1_ssim_loss(*images, **settings)

    rendered, target = noisy_pair(6, 20)
    _, plain = gradient_of(l1_ssim_loss, rendered, target, backend=backend)
    _, scaled = gradient_of(tripled, rendered, target, backend=backend)
    torch.testing.assert_close(scaled, 3 * plain)


def test_auto_takes_the_reference_for_float64_and_the_numba_door_refuses_it():
    rendered, target = (rgb.double() for rgb in noisy_pair(12, 12))
    assert ssim_map(rendered, target).dtype == torch.float64
    with pytest.raises(BackendError, match="float32"):
        ssim_map(rendered, target, backend="cpu")


def test_images_that_do_not_fit_are_refused():
    with pytest.raises(ShapeError, match="one size"):
        ssim_map(torch.zeros(4, 5, 3), torch.zeros(5, 4, 3))
    with pytest.raises(ShapeError, match="one weight per pixel"):
        l1_ssim_loss(torch.zeros(4, 5, 3), torch.zeros(4, 5, 3), pixel_weight=torch.ones(5, 4))
