"""The Triton backend against float64 autograd, and its kernels as a GPU would get them.

Without a GPU the kernels are interpreted, by numpy and slowly: the scenes that the numba backend is
tried with take minutes here and run with the slow tests.
"""

import sys

import pytest
import torch
from gaussian_world import build_world
from machine_code import assert_fits, machine_code
from splat_drawing import TRITON, WITHOUT_TRITON, home_of, render
from splat_errors import CASES, image_errors, relative_errors

from lidarpainter_models.errors import BackendError
from lidarpainter_models.gaussians.fitting.config import DensificationConfig, FitConfig
from lidarpainter_models.gaussians.fitting.fit import fit_gaussians
from lidarpainter_models.gaussians.initialisation.settings import InitialisationConfig
from lidarpainter_models.kernels import backends, gaussian_raster, gpu_packages

IMAGE_ERROR = 1e-6
GRADIENT_ERROR = 1e-5
OPAQUE_GRADIENT_ERROR = 1.5e-5
"""As for numba: one minus an alpha near the clamp has two digits fewer. Seen are 8.9e-6."""
KERNELS = {"project", "write_keys", "blend", "entry_sums", "gaussian_sums", "unproject"}
SMALL = {
    "degree 3": {"count": 30, "coefficients": 16, "width_px": 40, "height_px": 24},
    "features, one body": {
        "count": 30,
        "coefficients": 1,
        "features": 3,
        "num_bodies": 1,
        "width_px": 33,
        "height_px": 17,
        "seed": 2,
    },
}
pytestmark = TRITON.marks
if WITHOUT_TRITON is not None:
    pytest.skip(WITHOUT_TRITON, allow_module_level=True)


def assert_agreement(splats, draw, build, most):
    inputs = splats(**build)
    expected = draw(inputs, backend="reference", dtype=torch.float64)
    actual = draw(inputs, backend="triton", dtype=torch.float32)
    assert torch.equal(actual.image.visible, expected.image.visible)
    assert max(image_errors(actual.image, expected.image).values()) < IMAGE_ERROR
    errors = relative_errors(actual.gradients, expected.gradients)
    assert max(errors.values()) < most, errors
    absolute, truth = actual.absolute_gradient, expected.absolute_gradient
    assert (absolute - truth).norm() < GRADIENT_ERROR * truth.norm()
    assert torch.equal(absolute == 0, truth == 0)


@pytest.mark.parametrize("case", SMALL)
def test_image_and_gradients_match_float64_autograd(splats, draw, case):
    assert_agreement(splats, draw, SMALL[case], GRADIENT_ERROR)


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_the_scenes_of_the_numba_backend_match_float64_autograd(splats, draw, case):
    most = OPAQUE_GRADIENT_ERROR if case == "large and opaque" else GRADIENT_ERROR
    assert_agreement(splats, draw, CASES[case], most)


def test_equal_input_gives_equal_bits(splats, draw):
    inputs = splats(15, features=1, width_px=33, height_px=17)
    first, again = (draw(inputs, backend="triton", dtype=torch.float32) for _ in range(2))
    for name in ("rgb", "depth_m", "alpha", "features"):
        assert torch.equal(getattr(first.image, name), getattr(again.image, name))
    assert all(
        torch.equal(first.gradients[name], again.gradients[name]) for name in again.gradients
    )


@pytest.mark.slow
def test_a_fit_by_triton_is_that_by_numba(monkeypatch):
    world = build_world()
    config = FitConfig(
        steps=6,
        log_every=6,
        initialisation=InitialisationConfig(num_gaussians=120, street_voxel_m=0.2),
        densification=DensificationConfig(budget=150, start=0.2, stop=0.8, every=3),
    )
    by_numba = fit_gaussians(world.observations, config, device=home_of("cpu"))
    chosen = gaussian_raster.implementation

    def by_name(kernel, function, _backend, device):
        return chosen(kernel, function, "triton", device)

    monkeypatch.setattr(gaussian_raster, "implementation", by_name)
    found = fit_gaussians(world.observations, config, device=home_of("triton"))
    assert found.history[-1]["num_gaussians"] == by_numba.history[-1]["num_gaussians"]
    expected = by_numba.scene.gaussians.columns()
    for name, value in found.scene.gaussians.columns().items():
        assert torch.allclose(value.cpu(), expected[name], atol=1e-4), name


@pytest.mark.slow
def test_every_kernel_compiles_to_machine_code_without_spilling():
    found = machine_code(90, 1, 1)
    assert set(found) == KERNELS
    assert_fits(found)


@pytest.mark.slow
@pytest.mark.parametrize("architecture", [80, 90])
@pytest.mark.parametrize(("coefficients", "features"), [(16, 0), (4, 1), (4, 2)])
def test_every_kernel_compiles_for_every_degree(architecture, coefficients, features):
    assert_fits(machine_code(architecture, coefficients, features))


def test_a_machine_without_triton_is_told_so(monkeypatch):
    monkeypatch.setitem(sys.modules, "triton", None)
    reason = gpu_packages.why_no_triton.__wrapped__()
    assert "Triton is not installed" in reason


def test_tensors_off_the_gpu_are_refused_where_nothing_is_interpreted(splats, monkeypatch):
    monkeypatch.setattr(backends, "is_interpreting", lambda: False)
    with pytest.raises(BackendError, match="needs tensors on a CUDA device"):
        render(splats(2), backend="triton")
