"""The numba backend against float64 autograd, and against itself on other thread counts."""

from concurrent.futures import ThreadPoolExecutor

import numba
import pytest
import torch
from splat_errors import CASES, image_errors, relative_errors

EPS = torch.finfo(torch.float32).eps
# The polynomial exponential is good to 6 EPS, and a pixel's sums round each of some dozen Gaussians
# once, or twice on a CPU without fused multiply-add (as `NUMBA_CPU_NAME=generic` has it). The seeds
# below hold no Gaussian that one side just cuts and the other just keeps: one such pixel in twenty
# scenes moves a gradient by 1e-4.
IMAGE_ERROR = 16 * EPS
GRADIENT_ERROR = 64 * EPS
"""Relative; seen are 3e-6 with fused multiply-add, 4e-6 without, both in the rotations."""
OPAQUE_GRADIENT_ERROR = 128 * EPS
"""Where alphas come near their clamp, 0.99. What lies behind a Gaussian is the image minus what
was passed, and counts by alpha / (1 - alpha), a hundredfold: 5.2e-6 in the rotations with fused
multiply-add, 1.1e-5 without. Put into float64 one by one, the running sums of the drawn image make
5.6e-6 of it in opacity, those of what was passed 3.3e-6, the exponential 7e-7, rounding of the
finished image 7e-7. Compensated sums of what was passed gave 4.9e-6 for a tenth of the time of
going back; of the image they would take four more sums a lane in drawing.
"""


@pytest.mark.parametrize("case", CASES)
def test_image_and_gradients_match_float64_autograd(splats, draw, case):
    inputs = splats(**CASES[case])
    expected = draw(inputs, backend="reference", dtype=torch.float64)
    actual = draw(inputs, backend="cpu", dtype=torch.float32)
    assert torch.equal(actual.image.visible, expected.image.visible)
    assert max(image_errors(actual.image, expected.image).values()) < IMAGE_ERROR
    errors = relative_errors(actual.gradients, expected.gradients)
    most = OPAQUE_GRADIENT_ERROR if case == "large and opaque" else GRADIENT_ERROR
    assert max(errors.values()) < most, errors
    absolute, truth = actual.absolute_gradient, expected.absolute_gradient
    assert (absolute - truth).norm() < GRADIENT_ERROR * truth.norm()
    assert torch.equal(absolute == 0, truth == 0)


def test_threads_and_repetition_change_no_bit(splats, draw):
    if numba.config.NUMBA_NUM_THREADS < 2:
        pytest.skip("one core")
    inputs = splats(900, features=2, size_px=8.0)
    before = numba.get_num_threads()
    drawn = []
    try:
        for threads in (1, 2, 2):
            numba.set_num_threads(threads)
            drawn.append(draw(inputs, backend="cpu", dtype=torch.float32))
    finally:
        numba.set_num_threads(before)
    for other in drawn[1:]:
        for name in ("rgb", "depth_m", "alpha", "features"):
            assert torch.equal(getattr(other.image, name), getattr(drawn[0].image, name))
        for name, gradient in drawn[0].gradients.items():
            assert torch.equal(other.gradients[name], gradient), name
        assert torch.equal(other.absolute_gradient, drawn[0].absolute_gradient)


def test_two_python_threads_may_draw_at_once(splats, draw):
    inputs = splats(200)
    expected = draw(inputs, backend="cpu", dtype=torch.float32)

    def again(_):
        return draw(inputs, backend="cpu", dtype=torch.float32)

    with ThreadPoolExecutor(2) as pool:
        for drawn in pool.map(again, range(4)):
            assert torch.equal(drawn.image.rgb, expected.image.rgb)
            assert torch.equal(drawn.gradients["means"], expected.gradients["means"])


def test_features_leave_the_other_images_as_they_are(splats, draw):
    inputs = splats(200, features=3)
    bare = inputs | {"features": torch.zeros(200, 0)}
    first = draw(inputs, backend="cpu", dtype=torch.float32).image
    second = draw(bare, backend="cpu", dtype=torch.float32).image
    assert torch.equal(first.rgb, second.rgb)
    assert torch.equal(first.alpha, second.alpha)
    assert second.features.shape == (50, 70, 0)


def test_strided_and_double_input_draws_the_same(splats, draw):
    inputs = splats(80, features=2)
    strided = {
        name: value.mT.contiguous().mT if value.ndim == 2 and value.shape[1] > 1 else value
        for name, value in inputs.items()
        if isinstance(value, torch.Tensor)
    }
    plain = draw(inputs, backend="cpu", dtype=torch.float32)
    other = draw(inputs | strided, backend="cpu", dtype=torch.float64)
    assert torch.equal(plain.image.rgb.double(), other.image.rgb.double())
    assert other.gradients["means"].dtype == torch.float64
    assert torch.allclose(plain.gradients["means"], other.gradients["means"], rtol=1e-4, atol=1e-4)
