"""Every fast backend draws what the reference draws: one suite for the CPU and for GPUs.

The CUDA backend is tried twice: on a GPU where there is one, and without gsplat's kernels, with a
stand-in for the functions that it calls (`documented_gsplat`). Triton's is interpreted where there
is no GPU, and gets fewer Gaussians.

Backends are compared by mean error: a pixel that sits on the alpha cut may fall on either side.
gsplat clamps alpha at 0.999 and not at 0.99, so no Gaussian here is that opaque.
"""

import sys
from functools import partial
from types import ModuleType, SimpleNamespace

import documented_gsplat
import pytest
import torch
from splat_drawing import TRITON

from lidarpainter_models.errors import BackendError
from lidarpainter_models.kernels import backends
from lidarpainter_models.kernels.gaussian_raster import cuda
from lidarpainter_models.kernels.gpu_packages import import_gsplat, why_no_gsplat

ON_CUDA = pytest.param(
    "cuda",
    marks=[
        pytest.mark.gpu,
        pytest.mark.skipif(why_no_gsplat() is not None, reason=str(why_no_gsplat())),
    ],
)
FAST = ["cpu", "stand-in", TRITON, ON_CUDA]
MEAN_ERROR = {"rgb": 1e-5, "depth_m": 1e-4, "alpha": 1e-5, "features": 1e-5}
GRADIENT_ERROR = {"cpu": 1e-5, "stand-in": 1e-5, "triton": 1e-5, "cuda": 1e-3}
"""Relative; gsplat's exponential is the GPU's fast one and its sums are atomic."""


@pytest.fixture(autouse=True)
def stand_in(request, monkeypatch):
    """Let the backend of tests called `stand-in` be the CUDA backend's own code on the CPU."""
    if "stand-in" not in request.node.name:
        return
    module = ModuleType(cuda.__name__)
    module.draw_view = partial(cuda.draw_with, documented_gsplat)
    monkeypatch.setitem(sys.modules, cuda.__name__, module)
    monkeypatch.setattr(backends, "available_backends", lambda _kernel: ("cuda", "reference"))


def named(backend):
    """The name that the door takes."""
    return "cuda" if backend == "stand-in" else backend


def agreeing(splats, draw, backend, **build):
    """What a backend and the reference make of the same Gaussians."""
    if backend == "triton" and build["count"]:
        build |= {"count": 40, "width_px": 40, "height_px": 24}
    inputs = splats(**build)
    inputs["opacity"] = inputs["opacity"].clamp(max=0.98)
    expected = draw(inputs, backend="reference", dtype=torch.float64)
    if backend == "cuda":
        inputs = {k: v.cuda() if torch.is_tensor(v) else v for k, v in inputs.items()}
    return draw(inputs, backend=named(backend), dtype=torch.float32), expected


@pytest.mark.parametrize("backend", FAST)
@pytest.mark.parametrize("features", [0, 1, 3])
def test_images_agree(splats, draw, backend, features):
    actual, expected = agreeing(splats, draw, backend, count=300, features=features)
    assert torch.equal(actual.image.visible.cpu(), expected.image.visible)
    for name, most in MEAN_ERROR.items():
        truth = getattr(expected.image, name).detach()
        error = (getattr(actual.image, name).detach().cpu().double() - truth).abs()
        assert truth.numel() == 0 or float(error.mean()) < most, name


@pytest.mark.parametrize("backend", FAST)
def test_gradients_agree(splats, draw, backend):
    actual, expected = agreeing(splats, draw, backend, count=250, features=2)
    for name, truth in expected.gradients.items():
        error = (actual.gradients[name].cpu() - truth).norm() / truth.norm()
        assert float(error) < GRADIENT_ERROR[backend], name
    error = (actual.absolute_gradient.cpu() - expected.absolute_gradient).norm()
    assert float(error) < GRADIENT_ERROR[backend] * float(expected.absolute_gradient.norm())


def pretend_gsplat(monkeypatch, backend):
    monkeypatch.setitem(sys.modules, "gsplat", ModuleType("gsplat"))
    monkeypatch.setitem(sys.modules, "gsplat.cuda", ModuleType("gsplat.cuda"))
    monkeypatch.setitem(sys.modules, "gsplat.cuda._backend", backend)


def test_missing_gsplat_is_told_with_the_extra_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "gsplat", None)
    with pytest.raises(BackendError, match=r"lidarpainter\[cuda\]"):
        import_gsplat()


def test_gsplat_without_kernels_and_compiler_is_told_in_one_line(monkeypatch):
    pretend_gsplat(monkeypatch, SimpleNamespace(_C=None))
    with pytest.raises(BackendError, match="no nvcc") as caught:
        import_gsplat()
    assert len(str(caught.value).splitlines()) == 1


def test_gsplat_whose_kernels_do_not_load_is_told_in_one_line(monkeypatch):
    pretend_gsplat(monkeypatch, None)
    with pytest.raises(BackendError, match="could not load or compile") as caught:
        import_gsplat()
    assert len(str(caught.value).splitlines()) == 1
