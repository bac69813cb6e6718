"""Every fast backend draws what the reference draws: one suite for the CPU and for CUDA.

Backends are compared by mean error: a pixel that sits on the alpha cut may fall on either side.
gsplat clamps alpha at 0.999 and not at 0.99, so no Gaussian here is that opaque.
"""

import sys
from types import ModuleType, SimpleNamespace

import pytest
import torch

from lidarpainter_models.errors import BackendError
from lidarpainter_models.kernels.gaussian_raster.cuda import import_gsplat

ON_CUDA = pytest.param(
    "cuda",
    marks=[
        pytest.mark.gpu,
        pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device"),
    ],
)
FAST = ["cpu", ON_CUDA]
MEAN_ERROR = {"rgb": 1e-5, "depth_m": 1e-4, "alpha": 1e-5, "features": 1e-5}
GRADIENT_ERROR = {"cpu": 1e-5, "cuda": 1e-3}
"""Relative; gsplat's exponential is the GPU's fast one and its sums are atomic."""


def agreeing(splats, draw, backend, *, settings=None, **build):
    """What a backend and the reference make of the same Gaussians."""
    inputs = splats(**build)
    inputs["opacity"] = inputs["opacity"].clamp(max=0.98)
    expected = draw(inputs, backend="reference", dtype=torch.float64, **settings or {})
    if backend == "cuda":
        inputs = {k: v.cuda() if torch.is_tensor(v) else v for k, v in inputs.items()}
    return draw(inputs, backend=backend, dtype=torch.float32, **settings or {}), expected


@pytest.mark.parametrize("backend", FAST)
@pytest.mark.parametrize("antialias", [False, True])
@pytest.mark.parametrize("features", [0, 1, 3])
def test_pictures_agree(splats, draw, backend, antialias, features):
    settings = {"antialias": antialias}
    actual, expected = agreeing(
        splats, draw, backend, count=300, features=features, settings=settings
    )
    assert torch.equal(actual.image.visible.cpu(), expected.image.visible)
    for name, most in MEAN_ERROR.items():
        truth = getattr(expected.image, name).detach()
        error = (getattr(actual.image, name).detach().cpu().double() - truth).abs()
        assert truth.numel() == 0 or float(error.mean()) < most, name


@pytest.mark.parametrize("backend", FAST)
@pytest.mark.parametrize("antialias", [False, True])
def test_gradients_agree(splats, draw, backend, antialias):
    settings = {"antialias": antialias}
    actual, expected = agreeing(splats, draw, backend, count=250, features=2, settings=settings)
    for name, truth in expected.gradients.items():
        error = (actual.gradients[name].cpu() - truth).norm() / truth.norm()
        assert float(error) < GRADIENT_ERROR[backend], name
    error = (actual.absolute_gradient.cpu() - expected.absolute_gradient).norm()
    assert float(error) < GRADIENT_ERROR[backend] * float(expected.absolute_gradient.norm())


@pytest.mark.parametrize("backend", FAST)
def test_no_gaussian_draws_nothing(splats, draw, backend):
    actual, _ = agreeing(splats, draw, backend, count=0, features=1)
    assert float(actual.image.alpha.detach().abs().max()) == 0
    assert float(actual.gradients["camera_from_body"].abs().max()) == 0


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
